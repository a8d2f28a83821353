"""Depth from water pressure."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector3, require
from ..randomness import Scalar, column
from .base import Gauge, Innovation, along_pose


@dataclass(frozen=True)
class DepthSensor(Gauge):
    """A pressure sensor that converts pressure to depth with an assumed density.

    Reading (1): depth of the sensor, positive down (m), in still water (wave pressure is
    neglected). The sensor is mounted away from Bo, so tilting the vehicle changes its depth.
    State: the offset left by zeroing at the surface, then the reading.

    The noise is that of a Bar30's log at 10 Hz (2.8 to 3.0 mm).

    Attributes:
        noise: standard deviation of one measurement (m).
        offset_std: standard deviation of the offset, constant during a run (m).
        water_density: density of the water (kg/m³).
        assumed_density: density that the reading is computed with (kg/m³); fresh water's 1000 in
            sea water overstates depth by 2.5 %.
        deepest: the largest depth that it measures (m), by default that of the oceans; a reading
            that is larger is invalid.
    """

    rate: float = 10.0
    position: Vector3 = (-0.15, 0.0, 0.05)
    noise: float = 0.003
    offset_std: float = 0.01
    water_density: float = 1025.0
    assumed_density: float = 1025.0
    deepest: float = 11_000.0

    observes: ClassVar[Literal["position"]] = "position"
    stuck_after: ClassVar[int] = 8  # its resolution may be as coarse as its noise

    def __post_init__(self) -> None:
        """Check signs."""
        super().__post_init__()
        self._require_not_negative("noise", "offset_std")
        for field in ("water_density", "assumed_density"):
            require(getattr(self, field) > 0, self, field, "give a density above zero")
        require(self.deepest > 0, self, "deepest", "give a depth above zero")

    @property
    def noise_size(self) -> int:
        """White noise."""
        return 1

    @property
    def slow_error(self) -> tuple[float, float]:
        """The offset."""
        return self.offset_std, math.inf

    @property
    def largest(self) -> float:
        """The deepest depth."""
        return self.deepest

    def innovation(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        slow: Float[Array, "1"],
        values: Float[Array, "1"],
    ) -> Innovation:
        """Depth of the gauge and its offset."""
        expected, H = along_pose(self.expected, X_WB)
        return Innovation(values - expected - slow, H, slow=jnp.ones_like(slow))

    def expected(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "1 *batch"]:
        """Noise-free reading: −z of the sensor times the ratio of the densities."""
        z = se3.act(X_WB, column(self.position, X_WB))[2:]
        return -(self.water_density / self.assumed_density) * z

    def measure(
        self,
        state: Float[Array, "2 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dV_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        w: Float[Array, "1 *batch"],
    ) -> Float[Array, "2 *batch"]:
        """Measure."""
        del V_WB_B, dV_WB_B, t
        offset = state[:1]
        return jnp.concatenate([offset, self.expected(X_WB) + offset + self.noise * w])
