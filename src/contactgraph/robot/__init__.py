"""The path to a real arm: the robot contract, its safety limits and its driver."""
