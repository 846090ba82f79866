"""The one exception that a user's mistake raises."""


class UserError(Exception):
    """A mistake in the user's input: one clear sentence that names the file or option and what was expected.

    The command lines print it without a traceback and exit with code 2.
    """
