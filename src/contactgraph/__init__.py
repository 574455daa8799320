"""contactgraph: learn which objects touch when, and control through contact."""

__version__ = "0.1.0"
