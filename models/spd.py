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

from . import symmetric

N = 6
PACKED = N * (N + 1) // 2
"""Entries of a packed symmetric or triangular matrix: the diagonal, then below it by rows."""


def packed_index(i: int, j: int) -> int:
    """Index of entry (i, j), i ≥ j, in a packed matrix."""
    return i if i == j else N + i * (i - 1) // 2 + j


def pack(matrix: Float[Array, "6 6 *batch"]) -> Float[Array, "21 *batch"]:
    """The lower triangle of a matrix: the diagonal, then the entries below it by rows."""
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
    """A symmetric positive definite operator, which can be inverted.

    Several vectors for each batch entry have an axis ahead of the batch: (6, k, *batch).
    """

    @abc.abstractmethod
    def solve(self, y: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        """A⁻¹ y."""


class ConstantOperator(Operator):
    """One matrix for all batch entries; it need not be invertible."""

    dense: Float[Array, "6 6"]

    def matvec(self, x: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        return jnp.tensordot(self.dense, x, 1)

    def matrix(self) -> Float[Array, "6 6"]:
        return self.dense


class ConstantSpd(Spd):
    """One matrix for all batch entries, stored with its inverse."""

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


class ScaledSpd(Spd):
    """A = S B(raw) Sᵀ with a fixed S that gives the magnitudes and B of order one.

    The products with S are matrix products over the whole batch. They also prevent a fusion by the
    compiler that would recompute its inputs for each of the six components.
    """

    scale: eqx.AbstractVar[Float[Array, "6 6"]]
    unscale: eqx.AbstractVar[Float[Array, "6 6"]]

    @classmethod
    @abc.abstractmethod
    def from_raw(
        cls,
        raw: Float[Array, "21 *batch"],
        scale: Float[Array, "6 6"],
        unscale: Float[Array, "6 6"],
    ) -> "ScaledSpd":
        """The operator of 21 unconstrained (packed) numbers, S and S⁻¹; zeros give S Sᵀ."""

    @abc.abstractmethod
    def _inner_matvec(self, x: Array) -> Array: ...

    @abc.abstractmethod
    def _inner_solve(self, y: Array) -> Array: ...

    def matvec(self, x: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        return jnp.tensordot(self.scale, self._inner_matvec(jnp.tensordot(self.scale.T, x, 1)), 1)

    def solve(self, y: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        inner = self._inner_solve(jnp.tensordot(self.unscale, y, 1))
        return jnp.tensordot(self.unscale.T, inner, 1)

    def matrix(self) -> Float[Array, "6 6 *batch"]:
        batch = self._batch_shape()
        columns = [
            self.matvec(jnp.broadcast_to(e.reshape((N,) + (1,) * len(batch)), (N, *batch)))
            for e in jnp.eye(N, dtype=self.scale.dtype)
        ]
        return jnp.stack(columns, axis=1)

    @abc.abstractmethod
    def _batch_shape(self) -> tuple[int, ...]: ...


class CholeskySpd(ScaledSpd):
    """A = S L Lᵀ Sᵀ with L lower triangular and its diagonal positive."""

    diagonal: Float[Array, "6 *batch"]
    below: Float[Array, "15 *batch"]
    scale: Float[Array, "6 6"]
    unscale: Float[Array, "6 6"]

    @classmethod
    def from_raw(
        cls,
        raw: Float[Array, "21 *batch"],
        scale: Float[Array, "6 6"],
        unscale: Float[Array, "6 6"],
    ) -> "CholeskySpd":
        diagonal, below = jnp.split(raw, [N])
        return cls(squareplus(diagonal), below, scale, unscale)

    def _rows(self, like: Array) -> list[list[Array]]:
        """L as rows of entries, each an array that broadcasts against a component of `like`."""
        ahead = (1,) * (like.ndim - self.diagonal.ndim)
        diagonal = jnp.unstack(self.diagonal.reshape((N, *ahead, *self.diagonal.shape[1:])))
        below = jnp.unstack(self.below.reshape((-1, *ahead, *self.below.shape[1:])))
        return [[*below[i * (i - 1) // 2 : i * (i + 1) // 2], diagonal[i]] for i in range(N)]

    def _batch_shape(self) -> tuple[int, ...]:
        return self.diagonal.shape[1:]

    def _inner_matvec(self, x: Array) -> Array:
        L, z = self._rows(x), jnp.unstack(x)
        t = [_sum(L[i][j] * z[i] for i in range(j, N)) for j in range(N)]
        return jnp.stack([_sum(L[i][j] * t[j] for j in range(i + 1)) for i in range(N)])

    def _inner_solve(self, y: Array) -> Array:
        L, rest = self._rows(y), list(jnp.unstack(y))
        pivot = [1 / L[i][i] for i in range(N)]
        for i in range(N):
            rest[i] = rest[i] * pivot[i]
            for j in range(i + 1, N):
                rest[j] = rest[j] - L[j][i] * rest[i]
        for i in reversed(range(N)):
            rest[i] = rest[i] * pivot[i]
            for j in range(i):
                rest[j] = rest[j] - L[i][j] * rest[i]
        return jnp.stack(rest)


class EigenSpd(ScaledSpd):
    """A = S f(P) Sᵀ with P symmetric and f positive on its eigenvalues."""

    value: Float[Array, "6 6 *batch"]
    inverse: Float[Array, "6 6 *batch"]
    scale: Float[Array, "6 6"]
    unscale: Float[Array, "6 6"]

    @classmethod
    def from_raw(
        cls,
        raw: Float[Array, "21 *batch"],
        scale: Float[Array, "6 6"],
        unscale: Float[Array, "6 6"],
    ) -> "EigenSpd":
        rows = unpack_symmetric(raw)
        value, inverse = symmetric.positive(jnp.stack([jnp.stack(row) for row in rows]))
        return cls(value, inverse, scale, unscale)

    def _batch_shape(self) -> tuple[int, ...]:
        return self.value.shape[2:]

    def _inner_matvec(self, x: Array) -> Array:
        return _apply(self.value, x)

    def _inner_solve(self, y: Array) -> Array:
        return _apply(self.inverse, y)


def _apply(A: Array, x: Array) -> Array:
    A = A.reshape((N, N) + (1,) * (x.ndim + 1 - A.ndim) + A.shape[2:])
    columns = zip(jnp.unstack(A, axis=1), jnp.unstack(x), strict=True)
    return _sum(column * entry[None] for column, entry in columns)


def _sum(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)


def unpack_symmetric(packed: Float[Array, "21 *batch"]) -> list[list[Array]]:
    """The 6 x 6 nested list of a packed symmetric matrix."""
    entries = jnp.unstack(packed)
    return [[entries[packed_index(max(i, j), min(i, j))] for j in range(N)] for i in range(N)]
