"""What ends a command before its end, by one sentence and an exit code."""

DIVERGED, OUT_OF_MEMORY, DISK_FULL = 3, 4, 5  # exit codes of errors that a script may want to tell from mistakes


class UserError(Exception):
    """A mistake in the user's input: one clear sentence that names the file or option and what was expected.

    The command lines print it without a traceback and exit with its code.

    Attributes:
        code: exit code, 2 unless one of those above says more.
    """

    def __init__(self, message: str, code: int = 2):
        super().__init__(message)
        self.code = code


class Interrupted(Exception):  # noqa: N818  (it is no error)
    """A signal has stopped the command, and nothing is lost: one sentence that says how to go on.

    Attributes:
        code: exit code, 128 and the number of the signal, as shells have it.
    """

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code
