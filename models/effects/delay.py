"""Commands that arrive late."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import ALL_OR_ONE, Effect, Parameter


class ActuationDelay(Effect):
    """f(t) = u(t - δ): transport and processing time between the recorded command and the thrust.

    The memory holds the last `steps` commands, so delays up to `steps` × dt are told apart; the
    means over substeps of the shifted piecewise constant command are exact.
    """

    name: ClassVar[str] = "actuation_delay"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("delay", "s", (0.01, 0.03, 0.08, 0.2), 0.0, 1.0),)
    places: ClassVar = ALL_OR_ONE
    echoes: ClassVar = ("thruster_lag", "clock_offset")
    order: ClassVar[int] = 0
    source: ClassVar[str] = "a motor drive starts 110 ± 10 ms late (Blue Robotics forum, 11112)"
    thrusters: int = eqx.field(static=True, default=8)
    steps: int = eqx.field(static=True, default=6)

    @property
    def memory_size(self) -> int:
        """The last commands, newest first."""
        return self.thrusters * self.steps

    def initial(self, command: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
        return jnp.concatenate([command] * self.steps)

    def actuate(
        self,
        memory: Float[Array, "m *#batch"],
        level: Float[Array, "n *#batch S"],
        dt: Float[Array, ""],
    ) -> tuple[Float[Array, "m *#batch"], Float[Array, "n *#batch S"]]:
        n, S = level.shape[0], level.shape[-1]
        past = [level[..., 0], *jnp.split(memory, self.steps)]  # command k steps ago
        behind = self.each(0, memory) / dt  # delay in steps
        means = []
        for s in range(S):
            start, end = s / S - behind, (s + 1) / S - behind
            total = jnp.zeros_like(level[..., s])
            for k, command in enumerate(past):
                # overlap of the shifted substep with the time at which command k held
                low, high = -float(k), 1.0 - float(k)
                low = -jnp.inf if k == self.steps else low
                share = jnp.clip(jnp.minimum(end, high) - jnp.maximum(start, low), 0, None) * S
                total = total + share * command
            means.append(total)
        batch = jnp.broadcast_shapes(level.shape[1:-1], memory.shape[1:])
        kept = [level[..., 0], memory[: n * (self.steps - 1)]]
        kept = [jnp.broadcast_to(part, (part.shape[0], *batch)) for part in kept]
        return jnp.concatenate(kept), jnp.stack(jnp.broadcast_arrays(*means), axis=-1)
