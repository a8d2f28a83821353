"""Causes in the law of the disturbance: how large, how slow, how abrupt, when."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .effect import Effect, Latent, Moment, Parameters, around, value

NOMINAL_DIFFUSION = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
"""Intensity of the nominal white wrench in B, N√s and N·m√s."""


@dataclass(frozen=True)
class DisturbanceLevel(Effect):
    """The white wrench is k times as intense as nominal, in force, moment or both."""

    cause = "disturbance_level"
    factor: float = 1.0
    part: str = "all"

    @property
    def where(self) -> str:
        return self.part

    def parameters(self) -> Parameters:
        return {"factor": value(self.factor, "1")}

    def neutral(self) -> bool:
        return self.factor == 1

    def diffusion(self, b: np.ndarray, now_nu_r: np.ndarray) -> np.ndarray:
        rows = {"all": slice(0, 6), "force": slice(0, 3), "moment": slice(3, 6)}[self.part]
        out = b.copy()
        out[rows] *= self.factor
        return out

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DisturbanceLevel":
        return cls(1 + around(rng, size), str(rng.choice(["all", "force", "moment"])))


@dataclass(frozen=True)
class DisturbanceColour(Effect):
    """Added to it, a mean-reverting (Ornstein–Uhlenbeck) force in B: ḟ + f/T = w, variance σ².

    The same on surge, sway and heave, independently; on the moments σ × 0.05 m.
    """

    cause = "disturbance_colour"
    std: float = 0.0
    time_constant: float = 1.0

    @property
    def where(self) -> str:
        return "B"

    def parameters(self) -> Parameters:
        told = {"std": value(self.std, "N")}
        return told | {"time_constant": value(self.time_constant, "s")}

    def neutral(self) -> bool:
        return self.std == 0

    def draw_latent(self, batch: int, rng: Any) -> Latent:
        return {"w": rng.standard_normal((6, batch))}

    def advance(self, latent: Latent, h: float, rng: Any) -> Latent:
        keep = np.exp(-h / self.time_constant)
        w = rng.standard_normal(latent["w"].shape)
        return {"w": keep * latent["w"] + np.sqrt(1 - keep**2) * w}

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        return self.std * np.array([1, 1, 1, 0.05, 0.05, 0.05])[:, None] * latent["w"]

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DisturbanceColour":
        return cls(around(rng, 1.5 * size), rng.uniform(0.7, 2.5))


@dataclass(frozen=True)
class DisturbanceImpacts(Effect):
    """Knocks: a compound Poisson process, Gaussian impulses in any direction, 0.1 m off Bo."""

    cause = "disturbance_impacts"
    impulse_std: float = 0.0
    rate: float = 0.3

    @property
    def where(self) -> str:
        return "B"

    def parameters(self) -> Parameters:
        return {"impulse": value(self.impulse_std, "N s"), "rate": value(self.rate, "1/s")}

    def neutral(self) -> bool:
        return self.impulse_std == 0 or self.rate == 0

    def impulse(self, batch: int, h: float, rng: Any) -> np.ndarray | None:
        hit = rng.uniform(size=batch) < 1 - np.exp(-self.rate * h)
        j, r = rng.standard_normal((3, batch)), 0.1 * rng.standard_normal((3, batch))
        if not hit.any():
            return None
        j = self.impulse_std * j * hit
        return np.concatenate([j, np.cross(r, j, axis=0)])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DisturbanceImpacts":
        return cls(around(rng, 1.0 * size), rng.uniform(0.2, 0.5))


@dataclass(frozen=True)
class DisturbanceStateDependence(Effect):
    """The white wrench grows with speed through the water: b (1 + κ |v_r|), Stratonovich."""

    cause = "disturbance_state_dependence"
    growth: float = 0.0

    @property
    def where(self) -> str:
        return "all"

    def parameters(self) -> Parameters:
        return {"growth": value(self.growth, "s/m")}

    def neutral(self) -> bool:
        return self.growth == 0

    def diffusion(self, b: np.ndarray, now_nu_r: np.ndarray) -> np.ndarray:
        return b * (1 + self.growth * np.sqrt(np.sum(now_nu_r[:3] ** 2, axis=0)))

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DisturbanceStateDependence":
        return cls(around(rng, 3.0 * size))
