"""The command line: one command a file; `contactgraph.cli.main` parses and runs them."""


class CommandError(Exception):
    """A fault that is not the user's mistake: one line on stderr, exit code 1."""
