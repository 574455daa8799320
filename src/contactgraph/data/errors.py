"""The one exception for a mistake of the user's: bad files, bad arguments, unfit parts."""


class InvalidInputError(ValueError):
    """Input that cannot be used.

    The message is one line that says what was found, where (file, trajectory, field or argument),
    and what would be valid. The command line prints it and exits with code 2.
    """
