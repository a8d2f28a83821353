"""Rows of numbers that grow without ever being copied, for what a loop in real time notes."""

import numpy as np
from jaxtyping import Float

_BLOCK = 1024
"""Rows that are allocated at once."""


class GrowingRows:
    """A table of numbers to which rows are added, kept in blocks.

    A list of objects would grow as well, but the garbage collector would look through all of them
    again and again.

    Example:
        >>> rows = GrowingRows(3)
        >>> rows.new()[:] = 0.5, 1.0, 1.0
        >>> len(rows), rows[0].tolist(), rows.since(1).shape
        (1, [0.5, 1.0, 1.0], (0, 3))
    """

    def __init__(self, size: int):
        self._size, self._count = size, 0
        self._blocks: list[Float[np.ndarray, "b size"]] = []

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: int) -> Float[np.ndarray, " size"]:
        if not -self._count <= k < self._count:
            raise IndexError(f"row {k} of {self._count}")
        block, at = divmod(k % self._count, _BLOCK)
        return self._blocks[block][at]

    def new(self) -> Float[np.ndarray, " size"]:
        """Add a row, to be filled by the caller."""
        at = self._count % _BLOCK
        if at == 0:
            self._blocks.append(np.empty((_BLOCK, self._size)))
        self._count += 1
        return self._blocks[-1][at]

    def since(self, first: int = 0) -> Float[np.ndarray, "n size"]:
        """The rows from `first` on."""
        start = first // _BLOCK
        kept = self._blocks[start:]
        if not kept:
            return np.zeros((0, self._size))
        whole = kept[0] if len(kept) == 1 else np.concatenate(kept)
        return whole[first - start * _BLOCK : self._count - start * _BLOCK]
