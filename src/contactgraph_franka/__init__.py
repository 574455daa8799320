"""A Franka arm for contactgraph: simulation, driver, perception, control loop and commands."""
