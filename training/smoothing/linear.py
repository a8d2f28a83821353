"""A Kalman filter and its smoother for one linear problem, with the likelihood's slopes.

The backward pass is that of Bryson and Frazier in the form of de Jong (1989, "Smoothing and
interpolation with the state-space model"): it inverts innovation covariances alone. Its adjoints
also give the slopes of the likelihood in the variances of process and measurements (Koopman and
Shephard 1992, "Exact score for time series models in state space form").
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .states import MEASUREMENTS, SIZE, Linear


class Smoothed(NamedTuple):
    """Errors of the reference for one run: means and covariances.

    Attributes:
        filtered, filtered_cov: given the measurements until then.
        mean, cov: given all of them.
        process: sums of r_i² and N_ii along the columns of `ways`: variances of the process times
            the ratio of the two are a fixed point at maximum likelihood.
        noise: the same for the measurements.
        fit: log likelihood, up to a constant.
    """

    filtered: Float[Array, "N 46"]
    filtered_cov: Float[Array, "N 46 46"]
    mean: Float[Array, "N 46"]
    cov: Float[Array, "N 46 46"]
    process: Float[Array, "2 k"]
    noise: Float[Array, "2 16"]
    fit: Float[Array, ""]


def smooth(
    linear: Linear,
    known: Float[Array, "N 16"],
    lasts: Float[Array, " N"],
    start: tuple[Float[Array, "46"], Float[Array, "46 46"]],
    R: Float[Array, "16"],
    ways: Float[Array, "46 k"],
    q: Float[Array, " k"],
    kinematic: Float[Array, "46"],
) -> Smoothed:
    """Filter and smooth one run.

    The process noise of a step is ways diag(q) waysᵀ + diag(kinematic); R holds the variances of
    the measurements. `known` and `lasts` are 1 where a measurement and a next sample exist.
    """
    eye = jnp.eye(SIZE, dtype=R.dtype)
    Q = (ways * q[None]) @ ways.T + jnp.diag(kinematic)

    def forward(carry: Any, given: Any) -> Any:
        mean, P = carry
        A, c, H, y, there, lasting = given
        variance = jnp.where(there > 0, R, 1.0)
        e = y - H @ mean
        PH = P @ H.T
        S = H @ PH + jnp.diag(variance)
        factor = jax.scipy.linalg.cho_factor(S, lower=True)
        inverse = jax.scipy.linalg.cho_solve(factor, jnp.eye(MEASUREMENTS, dtype=S.dtype))
        K = PH @ inverse
        L = eye - K @ H
        now = mean + K @ e
        P_now = L @ P @ L.T + (K * variance[None]) @ K.T
        P_now = (P_now + P_now.T) / 2
        fit = -jnp.sum(jnp.log(jnp.diag(factor[0]))) - e @ inverse @ e / 2
        after = A @ now + c, A @ P_now @ A.T + lasting * Q
        return after, (mean, P, now, P_now, e, inverse, K, L, fit)

    given = (*linear, known, lasts)
    _, (mean, P, now, P_now, e, inverse, K, L, fit) = jax.lax.scan(forward, start, given)

    def backward(carry: Any, given: Any) -> Any:
        r, N = carry  # of the next sample before its measurement
        A, H, e, inverse, K, L, there, lasting = given
        process = lasting * jnp.stack([(ways.T @ r) ** 2, jnp.sum(ways * (N @ ways), axis=0)])
        r, N = A.T @ r, A.T @ N @ A
        u, D = inverse @ e - K.T @ r, inverse + K.T @ N @ K
        noise = there[None] * jnp.stack([u * u, jnp.diag(D)])
        r, N = H.T @ (inverse @ e) + L.T @ r, H.T @ inverse @ H + L.T @ N @ L
        return (r, N), (r, N, process, noise)

    end = jnp.zeros(SIZE, R.dtype), jnp.zeros_like(eye)
    given = (linear.A, linear.H, e, inverse, K, L, known, lasts)
    _, (r, N, process, noise) = jax.lax.scan(backward, end, given, reverse=True)
    cov = P - P @ N @ P
    smoothed = mean + jnp.einsum("nij,nj->ni", P, r), (cov + jnp.swapaxes(cov, 1, 2)) / 2
    return Smoothed(now, P_now, *smoothed, *(jnp.sum(a, axis=0) for a in (process, noise, fit)))
