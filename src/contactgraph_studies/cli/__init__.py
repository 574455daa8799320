"""The command `contactgraph reproduce`."""
