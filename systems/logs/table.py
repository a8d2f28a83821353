"""Columns of one kind of message of a log; implausibly large numbers become NaN."""

import numpy as np

from ...models.config.errors import UserError

_LARGEST = 1e18
"""Squares of smaller numbers are finite in single precision; clocks in µs stay below it."""


class Table(dict[str, np.ndarray]):
    """Columns by name, with one entry per message; `name` is that of the message.

    Raises:
        UserError: on access to a column that the messages lack.
    """

    def __init__(self, name: str, columns: dict[str, np.ndarray] | None = None):
        super().__init__(columns or {})
        self.name = name

    def __missing__(self, column: str) -> np.ndarray:
        raise UserError(
            f"message {self.name} lacks the field {column!r}, so this is no log of an ArduPilot "
            "version that is known (4.0 to 4.6)"
        )

    def rows(self, which: np.ndarray) -> "Table":
        """The messages selected by indices or a boolean mask."""
        return Table(self.name, {column: values[which] for column, values in self.items()})


def whole(values: np.ndarray) -> np.ndarray:
    """Flags, modes or indices as int64; 0 where they are NaN."""
    return np.nan_to_num(values, nan=0.0).astype(np.int64)


def numbers(values: np.ndarray) -> np.ndarray:
    """The values in float64; NaN where they are infinite or so large that they must be corrupt."""
    with np.errstate(invalid="ignore"):  # a damaged number may signal when it is converted
        wide = values.astype(np.float64)
    wide[~(np.abs(wide) < _LARGEST)] = np.nan
    return wide
