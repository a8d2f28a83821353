"""Symmetric positive definite 6 x 6 operators, in plain arithmetic that batches with samples last.

Library factorisations of many small matrices are slow on a CPU and batched `eigh` can hang XLA
there; every operation below is elementwise arithmetic instead.
"""

import abc
import functools
import operator
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import se3, symmetric

N = 6
PACKED = N * (N + 1) // 2
"""Numbers of a packed symmetric or triangular matrix: the diagonal, then below it by rows."""


def packed_index(i: int, j: int) -> int:
    """Where entry (i, j), i ≥ j, of a packed matrix stands."""
    return i if i == j else N + i * (i - 1) // 2 + j


def pack(matrix: Float[Array, "6 6 *batch"]) -> Float[Array, "21 *batch"]:
    """The lower triangle of a matrix: the diagonal, then what is below it by rows."""
    rows = [*range(N), *(i for i in range(N) for _ in range(i))]
    columns = [*range(N), *(j for i in range(N) for j in range(i))]
    return matrix[jnp.asarray(rows), jnp.asarray(columns)]


def squareplus(x: Array) -> Array:
    """The smooth positive function (x + √(x² + 4)) / 2, which is 1 at 0 (Barron 2021).

    The branch below zero is its reciprocal form, which loses no digit to cancellation.
    """
    root = jnp.sqrt(x * x + 4)
    return jnp.where(x < 0, 2 / (root - x), (x + root) / 2)


class Operator(eqx.Module):
    """A linear operator A on R⁶, one for each batch entry."""

    @abc.abstractmethod
    def matvec(self, x: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        """A x."""

    @abc.abstractmethod
    def matrix(self) -> Float[Array, "6 6 *#batch"]:
        """The dense matrices."""


class Spd(Operator):
    """A symmetric positive definite operator, which can be inverted."""

    @abc.abstractmethod
    def solve(self, y: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        """A⁻¹ y."""


class ConstantOperator(Operator):
    """One matrix for all batch entries, which need not be invertible."""

    dense: Float[Array, "6 6"]

    def matvec(self, x: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        return jnp.tensordot(self.dense, x, 1)

    def matrix(self) -> Float[Array, "6 6"]:
        return self.dense


class ConstantSpd(Spd):
    """One matrix for all batch entries, held with its inverse."""

    dense: Float[Array, "6 6"]
    inverse: Float[Array, "6 6"]

    def __init__(self, dense: Float[Array, "6 6"], inverse: Float[Array, "6 6"] | None = None):
        self.dense = dense
        self.inverse = jnp.linalg.inv(dense) if inverse is None else inverse

    def matvec(self, x: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        return jnp.tensordot(self.dense, x, 1)

    def solve(self, y: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        return jnp.tensordot(self.inverse, y, 1)

    def matrix(self) -> Float[Array, "6 6"]:
        return self.dense


class CholeskySpd(Spd):
    """A = S L Lᵀ S with L lower triangular (positive diagonal) and S = diag(scale)."""

    diagonal: Float[Array, "6 *batch"]
    below: Float[Array, "15 *batch"]
    scale: Float[Array, "6"]

    @classmethod
    def from_raw(cls, raw: Float[Array, "21 *batch"], scale: Float[Array, "6"]) -> "CholeskySpd":
        """The operator of 21 unconstrained numbers (packed L); zeros give S²."""
        diagonal, below = jnp.split(raw, [N])
        return cls(squareplus(diagonal), below, scale)

    def _rows(self) -> list[list[Array]]:
        """L as rows of entries, each an array over the batch."""
        diagonal, below = jnp.unstack(self.diagonal), jnp.unstack(self.below)
        return [[*below[i * (i - 1) // 2 : i * (i + 1) // 2], diagonal[i]] for i in range(N)]

    def matvec(self, x: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        L, s = self._rows(), jnp.unstack(self.scale)
        z = [a * b for a, b in zip(s, jnp.unstack(x), strict=True)]
        t = [_sum(L[i][j] * z[i] for i in range(j, N)) for j in range(N)]
        return jnp.stack([s[i] * _sum(L[i][j] * t[j] for j in range(i + 1)) for i in range(N)])

    def solve(self, y: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        L, s = self._rows(), jnp.unstack(self.scale)
        pivot = [1 / L[i][i] for i in range(N)]
        rest = [a / b for a, b in zip(jnp.unstack(y), s, strict=True)]
        for i in range(N):
            rest[i] = rest[i] * pivot[i]
            for j in range(i + 1, N):
                rest[j] = rest[j] - L[j][i] * rest[i]
        for i in reversed(range(N)):
            rest[i] = rest[i] * pivot[i]
            for j in range(i):
                rest[j] = rest[j] - L[i][j] * rest[i]
        return jnp.stack([a / b for a, b in zip(rest, s, strict=True)])

    def matrix(self) -> Float[Array, "6 6 *batch"]:
        L, s = self._rows(), jnp.unstack(self.scale)
        rows = [
            [s[i] * s[j] * _sum(L[i][k] * L[j][k] for k in range(min(i, j) + 1)) for j in range(N)]
            for i in range(N)
        ]
        return jnp.stack([jnp.stack(row) for row in rows])


class EigenSpd(Spd):
    """A = S f(P) S with P symmetric, f positive on its eigenvalues and S = diag(scale)."""

    value: Float[Array, "6 6 *batch"]
    inverse: Float[Array, "6 6 *batch"]
    scale: Float[Array, "6"]

    @classmethod
    def from_raw(cls, raw: Float[Array, "21 *batch"], scale: Float[Array, "6"]) -> "EigenSpd":
        """The operator of 21 unconstrained numbers (packed P); zeros give S²."""
        rows = unpack_symmetric(raw)
        value, inverse = symmetric.positive(jnp.stack([jnp.stack(row) for row in rows]))
        return cls(value, inverse, scale)

    def matvec(self, x: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        s, x = se3.align(self.scale, x)
        return s * _apply(self.value, s * x)

    def solve(self, y: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        s, y = se3.align(self.scale, y)
        return _apply(self.inverse, y / s) / s

    def matrix(self) -> Float[Array, "6 6 *batch"]:
        s = self.scale.reshape((N,) + (1,) * (self.value.ndim - 2))
        return s[:, None] * s[None] * self.value


def _apply(A: Array, x: Array) -> Array:
    columns = zip(jnp.unstack(A, axis=1), jnp.unstack(x), strict=True)
    return _sum(column * entry[None] for column, entry in columns)


def _sum(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)


def unpack_symmetric(packed: Float[Array, "21 *batch"]) -> list[list[Array]]:
    """The 6 x 6 nested list of a packed symmetric matrix."""
    entries = jnp.unstack(packed)
    return [[entries[packed_index(max(i, j), min(i, j))] for j in range(N)] for i in range(N)]
