"""Delay between command and thrust."""

import dataclasses
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import ByThruster, Parameter
from .traits import Region

_LATEST, _STEPS = 0.25, (6, 16)
"""Longest delay (s) that a diagnosis resolves, and fewest and most steps of the memory for it."""


class ActuationDelay(ByThruster):
    """f(t) = u(t - δ): transport and processing time between the recorded command and the thrust.

    The memory holds the last `steps` commands and how long each was held, so it represents delays
    up to that many steps, of equal length or not. The means over substeps of the shifted piecewise
    constant command are exact.
    """

    name: ClassVar[str] = "actuation_delay"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("delay", "s", (0.01, 0.03, 0.08, 0.2), 0.0, 1.0, refit=0.01),)
    echoes: ClassVar = ("thruster_lag", "clock_offset")
    order: ClassVar[int] = 0
    timing: ClassVar[bool] = True
    refits: ClassVar = ("all",)
    refit_needs: ClassVar = frozenset({"thrust"})
    source: ClassVar[str] = "a motor drive starts 110 ± 10 ms late (Blue Robotics forum, 11112)"
    steps: int = eqx.field(static=True, default=6)

    @classmethod
    def options_for(cls, region: Region) -> dict[str, Any]:
        """As many steps as resolve a delay of `_LATEST` s."""
        steps = math.ceil(_LATEST / region.step - 1e-6) + 1
        return {"steps": min(max(steps, _STEPS[0]), _STEPS[1])}

    @property
    def memory_size(self) -> int:
        """The last commands, newest first, then their hold times."""
        return (self.thrusters + 1) * self.steps

    @property
    def memory_duration(self) -> float:
        return self.longest(0)

    def initial(self, command: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
        held = jnp.ones((self.steps, *command.shape[1:]), command.dtype)
        return jnp.concatenate([command] * self.steps + [held])

    def for_steps_of(self, dt: float) -> "ActuationDelay":
        return dataclasses.replace(
            self, steps=max(math.ceil(self.memory_duration / dt - 1e-9), 0) + 1
        )

    def actuate(
        self,
        memory: Float[Array, "m *#batch"],
        level: Float[Array, "n *#batch S"],
        dt: Float[Array, "..."],
    ) -> tuple[Float[Array, "m *#batch"], Float[Array, "n *#batch S"]]:
        n, S, K = level.shape[0], level.shape[-1], self.steps
        commands = jnp.split(memory[: n * K], K)
        held = memory[n * K :]
        delay = self.each(0, memory)
        h = dt / S

        def mean(s: Array, level: Array) -> Array:
            # the shifted substep, from the step's start
            start, end = s * h - delay, (s + 1) * h - delay
            total = _overlap(start, end, jnp.zeros_like(dt), dt) * level
            high = jnp.zeros_like(held[:1])
            for k, command in enumerate(commands):
                low = high - held[k : k + 1] if k < K - 1 else -jnp.inf * jnp.ones_like(high)
                total = total + _overlap(start, end, low, high) * command
                high = low
            return total / h

        means = jax.vmap(mean, (0, -1), -1)(jnp.arange(S, dtype=h.dtype), level)
        batch = jnp.broadcast_shapes(level.shape[1:-1], memory.shape[1:], jnp.shape(dt)[1:])
        now = jnp.broadcast_to(dt, (1, *batch)) if jnp.ndim(dt) else jnp.full((1, *batch), dt)
        kept = [level[..., 0], *commands[:-1], now, held[:-1]]
        kept = [jnp.broadcast_to(part, (part.shape[0], *batch)) for part in kept]
        return jnp.concatenate(kept), means


def _overlap(start: Array, end: Array, low: Array, high: Array) -> Array:
    """Length of the intersection of two intervals."""
    return jnp.clip(jnp.minimum(end, high) - jnp.maximum(start, low), 0, None)
