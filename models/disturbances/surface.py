"""The water's surface: a hull that emerges loses buoyancy."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector3, require
from ..dynamics import Flow
from ..randomness import Scalar, column
from ..vehicles.vehicle import Vehicle
from .base import Disturbance


@dataclass(frozen=True)
class Surface(Disturbance):
    """Buoyancy that is missing above z = 0: F = −B e ẑ_W at the centre of buoyancy.

    e is the emerged share of a hull of uniform section and of the given height about its centre of
    buoyancy: 0 below −height / 2, 1 above height / 2, linear in between (Fossen 2011, section 4.2:
    the stiffness ρ g A of a floating body). Without it a vehicle whose thrusters rest rises for
    ever. Waves do not move this surface.

    Attributes:
        buoyancy: B of the submerged hull (N).
        height: of the hull (m).
        center_of_buoyancy: in B (m).
    """

    buoyancy: float
    height: float
    center_of_buoyancy: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        require(self.buoyancy > 0, self, "buoyancy", "give a force above 0 N")
        require(self.height > 0, self, "height", "give a height above 0 m")

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Surface":
        """That of a vehicle's hull."""
        return cls(vehicle.buoyancy, vehicle.size[2], vehicle.center_of_buoyancy)

    @property
    def state_size(self) -> int:
        """None."""
        return 0

    def wrench(
        self,
        state: Float[Array, "0 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        flow: Flow | None = None,
    ) -> Float[Array, "6 *batch"]:
        """Return the buoyancy's loss."""
        del state, V_WB_B, t, flow
        r_B = column(self.center_of_buoyancy, X_WB)
        emerged = jnp.clip(0.5 + se3.act(X_WB, r_B)[2] / self.height, 0.0, 1.0)
        down_W = jnp.zeros_like(X_WB[:3]).at[2].set(-self.buoyancy * emerged)
        force = se3.rotate_inverse(X_WB, down_W)
        return jnp.concatenate([force, se3.cross(r_B, force)])
