"""The kernel score of two-time laws as an unbiased estimate from samples.

For a kernel k, predicted samples z_1 … z_P at the times (t_n, t_{n+ℓ}) and an observation y

    S = ½ mean_{p ≠ q} k(z_p, z_q) - mean_p k(z_p, y),

the negative of the kernel score (Gneiting and Raftery 2007, section 5; Zhang et al. 2025 for two
times). Its expectation is minimal where the predicted law equals the observed one, and differs from
half the squared maximum mean discrepancy by a constant. Pairs p = q are left out, so the estimate
is unbiased (a U-statistic; Gretton et al. 2012, eq. 3).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .kernels import Kernel


def shifts(samples: int, count: int | None = None) -> list[tuple[int, float]]:
    """Cyclic shifts s and weights, such that pairs (p, p + s) estimate the mean over p ≠ q.

    All unordered pairs occur once with s = 1 … ⌊P/2⌋, the last one with half the weight if P is
    even. A smaller `count` keeps the first shifts: still unbiased, as samples are exchangeable.

    Raises:
        ValueError: fewer than two samples.
    """
    if samples < 2:
        raise ValueError(f"samples: a score needs at least 2 predicted ones, got {samples}")
    kept = range(1, samples // 2 + 1)[: None if count is None else max(1, count)]
    weights = [(s, 0.5 if 2 * s == samples else 1.0) for s in kept]
    total = sum(w for _, w in weights)
    return [(s, w / total) for s, w in weights]


def partners(samples: Float[Array, "C L P W"], pair_shifts: int | None) -> Array:
    """The samples' partners under each cyclic shift, (C, L, S, P, W), without gather.

    The samples are repeated and reshaped to rows of P + 1: row s starts s samples later. (Slicing
    each shift takes one operation per shift, which is slow to compile.)
    """
    *lead, P, W = samples.shape
    rows = len(shifts(P, pair_shifts)) + 1
    needed = rows * (P + 1)
    repeats = -(-needed // P)
    repeated = jnp.broadcast_to(samples[..., None, :, :], (*lead, repeats, P, W))
    flat = repeated.reshape(*lead, repeats * P, W)[..., :needed, :]
    return flat.reshape(*lead, rows, P + 1, W)[..., 1:, :P, :]


def time_pairs(
    key: Array, steps: int, lags: tuple[int, ...], count: int
) -> tuple[Int[Array, " L"], Int[Array, " L"]]:
    """Pairs (n, n + ℓ) with 0 ≤ n and n + ℓ < `steps`, each equally likely given its lag ℓ.

    Index n is the n-th predicted state. Lags are used in turn. The n of one lag are drawn by
    systematic sampling (one uniform start, equal spacing), which keeps every n equally likely and
    spreads the draws over the window (Cochran 1977, chapter 8).

    Raises:
        ValueError: a lag doesn't fit into the window.
    """
    if not lags or max(lags) >= steps or min(lags) < 1:
        raise ValueError(f"lags: must lie between 1 and {steps - 1} steps, got {lags}")
    first, second = [], []
    for i, (lag, k) in enumerate(zip(lags, jax.random.split(key, len(lags)), strict=True)):
        share = len(range(i, count, len(lags)))
        choices = steps - lag
        u = jax.random.uniform(k, (1,), jnp.float32)
        position = (jnp.arange(share, dtype=jnp.float32) + u) * (choices / max(share, 1))
        n = jnp.clip(position.astype(jnp.int32), 0, choices - 1)
        first.append(n)
        second.append(n + lag)
    return jnp.concatenate(first), jnp.concatenate(second)


def kernel_score(
    kernel: Kernel,
    predicted: Float[Array, "N C P W"],
    observed: Float[Array, "N C W"],
    first: Int[Array, " L"],
    second: Int[Array, " L"],
    pair_shifts: int | None = None,
) -> Float[Array, " W"]:
    """The score S of each window's law, averaged over the time pairs (`first`, `second`).

    `predicted` holds P samples of each of W conditional laws, `observed` one sample of each; the
    kernel's bandwidths have the same time index. Half of the pairs are evaluated, as contiguous
    slices: no gather over samples.
    """
    d2_own, d2_cross = 0.0, 0.0
    for index in (first, second):
        z = jnp.moveaxis(predicted[index], 1, 0)  # (C, L, P, W)
        y = jnp.moveaxis(observed[index], 1, 0)[:, :, None]
        g = kernel.bandwidths[:, index][:, :, None, None]
        d2_cross = d2_cross + kernel.squared(z, y, g)
        d2_own = d2_own + kernel.squared(z[:, :, None], partners(z, pair_shifts), g[:, :, None])
    weight = jnp.asarray([w for _, w in shifts(predicted.shape[2], pair_shifts)], predicted.dtype)
    own = jnp.tensordot(weight, jnp.mean(kernel.value(d2_own), axis=(0, 2)), 1)
    return own / 2 - jnp.mean(kernel.value(d2_cross), axis=(0, 1))
