"""Causes fixed to the earth: currents, waves, the tether. Vectors in W."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .effect import Effect, Latent, Moment, Parameters, around, value
from .rotations import cross
from .vehicle import GRAVITY


def _horizontal(speed: float, direction: float) -> np.ndarray:
    return speed * np.array([np.cos(direction), np.sin(direction), 0.0])


@dataclass(frozen=True)
class CurrentSteady(Effect):
    """A uniform, constant current; the hull feels ν_r = ν − R_WBᵀ v_c (Fossen 2011, ch. 8.3)."""

    cause = "current_steady"
    east: float = 0.0
    north: float = 0.0

    @property
    def where(self) -> str:
        return "W"

    def parameters(self) -> Parameters:
        return {"east": value(self.east, "m/s"), "north": value(self.north, "m/s")}

    def neutral(self) -> bool:
        return self.east == 0 and self.north == 0

    def flow(self, p: np.ndarray, t: float, latent: Latent) -> tuple[np.ndarray, np.ndarray]:
        v = np.zeros_like(p)
        v[0], v[1] = self.east, self.north
        return v, np.zeros_like(p)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "CurrentSteady":
        v = _horizontal(around(rng, 0.12 * size), rng.uniform(-np.pi, np.pi))
        return cls(float(v[0]), float(v[1]))


@dataclass(frozen=True)
class CurrentVarying(Effect):
    """East and north speeds are Gauss–Markov: v̇ + v/T = w, with variance σ² (Fossen 2011, 8.46).

    Each run starts somewhere in the stationary law. The water's acceleration is left out, as usual
    for a slow current.
    """

    cause = "current_varying"
    std: float = 0.0
    time_constant: float = 10.0

    @property
    def where(self) -> str:
        return "W"

    def parameters(self) -> Parameters:
        told = {"std": value(self.std, "m/s")}
        return told | {"time_constant": value(self.time_constant, "s")}

    def neutral(self) -> bool:
        return self.std == 0

    def draw_latent(self, batch: int, rng: Any) -> Latent:
        return {"v": self.std * rng.standard_normal((2, batch))}

    def advance(self, latent: Latent, h: float, rng: Any) -> Latent:
        keep = np.exp(-h / self.time_constant)
        w = rng.standard_normal(latent["v"].shape)
        return {"v": keep * latent["v"] + self.std * np.sqrt(1 - keep**2) * w}

    def flow(self, p: np.ndarray, t: float, latent: Latent) -> tuple[np.ndarray, np.ndarray]:
        v = np.zeros_like(p)
        v[:2] = latent["v"]
        return v, np.zeros_like(p)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "CurrentVarying":
        return cls(around(rng, 0.1 * size), rng.uniform(5.0, 20.0))


@dataclass(frozen=True)
class Waves(Effect):
    """A regular deep-water wave a cos(k·x − ωt + φ), ω² = g k (Airy; Newman 1977, ch. 6.2).

    u = aω e^(kz) cos θ along its direction, w = aω e^(kz) sin θ; the acceleration is ∂v/∂t. Phase φ
    is drawn for each run.
    """

    cause = "waves"
    amplitude: float = 0.0
    period: float = 3.0
    direction: float = 0.0

    @property
    def where(self) -> str:
        return "W"

    def parameters(self) -> Parameters:
        told = {"amplitude": value(self.amplitude, "m"), "period": value(self.period, "s")}
        told["direction"] = value(self.direction, "rad")
        omega = 2 * np.pi / self.period
        told["frequency"] = value(omega, "rad/s")
        return told | {"surface_speed": value(self.amplitude * omega, "m/s")}

    def neutral(self) -> bool:
        return self.amplitude == 0

    def draw_latent(self, batch: int, rng: Any) -> Latent:
        return {"phase": rng.uniform(0, 2 * np.pi, batch)}

    def flow(self, p: np.ndarray, t: float, latent: Latent) -> tuple[np.ndarray, np.ndarray]:
        omega = 2 * np.pi / self.period
        k = omega**2 / GRAVITY
        c, s = np.cos(self.direction), np.sin(self.direction)
        theta = k * (c * p[0] + s * p[1]) - omega * t + latent["phase"]
        speed = self.amplitude * omega * np.exp(k * np.minimum(p[2], 0.0))
        along, up = speed * np.cos(theta), speed * np.sin(theta)
        v = np.stack([c * along, s * along, up])
        along, up = omega * speed * np.sin(theta), -omega * speed * np.cos(theta)
        return v, np.stack([c * along, s * along, up])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Waves":
        direction = rng.uniform(-np.pi, np.pi)
        return cls(around(rng, 0.12 * size), rng.uniform(2.5, 4.0), direction)


@dataclass(frozen=True)
class Tether(Effect):
    """A tether pulls like a spring towards an anchor: F = −k (p_t − p_a), at r_t on the body.

    By default it is fixed aft on top. Quasi-static; the tether's own drag would be quadratic drag.
    """

    cause = "tether"
    stiffness: float = 0.0
    anchor: tuple[float, float, float] = (4.0, 0.0, -1.0)
    attachment: tuple[float, float, float] = (-0.2, 0.0, 0.1)

    @property
    def where(self) -> str:
        return "W"

    def parameters(self) -> Parameters:
        told = {"stiffness": value(self.stiffness, "N/m")}
        names = ("anchor_x", "anchor_y", "anchor_z")
        return told | {n: value(a, "m") for n, a in zip(names, self.anchor, strict=True)}

    def neutral(self) -> bool:
        return self.stiffness == 0

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        r = np.array(self.attachment)[:, None] + np.zeros_like(now.p)
        stretch = now.p + now.to_world(r) - np.array(self.anchor)[:, None]
        force = now.to_body(-self.stiffness * stretch)
        return np.concatenate([force, cross(r, force)])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Tether":
        a = _horizontal(rng.uniform(3.0, 5.0), rng.uniform(-np.pi, np.pi))
        return cls(around(rng, 0.5 * size), (float(a[0]), float(a[1]), rng.uniform(-3.0, -1.0)))
