"""Swell, currents that differ from run to run, and judging causes beside either or slow pushes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...models.effects.base import AXES
from .beside import Beside
from .laws import Law, estimated, run_constants
from .looking import Bench, Look
from .structures import Screen

_OMEGAS = np.arange(0.6, 5.3, 0.2)
"""Frequencies that are tried (rad/s); runs of ten seconds tell 0.6 rad/s apart."""
_WAYS = 12
"""Directions that are tried; a quarter of them with every frequency."""
_EACH = np.full(4, 0.05)
"""Amplitudes that are tried: 1/8 to 64 times as much (m/s)."""
_FINER = (-0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.15)
_GRAVITY = 9.80665
_LEAST = 5.0
"""Nats that a slow push on an axis must win to be taken into account."""
_BENDS = 4
"""Cosines that bend a current over a piece, besides a constant."""


def beside_laws(bench: Bench, look: Look, laws: Sequence[Law]) -> Beside:
    """The random structure that wins most: slow pushes by axis, a current, or swell."""
    slow = [law for law in laws if law.name == "disturbance_colour" and law.heldout_gain > _LEAST]
    pushes = sum(law.heldout_gain for law in slow)
    current = max((law.heldout_gain for law in laws if law.name == "current_varying"), default=0.0)
    if current > pushes:
        whole = Screen(bench, look, None, len(bench.data.fold))
        v = _flow(bench, whole.kept)
        return _drawn(whole, v, np.zeros_like(v), _bends())
    if slow:
        waves = find_waves(bench, look)
        if waves.heldout_gain > sum(law.heldout_gain for law in slow if law.where in AXES[:3]):
            whole = Screen(bench, look, None, len(bench.data.fold))
            swell = Swell(waves.parameters["frequency"], waves.parameters["direction"])
            return _drawn(whole, *swell.water(bench, whole.kept), _EACH)
    numbers = {}
    for law in slow:
        tau, kappa = np.exp(estimated(law, bench.data.cluster)[0])
        rho = np.exp(-bench.data.dt / tau)
        numbers[AXES.index(law.where)] = float(rho), float(min(kappa, 0.99))
    return Beside.slowly(look.z.astype(float), numbers)


def _drawn(screen: Screen, v: np.ndarray, a: np.ndarray, spread: np.ndarray) -> Beside:
    """Motion of the water drawn for each piece, its terms' standard deviations in proportion."""
    J = _responses(screen, v, a)
    G = _products(screen, J)
    std = run_constants(G, list(range(1, len(J) + 1)), spread, screen.fold)[1]["std"] / spread[0]
    return Beside(drawn=J, precision=1 / (max(std, 1e-9) * spread) ** 2)


def _responses(screen: Screen, v: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "k N12 R"]:
    """Whitened responses to velocities and accelerations of the water in W (N, 3, k, R)."""
    by_v, by_a = screen.water
    return screen.passed(
        np.einsum("nijr,njkr->nikr", by_v, v) + np.einsum("nijr,njkr->nikr", by_a, a)
    )


def _products(screen: Screen, J: np.ndarray) -> Float[np.ndarray, "R m m"]:
    columns = np.concatenate([screen.z[:1], J]).astype(np.float64)
    return np.einsum("iar,jar->rij", columns, columns, optimize=True)


def _times(bench: Bench, kept: np.ndarray) -> Float[np.ndarray, "N R"]:
    """Middles of the steps since the begin of each piece (s)."""
    return (bench.data.times[:-1] + bench.data.step / 2)[:, kept]


def _flow(bench: Bench, kept: np.ndarray) -> Float[np.ndarray, "N 3 k R"]:
    """East and north flow of 1 m/s: a constant and `_BENDS` cosines of time each."""
    t = _times(bench, kept) / np.maximum(bench.data.times[-1, kept], 1e-9)
    found = np.zeros((len(t), 3, 2 * (_BENDS + 1), len(kept)))
    for k in range(_BENDS + 1):
        for way in range(2):
            found[:, way, 2 * k + way] = np.cos(np.pi * k * t) * (np.sqrt(2) if k else 1)
    return found


def _bends() -> np.ndarray:
    """Standard deviations of the flow's terms: mean-reverting within the length of a piece."""
    t = (np.arange(64) + 0.5) / 64
    C = np.exp(-np.abs(t[:, None] - t))
    phi = np.stack([np.cos(np.pi * k * t) * (np.sqrt(2) if k else 1) for k in range(_BENDS + 1)])
    return np.repeat(np.sqrt(np.diag(phi @ C @ phi.T)) / 64, 2)


@dataclass(frozen=True)
class Swell:
    """Swell of one frequency ω (rad/s) and one direction ψ (rad), for each piece four amplitudes.

    Water moves along ψ with cos θ and sin θ and up with cos θ and sin θ, θ = k (x cos ψ + y sin ψ)
    - ω t, fading with exp(k z), ω² = g k (Airy; Faltinsen 1990, table 2.1, deep water).
    """

    frequency: float
    direction: float

    def water(
        self, bench: Bench, kept: np.ndarray
    ) -> tuple[Float[np.ndarray, "N 3 4 R"], Float[np.ndarray, "N 3 4 R"]]:
        """Velocities of 1 m/s at the surface and accelerations, in W."""
        omega, k = self.frequency, self.frequency**2 / _GRAVITY
        east, north = np.cos(self.direction), np.sin(self.direction)
        X = bench.data.X[:-1][..., kept]
        theta = k * (east * X[:, 4] + north * X[:, 5]) - omega * _times(bench, kept)
        fade = np.exp(k * np.minimum(X[:, 6], 0.0))
        v, a = np.zeros((2, len(theta), 3, 4, len(kept)))
        for number, (now, rate) in enumerate(
            ((np.cos(theta), np.sin(theta)), (np.sin(theta), -np.cos(theta)))
        ):
            for way, share in ((0, east), (1, north)):
                v[:, way, number], a[:, way, number] = (
                    share * fade * now,
                    share * omega * fade * rate,
                )
            v[:, 2, 2 + number], a[:, 2, 2 + number] = fade * now, omega * fade * rate
        return v, a


def find_waves(bench: Bench, look: Look) -> Law:
    """Swell of one frequency and direction, its amplitudes drawn anew for each piece of a run.

    They have one variance: z ~ N(0, I + σ² J Jᵀ). Frequency and direction from a grid, then from
    finer ones.
    """
    screen = Screen(bench, look, None)

    def tried(swells: list[Swell]) -> list[tuple[np.ndarray, np.ndarray]]:
        water = [swell.water(bench, screen.kept) for swell in swells]
        J = _responses(screen, *(np.concatenate(w, axis=2) for w in zip(*water, strict=True)))
        found = []
        for first in range(0, len(J), 4):
            G = _products(screen, J[first : first + 4])
            found.append((G, run_constants(G, [1, 2, 3, 4], _EACH, screen.fold)[0]))
        return found

    def totals(swells: list[Swell]) -> np.ndarray:
        return np.array([gain.sum() for _, gain in tried(swells)])

    ways = np.arange(_WAYS) * 2 * np.pi / _WAYS
    few = [Swell(omega, way) for omega in _OMEGAS for way in ways[:: _WAYS // 4]]
    best = few[int(np.argmax(totals(few)))]
    several = [Swell(best.frequency, way) for way in ways]
    gains = totals(several)
    middle = int(np.argmax(gains))
    near = [(middle + k) % _WAYS for k in (-1, 0, 1)]
    direction, unsure = _peak(ways[middle] + 2 * np.pi / _WAYS * np.array([-1, 0, 1]), gains[near])
    finer = [Swell(best.frequency + step, direction) for step in _FINER]
    gains = totals(finer)
    omega, error = _peak(np.array([swell.frequency for swell in finer]), gains)
    best = Swell(omega, direction)
    G, heldout = tried([best])[0]
    std = run_constants(G, [1, 2, 3, 4], _EACH, screen.fold)[1]["std"]
    a = -np.linalg.solve(G[:, 1:, 1:] + np.eye(4) / max(std, 1e-3) ** 2, G[:, 1:, 0][..., None])
    speeds = np.sqrt(np.mean(a[:, :2, 0] ** 2, axis=1))
    speed = float(np.sqrt(np.mean(speeds**2)))
    spread = float(np.std(speeds**2) / np.sqrt(len(speeds)) / (2 * max(speed, 1e-9)))
    turned = float(np.angle(np.exp(1j * direction)))
    values = {"speed": speed, "frequency": omega, "direction": turned}
    unsure = {"speed": spread, "frequency": error, "direction": unsure}
    share = bench.data.steps / bench.data.weight[:, screen.kept].sum()
    return Law("waves", "W", values, heldout * share, errors=unsure)


def _peak(at: np.ndarray, gains: np.ndarray) -> tuple[float, float]:
    """The top of a parabola through the gains, and its width where half a nat is lost."""
    a, b, _ = np.polyfit(at - at.mean(), gains, 2)
    if a >= 0:
        return float(at[int(np.argmax(gains))]), float(np.ptp(at))
    reach = float(np.ptp(at)) / 2
    top = float(np.clip(-b / (2 * a), -reach, reach))
    return float(at.mean() + top), float(1 / np.sqrt(-2 * a))
