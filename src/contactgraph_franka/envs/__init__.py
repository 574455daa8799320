"""The arm's pickup. `arm_world`, `arm_model` and `arm_picture` import MuJoCo, the rest does not."""
