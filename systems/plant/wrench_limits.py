"""The feasible wrenches of a vehicle: the set U of planner and controller."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...models.thrusters import Thrusters


class WrenchLimits(eqx.Module):
    """A star-shaped set of wrenches about zero."""

    @abc.abstractmethod
    def clip(self, F_Bo_B: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        """The wrench itself if it is feasible, else a feasible part of it."""

    def axes(self) -> Float[Array, "6"]:
        """The largest wrench along each axis alone that is feasible in both signs (N, N·m)."""
        far = jnp.eye(6, dtype=self.dtype) * 1e4
        both = jnp.concatenate([far, -far], axis=1)
        reached = jnp.abs(jnp.sum(self.clip(both) * both, axis=0)) / 1e4
        return jnp.minimum(reached[:6], reached[6:])

    @property
    @abc.abstractmethod
    def dtype(self) -> jnp.dtype:
        """Precision of the numbers."""


class BoxLimits(WrenchLimits):
    """Each component independently within ± its limit."""

    limit: Float[Array, "6"]

    def clip(self, F_Bo_B: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        limit = self.limit.reshape((6,) + (1,) * (F_Bo_B.ndim - 1))
        return jnp.clip(F_Bo_B, -limit, limit)

    @property
    def dtype(self) -> jnp.dtype:
        return self.limit.dtype


class ThrusterLimits(WrenchLimits):
    """The wrenches of the thrusters within their force limits, times `fraction`.

    Horizontal and vertical thrusters are scaled by separate factors, as in ArduSub's mixer: depth
    and attitude keep their authority while the horizontal thrusters saturate.
    """

    thrusters: Thrusters
    voltage: Float[Array, ""]
    fraction: Float[Array, ""]

    @classmethod
    def create(
        cls, thrusters: Thrusters, voltage: float | None = None, fraction: float = 1.0
    ) -> "ThrusterLimits":
        """Limits at a battery voltage (V), the thrusters' nominal one unless given."""
        dtype = thrusters.nominal_voltage.dtype
        volts = thrusters.nominal_voltage if voltage is None else jnp.asarray(voltage, dtype)
        return cls(thrusters, volts, jnp.asarray(fraction, dtype))

    def clip(self, F_Bo_B: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        if F_Bo_B.ndim > 1:
            return self._scaled(F_Bo_B)
        # A single feasible wrench, the usual case, needs no search for the factors.
        forces = self.thrusters.inverse @ F_Bo_B / self.fraction
        low, high = self.thrusters.force_limits(self.voltage)
        feasible = jnp.all((forces >= low) & (forces <= high))
        F = self.thrusters.wrench(forces) * self.fraction if self.thrusters.unactuated else F_Bo_B
        return jax.lax.cond(feasible, lambda F: F, lambda F: self._scaled(F), F)

    def _scaled(self, F_Bo_B: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        forces = self.thrusters.allocate(F_Bo_B / self.fraction, self.voltage, "groups")
        return self.thrusters.wrench(forces) * self.fraction

    @property
    def dtype(self) -> jnp.dtype:
        return self.fraction.dtype
