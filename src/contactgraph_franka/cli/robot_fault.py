"""What went wrong with a robot, and is nobody's mistake."""


class RobotFault(Exception):
    """The message is one line for the user; the command line exits with code 1."""
