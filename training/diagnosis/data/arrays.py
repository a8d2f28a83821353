"""Recordings as the arrays that a diagnosis works on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from ....models.config.errors import UserError
from ....models.effects.traits import Need, Region
from ....models.recordings.checks.small_speeds import DeadZone
from ....models.recordings.kinematics import dead_reckoned
from ....models.recordings.origin import states_estimated
from ....models.recordings.store import Recording
from ....models.se3 import AXES, TWIST, XYZ
from ....models.vehicles.vehicle import Vehicle
from ...data.behind_filter import with_rises
from .lost import known_errors, with_lost_zero
from .pieces import cut, stack, weight_of
from .readings import sensors_of_latent
from .reckoned import dead_reckoned_axes

SEGMENT = 256
"""Longest piece (samples) that a run is cut into; pieces are filtered side by side."""
_BLOCKS, _LEAST = 8, 16
"""Pieces that a single run is cut into at least, and samples of a piece at least."""
REMEMBERED, _OF_A_RUN = 0.5, 0.1
"""Time (s) before a piece whose commands may set its actuator states; share of a run at most."""
_BEYOND = 8.0
"""Multiple of a thruster's largest force above which commands can't be in newtons."""
_MARGIN = 0.3
"""Distance (m) between the places of a vehicle and the boundaries that are assumed around them."""
_MOST_FOLDS = 10
_FEW_RUNS = 6
_EVEN = 1e-6
"""Share of a step by which equal steps may differ."""


def all_equal(step: np.ndarray, dt: float) -> bool:
    """Whether steps (s) are all equal, with the mean `dt`."""
    return bool(np.ptp(step) <= _EVEN * dt)


@dataclass(frozen=True)
class Data:
    """R pieces of runs, N steps each, component first and pieces last; short pieces are padded.

    Attributes:
        X: recorded poses (N + 1, 7, R).
        V: recorded twists (N + 1, 6, R).
        u: commanded thruster forces (N), held from n to n + 1 (N, n, R).
        past: those of the steps before (N), oldest first (P, n, R): they set actuator states.
        past_step: how long each of these was held (s) (P, R).
        voltage: relative to the vehicle's nominal one (N, R).
        step: from sample n to n + 1 (s) (N, R).
        weight: 1 for steps that exist, else 0 (N, R).
        scenario: index into `names` (R,).
        run: which run a piece was cut from (R,).
        names: scenarios.
        dt: mean step (s).
        command: kind of commands: thruster_force, pwm or F_Bo_B.
        has_voltage: whether the voltage was recorded.
        unmeasured: coordinates of the position that are integrals of the velocity alone (then no
            error of position is used: in B the coordinates are mixed), and velocities that were not
            recorded. These are latent: `filter.reference` fills them with a simulation.
        reckoned: axes of W (0 to 2) whose position is an integral of the recorded velocity.
        specific_force: of the accelerometer (m/s²), where velocities are latent (N + 1, 3, R).
        climb: vertical velocity in W (m/s), where w follows from it and the latent ones (N + 1, R).
        began: time of each piece's first sample since the start of its run (s) (1, R).
        started: when each piece's run started, on the recorder's clock (s), if that is known (R,).
        labels: of the runs, by scenario.
        sampled: whether commands are a log's samples of faster ones.
        rise: change of the command over each step (N), whose mean it then is; None where it is held
            (N, n, R).
        estimated: whether the states are known to be a filter's estimate.
        zones: small speeds that an instrument lost.
        spread: standard deviation that a lost velocity adds to its record, which is zero; 0 where
            it was measured (m/s) (N + 1, 6, R). None where no zone was found.
    """

    X: Float[np.ndarray, "M 7 R"]
    V: Float[np.ndarray, "M 6 R"]
    u: Float[np.ndarray, "N n R"]
    past: Float[np.ndarray, "P n R"]
    past_step: Float[np.ndarray, "P R"]
    voltage: Float[np.ndarray, "N R"]
    step: Float[np.ndarray, "N R"]
    weight: Float[np.ndarray, "N R"]
    scenario: Int[np.ndarray, " R"]
    run: Int[np.ndarray, " R"]
    names: tuple[str, ...]
    dt: float
    command: str
    has_voltage: bool
    unmeasured: tuple[str, ...] = ()
    reckoned: tuple[int, ...] = ()
    specific_force: Float[np.ndarray, "M 3 R"] | None = None
    climb: Float[np.ndarray, "M R"] | None = None
    began: Float[np.ndarray, "1 R"] | None = None
    started: Float[np.ndarray, " R"] | None = None
    labels: tuple[str, ...] = ()
    sampled: bool = False
    rise: Float[np.ndarray, "N n R"] | None = None
    estimated: bool = False
    zones: tuple[DeadZone, ...] = ()
    spread: Float[np.ndarray, "M 6 R"] | None = None

    @property
    def known(self) -> Float[np.ndarray, "N 12 R"] | None:
        """1 for errors of a step that no lost velocity is in, else 0; None where none is lost."""
        return None if self.spread is None else known_errors(self.spread)

    @property
    def clean(self) -> Float[np.ndarray, "N R"]:
        """Weight of the steps that no lost velocity is in."""
        return self.weight if self.known is None else self.weight * self.known.min(axis=1)

    @property
    def measured(self) -> Float[np.ndarray, "12"]:
        """1 for errors (pose in B, twist) that are measured, 0 for others."""
        found = np.ones(12)
        found[:3] = not set(self.unmeasured) & set(XYZ)
        found[6:] = [name not in self.unmeasured for name in TWIST]
        return found

    @property
    def latent(self) -> list[int]:
        """Axes whose velocity was not measured, by index."""
        return [i for i, name in enumerate(TWIST) if name in self.unmeasured]

    @property
    def felt(self) -> tuple[int, ...]:
        """Those of them that an accelerometer tells of."""
        if self.specific_force is None or self.measured[:3].any():
            return ()
        return tuple(self.latent)

    @property
    def used(self) -> Float[np.ndarray, "12"]:
        """1 for errors that a filter uses: measured ones, and an accelerometer's in their place."""
        found = self.measured
        found[[6 + i for i in self.felt]] = 1.0
        return found

    @property
    def unseen(self) -> list[str]:
        """Axes of which no instrument tells."""
        return [AXES[i] for i in self.latent if i not in self.felt]

    @property
    def compared(self) -> Float[np.ndarray, "12"]:
        """1 for errors of simulations that are judged; dead-reckoned positions are, latent not."""
        return self.measured if self.latent else np.ones(12)

    @property
    def offers(self) -> frozenset[Need]:
        """What of the `needs` of effects was recorded."""
        level = self.command != "F_Bo_B"
        offered = {
            "voltage": self.has_voltage, "thrust": level, "pwm": self.command == "pwm",
            "velocity": not self.latent,
        }  # fmt: skip
        return frozenset(need for need, there in offered.items() if there)  # pyright: ignore[reportReturnType]

    @property
    def region(self) -> Region:
        """Where the vehicle was, with a margin, and the mean step."""
        p = self.X[:, 4:]
        low, high = p.min(axis=(0, 2)) - _MARGIN, p.max(axis=(0, 2)) + _MARGIN
        return Region(tuple(low.tolist()), tuple(high.tolist()), self.dt)

    @property
    def left_out(self) -> Literal["scenario", "run", "block"]:
        """What folds are: scenarios, runs of a single scenario, or blocks of few runs.

        A few long runs are too few to be left out in turn: they differ in what the vehicle does,
        so each would be judged by data of other motions, and intervals would rest on a handful.
        """
        if self.few:
            return "block"
        return "scenario" if len(np.unique(self.scenario)) > 1 else "run"

    @property
    def fold(self) -> Int[np.ndarray, " R"]:
        """Which pieces are left out together."""
        if self.left_out == "scenario":
            return self.scenario
        number = np.unique(self.cluster, return_inverse=True)[1]
        return number * min(_MOST_FOLDS, number.max() + 1) // (number.max() + 1)

    @property
    def cluster(self) -> Int[np.ndarray, " R"]:
        """Clusters of pieces that may depend on each other: runs; with few runs single pieces.

        A test between clusters needs more of them than a handful.
        """
        return np.arange(len(self.run)) if self.few else self.run

    @property
    def few(self) -> bool:
        """Whether there are few runs."""
        return len(np.unique(self.run)) < _FEW_RUNS

    @property
    def even(self) -> bool:
        """Whether all steps are equal."""
        return all_equal(self.step, self.dt)

    def own_steps(
        self, pieces: Int[np.ndarray, " K"] | slice = slice(None)
    ) -> Float[np.ndarray, "N _"]:
        """Steps of some pieces (s), as one column where all are equal."""
        return self.step[:, :1] if self.even else self.step[:, pieces]

    def past_steps(
        self, pieces: Int[np.ndarray, " K"] | slice = slice(None)
    ) -> Float[np.ndarray, "P _"]:
        """The same of the steps before."""
        return self.past_step[:, :1] if self.even else self.past_step[:, pieces]

    @property
    def longest(self) -> float:
        """The longest step (s)."""
        return float(self.step.max())

    @property
    def times(self) -> Float[np.ndarray, "M R"]:
        """Times of the samples since each piece's first (s), M = N + 1."""
        return np.concatenate([np.zeros((1, self.step.shape[1])), np.cumsum(self.step, axis=0)])

    @property
    def steps(self) -> int:
        """Steps that exist."""
        return int(self.weight.sum())


def make_data(
    recording: Recording,
    vehicle: Vehicle,
    segment: int = SEGMENT,
    without: Sequence[int] = (),
    remembered: float = REMEMBERED,
) -> Data:
    """Cut a recording into pieces and turn its commands into thruster forces.

    Thruster forces are as they are; PWM goes through the vehicle's curve at the recorded voltage; a
    wrench is allocated with the least effort. Runs `without` (by number, scenario by scenario) are
    left out unless none would remain. A run's first `remembered` s (a tenth at most) set actuators.
    Positions not measured are integrated velocities; velocities not measured, or lost, are zero.

    Raises:
        UserError: attitude or rates are missing, or no run has two samples.
    """
    unmeasured = unmeasured_channels(recording)
    latent = [i for i, name in enumerate(TWIST) if name in unmeasured]
    recording, zones, spread = with_lost_zero(recording)
    data, lengths = recording.dataset, recording.lengths
    thrust, volts, risen = _commands(recording, vehicle)
    extra = sensors_of_latent(recording, latent) | spread | risen
    kept, behind = _kept(lengths, without), max(1, round(remembered / recording.dt))
    segment = min(segment, _longest_piece(kept, lengths))
    pieces, scenario, run = list[dict[str, np.ndarray]](), list[int](), list[int]()
    for number, (j, k) in enumerate(np.argwhere(kept).tolist()):
        length = int(lengths[j, k])
        times, V = recording.elapsed(j, k), data["V_WB_B"].to_numpy()[j, k, :length].copy()
        V[:, latent] = 0.0
        X = dead_reckoned(times, data["X_WB"].to_numpy()[j, k, :length], V)
        of_run = X, V, thrust[j, k, :length], volts[j, k, :length], times
        first = min(behind, int(_OF_A_RUN * (length - 1))) if remembered else 0
        sensors = {name: values[j, k, :length] for name, values in extra.items()}
        pieces += cut(*of_run, sensors, first, segment, behind)
        scenario += [j] * (len(pieces) - len(run))
        run += [number] * (len(pieces) - len(run))
    if not run:
        raise UserError("recording: no run is long enough for a diagnosis")
    _refuse_units(recording, vehicle, thrust)
    arrays = {name: stack([piece[name] for piece in pieces]) for name in pieces[0]}
    weight = weight_of(np.array([len(piece["u"]) for piece in pieces]))
    mean, arrays["step"] = _steps(recording, arrays["step"], weight)
    return Data(
        **arrays,
        weight=weight,
        scenario=np.array(scenario, int),
        run=np.array(run, int),
        names=recording.scenarios,
        dt=mean,
        command=recording.thrust_from,
        has_voltage="voltage" in data and bool(np.isfinite(data["voltage"].to_numpy()).any()),
        unmeasured=unmeasured,
        reckoned=dead_reckoned_axes(arrays["X"], arrays["V"], arrays["step"], weight),
        started=_started(recording, kept, run),
        labels=run_labels(recording, kept),
        sampled=recording.commands_sampled,
        estimated=states_estimated(data),
        zones=zones,
    )


def _commands(
    recording: Recording, vehicle: Vehicle
) -> tuple[Float[np.ndarray, "S K N n"], Float[np.ndarray, "S K N"], dict[str, np.ndarray]]:
    """Thruster forces, relative voltage, and rises of forces over each step (`with_rises`)."""
    recording, rise = with_rises(recording, vehicle)
    return *recording.thrust(vehicle), {} if rise is None else {"rise": rise}


def _longest_piece(kept: np.ndarray, lengths: np.ndarray) -> int:
    """Samples of a piece at most: a single run is cut into several."""
    longest = int(lengths.max())
    return max(longest // _BLOCKS, _LEAST) if kept.sum() == 1 else longest


def _steps(
    recording: Recording, step: np.ndarray, weight: np.ndarray
) -> tuple[float, Float[np.ndarray, "N R"]]:
    """Mean step (s), and steps; all equal but for rounding where samples are on a grid."""
    if recording.uneven:
        return float((step * weight).sum() / weight.sum()), step
    return recording.dt, np.full(weight.shape, recording.dt)


def _started(
    recording: Recording, kept: np.ndarray, run: Sequence[int]
) -> Float[np.ndarray, " R"] | None:
    """When each piece's run started (s); None where that is not known, or runs overlap."""
    if "start_time" not in recording.dataset:
        return None
    start = recording.dataset["start_time"].to_numpy()[kept]
    at = np.argwhere(kept).tolist()
    ends = [a + recording.elapsed(j, k)[-1] for a, (j, k) in zip(start, at, strict=True)]
    order = np.argsort(start)
    apart = np.all(np.array(ends)[order[:-1]] <= start[order[1:]])
    return start[list(run)] if np.isfinite(start).all() and apart else None


def run_labels(recording: Recording, kept: np.ndarray | None = None) -> tuple[str, ...]:
    """A name of each run that is kept: its scenario, with its number there if there are several."""
    kept = recording.lengths > 0 if kept is None else kept
    several = (recording.lengths > 0).sum(axis=1) > 1
    return tuple(
        f"{recording.scenarios[j]}, run {k + 1}" if several[j] else str(recording.scenarios[j])
        for j, k in np.argwhere(kept)
    )


def _kept(lengths: np.ndarray, without: Sequence[int]) -> np.ndarray:
    """Runs of three samples and more, `without` some unless none would remain."""
    long = lengths >= 3
    kept = long.copy()
    for number, at in enumerate(np.argwhere(lengths > 0)):
        kept[tuple(at)] &= number not in without
    return kept if kept.any() else long


def unmeasured_channels(recording: Recording) -> tuple[str, ...]:
    """Coordinates and velocities that were not measured; attitude and rates must be."""
    lacking = recording.missing
    free = {"X_WB": XYZ, "V_WB_B": TWIST[:3]}
    needed = {name: [c for c in which if c not in free[name]] for name, which in lacking.items()}
    if any(needed.values()):
        channels = ", ".join(f"{name} {'/'.join(c)}" for name, c in needed.items() if c)
        raise UserError(
            f"recording: {channels} is missing; a diagnosis needs attitude and the rates p, q, r. "
            "Give rates from the attitude (differences, turned into B)"
        )
    return (*lacking.get("X_WB", ()), *lacking.get("V_WB_B", ()))


def _refuse_units(
    recording: Recording, vehicle: Vehicle, thrust: Float[np.ndarray, "S K N n"]
) -> None:
    """Refuse forces far beyond what the thrusters give: they are not in newtons."""
    most = np.maximum(*(np.abs(np.asarray(f)) for f in vehicle.thrusters().force_limits()))
    share = np.nanmax(np.abs(thrust), axis=(0, 1, 2)) / most
    k = int(np.argmax(share))
    if share[k] > _BEYOND:
        raise UserError(
            f"{recording.thrust_from} asks thruster {k + 1} for {share[k] * most[k]:.4g} N, "
            f"{share[k]:.0f} times what one of {vehicle.name} gives: give newtons (pulses in µs "
            "belong into columns pwm1, pwm2 …), or the --vehicle"
        )
