"""What an effect may change: vehicle, thrust, wrench, water, noise, or what is measured."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from .rotations import to_body, to_world
from .vehicle import Vehicle

Parameters = dict[str, dict[str, Any]]
Latent = dict[str, np.ndarray]


@dataclass
class Moment:
    """The state of all runs at one time, as the hooks of an effect see it."""

    t: float
    p: np.ndarray  # (3, B) m, W
    q: np.ndarray  # (4, B)
    nu: np.ndarray  # (6, B) m/s, rad/s
    up: np.ndarray  # (3, B) W's z axis in B
    nu_r: np.ndarray  # (6, B) relative to the water
    vehicle: Vehicle
    latents: dict[int, Latent] = field(default_factory=dict)

    def to_body(self, v_W: np.ndarray) -> np.ndarray:
        return to_body(self.q, v_W)

    def to_world(self, v_B: np.ndarray) -> np.ndarray:
        return to_world(self.q, v_B)


@dataclass
class Signals:
    """What instruments would show, sample by sample: (component, samples, B)."""

    t: np.ndarray  # (samples, B)
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    w: np.ndarray


@dataclass(frozen=True)
class Effect:
    """One physical cause. Every hook's default changes nothing.

    `cause` is the name a diagnosis must give. `order` sorts effects along the way from command to
    measurement. `rng` of a hook is the effect's own stream, so the other noise stays as it is.
    """

    cause: ClassVar[str] = ""
    order: ClassVar[int] = 0
    states: ClassVar[int] = 0

    @property
    def where(self) -> str:
        raise NotImplementedError

    def parameters(self) -> Parameters:
        """Value and unit by name."""
        raise NotImplementedError

    def neutral(self) -> bool:
        """Whether the parameters mean no effect at all; such an effect is left out."""
        raise NotImplementedError

    # ----------------------------------------------------------------- before a simulation

    def alter(self, vehicle: Vehicle) -> Vehicle:
        return vehicle

    def draw_latent(self, batch: int, rng: Any) -> Latent:
        """What is constant in a run but unknown (phases), or the start of a random process."""
        return {}

    # ------------------------------------------------------------------------- actuation

    def delay(self) -> np.ndarray:
        """(8,) s."""
        return np.zeros(8)

    def lag(self) -> np.ndarray:
        """(8,) s."""
        return np.zeros(8)

    def follow(self, before: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        """What the drive makes of the command (8, B) within h s, `before` being what it made."""
        return u

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        """Steady thrust (8, B) for commanded thrust u (8, B) and battery `volts` (B,)."""
        return u

    def distort_at(self, u: np.ndarray, volts: np.ndarray, t: float) -> np.ndarray:
        """The same at a time of the runs."""
        return self.distort(u, volts)

    def load(self, thrust: np.ndarray, axial: np.ndarray) -> np.ndarray:
        """Thrust (8, B) at inflow speeds `axial` (8, B): the thruster's own, along its axis."""
        return thrust

    # ----------------------------------------------------------------------------- body

    def flow(self, p: np.ndarray, t: float, latent: Latent) -> tuple[np.ndarray, np.ndarray] | None:
        """Velocity and acceleration Dv/Dt of the water at p, (3, B) each, in W."""
        return None

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray | None:
        """Additional wrench on the body about Bo in B, (6, B)."""
        return None

    def derivative(
        self, now: Moment, nu_dot: np.ndarray, latent: Latent, state: np.ndarray
    ) -> np.ndarray:
        """Rate of the effect's own `states`."""
        return state

    # ----------------------------------------------------------------------------- noise

    def advance(self, latent: Latent, h: float, rng: Any) -> Latent:
        """Random processes over one inner step, held constant within it."""
        return latent

    def diffusion(self, b: np.ndarray, now_nu_r: np.ndarray) -> np.ndarray:
        """Intensity (6, B) of the white wrench."""
        return b

    def impulse(self, batch: int, h: float, rng: Any) -> np.ndarray | None:
        """Sudden impulse on the body in B, (6, B) N·s and N·m·s."""
        return None

    # ----------------------------------------------------------------------- measurement

    def shift(self) -> dict[str, float]:
        """By how many s the channels `pose`, `linear`, `angular` show the past."""
        return {}

    def measure(self, signals: Signals) -> Signals:
        return signals


def value(number: float, unit: str) -> dict[str, Any]:
    return {"value": float(number), "unit": unit}


def one_axis(axis: int, x: np.ndarray) -> np.ndarray:
    """(6, B) with x on one axis."""
    out = np.zeros((6, x.shape[-1]))
    out[axis] = x
    return out


def around(rng: np.random.Generator, typical: float) -> float:
    """A size near a typical one: × 0.8 to 1.25."""
    return float(typical * rng.uniform(0.8, 1.25))


def sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))
