"""Exceptions that end a command early, each with a message of one sentence and an exit code."""

DIVERGED, OUT_OF_MEMORY, DISK_FULL = 3, 4, 5  # exit codes by which scripts tell these errors from user mistakes


class UserError(Exception):
    """A mistake in the user's input: one clear sentence that names the file or option and what was expected.

    The command lines print it without a traceback and exit with its code.

    Attributes:
        code: exit code: 2, or one of the constants above.
    """

    def __init__(self, message: str, code: int = 2):
        super().__init__(message)
        self.code = code


class Interrupted(Exception):  # noqa: N818  (not an error)
    """A signal has stopped the command and no work is lost: one sentence that says how to continue.

    Attributes:
        code: exit code: 128 plus the signal's number, as in shells.
    """

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code
