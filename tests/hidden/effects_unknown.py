"""Structure that no name of the diagnosis explains. `parameters` tell what it is nevertheless."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from .effect import Effect, Latent, Moment, Parameters, around, one_axis, sign, value
from .rotations import cross, heading
from .vehicle import AXES


@dataclass(frozen=True)
class _Unknown(Effect):
    cause = "unknown"
    kind: ClassVar[str] = ""
    variables: ClassVar[tuple[str, ...]] = ()
    """What a description has to mention, in the columns' names."""


@dataclass(frozen=True)
class Swirl(_Unknown):
    """An eddy stands in the water: v_θ = V (r/a) exp(½ (1 − r²/a²)), largest at r = a.

    A Taylor vortex; the water's acceleration is centripetal, −v_θ²/r.
    """

    kind = "swirl"
    variables = ("x", "y")
    x: float = 0.0
    y: float = 0.0
    speed: float = 0.0
    radius: float = 0.8

    @property
    def where(self) -> str:
        return "W"

    def parameters(self) -> Parameters:
        told = {"x": value(self.x, "m"), "y": value(self.y, "m")}
        return told | {"speed": value(self.speed, "m/s"), "radius": value(self.radius, "m")}

    def neutral(self) -> bool:
        return self.speed == 0

    def flow(self, p: np.ndarray, t: float, latent: Latent) -> tuple[np.ndarray, np.ndarray]:
        dx, dy = p[0] - self.x, p[1] - self.y
        turn = self.speed / self.radius * np.exp(0.5 * (1 - (dx**2 + dy**2) / self.radius**2))
        zero = np.zeros_like(dx)
        return np.stack([-turn * dy, turn * dx, zero]), np.stack(
            [-(turn**2) * dx, -(turn**2) * dy, zero]
        )

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Swirl":
        x, y = rng.uniform(-0.5, 0.5, 2)
        return cls(float(x), float(y), sign(rng) * around(rng, 0.2 * size), rng.uniform(0.6, 1.0))


@dataclass(frozen=True)
class Appendage(_Unknown):
    """A mass on a spring hangs on the hull: s̈ + 2ζΩṡ + Ω²s = −n·a, force m (2ζΩṡ + Ω²s) n at r.

    a is the acceleration of Bo in the inertial frame, v̇ + ω × v; n is an axis of B.
    """

    kind = "appendage"
    states = 2
    axis: int = 1
    mass: float = 0.0
    frequency: float = 1.0
    damping: float = 0.03
    arm: tuple[float, float, float] = (0.2, 0.0, 0.0)

    @property
    def where(self) -> str:
        return AXES[self.axis]

    def parameters(self) -> Parameters:
        told = {"mass": value(self.mass, "kg"), "frequency": value(self.frequency, "Hz")}
        return told | {"damping": value(self.damping, "1")}

    def neutral(self) -> bool:
        return self.mass == 0

    def _pull(self, state: np.ndarray) -> np.ndarray:
        omega = 2 * np.pi * self.frequency
        return 2 * self.damping * omega * state[1] + omega**2 * state[0]

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        force = one_axis(self.axis, self.mass * self._pull(state))[:3]
        return np.concatenate([force, cross(np.array(self.arm)[:, None] + 0 * force, force)])

    def derivative(
        self, now: Moment, nu_dot: np.ndarray, latent: Latent, state: np.ndarray
    ) -> np.ndarray:
        a = nu_dot[:3] + cross(now.nu[3:], now.nu[:3])
        return np.stack([state[1], -self._pull(state) - a[self.axis]])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Appendage":
        return cls(int(rng.integers(3)), around(rng, 1.0 * size), rng.uniform(0.7, 1.5))


@dataclass(frozen=True)
class Memory(_Unknown):
    """The flow remembers: F = −∫ K(s) ν_r(t − s) ds, K = A e^(−s/T) cos Ωs (Cummins 1962).

    The integral is the real part of a state with ż = (−1/T + iΩ) z + ν_r.
    """

    kind = "memory"
    states = 2
    axis: int = 1
    strength: float = 0.0
    decay: float = 1.5
    frequency: float = 0.35

    @property
    def where(self) -> str:
        return AXES[self.axis]

    def parameters(self) -> Parameters:
        unit = "N/m" if self.axis < 3 else "N m/rad"
        told = {"strength": value(self.strength, unit), "decay": value(self.decay, "s")}
        return told | {"frequency": value(self.frequency, "Hz")}

    def neutral(self) -> bool:
        return self.strength == 0

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        return one_axis(self.axis, -self.strength * state[0])

    def derivative(
        self, now: Moment, nu_dot: np.ndarray, latent: Latent, state: np.ndarray
    ) -> np.ndarray:
        omega = 2 * np.pi * self.frequency
        decay = -state / self.decay
        return decay + np.stack([-omega * state[1] + now.nu_r[self.axis], omega * state[0]])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Memory":
        axis = int(rng.choice([0, 1, 2, 5]))
        return cls(axis, around(rng, (40.0 if axis < 3 else 1.5) * size), rng.uniform(1.0, 2.0))


@dataclass(frozen=True)
class Backlash(_Unknown):
    """Drives follow their command with play: f stays until u leaves f ± δ, then f = u ∓ δ.

    The play operator (Krasnosel'skii and Pokrovskii 1989; Tao and Kokotović 1996, eq. 2.2); in one
    thruster, 1 … 8, or in all (None).
    """

    kind = "backlash"
    width: float = 0.0
    thruster: int | None = None

    @property
    def variables(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(f"f{k}" for k in range(1, 9) if self.thruster in (None, k))

    @property
    def where(self) -> str:
        return "thrusters" if self.thruster is None else str(self.thruster)

    def parameters(self) -> Parameters:
        return {"width": value(self.width, "N")}

    def neutral(self) -> bool:
        return self.width == 0

    def follow(self, before: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        taken = np.minimum(np.maximum(before, u - self.width), u + self.width)
        concerned = np.isin(np.arange(1, 9), self.thruster or np.arange(1, 9))[:, None]
        return np.where(concerned, taken, u)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Backlash":
        if rng.uniform() < 0.5:
            return cls(around(rng, 1.0 * size))
        return cls(around(rng, 2.0 * size), int(rng.integers(1, 9)))


@dataclass(frozen=True)
class Slew(_Unknown):
    """Drives follow their command at most at a rate: ḟ = R sign(u − f) until f = u."""

    kind = "slew"
    variables = tuple(f"f{k}" for k in range(1, 9))
    rate: float = np.inf

    @property
    def where(self) -> str:
        return "thrusters"

    def parameters(self) -> Parameters:
        return {"rate": value(self.rate, "N/s")}

    def neutral(self) -> bool:
        return self.rate == np.inf

    def follow(self, before: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        return before + np.clip(u - before, -self.rate * h, self.rate * h)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Slew":
        return cls(around(rng, 40.0 / size))


@dataclass(frozen=True)
class Exchange(_Unknown):
    """Two thrusters are wired to each other's drive: each does what the other is told."""

    kind = "exchange"
    pair: tuple[int, int] = (1, 2)
    share: float = 0.0

    @property
    def variables(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(f"f{k}" for k in self.pair)

    @property
    def where(self) -> str:
        return "thrusters"

    def parameters(self) -> Parameters:
        return {"share": value(self.share, "1")}

    def neutral(self) -> bool:
        return self.share == 0

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        mine, others = (k - 1 for k in self.pair)
        found = u.copy()
        found[mine] += self.share * (u[others] - u[mine])
        found[others] += self.share * (u[mine] - u[others])
        return found

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Exchange":
        i, j = sorted(int(k) for k in rng.choice(8, 2, replace=False))
        return cls((i + 1, j + 1), min(size, 1.0))


@dataclass(frozen=True)
class Course(_Unknown):
    """A wrench on one axis in a velocity that heading turns: k cos(ψ - ψ₀) ν_j."""

    kind = "course"
    axis: int = 5
    of: int = 0
    size: float = 0.0
    turned: float = 0.0

    @property
    def variables(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return "heading", "uvwpqr"[self.of]

    @property
    def where(self) -> str:
        return AXES[self.axis]

    def parameters(self) -> Parameters:
        return {"size": value(self.size, "N s"), "turned": value(self.turned, "rad")}

    def neutral(self) -> bool:
        return self.size == 0

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        turn = np.cos(heading(now.q) - self.turned)
        return one_axis(self.axis, self.size * turn * now.nu_r[self.of])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Course":
        axis, of = [(5, 0), (1, 0), (0, 1), (5, 1)][rng.integers(4)]
        return cls(axis, of, around(rng, (4.0 if axis == 5 else 12.0) * size), rng.uniform(-3, 3))


@dataclass(frozen=True)
class Steps(_Unknown):
    """Drives know few speeds: each does the multiple of a step that is nearest to its command."""

    kind = "steps"
    variables = tuple(f"f{k}" for k in range(1, 9))
    step: float = 0.0

    @property
    def where(self) -> str:
        return "thrusters"

    def parameters(self) -> Parameters:
        return {"step": value(self.step, "N")}

    def neutral(self) -> bool:
        return self.step == 0

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        return self.step * np.round(u / self.step) if self.step else u.copy()

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Steps":
        return cls(around(rng, 6.0 * size))
