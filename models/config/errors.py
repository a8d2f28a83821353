"""The exception for bad input; its message names the fault and the remedy."""


class UserError(ValueError):
    """Bad input from outside (file, option, data); the command line prints it and exits with 2.

    Example:
        >>> try:
        ...     load_vehicle("heavy")
        ... except UserError as error:
        ...     print(str(error).partition(";")[0])
        vehicle `heavy` is no preset
    """
