"""Thrusters that follow their command with a first-order lag."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import ByThruster, Parameter


class ThrusterLag(ByThruster):
    """τ df/dt = u - f for each thruster; exact means and ends over substeps of a held command.

    A step response of about 0.1 to 0.2 s is usual for a T200 with its drive (Wu 2018; public
    simulators take 0.15 to 0.2 s).
    """

    name: ClassVar[str] = "thruster_lag"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("time_constant", "s", (0.02, 0.06, 0.15, 0.35), 0.0, 1.5),)
    echoes: ClassVar = ("actuation_delay", "clock_offset")
    order: ClassVar[int] = 1
    timing: ClassVar[bool] = True
    source: ClassVar[str] = "0.05 to 0.2 s: Blue Robotics forum measurements, public simulators"

    @property
    def memory_size(self) -> int:
        """The present force of each thruster."""
        return self.thrusters

    @property
    def memory_duration(self) -> float:
        return 5 * self.longest(0)

    def initial(self, command: Float[Array, "n *batch"]) -> Float[Array, "n *batch"]:
        return command

    def actuate(
        self,
        memory: Float[Array, "n *#batch"],
        level: Float[Array, "n *#batch S"],
        dt: Float[Array, "..."],
    ) -> tuple[Float[Array, "n *#batch"], Float[Array, "n *#batch S"]]:
        tau = self.each(0, memory)
        h = dt / level.shape[-1]
        lags = tau > 0
        ratio = h / jnp.where(lags, tau, 1)
        decay = jnp.where(lags, jnp.exp(-ratio), 0)
        mean = jnp.where(lags, -jnp.expm1(-ratio) / ratio, 0)
        means = []
        for s in range(level.shape[-1]):
            behind = memory - level[..., s]
            means.append(level[..., s] + behind * mean)
            memory = level[..., s] + behind * decay
        return memory, jnp.stack(means, axis=-1)
