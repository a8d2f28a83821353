"""Eigenvalues and positive functions of symmetric 6 x 6 matrices, batched, samples last.

Cyclic Jacobi in elementwise arithmetic: each of a sweep's five rounds rotates three disjoint pairs
of indices at once, so that a sweep covers all fifteen (Golub and Van Loan 2013, section 8.5; Brent
and Luk 1985 for the order). The derivative of a matrix function is Daleckii and Krein's (1965)
formula, which is finite at equal eigenvalues; that of single eigenvectors is not.
"""

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_N = 6
_NEXT = (0, 3, 1, 5, 2, 4)
"""Round-robin permutation of the indices after a round; its fifth power is the identity."""


def jacobi(
    A: Float[Array, "6 6 *batch"], sweeps: int | None = None
) -> tuple[Float[Array, "6 *batch"], Float[Array, "6 6 *batch"]]:
    """Eigenvalues w (unordered) and orthonormal eigenvectors, the columns of Q: A = Q diag(w) Qᵀ.

    Convergence is quadratic; 5 sweeps reach float32 precision and 6 float64 precision.
    """
    sweeps = (6 if A.dtype == jnp.float64 else 5) if sweeps is None else sweeps
    eye = jnp.eye(_N, dtype=A.dtype).reshape((_N, _N) + (1,) * (A.ndim - 2))

    def turn(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        A, Q = state
        c, s = _rotations(A)
        A = _rotate_columns(_rotate_columns(A, c, s).swapaxes(0, 1), c, s)
        return _move(_move(A).swapaxes(0, 1)), _move(_rotate_columns(Q, c, s))

    A, Q = jax.lax.fori_loop(0, 5 * sweeps, turn, (A, jnp.broadcast_to(eye, A.shape)))
    return jnp.stack([A[i, i] for i in range(_N)]), Q


def _rotations(A: Array) -> tuple[Array, Array]:
    """Cosines and sines (3, *batch) that zero entries (0, 1), (2, 3) and (4, 5)."""
    p, q = (0, 2, 4), (1, 3, 5)
    gap = jnp.stack([A[j, j] - A[i, i] for i, j in zip(p, q, strict=True)])
    off = 2 * jnp.stack([A[i, j] for i, j in zip(p, q, strict=True)])
    reach = jnp.abs(gap) + jnp.sqrt(gap * gap + off * off)
    t = jnp.where(gap < 0, -off, off) / jnp.where(reach > 0, reach, 1)
    c = jax.lax.rsqrt(1 + t * t)
    return c, t * c


def _rotate_columns(A: Array, c: Array, s: Array) -> Array:
    """A J with J the product of the three plane rotations."""
    columns = A.reshape((_N, 3, 2, *A.shape[2:]))
    a, b = columns[:, :, 0], columns[:, :, 1]
    c, s = c[None], s[None]
    return jnp.stack([c * a - s * b, s * a + c * b], axis=2).reshape(A.shape)


def _move(A: Array) -> Array:
    return jnp.stack([A[:, j] for j in _NEXT], axis=1)


def _product(A: Array, B: Array) -> Array:
    """A B, component first."""
    columns, rows = jnp.unstack(A, axis=1), jnp.unstack(B)
    return functools.reduce(
        operator.add, (a[:, None] * b[None] for a, b in zip(columns, rows, strict=True))
    )


@jax.custom_jvp
def positive(
    A: Float[Array, "6 6 *batch"],
) -> tuple[Float[Array, "6 6 *batch"], Float[Array, "6 6 *batch"]]:
    """f(A) and f(A)⁻¹ for f(w) = (w + √(w² + 4)) / 2, which maps eigenvalues to positive ones.

    f(0) = 1 and 1 / f(w) = f(-w). First derivatives are exact for every A; for second derivatives
    use the Cholesky form.
    """
    return _positive(A)[0]


def _positive(A: Array) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
    w, Q = jacobi(A)
    root = jnp.sqrt(w * w + 4)
    small = 2 / (jnp.abs(w) + root)
    up = jnp.where(w < 0, small, (w + root) / 2)
    down = jnp.where(w < 0, (root - w) / 2, small)
    Qt = Q.swapaxes(0, 1)
    return (_product(Q * up[None], Qt), _product(Q * down[None], Qt)), (w, root, Q)


@positive.defjvp
def _positive_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Along dA: Q (Γ ∘ Qᵀ dA Q) Qᵀ with Γ_ij = (f(w_i) - f(w_j)) / (w_i - w_j).

    For this f the quotient is (1 + (w_i + w_j) / (r_i + r_j)) / 2 with r = √(w² + 4).
    """
    values, (w, root, Q) = _positive(*primals)
    slope = (w[:, None] + w[None]) / (root[:, None] + root[None])
    Qt = Q.swapaxes(0, 1)
    inner = _product(_product(Qt, tangents[0]), Q) / 2
    up = _product(_product(Q, (1 + slope) * inner), Qt)
    down = _product(_product(Q, (slope - 1) * inner), Qt)
    return values, (up, down)
