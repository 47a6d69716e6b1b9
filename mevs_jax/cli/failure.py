"""The error of a command whose input cannot be used."""


class Unusable(ValueError):
    """Ends a command with its message, one sentence, and exit code 2."""
