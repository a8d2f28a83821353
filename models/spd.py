"""Symmetric positive definite 6 x 6 operators, in plain arithmetic that batches with samples last.

Library factorisations of many small matrices are slow on a CPU and batched `eigh` can hang XLA
there; every operation below is unrolled elementwise arithmetic instead.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

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
        return cls(squareplus(raw[:N]), raw[N:], scale)

    def _L(self, i: int, j: int) -> Array:
        return self.diagonal[i] if i == j else self.below[packed_index(i, j) - N]

    def matvec(self, x: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        s = self.scale
        z = [s[i] * x[i] for i in range(N)]
        t = [sum(self._L(i, j) * z[i] for i in range(j, N)) for j in range(N)]
        y = [s[i] * sum(self._L(i, j) * t[j] for j in range(i + 1)) for i in range(N)]
        return jnp.stack([jnp.asarray(c) for c in y])

    def solve(self, y: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        s = self.scale
        pivot = [1 / self._L(i, i) for i in range(N)]
        t: list[Array] = []
        for i in range(N):
            rest = y[i] / s[i]
            for j in range(i):
                rest = rest - self._L(i, j) * t[j]
            t.append(rest * pivot[i])
        x: list[Array] = [t[0]] * N
        for i in reversed(range(N)):
            rest = t[i]
            for j in range(i + 1, N):
                rest = rest - self._L(j, i) * x[j]
            x[i] = rest * pivot[i]
        return jnp.stack([x[i] / s[i] for i in range(N)])

    def matrix(self) -> Float[Array, "6 6 *#batch"]:
        s = self.scale
        rows = [
            [
                s[i] * s[j] * sum(self._L(i, k) * self._L(j, k) for k in range(min(i, j) + 1))
                for j in range(N)
            ]
            for i in range(N)
        ]
        return jnp.stack([jnp.stack([jnp.asarray(c) for c in row]) for row in rows])


def unpack_symmetric(packed: Float[Array, "21 *batch"]) -> list[list[Array]]:
    """The 6 x 6 nested list of a packed symmetric matrix."""
    return [[packed[packed_index(max(i, j), min(i, j))] for j in range(N)] for i in range(N)]
