"""The logarithm of relative poses, optimised for millions of pairs.

For a unit quaternion with w = cos φ ≥ 0 (φ half the angle) log has two coefficients,

    ω = 2 f(w) u,            f = φ / sin φ,
    v = p - ½ ω × p + d(w) ω × (ω × p),   d = (1 - φ cot φ) / (4 φ²),

both analytic in w on (-1, 1], so polynomials in w give them on [0, 1] to rounding: no square root,
no arc tangent, no branch, and no 0/0 where two poses coincide or at the cut locus (Trefethen 2013,
chapter 8: with the nearest singularity at w = -1 the error falls as 5.8⁻ⁿ).
`models.se3.log` is the same function for single poses.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import chebyshev

_DEGREE = {4: 11, 8: 24}


def _f(w: np.ndarray) -> np.ndarray:
    n2 = (1 - w) * (1 + w)
    phi = np.arctan2(np.sqrt(n2), w)
    return np.where(n2 < 1e-12, 1 + n2 / 6, phi / np.sqrt(np.maximum(n2, 1e-12)))


def _d(w: np.ndarray) -> np.ndarray:
    n2 = (1 - w) * (1 + w)
    phi2 = np.maximum(np.arctan2(np.sqrt(n2), w) ** 2, 1e-30)
    series = (1 + phi2 / 15 * (1 + phi2 * 2 / 21 * (1 + phi2 / 10 * (1 + phi2 * 10 / 99)))) / 12
    return np.where(phi2 < 1e-2, series, (1 - _f(w) * w) / (4 * phi2))


def _fit(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[float]:
    """Monomial coefficients in x = 2w - 1 of the interpolant at Chebyshev points of [0, 1]."""
    x = chebyshev.chebpts1(degree + 1)
    series = chebyshev.chebfit(x, function((x + 1) / 2), degree)
    return [float(c) for c in chebyshev.cheb2poly(series)]


_F = {size: _fit(_f, degree) for size, degree in _DEGREE.items()}
_D = {size: _fit(_d, degree) for size, degree in _DEGREE.items()}


def _polynomial(coefficients: list[float], x: Array) -> Array:
    result = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        result = result * x + c
    return result


def _cross(a: list[Array], b: list[Array]) -> list[Array]:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def relative_log(X_WA: Float[Array, "7 *a"], X_WB: Float[Array, "7 *b"]) -> list[Array]:
    """The six components of log(X_WA⁻¹ X_WB), unit quaternions; the two broadcast.

    Both must have the same rank.
    """
    w, x, y, z, *p = jnp.unstack(X_WA)
    s, i, j, k, *r = jnp.unstack(X_WB)
    cosine = w * s + x * i + y * j + z * k
    sign = jnp.where(cosine < 0, -1, 1).astype(cosine.dtype)
    cosine = sign * cosine
    u = [
        sign * (w * i - x * s - y * k + z * j),
        sign * (w * j + x * k - y * s - z * i),
        sign * (w * k - x * j + y * i - z * s),
    ]
    # R_WAᵀ (r - p) = t + 2 (w a × t + a × (a × t)) with a = -(x, y, z)
    t = [b - a for a, b in zip(p, r, strict=True)]
    axis = [-x, -y, -z]
    c1 = _cross(axis, t)
    c2 = _cross(axis, c1)
    t = [t[n] + 2 * (w * c1[n] + c2[n]) for n in range(3)]
    size = cosine.dtype.itemsize
    argument = 2 * cosine - 1
    f = 2 * _polynomial(_F[size], argument)
    d = _polynomial(_D[size], argument)
    omega = [f * a for a in u]
    c1 = _cross(omega, t)
    c2 = _cross(omega, c1)
    return [t[n] - c1[n] / 2 + d * c2[n] for n in range(3)] + omega
