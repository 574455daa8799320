"""Bodies as a graph: their shapes, where and when they meet, and messages along edges."""
