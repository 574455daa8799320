"""Planning and control: quadratic costs, LQR, iLQR and MPC."""
