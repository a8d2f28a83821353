"""Current and waves."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import Effect, Parameter


class CurrentSteady(Effect):
    """A uniform current, constant in W: drag and added mass act on the relative velocity."""

    name: ClassVar[str] = "current_steady"
    family: ClassVar = "environment"
    parameters: ClassVar = (
        Parameter("east", "m/s", (0.03,), -3.0, 3.0),
        Parameter("north", "m/s", (0.03,), -3.0, 3.0),
    )
    places: ClassVar = ("W",)
    needs: ClassVar = frozenset({"velocity"})
    source: ClassVar[str] = "0.02 to 0.5 m/s in harbours and tanks with pumps"

    def flow(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "3 *#batch"]:
        east, north = self.part(0, X_WB), self.part(1, X_WB)
        return jnp.stack(jnp.broadcast_arrays(east, north, jnp.zeros_like(X_WB[6])))


class _MovingWater(Effect):
    """Water that moves at random: two velocities are its state, with noise of their own."""

    family: ClassVar = "environment"
    places: ClassVar = ("W",)
    absorber: ClassVar[bool] = True
    random: ClassVar[bool] = True
    slow: ClassVar[bool] = True

    @property
    def pushes(self) -> int:
        """Two velocities."""
        return 2

    @property
    def noise_size(self) -> int:
        """One for each velocity."""
        return 2


class CurrentVarying(_MovingWater):
    """A varying horizontal current: each component is a Gauss–Markov process in W."""

    name: ClassVar[str] = "current_varying"
    parameters: ClassVar = (
        Parameter("std", "m/s", (0.05,), 0.0, 1.0),
        Parameter("time_constant", "s", (10.0,), 0.0, 1e4),
    )
    simpler: ClassVar = ("current_steady",)
    source: ClassVar[str] = "0 to 0.3 m/s over 10 s to minutes"

    def advance(
        self, state: Float[Array, "s *#batch"], w: Float[Array, "w *#batch"], dt: Float[Array, ""]
    ) -> Float[Array, "s *#batch"]:
        std, tau = self.part(0, state)[None], self.part(1, state)[None]
        decay = jnp.where(tau > 0, jnp.exp(-dt / jnp.where(tau > 0, tau, 1)), 0)
        return decay * state + std * jnp.sqrt(1 - decay * decay) * w

    def drift_of_water(
        self, state: Float[Array, "s *#batch"], X_WB: Float[Array, "7 *#batch"]
    ) -> Float[Array, "3 *#batch"]:
        return jnp.concatenate([state, jnp.zeros_like(state[:1])])


class Waves(_MovingWater):
    """Orbital motion of long-crested swell: a narrow-band velocity with the depth's decay.

    Waves of `amplitude` a and `frequency` ω run towards `direction`; water moves by aω cos along it
    and by aω sin up, decaying with exp(ω² z / g) (Faltinsen 1990, table 2.1, deep water). A damped
    oscillator (quality factor 12) gives both as its quadratures, each of standard deviation
    aω / √2: a is the amplitude of a regular wave of the same mean square orbital speed.
    """

    name: ClassVar[str] = "waves"
    parameters: ClassVar = (
        Parameter("amplitude", "m", (0.02,), 0.0, 20.0),
        Parameter("frequency", "rad/s", (1.0,), 0.0, 10.0),
        Parameter("direction", "rad", (0.0,), -7.0, 7.0),
    )
    source: ClassVar[str] = "wind sea of 3 to 8 s, swell of 8 to 16 s"

    def advance(
        self, state: Float[Array, "s *#batch"], w: Float[Array, "w *#batch"], dt: Float[Array, ""]
    ) -> Float[Array, "s *#batch"]:
        omega = self.part(1, state)
        speed = self.part(0, state) * omega / jnp.sqrt(jnp.asarray(2.0, omega.dtype))
        decay = jnp.exp(-omega * dt / 24)
        c, s = jnp.cos(omega * dt), jnp.sin(omega * dt)
        a, b = state[0], state[1]
        turned = jnp.stack([c * a - s * b, s * a + c * b])
        return decay[None] * turned + (speed * jnp.sqrt(1 - decay * decay))[None] * w

    def drift_of_water(
        self, state: Float[Array, "s *#batch"], X_WB: Float[Array, "7 *#batch"]
    ) -> Float[Array, "3 *#batch"]:
        omega, angle = self.part(1, state), self.part(2, state)
        fade = jnp.exp(omega * omega * jnp.minimum(X_WB[6], 0) / 9.80665)
        level = state[0] * fade
        return jnp.stack([level * jnp.cos(angle), level * jnp.sin(angle), -state[1] * fade])
