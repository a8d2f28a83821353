"""Measurements of a recording's runs, as arrays side by side."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.effects.recorded_rollout import Commands, actuated
from ...models.integrate import over_substeps
from ...models.recordings.store import Recording
from ..data.behind_filter import with_rises, wrench_rise
from .states import Track


def track_of(
    recording: Recording, vehicle: Any, model: Dynamics, substeps: int
) -> tuple[Track, list[tuple[int, int]], np.ndarray, np.ndarray, np.ndarray]:
    """Measurements of all runs, where they stand, and what of pose and twist was recorded."""
    data, lengths = recording.dataset, recording.lengths
    places = [(int(j), int(k)) for j, k in np.argwhere(lengths > 0)]
    N = _padded(int(lengths.max()))
    driving = _driving(recording, vehicle, model, substeps)

    def of(name: str, size: int) -> np.ndarray:
        """A variable, each run's last sample repeated; NaN where there is none."""
        found = np.full((len(places), N, size), np.nan)
        if name in data:
            values = data[name].to_numpy()
            values = values if values.ndim == 4 else values[..., None]
            for i, (j, k) in enumerate(places):
                found[i] = values[j, k, np.minimum(np.arange(N), lengths[j, k] - 1)]
        return found

    X, V, depth = of("X_WB", 7), of("V_WB_B", 6), of("pressure_depth", 1)
    climb, force = of("vertical_velocity", 1), of("imu_specific_force", 3)
    z = X[..., 6:]
    X[..., 6:] = np.where(np.isfinite(z).any(axis=1, keepdims=True), z, -depth)
    seen = np.concatenate([X[..., 4:], np.zeros((*X.shape[:2], 3)), V, climb, force], axis=-1)
    inside = np.arange(N) < np.array([lengths[p] for p in places])[:, None]
    known: np.ndarray = np.isfinite(seen) & inside[..., None]
    # w of a log without u and v is the climb with them taken as zero: the climb itself is used
    derived = known[..., 12] & ~known[..., 6:8].all(axis=-1)
    known[..., 8] &= ~derived
    seen = np.where(known, seen, 0.0)
    lasts = np.concatenate([inside[:, 1:], np.zeros((len(places), 1), bool)], axis=1)
    F = np.stack([driving[j, k, np.minimum(np.arange(N), lengths[j, k] - 1)] for j, k in places])
    own = np.all(np.isfinite(np.concatenate([X[..., 4:], V], axis=-1)), axis=1)
    own[:, 5] &= ~derived.any(axis=1)
    observed = np.repeat(own[:, None], N, axis=1)
    filled = np.nan_to_num(X), np.nan_to_num(V)
    track = Track(*map(jnp.asarray, (np.nan_to_num(F), seen, X[..., :4], known, lasts)))
    return track, places, *filled, observed


def _driving(
    recording: Recording, vehicle: Any, model: Dynamics, substeps: int
) -> Float[np.ndarray, "J K N S k"]:
    """What drives the model (`Track.F`)."""
    recording, rise = with_rises(recording, vehicle)
    if not isinstance(model, Extended):
        F, change = recording.wrench(vehicle).to_numpy(), wrench_rise(recording, vehicle, rise)
        if change is None:
            return F[:, :, :, None]
        parts = over_substeps(jnp.asarray(F), jnp.asarray(change), substeps)
        return np.moveaxis(np.asarray(parts), -1, 3)
    level, voltage = recording.thrust(vehicle)
    u, volts = np.moveaxis(level, (2, 3), (0, 1)), np.moveaxis(voltage, 2, 0)[:, None]
    before, V = u[:1], np.zeros((1, 6, *u.shape[2:]))
    change = None if rise is None else np.moveaxis(rise, (2, 3), (0, 1))
    commands = Commands(u, volts, before, V, change)
    felt = eqx.filter_jit(actuated)(model, commands, recording.dt, substeps)
    felt = np.moveaxis(np.asarray(felt), (0, 1, 4), (2, 4, 3))
    relative = np.broadcast_to(voltage[..., None, None], (*felt.shape[:4], 1))
    return np.concatenate([felt, relative], axis=-1)


def _padded(samples: int) -> int:
    """A power of two, or 1.5 times one: runs of similar length share a compiled program."""
    whole = 1 << (samples - 1).bit_length()
    return max(64, 3 * whole // 4 if samples <= 3 * whole // 4 else whole)
