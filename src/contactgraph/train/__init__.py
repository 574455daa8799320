"""Training: loss terms, the loop, and checkpoints that survive anything."""
