"""The one exception that means: the input is at fault and this sentence says how to mend it."""


class UserError(ValueError):
    """Bad input from outside (file, option, data); the command line prints it and exits with 2."""
