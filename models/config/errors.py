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


class FieldError(UserError):
    """A value that a field of a dataclass can't take; `path` leads to it from the dataclass.

    Attributes:
        kind: name of the dataclass.
        path: names and indices, such as ("mounts", 4, "position").
        told: what was found and the remedy: "is …: give …".
    """

    def __init__(self, kind: str, path: tuple[str | int, ...], told: str):
        self.kind, self.path, self.told = kind, path, told
        where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
        super().__init__(f"{kind}{where} {told}")

    def __reduce__(self):
        """A copy for another process, which is made from the three parts."""
        return type(self), (self.kind, self.path, self.told)
