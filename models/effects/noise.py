"""Laws of the disturbance: its intensity, colour, impacts and dependence on speed."""

from typing import ClassVar

import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from ..se3 import AXES
from .base import Effect, Parameter


class DisturbanceLevel(Effect):
    """b_i (1 + c_i): white disturbance stronger or weaker than modelled."""

    name: ClassVar[str] = "disturbance_level"
    family: ClassVar = "disturbance"
    parameters: ClassVar = (Parameter("change", "1", (0.1,), -1.0, 50.0),)
    places: ClassVar = AXES
    random: ClassVar[bool] = True
    source: ClassVar[str] = "no model states it well"

    def diffusion(
        self, V_WB_B: Float[Array, "6 *#batch"], b: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        return b * (1 + self.column(V_WB_B))


class DisturbanceStateDependence(Effect):
    """b_i √(1 + k_i |v|²): disturbance that grows with speed (v, m/s), on every axis alike."""

    name: ClassVar[str] = "disturbance_state_dependence"
    family: ClassVar = "disturbance"
    parameters: ClassVar = (Parameter("growth", "s²/m²", (1.0,), 0.0, 1e3),)
    places: ClassVar = AXES
    random: ClassVar[bool] = True
    source: ClassVar[str] = "vortex shedding grows with speed squared"

    def diffusion(
        self, V_WB_B: Float[Array, "6 *#batch"], b: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        square = jnp.sum(V_WB_B[:3] ** 2, axis=0, keepdims=True)
        return b * jnp.sqrt(1 + self.column(V_WB_B) * square)


class DisturbanceColour(Effect):
    """A mean-reverting wrench on an axis: stationary std σ and time constant τ."""

    name: ClassVar[str] = "disturbance_colour"
    family: ClassVar = "disturbance"
    parameters: ClassVar = (
        Parameter("std", "N or N·m", (0.5,), 0.0, 100.0),
        Parameter("time_constant", "s", (1.0,), 0.0, 1e3),
    )
    places: ClassVar = AXES
    absorber: ClassVar[bool] = True
    random: ClassVar[bool] = True
    slow: ClassVar[bool] = True
    source: ClassVar[str] = "0.3 to 3 N over 0.5 to 10 s"

    @property
    def pushes(self) -> int:
        """The wrench itself."""
        return 6

    @property
    def noise_size(self) -> int:
        """One for each axis."""
        return 6

    def advance(
        self, state: Float[Array, "s *#batch"], w: Float[Array, "w *#batch"], dt: Float[Array, ""]
    ) -> Float[Array, "s *#batch"]:
        values = self.column(state)
        std, tau = values[0::2], values[1::2]
        decay = jnp.where(tau > 0, jnp.exp(-dt / jnp.where(tau > 0, tau, 1)), 0)
        return decay * state + std * jnp.sqrt(1 - decay * decay) * w

    def push(
        self, state: Float[Array, "s *#batch"], X_WB: Float[Array, "7 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        return state


class DisturbanceImpacts(Effect):
    """Impulses of std J on an axis (N·s, N·m·s), `rate` per second, each spread over one step.

    The wrench of a step is J w / dt with probability rate · dt, else zero.
    """

    name: ClassVar[str] = "disturbance_impacts"
    family: ClassVar = "disturbance"
    parameters: ClassVar = (
        Parameter("impulse", "N·s or N·m·s", (0.5,), 0.0, 100.0),
        Parameter("rate", "1/s", (0.2,), 0.0, 20.0),
    )
    places: ClassVar = AXES
    random: ClassVar[bool] = True
    source: ClassVar[str] = "0.2 to 2 N·s: debris, contact, snapping cable"

    @property
    def pushes(self) -> int:
        """The wrench itself."""
        return 6

    @property
    def noise_size(self) -> int:
        """Occurrence and size, for each axis."""
        return 12

    def advance(
        self, state: Float[Array, "s *#batch"], w: Float[Array, "w *#batch"], dt: Float[Array, ""]
    ) -> Float[Array, "s *#batch"]:
        values = self.column(state)
        impulse, rate = values[0::2], values[1::2]
        hits = ndtr(w[:6]) < rate * dt
        return jnp.where(hits, impulse * w[6:] / dt, 0) + jnp.zeros_like(state)

    def push(
        self, state: Float[Array, "s *#batch"], X_WB: Float[Array, "7 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        return state
