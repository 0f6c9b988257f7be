"""How a command ends that cannot do what it is asked to."""

# The exit code after Ctrl-C, SIGTERM or SIGHUP.
INTERRUPTED = 130


class UsageError(Exception):
    """The command's options or files are unusable; the text says how to correct them."""


class RunFailed(Exception):
    """Something that the command needs does not work; the text names it and says what to do."""
