"""A library of maneuvers that a pilot can drive, simulated as data for a diagnosis.

Each has `VARIANTS` pieces as long as those recorded, at the recorded steps: axis after axis,
thruster after thruster, heading after heading, from rest in the middle of the recorded places.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ....models.effects.extended import Extended
from ....models.se3 import AXES
from ....models.thrusters import Thrusters
from ...data.maneuvers import largest
from ..data.arrays import Data
from ..filter.latent import specific_force
from ..filter.problem import DiagnosisProblem
from ..validation.forecast import forecast

VARIANTS = 8
"""Pieces of a maneuver."""
_GENTLE = np.array([1, 1, 1, 0.1, 0.1, 0.4])
"""Share of the largest wrench about each axis that keeps a vehicle upright."""
_FASTEST = 0.4
"""Highest frequency of a chirp, as a share of the sampling rate."""
_APART = 4.0
"""Distance (m) between the places of maneuvers that need several."""
_HEADINGS = 4
_SURFACE, _WILD = -0.2, 20.0
"""Height (m) above which a piece ends, and speed (m/s, rad/s) at which it does."""

Effort = Callable[[Float[np.ndarray, " N"], int], Float[np.ndarray, "N k"]]
"""Shares of full effort by axis, or of one thruster, at the times (s) of one variant."""


def _axis(k: int, s: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 6"]:
    """A signal on one axis after the other; the second cycle has the opposite sign."""
    sign = -1.0 if (k // len(AXES)) % 2 else 1.0
    return sign * np.asarray(s)[:, None] * np.eye(len(AXES))[k % len(AXES)]


def _phase(t: np.ndarray) -> np.ndarray:
    return t / max(t[-1], 1e-9)


def _levels(t: np.ndarray, *levels: float) -> np.ndarray:
    """Levels held one after the other, equally long."""
    return np.asarray(levels)[np.minimum((_phase(t) * len(levels)).astype(int), len(levels) - 1)]


def _chirp(t: np.ndarray, k: int) -> np.ndarray:
    top = min(4.0, _FASTEST / max(float(np.diff(t).max()), 1e-9))
    low = min(0.5, top / 2)
    return _axis(k, 0.5 * np.sin(2 * np.pi * (low + (top - low) / 2 * _phase(t)) * t))


def _each_thruster(t: np.ndarray, k: int) -> np.ndarray:
    return _levels(t, 0.0, 0.25, 0.5, 0.0, -0.25, -0.5)[:, None] * np.ones((1, 1))


def _square(t: np.ndarray, k: int) -> np.ndarray:
    turning = (4 * _phase(t)) % 1 > 0.6
    side = -1.0 if k % 2 else 1.0
    surge, yaw = np.where(turning, 0.0, 0.3), np.where(turning, 0.3 * side, 0.0)
    return surge[:, None] * np.eye(6)[0] + yaw[:, None] * np.eye(6)[5]


def _curves(t: np.ndarray, k: int) -> np.ndarray:
    sides = np.array([[1, 0, 0, 0, 0, 1], [1, 1, 0, 0, 0, -1], [0, 1, 1, 0, 0, 1]])
    return np.repeat((-1.0 if k % 2 else 1.0) * sides[[k % 3]], len(t), axis=0)


def _lines(t: np.ndarray, k: int) -> np.ndarray:
    return np.repeat(0.5 * np.eye(6)[:1], len(t), axis=0)


def _bounce(t: np.ndarray, k: int) -> np.ndarray:
    return _axis(2, (-1.0 if k % 2 else 1.0) * 0.6 * np.sin(2 * np.pi * 0.4 * t))


def _pushes(t: np.ndarray, k: int) -> np.ndarray:
    return _levels(t, 0.0, 0.3, 0.0, -0.3)[:, None] * np.array([1, 1, 1, 0, 0, 1])


def _nothing(t: np.ndarray, k: int) -> np.ndarray:
    return np.zeros((len(t), 6))


@dataclass(frozen=True)
class Maneuver:
    """One maneuver of the library.

    Attributes:
        text: instruction to the pilot.
        effort: share of full effort, by axis, or of one thruster (N, 1).
        voltage: relative to the nominal one, variant after variant.
        apart: whether variants start at different places and depths.
    """

    text: str
    effort: Effort
    voltage: tuple[float, ...] = (1.0,)
    apart: bool = False


MANEUVERS: dict[str, Maneuver] = {
    "chirp": Maneuver(
        "chirp one axis after the other from 0.5 to 4 Hz at half effort", _chirp
    ),
    "steps": Maneuver(
        "step each axis from rest to half and to full effort and back",
        lambda t, k: _axis(k, _levels(t, 0.0, 0.5, 1.0, 0.0)),
    ),
    "thrusters": Maneuver(
        "step each thruster alone from rest to a quarter and to half effort, both ways",
        _each_thruster,
    ),
    "sweep": Maneuver(
        "sweep one axis after the other slowly through its full range",
        lambda t, k: _axis(k, np.interp(_phase(t), (0, 0.25, 0.75, 1), (0, 1, -1, 0))),
    ),
    "speeds": Maneuver(
        "drive each axis at a tenth of its speed, then at full speed",
        lambda t, k: _axis(k, _levels(t, 0.01, 1.0)),
    ),
    "coast": Maneuver(
        "drive each axis up to speed and let it coast down without thrust",
        lambda t, k: _axis(k, _levels(t, 0.7, 0.0, 0.0)),
    ),
    "curves": Maneuver("drive and turn at full effort, both ways", _curves),
    "square": Maneuver("drive a square and turn on the spot at each corner", _square),
    "lines": Maneuver("drive straight lines along four headings", _lines),
    "bounce": Maneuver("accelerate up and down", _bounce),
    "places": Maneuver("repeat the same pushes at other places, depths and headings", _pushes,
                    apart=True),
    "battery": Maneuver("repeat the same run with a full and with an empty battery", _pushes,
                     voltage=(1.05, 0.8)),
    "drift": Maneuver("let it drift without commands", _nothing),
}  # fmt: skip


def full_effort(thrusters: Thrusters) -> Float[np.ndarray, "6"]:
    """The wrench about each axis alone that counts as full effort (N, N·m)."""
    return _GENTLE * [largest(thrusters, axis) for axis in np.eye(6)]


def heading(k: int) -> float:
    """Heading of a maneuver's variant k (rad)."""
    return 2 * np.pi / _HEADINGS * (k % _HEADINGS) + 0.3


def place(name: str, k: int) -> tuple[float, float, float]:
    """Where a maneuver's variant k begins: x and y (m), depth as a share of the usual one."""
    if not MANEUVERS[name].apart:
        return 0.0, 0.0, 1.0
    return _APART * np.cos(2.4 * k), _APART * np.sin(2.4 * k), 0.3 + 0.2 * k


def simulate_maneuvers(
    problem: DiagnosisProblem, theta: Float[np.ndarray, " p"]
) -> Iterator[tuple[list[str], Data]]:
    """Noise-free data of all maneuvers under θ, with the maneuver of each piece ('' for padding).

    Shapes are those of the problem's own data, so that programs compiled for these are reused.
    """
    own = problem.data
    R, n = own.u.shape[2], own.u.shape[1]
    thrusters = problem.vehicle.thrusters()
    model = problem.model.with_effects(problem.library.used(theta))
    middle = np.median(own.X[:, 4:].transpose(0, 2, 1).reshape(-1, 3), axis=0)
    left_out = set() if own.has_voltage else {"battery"}
    left_out |= {"thrusters"} if own.command == "F_Bo_B" else set()
    every = list(itertools.product([t for t in MANEUVERS if t not in left_out], range(VARIANTS)))
    full = full_effort(thrusters)
    alone = np.min(np.abs(thrusters.curve.limits(thrusters.nominal_voltage)), axis=0) * np.ones(n)
    for first in range(0, len(every), R):
        some = every[first : first + R]
        wrench, voltage = np.zeros((len(own.u), 6, R)), np.ones((len(own.u), R))
        single = np.zeros((len(own.u), n, R))
        X = np.zeros((len(own.X), 7, R))
        X[:, 0] = 1.0
        X[:, 4:] = middle[:, None]
        for r, (name, k) in enumerate(some):
            maneuver, half = MANEUVERS[name], heading(k) / 2
            X[:, 0, r], X[:, 3, r] = np.cos(half), np.sin(half)
            x, y, depth = place(name, k)
            X[:, 4, r] += x
            X[:, 5, r] += y
            X[:, 6, r] *= depth
            share = maneuver.effort(own.times[:-1, r], k)
            if share.shape[1] == 1:
                single[:, k % n, r] = share[:, 0] * alone[k % n]
            else:
                wrench[..., r] = share * full
            voltage[:, r] = maneuver.voltage[k % len(maneuver.voltage)]
        allocated = thrusters.allocate(jnp.asarray(wrench.swapaxes(0, 1), thrusters.inverse.dtype))
        u = single + np.asarray(allocated).swapaxes(0, 1)
        names = [name for name, _ in some] + [""] * (R - len(some))
        data = replace(
            own, X=X, V=np.zeros_like(own.V), u=u, rise=None, past=np.zeros_like(own.past),
            voltage=voltage,
            weight=np.repeat([[float(name != "") for name in names]], len(u), axis=0),
        )  # fmt: skip
        yield names, _flown(model, data)


def _flown(model: Extended, data: Data) -> Data:
    """The data with the simulated motion; samples out of the water or diverged have no weight."""
    X1, V1 = forecast(model, data, len(data.u))
    X, V = np.concatenate([data.X[:1], X1]), np.concatenate([data.V[:1], V1])
    with np.errstate(invalid="ignore"):
        there = np.isfinite(X).all(axis=1) & (np.abs(V).max(axis=1) < _WILD)
        there &= X[:, 6] <= np.maximum(_SURFACE, data.X[0, 6])
    there = np.logical_and.accumulate(there, axis=0)
    last = np.maximum(there.sum(axis=0) - 1, 0)  # its repetitions have no weight
    at = np.minimum(np.arange(len(X))[:, None], last)[:, None]
    X, V = (np.take_along_axis(states, at, axis=0) for states in (X, V))
    force = None if data.specific_force is None else specific_force(X, V, data.step)
    weight = data.weight * there[1:]
    return replace(data, X=X, V=V, weight=weight, specific_force=force, climb=None, spread=None)
