"""Velocities that were not measured: a simulation in their place, and the accelerometer's errors.

A plain vehicle has no DVL. Its attitude, rates and depth say nothing of surge and sway directly, an
accelerometer says how they change: over a step, with the specific force f and up e_z in B,

    v_(n+1) - v_n = ∫ (f - g e_z - ω × v) dt.

The trajectory about which a filter is linear is that of the model itself: velocities without an
instrument are simulated, and everything else is reset to the record at every sample.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ....models.effects.extended import Extended
from ..data.arrays import Data

_GRAVITY = 9.80665
_UNSURE, _LASTS = 0.2, 1.0
"""Share of an axis' wrench by which a believed model may be wrong where nothing measures it, and
for how long (s): it gives latent velocities a process noise, and the others' innovations the
uncertainty that Munk's moment and Coriolis forces make of it."""

_MOST_OF_A_STEP = 1.0
"""Largest delay of an accelerometer, and half the square of its smoothing's width (steps)."""


def levels(model: Extended, data: Data) -> dict[int, float]:
    """Assumed diffusion b (N√s) of the axes whose velocity is latent."""
    F = np.einsum("ij,njr->nir", np.asarray(model.allocate(jnp.eye(data.u.shape[1]))), data.u)
    square = (F**2 * data.weight[:, None]).sum(axis=(0, 2)) / data.weight.sum()
    least = 1e-3 * np.sqrt(square[:3].max())  # an axis that is never driven still drifts a little
    size = np.maximum(np.sqrt(square), max(least, 1e-6))
    return {i: float(_UNSURE * size[i] * np.sqrt(2 * _LASTS)) for i in data.latent}


def specific_force_errors(
    p: Any, data: Data
) -> tuple[Array, Array, Float[np.ndarray, "N 12 12 R"]]:
    """Errors and Jacobians with an accelerometer in the place of latent velocities; `carried`.

    `p` are the predictions without it. A step's mean specific force is that of its two samples.
    """
    assert data.specific_force is not None
    force = jnp.asarray((data.specific_force[1:] + data.specific_force[:-1]) / 2)
    X, V = (jnp.moveaxis(a, 0, 1) for a in p.start)  # (7, N, R), (6, N, R)
    end = jnp.moveaxis(p.V, 0, 1)
    h = jnp.asarray(data.own_steps())[None]
    middle = (V + end) / 2
    at = se3.retract(X, h / 2 * middle)
    up = se3.rotate_inverse(at, jnp.zeros_like(V[:3]).at[2].set(1.0))
    omega, v = middle[3:], middle[:3]
    f = jnp.moveaxis(force, 0, 1)
    modelled = _GRAVITY * up + se3.cross(omega, v) + (end[:3] - V[:3]) / h
    rows = np.array(data.felt)
    sampled = _as_sampled(np.asarray(f)[rows], np.asarray(modelled)[rows], data.weight)
    lacking = (h * (f - modelled)).at[rows].add(-h * sampled)
    error = p.error.at[:, 6 + rows].set(jnp.moveaxis(lacking[rows], 0, 1))
    eye = jnp.broadcast_to(jnp.eye(3)[:, :, None, None], (3, 3, *up.shape[1:]))
    H = h[None]
    before = jnp.concatenate(
        [-H * eye, -H * _GRAVITY * _skew(up), eye - H * _skew(omega), jnp.zeros_like(eye)], axis=1
    )
    carried = np.zeros((*p.error.shape[:1], 12, 12, p.error.shape[2]))
    carried[:, 6 + rows] = np.moveaxis(np.asarray(before)[rows], 2, 0)
    # a bias stays, and nothing depends on the position whose place it has
    jacobian = p.jacobian.at[:, :3].set(jnp.eye(12)[None, :3, :, None])
    return error, jacobian.at[:, 3:, :3].set(0.0), carried


def _as_sampled(
    f: Float[np.ndarray, "k N R"], modelled: Float[np.ndarray, "k N R"], weight: np.ndarray
) -> Float[np.ndarray, "k N R"]:
    """What an accelerometer's filter and sampling add to the mean of a step, as far as data tell.

    A reading is late and smoothed by a part of a step, which is not known: to second order in it,
    the first and second differences of the modelled specific force, with the coefficients that fit
    best. Otherwise a command that jumps would look like one that is answered too little.
    """
    change, bend = np.zeros(modelled.shape), np.zeros(modelled.shape)
    change[:, 1:-1] = (modelled[:, 2:] - modelled[:, :-2]) / 2
    bend[:, 1:-1] = modelled[:, 2:] - 2 * modelled[:, 1:-1] + modelled[:, :-2]
    here = weight * np.concatenate([weight[1:], weight[:1] * 0])
    parts = np.stack([change, bend]) * here
    off = (f - modelled) * here
    H = np.einsum("aknr,bknr->ab", parts, parts)
    H = H + (1e-9 * np.trace(H) + 1e-12) * np.eye(2)  # a vehicle at rest tells nothing
    both = np.linalg.solve(H, np.einsum("aknr,knr->a", parts, off))
    return np.tensordot(np.clip(np.nan_to_num(both), -_MOST_OF_A_STEP, _MOST_OF_A_STEP), parts, 1)


def specific_force(
    X: Float[np.ndarray, "M 7 R"], V: Float[np.ndarray, "M 6 R"], step: Float[np.ndarray, "N R"]
) -> Float[np.ndarray, "M 3 R"]:
    """What an accelerometer would have read along a motion, by differences (m/s²)."""
    times = np.concatenate([np.zeros((1, step.shape[1])), np.cumsum(step, axis=0)])
    rate = np.stack(
        [np.gradient(V[:, :3, r], times[:, r], axis=0) for r in range(V.shape[2])], axis=2
    )
    poses, twists = (jnp.moveaxis(jnp.asarray(a), 1, 0) for a in (X, V))
    up = se3.rotate_inverse(poses, jnp.zeros_like(poses[4:]).at[2].set(_GRAVITY))
    turned = np.asarray(up + se3.cross(twists[3:], twists[:3]))
    return rate + np.moveaxis(turned, 0, 1)


def _skew(a: Float[Array, "3 N R"]) -> Float[Array, "3 3 N R"]:
    x, y, z = a
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])
