"""State and inputs of the delayed filter, its status and health, and their names."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models.sensors import Sensor
from . import error_state
from .config import EkfConfig
from .error_state import Navigation
from .inertial import Motion, Samples
from .readings import Shown
from .trust import Trust, trusted

SUMS = 10
"""Components of `FilterState.since`."""


class FilterState(NamedTuple):
    """The filter's state."""

    nominal: Navigation
    P: Float[Array, "e e"]
    ring: Float[Array, "slots row"]
    since: Float[Array, "10"]
    """Since the time of P: elapsed time, sums of force · dt and rate · dt, time without force,
    variances due to missing forces and rates."""
    before: Navigation
    """The nominal state at the time of P."""
    samples: Samples
    motion: Motion
    shown: Shown
    trust: Trust


class Readings(NamedTuple):
    """Sensor outputs at one time; the time of validity of a reading selects its slot."""

    imu: Float[Array, "6"]
    """Specific force (m/s²) and angular rate (rad/s) in the sensor's axes."""
    aids: tuple[Float[Array, "_"], ...]
    """[values, valid, time of validity (s)] of each other sensor."""

    def joined(self) -> tuple[Float[Array, "m"], Bool[Array, "n"], Float[Array, "n"]]:
        """Values, validity flags and times (s) of the sensors besides the IMU."""
        values = jnp.concatenate([each[:-2] for each in self.aids])
        marks = jnp.stack([each[-2] > 0 for each in self.aids])
        return values, marks, jnp.stack([each[-1] for each in self.aids])


def status_names(fused: Sequence[str]) -> tuple[str, ...]:
    """Components of the status vector, given the names of the sensors that the filter fuses.

    Time of the horizon (s), last NIS of each sensor, rejections in a row, and time since a reading
    was last accepted (s).
    """
    kinds = ("nis", "rejected", "age")
    return ("time", *(f"{kind}_{name}" for kind in kinds for name in fused))


def health_names(fused: Sequence[str]) -> tuple[str, ...]:
    """Components of the health vector, given the names of the sensors that the filter fuses.

    0 good, 1 degraded, 2 lost; then 1 where a sensor is trusted.
    """
    return ("state", "imu", *fused)


def status(trust: Trust, time: Float[Array, ""]) -> Float[Array, "_"]:
    """The status vector of `status_names` at the horizon's time (s)."""
    return jnp.concatenate([time[None], trust.nis, trust.rejected, time - trust.accepted_at])


def health(
    config: EkfConfig,
    aids: Sequence[Sensor],
    state: FilterState,
    P: Float[Array, "e e"],
    time: Float[Array, ""],
) -> Float[Array, "_"]:
    """The health vector of `health_names` at the horizon's time (s), for the shown covariance P."""
    c, variance, trust = config, jnp.diag(P), state.trust
    fit = (time - trust.accepted_at <= c.silence) & (trust.rejected < c.patience)
    fit = fit & (trust.noise_factor <= 1) & trusted(aids, P, state.nominal)
    fit = fit & ~state.shown.stuck(aids) & ~trust.suspect(time, c.silence)
    imu = (state.samples.calm > 1) & (trust.imu_factor < 2)
    imu = imu & (time - trust.jolted_at > c.silence)
    fit = jnp.concatenate([imu[None], fit])
    lost = jnp.any(variance[error_state.VELOCITY] > c.lost_velocity**2)
    lost = lost | jnp.any(variance[error_state.ROTATION] > c.lost_attitude**2)
    overall = jnp.where(lost, 2.0, jnp.where(jnp.all(fit), 0.0, 1.0))
    return jnp.concatenate([overall[None].astype(P.dtype), fit.astype(P.dtype)])
