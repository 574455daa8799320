"""The study of learned costs: the paper's fourth question."""
