"""Errors shown to users; their messages say what was expected, what was given, and what to do."""


class InputError(ValueError):
    """The user's input cannot be used; the message is self-contained.

    The CLI prints the message and exits with status 2, without a traceback.
    """


class ShardError(InputError):
    """A view shard is missing, incomplete or not of this format."""


class ConfigError(InputError):
    """A run's settings cannot be read."""


class InputWarning(UserWarning):
    """A warning about the user's input; commands print the sentence and go on."""
