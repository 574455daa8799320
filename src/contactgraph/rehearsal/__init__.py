"""Everything of a real arm but the arm: a tagged block, a camera that renders it."""
