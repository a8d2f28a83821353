"""Doppler velocity log: velocity over the bed, with latency and drop-outs."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector3, require
from ..randomness import Scalar, bernoulli, column, uniform
from .base import Innovation, Sensor, velocity_at


@dataclass(frozen=True)
class Dvl(Sensor):
    """Velocity of the transducer over the bed, in the transducer's axes.

    Reading (7): velocity (m/s), 1 if valid else 0, altitude above the bed (m), figure of merit
    (m/s), time of validity (s). A reading appears `latency` after its time of validity; a new
    reading has a new time of validity. Velocity is zero while invalid: bed out of range, speed too
    high, or in a drop-out. Drop-outs come in bursts (Gilbert 1960: a two-state Markov chain).
    Outliers are marked valid; an estimator's gate has to reject them.

    State: in a drop-out (0 or 1), scale error, time the newest reading appears, the newest
    reading (7) and the one before (7).

    Defaults follow the manual of the A50 in its standard grade (1 % of v, 5 Hz, latency 0.1 to
    0.2 s, altitude 0.05 to 50 m, 3.75 m/s), with 1 cm/s noise as in public simulators; rates of
    drop-outs and outliers are estimates.

    Attributes:
        rpy: mount; zero gives forward, left, up axes, (π, 0, 0) forward, right, down.
        noise: standard deviation of each component (m/s).
        scale_std: standard deviation of the scale error, constant during a run (1).
        earliest_latency: lower end of the latency's range (s).
        latest_latency: upper end (s), at most 1/rate; the latency is uniform between the two.
        dropout_share: share of measurements in drop-outs (1); at most L / (1 + L) with
            L = dropout_length · rate, when a single measurement separates successive drop-outs.
        dropout_length: mean length of a drop-out (s), at least 1/rate.
        outlier_share: share of the measurements that are outliers (1).
        outlier_std: standard deviation of an outlier's error (m/s).
        lowest_altitude: least altitude with bottom lock (m).
        highest_altitude: largest altitude with bottom lock (m).
        highest_speed: largest speed with a valid velocity (m/s).
        water_depth: the bed lies at z = −water_depth (m).
    """

    rate: float = 5.0
    position: Vector3 = (-0.1, 0.0, -0.1)
    noise: float = 0.01
    scale_std: float = 0.005
    earliest_latency: float = 0.1
    latest_latency: float = 0.2
    dropout_share: float = 0.03
    dropout_length: float = 0.6
    outlier_share: float = 0.01
    outlier_std: float = 0.3
    lowest_altitude: float = 0.05
    highest_altitude: float = 50.0
    highest_speed: float = 3.75
    water_depth: float = 10.0

    observes: ClassVar[Literal["velocity"]] = "velocity"
    late: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check signs, shares and that a reading appears before the next measurement."""
        super().__post_init__()
        self._require_not_negative("noise", "scale_std", "earliest_latency", "outlier_std")
        require(0 <= self.outlier_share <= 1, self, "outlier_share", "give a share of 0 to 1")
        require(0 <= self.dropout_share < 1, self, "dropout_share", "give a share of 0 to below 1")
        period = 1 / self.rate
        slack = 1e-9
        require(
            self.earliest_latency <= self.latest_latency <= period + slack,
            self,
            "latest_latency",
            "give at least earliest_latency and at most 1/rate",
        )
        long_enough = self.dropout_length >= period - slack
        require(long_enough, self, "dropout_length", "give at least 1/rate")
        length = self.dropout_length * self.rate
        require(
            self.dropout_share <= length / (1 + length) + slack,
            self,
            "dropout_share",
            f"drop-outs of {self.dropout_length:g} s with a valid measurement between them take a "
            f"share of {length / (1 + length):.3g} at most; give less, or a longer dropout_length",
        )
        require(
            self.highest_altitude > self.lowest_altitude,
            self,
            "highest_altitude",
            "give more than lowest_altitude",
        )

    @property
    def state_size(self) -> int:
        """Three numbers and two readings."""
        return 17

    @property
    def noise_size(self) -> int:
        """White noise (3), drop-out, latency, outlier and its error (3)."""
        return 9

    @property
    def initial_noise_size(self) -> int:
        """Drop-out and scale error."""
        return 2

    @property
    def reading_size(self) -> int:
        """Velocity, valid, altitude, figure of merit, time of validity."""
        return 7

    @property
    def value_size(self) -> int:
        """Velocity."""
        return 3

    @property
    def slow_error(self) -> tuple[float, float]:
        """The scale error."""
        return self.scale_std, math.inf

    @property
    def latencies(self) -> tuple[float, float]:
        """Those configured."""
        return self.earliest_latency, self.latest_latency

    @property
    def largest(self) -> float:
        """A tenth above the highest speed."""
        return 1.1 * self.highest_speed

    def innovation(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        slow: Float[Array, "1"],
        values: Float[Array, "3"],
    ) -> Innovation:
        """(1 + scale) R_SB (v + ω × r)."""
        E = self.expected(jnp.eye(6, dtype=V_WB_B.dtype))  # the measurement is linear in the twist
        EV, scale = E @ V_WB_B, 1 + slow[0]
        return Innovation(values - scale * EV, None, scale * E[:, :3], scale * E[:, 3:], EV)

    def expected(self, V_WB_B: Float[Array, "6 *batch"]) -> Float[Array, "3 *batch"]:
        """Noise-free velocity in the transducer's axes: R_SB (v + ω × r)."""
        X_BS = self.mount(V_WB_B.dtype)
        return se3.rotate_inverse(X_BS, velocity_at(X_BS[4:], V_WB_B))

    def altitude(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "1 *batch"]:
        """Height of the transducer above the bed (m)."""
        return se3.act(X_WB, column(self.position, X_WB))[2:] + self.water_depth

    def initial(self, w: Float[Array, "2 *batch"]) -> Float[Array, "17 *batch"]:
        """Draw the scale error, and the drop-out's stationary law; no reading is valid yet."""
        dropped = bernoulli(w[:1], self.dropout_share).astype(w.dtype)
        rest = jnp.zeros((15, *w.shape[1:]), w.dtype)
        return jnp.concatenate([dropped, self.scale_std * w[1:], rest])

    def measure(
        self,
        state: Float[Array, "17 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dV_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        w: Float[Array, "9 *batch"],
    ) -> Float[Array, "17 *batch"]:
        """Ping at time t; the newest reading becomes the one before."""
        del dV_WB_B
        dropped, scale, newest = state[:1], state[1:2], state[3:10]
        leave = 1 / (self.dropout_length * self.rate)
        enter = leave * self.dropout_share / (1 - self.dropout_share)
        dropped = bernoulli(w[3:4], jnp.where(dropped > 0.5, 1 - leave, enter))

        true = self.expected(V_WB_B)
        gross = jnp.where(bernoulli(w[5:6], self.outlier_share), self.outlier_std, 0.0)
        v = (1 + scale) * true + self.noise * w[:3] + gross.astype(w.dtype) * w[6:]
        altitude = self.altitude(X_WB)
        speed = jnp.sqrt(jnp.sum(true * true, axis=0, keepdims=True))
        seen = (altitude >= self.lowest_altitude) & (altitude <= self.highest_altitude)
        valid = seen & (speed <= self.highest_speed) & ~dropped

        time = jnp.full_like(altitude, t)
        appears = time + uniform(w[4:5], self.earliest_latency, self.latest_latency)
        reading = [
            jnp.where(valid, v, 0),
            valid.astype(w.dtype),
            jnp.where(seen, altitude, 0),
            jnp.full_like(altitude, self.noise),
            time,
        ]
        return jnp.concatenate([dropped.astype(w.dtype), scale, appears, *reading, newest])

    def reading(self, state: Float[Array, "17 *batch"], t: Scalar) -> Float[Array, "7 *batch"]:
        """Return the newest reading that has appeared by time t."""
        appeared = jnp.asarray(t, state.dtype) >= state[2:3]
        return jnp.where(appeared, state[3:10], state[10:])
