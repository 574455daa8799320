"""What the command line can do: one file a command, each a flat dataclass with ``run``."""
