"""The controller `!Maneuvers`: the data protocol of the paper, for a scenario of its own kind.

Before anything is flown the vehicle's model predicts every maneuver. Its start is moved, and if
that is not enough its effort reduced, until the predicted path stays within the water.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydrake.systems.framework import System

from ...models import se3
from ...models.config.checks import Within, check_numbers, require
from ...models.config.errors import UserError
from ...models.integrate import rollout
from ...models.vehicles.vehicle import Vehicle
from ...systems.controllers.impedance import ImpedanceGains, ImpedanceLaw
from ...systems.controllers.kinds import Controller, Goal
from ...systems.controllers.maneuvers import ManeuverProgram, ManeuverSequence, Steadiness
from ...systems.plant.wrench_limits import ThrusterLimits
from ...systems.station.config import StationConfig
from ...systems.station.ports import station_ports
from ...training.data.maneuvers import MANEUVERS, maneuver_wrench
from ...training.diagnosis.findings import maneuver_library as library

TRAJECTORIES = 20
"""Of each of the ten maneuvers, as in the paper."""
USUAL_EFFORT = 0.3
"""Of the ten maneuvers, as in `training.data.generate`; an experiment has its own."""
_SHARES = tuple(2 ** (-k / 2) for k in range(11))
"""Shares of the effort that are tried until a maneuver stays within its bounds."""
_MARGIN = 0.4
"""Distance (m) kept from every bound: the real vehicle is not the model, and water moves it."""
_SUBSTEPS = 4
_LONGEST = 0.05  # s between calls of the controller

UNFLOWN = {
    "thrusters": "a wrench is commanded, and no wrench runs one thruster alone",
    "battery": "it needs a full and an empty battery: fly `places` with each",
}
"""Maneuvers of the library that this controller can't fly, and why."""


class Flown(NamedTuple):
    """A trajectory to fly.

    Attributes:
        maneuver: its name.
        repeat: its number among the maneuver's, from 1.
        X_WB: where it begins.
        share: of the effort asked for that stays within the bounds.
    """

    maneuver: str
    repeat: int
    X_WB: Float[np.ndarray, "7"]
    share: float


@dataclass(frozen=True)
class Bounds:
    """Where a vehicle may be in a maneuver.

    Attributes:
        depths: least and greatest depth of Bo (m).
        half_sides: of the box about the start, along x and y of W (m).
        turn_rate: largest angular velocity (rad/s).
    """

    depths: tuple[float, float] = (0.5, 10.0)
    half_sides: tuple[float, float] = (20.0, 20.0)
    turn_rate: float = 1.5

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(self.depths[1] > self.depths[0], self, "depths", "give the smaller depth first")
        require(min(self.half_sides) > 0, self, "half_sides", "give lengths above zero")
        require(self.turn_rate > 0, self, "turn_rate", "give a rate above zero")


@dataclass(frozen=True)
class Maneuvers(Controller):
    """Each maneuver several times: to its start, at rest there, then open loop.

    Attributes:
        maneuvers: names of the ten maneuvers, or of those of a diagnosis' experiments
            (`training/diagnosis/findings/maneuver_library.py`).
        repeats: trajectories of each; an experiment's differ (axes, headings, places).
        duration: of the open loop (s).
        effort: share of the largest wrench, 0.3 if left out; of an experiment's own wrenches all.
        rate: of the commands and of the log (Hz).
        steady: when the open loop begins.
        bounds: in which the predicted motion stays.
        gains: of the proportional-derivative controller.
        error_limit: distance (m) and angle (rad) at which its error is saturated.
        finished: trajectories that aren't flown again, such as `surge-forward 3`.
        positioned: whether the vehicle knows its place; by default if a sensor observes horizontal
            motion. Otherwise a start is an attitude, a depth and a heading.
    """

    maneuvers: tuple[str, ...] = tuple(MANEUVERS)
    repeats: Annotated[int, Within(1, 10_000)] = TRAJECTORIES
    duration: Annotated[float, Within(0.5, 600)] = 10.0
    effort: Annotated[float | None, Within(0, 1, above=True)] = None
    rate: Annotated[float, Within(1, 100)] = 20.0
    steady: Steadiness = field(default_factory=Steadiness)
    bounds: Bounds = field(default_factory=Bounds)
    gains: ImpedanceGains = field(default_factory=ImpedanceGains)
    error_limit: tuple[float, float] = (1.0, 1.0)
    finished: tuple[str, ...] = ()
    positioned: bool | None = None

    def __post_init__(self) -> None:
        """Check names and numbers."""
        check_numbers(self)
        require(len(self.maneuvers) > 0, self, "maneuvers", "give at least one")
        distinct = len(set(self.maneuvers)) == len(self.maneuvers)
        require(distinct, self, "maneuvers", "give each one once")
        require(min(self.error_limit) > 0, self, "error_limit", "give numbers above zero")
        for name in self.maneuvers:
            check_maneuver(name)

    @property
    def steps(self) -> int:
        """Commands of a trajectory."""
        return round(self.duration * self.rate)

    @property
    def longest(self) -> float:
        """The longest that all can take (s)."""
        return len(self.wanted()) * (self.duration + self.steady.limit + 1.0) + 1.0

    def wanted(self) -> list[tuple[str, int]]:
        """Maneuver and number of every trajectory that is to be flown, in order."""
        every = [(name, k) for k in range(1, self.repeats + 1) for name in self.maneuvers]
        return [(name, k) for name, k in every if f"{name} {k}" not in self.finished]

    def plan(self, station: StationConfig) -> list[Flown]:
        """The trajectories to be flown, in order.

        Raises:
            UserError: a maneuver can't stay within the bounds, or all are finished.
        """
        return _planned(self, station)[0]

    def without_position(self, station: StationConfig) -> Controller | None:
        del station
        return self

    def build(self, station: StationConfig, goal: Goal = None) -> System:
        del goal
        flown, F_Bo_B, which = _planned(self, station)
        vehicle = station.load_vehicle()
        model = vehicle.dynamics()
        limits = ThrusterLimits.create(vehicle.thrusters(), station.voltage)
        law = ImpedanceLaw(*self.gains.matrices(model), limits, self.error_limit)
        starts = np.stack([each.X_WB for each in flown])
        held = -np.asarray(model.potential_wrench(jnp.asarray(starts.T))).T
        step = 1 / self.rate
        names = tuple((each.maneuver, each.repeat) for each in flown)
        program = ManeuverProgram(starts, which, F_Bo_B, held, step, names)
        period = step / math.ceil(step / _LONGEST - 1e-9)
        health = station_ports(station)[1]["health"] if _positioned(self, station) else None
        return ManeuverSequence(program, law, self.steady, period, health)


def _positioned(config: Maneuvers, station: StationConfig) -> bool:
    return station.sensing.horizontal if config.positioned is None else config.positioned


def check_maneuver(name: str) -> None:
    """Refuse a name that is none of a maneuver that can be flown.

    Raises:
        UserError: it is unknown, or the controller can't fly it.
    """
    if name in UNFLOWN:
        raise UserError(f"maneuver '{name}' can't be flown here: {UNFLOWN[name]}")
    if name not in MANEUVERS and name not in library.MANEUVERS:
        known = [*MANEUVERS, *(n for n in library.MANEUVERS if n not in UNFLOWN)]
        raise UserError(f"maneuver '{name}' is unknown; take one of {', '.join(known)}")


def wrenches(
    name: str, number: int, vehicle: Vehicle, config: Maneuvers
) -> tuple[Float[np.ndarray, "n 6"], float, tuple[float, float, float]]:
    """Wrenches of a trajectory, its heading from the start's (rad), and its place from there (m).

    The place is x and y, and the depth as a share of the start's.
    """
    thrusters = vehicle.thrusters()
    if name in MANEUVERS:
        F, _ = maneuver_wrench(name, thrusters, config.effort or USUAL_EFFORT)
        return np.tile(F, (config.steps, 1)), 0.0, (0.0, 0.0, 1.0)
    k = number - 1
    times = np.arange(config.steps) / config.rate
    F = library.MANEUVERS[name].effort(times, k) * library.full_effort(thrusters)
    return (config.effort or 1.0) * F, library.heading(k), library.place(name, k)


def _planned(
    config: Maneuvers, station: StationConfig
) -> tuple[list[Flown], Float[np.ndarray, "k n 6"], np.ndarray]:
    """Trajectories, the distinct wrench sequences, and which of these each trajectory flies."""
    vehicle = station.load_vehicle()
    start = np.asarray(station.start.pose(), float)
    wanted, kinds, which = config.wanted(), {}, []
    starts, sequences = [], []
    for name, number in wanted:
        F, turn, (x, y, depth) = wrenches(name, number, vehicle, config)
        X = _turned(start, turn)
        X[4:] += (x, y, (depth - 1) * start[6])
        key = (F.tobytes(), round(turn, 6))
        if key not in kinds:
            kinds[key] = len(sequences)
            sequences.append((F, X[:4]))
        which.append(kinds[key])
        starts.append(X)
    if not sequences:
        raise UserError("Maneuvers.finished: it holds all trajectories; give more `repeats`")
    low, high, rates = _paths(vehicle, sequences, 1 / config.rate)
    free = not _positioned(config, station)
    flown, shares = [], []
    for (name, number), X, row in zip(wanted, starts, which, strict=True):
        found = _fit(config.bounds, station, X, low[row], high[row], rates[row], free)
        if found is None:
            raise UserError(
                f"maneuver '{name}' does not stay within the bounds, even with {_SHARES[-1]:.0%} "
                f"of its effort: {_words(config.bounds)}; give a shorter --duration or more room"
            )
        shares.append(_SHARES[found[0]])
        flown.append(Flown(name, number, np.array([*X[:4], *found[1]]), shares[-1]))
    # a sequence with less effort is another one
    distinct = sorted(set(zip(which, shares, strict=True)))
    F_Bo_B = np.stack([share * sequences[row][0] for row, share in distinct])
    rows = [distinct.index(pair) for pair in zip(which, shares, strict=True)]
    return flown, F_Bo_B, np.array(rows)


def _turned(X: Float[np.ndarray, "7"], yaw: float) -> Float[np.ndarray, "7"]:
    """A pose turned about the vertical through its place."""
    turn = np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2), 0, 0, 0])
    turned = np.asarray(se3.compose(jnp.asarray(turn), jnp.asarray([*X[:4], 0.0, 0, 0])))
    return np.array([*turned[:4], *X[4:]])


def _paths(
    vehicle: Vehicle, sequences: Sequence[tuple[np.ndarray, np.ndarray]], dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest position relative to the start, and the largest turn rate.

    By sequence and share of its effort; the motion of the vehicle's model without noise.
    """
    model = vehicle.dynamics()
    S = len(_SHARES)
    F = np.stack([share * F for F, _ in sequences for share in _SHARES], axis=2)
    X = np.zeros((7, F.shape[2]))
    X[:4] = np.repeat(np.stack([q for _, q in sequences], axis=1), S, axis=1)
    run = jax.jit(lambda X, V, F: rollout(model, X, V, F, dt, substeps=_SUBSTEPS))
    poses, twists = (np.asarray(a) for a in run(jnp.asarray(X), jnp.zeros_like(X[:6]), F))
    p = np.concatenate([np.zeros_like(poses[:1, 4:]), poses[:, 4:]])
    rate = np.linalg.norm(twists[:, 3:], axis=1).max(axis=0)
    low, high = (np.moveaxis(m, 1, 0).reshape(-1, S, 3) for m in (p.min(axis=0), p.max(axis=0)))
    return low, high, rate.reshape(-1, S)


def _fit(
    bounds: Bounds,
    station: StationConfig,
    X: Float[np.ndarray, "7"],
    low: Float[np.ndarray, "s 3"],
    high: Float[np.ndarray, "s 3"],
    rates: Float[np.ndarray, " s"],
    free: bool,
) -> tuple[int, Float[np.ndarray, "3"]] | None:
    """The largest share of the effort that fits, and the start for it; None if none does.

    `free` says that x and y are not known, and not bounded.
    """
    middle = np.array(station.start.position[:2])
    half = np.full(2, np.inf) if free else np.array(bounds.half_sides) - _MARGIN
    first = np.array([*(middle - half), -bounds.depths[1] + _MARGIN])
    last = np.array([*(middle + half), -bounds.depths[0] - _MARGIN])
    for s in range(len(_SHARES)):
        nearest, farthest = first - low[s], last - high[s]
        if np.all(nearest <= farthest) and rates[s] <= bounds.turn_rate:
            return s, np.clip(X[4:], nearest, farthest)
    return None


def _words(bounds: Bounds) -> str:
    return (
        f"depths of {bounds.depths[0]:g} to {bounds.depths[1]:g} m, ± {bounds.half_sides[0]:g} by "
        f"± {bounds.half_sides[1]:g} m about the start, {bounds.turn_rate:g} rad/s, each with "
        f"{_MARGIN:g} m to spare"
    )
