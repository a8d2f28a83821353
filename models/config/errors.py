"""The exception for bad input; its message names the fault and the remedy."""


class UserError(ValueError):
    """Bad input from outside (file, option, data); the command line prints it and exits with 2."""
