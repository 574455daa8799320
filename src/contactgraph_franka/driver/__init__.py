"""Driver of a Franka arm and its gripper over the maker's client, and impedance control."""
