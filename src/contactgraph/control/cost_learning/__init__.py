"""Learning a quadratic cost from demonstrations through a differentiable LQR."""
