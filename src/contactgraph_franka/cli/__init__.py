"""Commands of the arm: ``contactgraph robot``."""
