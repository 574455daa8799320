"""The arm's pickup. `franka_task`, `arm_world` and `arm_model` need MuJoCo, the rest does not."""
