"""Inference of the contact graph: which edges will be active, and what was seen of them."""
