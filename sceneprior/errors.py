"""The errors a user meets: a sentence that says what was expected, what came, and what to do."""


class InputError(ValueError):
    """What the user gave cannot be used; the message is the whole story.

    The CLI prints the message and exits with status 2, without a traceback.
    """


class ShardError(InputError):
    """A view shard is missing, incomplete or not of this format."""


class ConfigError(InputError):
    """A run's settings cannot be read."""
