"""Interface of sensors, their mounting on the vehicle, and their measurement models."""

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector3, check_numbers, require
from ..randomness import Scalar


class Innovation(NamedTuple):
    """Residual of a reading and the slopes of the measurement; None for what it does not measure.

    The slopes are those in [δp, δθ] of the pose, in the velocity v_B, in the rate ω_B and in the
    sensor's slow error.
    """

    residual: Float[Array, "m"]
    pose: Float[Array, "m 6"] | None = None
    velocity: Float[Array, "m 3"] | None = None
    rate: Float[Array, "m 3"] | None = None
    slow: Float[Array, "m"] | None = None


@dataclass(frozen=True)
class Sensor(abc.ABC):
    """A frozen configuration whose methods are pure functions of arrays.

    `measure` is called every 1/`rate` seconds and returns a new state `(state_size, *batch)`: the
    slow errors and the last readings. `reading` is the output at a time t. A Drake system holds the
    state, updates it periodically and evaluates its output from it. Randomness enters through `w`
    alone, independent unit Gaussians.

    A reading is the measured values alone, and the station adds [valid, time] to it; that of a
    sensor that is `late` has them itself, as [values, valid, …, time]. A sensor that `observes`
    something is fused by the station's filter: it has `predicted`, its noise `noise_std` and one
    slow error of standard deviation and time constant `slow_error`.

    Attributes:
        rate: measurements per second (Hz).
        position: p_BS_B, origin of the sensor in the body (m).
        rpy: roll, pitch, yaw of the sensor's axes in the body (rad).
    """

    rate: float = 10.0
    position: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)

    observes: ClassVar[Literal["velocity", "position", "attitude"] | None] = None
    """What a filter corrects with it; None if it is not fused."""
    late: ClassVar[bool] = False
    """Whether a reading appears later than it was measured."""
    angle: ClassVar[bool] = False
    """Whether its values are angles in [−π, π)."""
    stuck_after: ClassVar[int] = 4
    """Repeats of one value, bit for bit, after which it is stuck."""

    def __post_init__(self) -> None:
        """Check numbers; kinds extend this with their own limits and raise `UserError`."""
        check_numbers(self)
        require(self.rate > 0, self, "rate", "give a rate above zero")

    def _require_not_negative(self, *fields: str) -> None:
        for field in fields:
            require(getattr(self, field) >= 0, self, field, "give zero or more")

    def mount(self, dtype: jnp.dtype) -> Float[Array, "7"]:
        """Pose X_BS of the sensor in the body."""
        position, rpy = jnp.asarray(self.position, dtype), jnp.asarray(self.rpy, dtype)
        return se3.from_position_rpy(position, rpy)

    @property
    @abc.abstractmethod
    def state_size(self) -> int:
        """Length of the state."""

    @property
    @abc.abstractmethod
    def noise_size(self) -> int:
        """Number of unit Gaussians that one measurement takes."""

    @property
    @abc.abstractmethod
    def initial_noise_size(self) -> int:
        """Number of unit Gaussians that the initial state takes."""

    @property
    @abc.abstractmethod
    def reading_size(self) -> int:
        """Length of the reading."""

    @abc.abstractmethod
    def initial(self, w: Float[Array, "w *batch"]) -> Float[Array, "s *batch"]:
        """Return a state before the first measurement, its slow errors drawn at random."""

    @abc.abstractmethod
    def measure(
        self,
        state: Float[Array, "s *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dV_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        w: Float[Array, "w *batch"],
    ) -> Float[Array, "s *batch"]:
        """Take a measurement of the true motion; dV_WB_B is the rate of V_WB_B's components."""

    def reading(self, state: Float[Array, "s *batch"], t: Scalar) -> Float[Array, "r *batch"]:
        """Return the sensor's output at time t; it is the end of the state."""
        del t
        return state[self.state_size - self.reading_size :]

    @property
    def value_size(self) -> int:
        """Number of values in a reading."""
        return self.reading_size

    @property
    def port_size(self) -> int:
        """Length of the output on a station: the reading, with [valid, time] unless it has them."""
        return self.reading_size if self.late else self.reading_size + 2

    def marked(self, shown: Float[Array, "r *batch"]) -> Float[Array, "m *batch"]:
        """[values, valid, time] of an output."""
        n = self.value_size
        return shown if n + 2 == shown.shape[0] else jnp.concatenate([shown[: n + 1], shown[-1:]])

    @property
    def noise_std(self) -> tuple[float, ...]:
        """Standard deviation of each value's white noise."""
        return (getattr(self, "noise", 0.0),) * self.value_size

    @property
    def slow_error(self) -> tuple[float, float]:
        """Standard deviation and time constant (s) of the slow error, infinite for a constant."""
        return 0.0, math.inf

    @property
    def latencies(self) -> tuple[float, float]:
        """Shortest and longest time from a measurement to its appearance (s)."""
        return 0.0, 0.0

    @property
    def largest(self) -> float:
        """Norm of the values above which a reading is invalid."""
        return math.inf

    def predicted(
        self, X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"], slow: Float[Array, "1"]
    ) -> Float[Array, "m"]:
        """Noise-free values at a pose, a twist and a slow error, for `innovation`."""
        raise NotImplementedError(f"{type(self).__name__} has no measurement model")

    def innovation(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        slow: Float[Array, "1"],
        values: Float[Array, "m"],
    ) -> Innovation:
        """The residual of `predicted` and its derivatives; a kind may state them itself."""

        def moved(delta: Float[Array, "13"]) -> Float[Array, "m"]:
            X = se3.retract(X_WB, delta[:6])
            return self.predicted(X, V_WB_B + delta[6:12], slow + delta[12:])

        J = jax.jacfwd(moved)(jnp.zeros(13, X_WB.dtype))
        residual = values - self.predicted(X_WB, V_WB_B, slow)
        return Innovation(residual, J[:, :6], J[:, 6:9], J[:, 9:12], J[:, 12])

    def off(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        slow: Float[Array, "1"],
        values: Float[Array, "m"],
    ) -> Float[Array, "m"]:
        """The error of the values that would explain them, in their units; see `innovation`."""
        return self.innovation(X_WB, V_WB_B, slow, values).residual

    def add_to(self, station: Any, name: str) -> None:
        """Add it to a station's builder (`systems.station.simulated.StationBuilder`)."""
        station.measure(name, self)


class Gauge(Sensor):
    """A sensor of one value with a slow error. State: the slow error, then the reading."""

    @property
    def state_size(self) -> int:
        """Slow error and reading."""
        return 2

    @property
    def initial_noise_size(self) -> int:
        """The slow error."""
        return 1

    @property
    def reading_size(self) -> int:
        """One value."""
        return 1

    def initial(self, w: Float[Array, "1 *batch"]) -> Float[Array, "2 *batch"]:
        """Draw the slow error from its stationary law."""
        return jnp.concatenate([self.slow_error[0] * w, jnp.zeros_like(w)])


def along_pose(h: Callable[[Array], Array], X_WB: Float[Array, "7"]) -> tuple[Array, Array]:
    """Value of h at a pose and its Jacobian in the pose's error, by forward differentiation."""
    value, slope = jax.linearize(h, X_WB)
    return value, jax.vmap(slope, in_axes=1, out_axes=1)(_tangents(X_WB))


def _tangents(X_WB: Float[Array, "7"]) -> Float[Array, "7 6"]:
    """The derivative of X exp(ξ) at ξ = 0: q̇ = q (0, δθ) / 2, ṗ = R δp."""
    w, x, y, z = jnp.unstack(X_WB[:4] / 2)
    turns = jnp.stack([-x, -y, -z, w, -z, y, z, w, -x, -y, x, w]).reshape(4, 3)
    zero = jnp.zeros((3, 3), X_WB.dtype)
    moves = jnp.concatenate([se3.rotation_matrix(X_WB), zero], axis=1)
    return jnp.concatenate([jnp.concatenate([jnp.zeros_like(turns), turns], axis=1), moves])


def velocity_at(
    r_B: Float[Array, "3 *ones"], V_WB_B: Float[Array, "6 *batch"]
) -> Float[Array, "3 *batch"]:
    """Velocity in W of the point of the body at r_B, expressed in B: v + ω × r."""
    r, v = se3.align(r_B, V_WB_B[:3])
    return v + se3.cross(V_WB_B[3:], r)
