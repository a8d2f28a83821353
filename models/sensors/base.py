"""Interface of sensors, and their mounting on the vehicle."""

import abc
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector3, check_numbers, require
from ..randomness import Scalar


@dataclass(frozen=True)
class Sensor(abc.ABC):
    """A frozen configuration whose methods are pure functions of arrays.

    `measure` is called every 1/`rate` seconds and returns a new state `(state_size, *batch)`: the
    slow errors and the last readings. `reading` is the output at a time t. A Drake system holds the
    state, updates it periodically and evaluates its output from it. Randomness enters through `w`
    alone, independent unit Gaussians. Each kind also has a noise-free `expected`, the measurement
    function of an estimator.

    Attributes:
        rate: measurements per second (Hz).
        position: p_BS_B, origin of the sensor in the body (m).
        rpy: roll, pitch, yaw of the sensor's axes in the body (rad).
    """

    rate: float = 10.0
    position: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)

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


def velocity_at(
    r_B: Float[Array, "3 *ones"], V_WB_B: Float[Array, "6 *batch"]
) -> Float[Array, "3 *batch"]:
    """Velocity in W of the point of the body at r_B, expressed in B: v + ω × r."""
    r, v = se3.align(r_B, V_WB_B[:3])
    return v + se3.cross(V_WB_B[3:], r)
