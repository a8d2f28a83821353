"""Compiled parts of the completion: a Gauss-Newton step of the paths of some runs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from .linear import Smoothed, smooth
from .states import SCALES, SIZE, TWIST, Linear, Scaled, State, Track, linearised, moved

_SEQUENTIAL = {
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    "xla_cpu_multi_thread_eigen": False,
}
"""Kernels one after the other in the calling thread. They are small; and with a pool of threads XLA
waits for ever in the program of a model with effects (jaxlib 0.10, two cores)."""


class Pass(eqx.Module):
    """What one Gauss-Newton step of some runs returns: errors of its reference, and sums.

    Attributes:
        mean: of the smoothed errors, and `across` their covariance with the scales.
        cov: of smoothed pose and twist.
        now, now_cov: filtered twists, then scales, and their covariance.
        own: mean and covariance of the scales by each run alone.
        process, noise, fit: as in `Smoothed`, summed.
    """

    mean: Float[Array, "R N 46"]
    across: Float[Array, "R N 46 22"]
    cov: Float[Array, "R N 12 12"]
    now: Float[Array, "R N 28"]
    now_cov: Float[Array, "R N 28 28"]
    own: tuple[Float[Array, "R 22"], Float[Array, "R 22 22"]]
    process: Float[Array, "2 k"]
    noise: Float[Array, "2 16"]
    fit: Float[Array, ""]


@eqx.filter_jit(compiler_options=_SEQUENTIAL)  # pyright: ignore[reportCallIssue]
def smooth_runs(
    model: Scaled,
    reference: State,
    prior: State,
    P_0: Array,
    track: Track,
    noise: tuple[Array, Array, Array, Array],
    dt: Array,
    substeps: int,
) -> Pass:
    """Linearise about a reference and smooth."""
    linear: Linear = linearised(model, reference, track, dt, substeps)
    first = jax.tree.map(lambda a: a[:, 0], reference)
    ahead = jax.vmap(_difference)(first, prior)
    R, ways, q, kinematic = noise
    number = jnp.asarray(track.known, R.dtype), jnp.asarray(track.lasts, R.dtype)

    def one(linear: Linear, known: Array, lasts: Array, mean: Array, P: Array) -> Smoothed:
        return smooth(linear, known, lasts, (mean, P), R, ways, q, kinematic)

    s = jax.vmap(one)(linear, *number, ahead, P_0)
    kept = np.r_[TWIST, SCALES]
    return Pass(
        s.mean,
        s.cov[..., SCALES],
        s.cov[..., :12, :12],
        s.filtered[..., kept],
        s.filtered_cov[..., kept[:, None], kept[None]],
        (s.mean[:, 0, SCALES], s.cov[:, 0, SCALES, SCALES]),
        *(jnp.sum(a, axis=0) for a in (s.process, s.noise, s.fit)),
    )


@jax.jit
def given_scales(reference: State, found: Pass, shift: Array, share: Array) -> State:
    """The reference moved by a share of the smoothed errors, given a common error of the scales."""
    gain = found.across @ jnp.linalg.inv(found.own[1])[:, None]
    mean = found.mean + jnp.einsum("rnij,rj->rni", gain, shift[None] - found.own[0])
    mean = mean.at[..., SCALES].set(jnp.broadcast_to(shift, mean[..., SCALES].shape))
    return jax.vmap(jax.vmap(moved))(reference, share * mean)


@jax.jit
def final_covariances(found: Pass, shift: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Given the common scales: covariance of smoothed pose and twist, filtered twists (as errors of
    the reference) and their covariance.
    """
    gain = found.across[..., :12, :] @ jnp.linalg.inv(found.own[1])[:, None]
    less = jnp.einsum("rnij,rjk,rnlk->rnil", gain, found.own[1] - cov[None], gain)
    known = found.now_cov[..., 6:, 6:]
    now_gain = found.now_cov[..., :6, 6:] @ jnp.linalg.inv(known)
    now_less = jnp.einsum("rnij,rnjk,rnlk->rnil", now_gain, known - cov[None, None], now_gain)
    off = shift[None, None] - found.now[..., 6:]
    now = found.now[..., :6] + jnp.einsum("rnij,rnj->rni", now_gain, off)
    return found.cov - less, now, found.now_cov[..., :6, :6] - now_less


def _difference(a: State, b: State) -> Array:
    """The error of b from a."""
    return jnp.concatenate([se3.local(a.X, b.X), b.V - a.V, b.others - a.others])


@eqx.filter_jit(compiler_options=_SEQUENTIAL)  # pyright: ignore[reportCallIssue]
def imposed(
    model: Scaled, X: Array, V: Array, known: Array, F: Array, dt: Array, substeps: int
) -> tuple[Array, Array]:
    """Motion of the model with recorded channels set to what was recorded: the first reference."""
    zero = jnp.zeros(SIZE - 12, F.dtype)

    def run(X: Array, V: Array, known: Array, F: Array) -> tuple[Array, Array]:
        def step(carry: Any, given: Any) -> Any:
            X, V = carry
            X_seen, V_seen, there, F = given
            X = jnp.concatenate([X_seen[:4], jnp.where(there[:3], X_seen[4:], X[4:])])
            V = jnp.where(there[3:], V_seen, V)
            return model.advance(State(X, V, zero), F, dt, substeps), (X, V)

        start = X[0].at[4:].set(0.0), jnp.zeros(6, F.dtype)
        return jax.lax.scan(step, start, (X, V, known, F))[1]

    return jax.vmap(run)(X, V, known, F)
