"""Completion of recordings: the state channels that were not recorded, estimated with a model.

The recorded channels and the specific force are measurements of a state that the model moves under
the recorded commands. Gauss-Newton steps on the whole path (the iterated extended Kalman smoother,
Bell 1994, "The iterated Kalman smoother as a Gauss-Newton method") alternate with fixed-point steps
to the most likely variances of all noise, so that a model that is wrong has wide bands. Errors of
the model that last are in them through the scales of its coefficients and a fading push.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.integrate import cast
from ...models.recordings.resample import rotations
from ...models.recordings.store import Recording
from ...models.se3 import TWIST as TWIST_NAMES
from ...models.se3 import XYZ
from .levels import Belief, Levels
from .passes import Pass, final_covariances, given_scales, imposed, smooth_runs
from .states import BIAS, FADING, LEVER, POSE, PUSH, SCALES, SIZE, TWIST, Scaled, State, Track
from .track import track_of

CHANNELS = (*XYZ, *TWIST_NAMES)
"""Channels that may be completed."""
_ROUNDS = 10
"""Gauss-Newton steps, each with a step of the variances."""
_STEP = 0.0125
"""Longest integration step (s): rates of a light vehicle settle within 20 ms."""
_TOGETHER = 8000  # samples whose covariances are in memory together
_LONGEST_STEP = 0.5
"""Largest change of a scale in a Gauss-Newton step."""
_KINEMATIC = 5e-5
"""Noise of the pose in a step (m, rad), of the order of the integration's error."""
_LEAST_SPEED = 0.1
"""Added to the spread of an unknown start (m/s, rad/s)."""
_FLOOR = np.array([5e-3] * 3 + [5e-4] * 3 + [5e-3] * 3 + [1e-3] * 3 + [5e-3] + [0.02] * 3)
_FIRST = np.array([0.01] * 3 + [2e-3] * 3 + [0.02] * 3 + [3e-3] * 3 + [0.02] + [0.1] * 3)
"""Least and first standard deviations of `MEASURED`: m, rad, m/s, rad/s, m/s, m/s²."""
_OWN_NOISE = 0.05
"""Noise of an accelerometer (m/s²). What it shows beyond is motion: as white as it is, it moves the
velocity, by as much times the step in each step. The likelihood knows this from the drag alone."""
_LEAST_WHITE, _LEAST_PUSH = 1e-3, 1e-4
"""Least b and push, relative to those that accelerate by 1 in a second."""


@dataclass(frozen=True)
class Completed:
    """A recording without missing channels of the state, and how well they are known.

    Attributes:
        recording: posterior means in the channels that were missing; recorded values elsewhere.
        deviation: standard deviation of each of `CHANNELS` (scenario, trajectory, time, 9), zero
            where it was recorded and NaN beyond a trajectory's end.
        observed: whether each of `CHANNELS` was recorded (scenario, trajectory, 9).
        followed: whether each of `CHANNELS` is as good as recorded: also w where the climb was.
        force: specific force at Bo, less the estimated bias (scenario, trajectory, time, 3); NaN
            where it was not recorded.
        causal: twists estimated from what was recorded until then (scenario, trajectory, time, 6).
        causal_cov: their covariance; zero in recorded components.
        levels: most likely levels of all noise.
        scales: means of the scales of the model's coefficients (`states`), by all runs together.
        scales_cov: their covariance.
        fit: log likelihood.
    """

    recording: Recording
    deviation: Float[np.ndarray, "J K N 9"]
    observed: Bool[np.ndarray, "J K 9"]
    followed: Bool[np.ndarray, "J K 9"]
    force: Float[np.ndarray, "J K N 3"]
    causal: Float[np.ndarray, "J K N 6"]
    causal_cov: Float[np.ndarray, "J K N 6 6"]
    levels: Levels
    scales: Float[np.ndarray, "22"]
    scales_cov: Float[np.ndarray, "22 22"]
    fit: float


def complete(
    recording: Recording,
    vehicle: Any,
    model: Dynamics,
    *,
    belief: Belief | None = None,
    levels: Levels | None = None,
    rounds: int = _ROUNDS,
) -> Completed:
    """Estimate the state channels that some run lacks.

    Args:
        recording: with attitude; what it has of positions, twist, `vertical_velocity`,
            `pressure_depth` and `imu_specific_force` is used.
        vehicle: as in `Recording.wrench`.
        model: a Fossen model or a SPINN, or either with effects. Laws of the disturbance among
            these are left out, as the levels of noise tell it, and so are errors of instruments.
        belief: how well the model and the accelerometer are known; by default as a preset is.
        levels: of all noise to start from; with `rounds` 1 to stay at.
        rounds: Gauss-Newton steps, between which levels are estimated.

    Raises:
        UserError: the samples have times of their own, the commands need a vehicle, or an effect
            of the model remembers the motion.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> recording = generate(GenerateConfig(trajectories=1, duration=4.0), vehicle)
        >>> complete(recording, vehicle, vehicle.dynamics(), rounds=2).recording.missing
        {}
    """
    if recording.uneven:
        raise UserError(
            "recording: its samples stand at times of their own; read the CSV files with resampling"
        )
    if why := not_completed_by(model):
        raise UserError(f"model: {why}")
    with jax.enable_x64(True):
        return _Completion.of(recording, vehicle, model, belief, levels).go(rounds)


def not_completed_by(model: Dynamics) -> str:
    """Why a model can't complete recordings, a clause; empty if it can."""
    effects = model.effects if isinstance(model, Extended) else ()
    remembering = sorted({e.name for e in effects if e.acts("feel")})
    if not remembering:
        return ""
    return (
        f"its effect {', '.join(remembering)} remembers the motion, which needs pose and twist "
        "recorded; leave it out"
    )


@dataclass
class _Completion:
    """The data and state of `complete`."""

    recording: Recording
    model: Scaled
    belief: Belief
    levels: Levels
    substeps: int
    track: Track
    places: list[tuple[int, int]]
    X: np.ndarray
    V: np.ndarray
    observed: np.ndarray
    scales: np.ndarray = field(default_factory=lambda: np.zeros(22))

    @classmethod
    def of(
        cls,
        recording: Recording,
        vehicle: Any,
        model: Dynamics,
        belief: Belief | None,
        levels: Levels | None,
    ) -> "_Completion":
        model, dt = cast(model, jnp.float64), recording.dt
        model = model.for_steps_of(dt) if isinstance(model, Extended) else model
        substeps = max(1, math.ceil(dt / _STEP - 1e-6))
        track, places, X, V, observed = track_of(recording, vehicle, model, substeps)
        if levels is None:
            unit = np.diag(np.asarray(model.coefficients(jnp.zeros(6)).mass.matrix()))
            levels = Levels(0.3 * unit, 0.05 * unit, _FIRST)
        belief = Belief.of_preset() if belief is None else belief
        scaled = Scaled.of(model)
        return cls(recording, scaled, belief, levels, substeps, track, places, X, V, observed)

    def go(self, rounds: int) -> Completed:
        """All passes over all runs."""
        together = max(1, _TOGETHER // self.track.F.shape[1])
        groups = [
            np.arange(i, min(i + together, len(self.places)))
            for i in range(0, len(self.places), together)
        ]
        references = [self._first(group) for group in groups]
        priors = [self._prior(r, g) for r, g in zip(references, groups, strict=True)]
        before, found = references, []
        shift, cov = np.zeros(22), np.eye(22)
        for n in range(rounds):
            before = references
            found = [self._pass(*given) for given in zip(groups, references, priors, strict=True)]
            shift, cov = self._common([f.own for f in found])
            # scales are logarithms: beyond a factor the linearisation tells the direction only
            share = min(1.0, _LONGEST_STEP / max(np.abs(shift).max(), 1e-9))
            references = [
                given_scales(r, f, jnp.asarray(shift), jnp.asarray(share))
                for r, f in zip(references, found, strict=True)
            ]
            self.scales = self.scales + share * shift
            if n < rounds - 1:
                self._estimate(found)
        return self._result(groups, before, references, found, shift, cov)

    def _pass(self, group: np.ndarray, reference: State, start: tuple[State, np.ndarray]) -> Pass:
        ways, q = self._process()
        prior, P_0 = start
        P_0 = P_0 + np.diag(self._start_push())
        part = jax.tree.map(lambda a: jnp.asarray(a[group]), self.track)
        noise = (self.levels.measured**2, ways, q, self._kinematic())
        R, ways, q, kinematic = (jnp.asarray(a) for a in noise)
        return smooth_runs(
            self.model, reference, prior, jnp.asarray(P_0), part,
            (R, ways, q, kinematic), jnp.asarray(self.recording.dt), self.substeps,
        )  # fmt: skip

    def _common(
        self, own: list[tuple[Array, Array]]
    ) -> tuple[Float[np.ndarray, "22"], Float[np.ndarray, "22 22"]]:
        """Mean (as an error of the reference) and covariance of the scales by all runs together."""
        before = self.belief.covariance()[SCALES, SCALES]
        information = np.linalg.inv(before)
        total, push = information.copy(), -information @ self.scales
        for means, covs in own:
            for mean, cov in zip(np.asarray(means), np.asarray(covs), strict=True):
                each = np.linalg.inv(cov)
                total += each - information
                push += each @ mean + information @ self.scales
        cov = np.linalg.inv((total + total.T) / 2)
        return cov @ push, cov

    # levels

    def _process(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the process noise of a step, and its variances along them.

        White acceleration moves the pose within the step too: by half the step times the change of
        the twist, and by a part that is independent of it (Brownian bridge).
        """
        mass = np.asarray(self.model.model.coefficients(jnp.zeros(6)).mass.matrix())
        ways, dt = np.zeros((SIZE, 18)), self.recording.dt
        ways[TWIST, :6] = np.linalg.inv(mass)
        ways[POSE, :6] = dt / 2 * ways[TWIST, :6]
        ways[POSE, 6:12] = dt / 12**0.5 * ways[TWIST, :6]
        ways[PUSH, 12:] = np.eye(6)
        white, lost = dt * self.levels.white**2, 1 - np.exp(-2 * dt / FADING)
        return ways, np.concatenate([white, white, lost * self.levels.push**2])

    def _kinematic(self) -> np.ndarray:
        noise = np.zeros(SIZE)
        noise[POSE] = _KINEMATIC**2
        noise[BIAS] = self.belief.walk**2 * self.recording.dt
        return noise

    def _start_push(self) -> np.ndarray:
        start = np.zeros(SIZE)
        start[PUSH] = self.levels.push**2
        return start

    def _estimate(self, found: list[Pass]) -> None:
        """A fixed-point step of all levels."""
        process = np.sum([np.asarray(f.process) for f in found], axis=0)
        noise = np.sum([np.asarray(f.noise) for f in found], axis=0)
        process[:, 6:12] += process[:, :6]
        factor, other = (_factor(a[0], a[1]) for a in (process[:, 6:], noise))
        unit = np.diag(np.linalg.inv(self._process()[0][TWIST, :6]))
        measured = np.maximum(self.levels.measured * other, _FLOOR)
        shaken = np.zeros(6)
        shaken[:3] = np.sqrt(np.maximum(measured[13:] ** 2 - _OWN_NOISE**2, 0.0))
        least = np.maximum(_LEAST_WHITE, shaken * self.recording.dt**0.5) * unit
        self.levels = Levels(
            np.maximum(self.levels.white * factor[:6], least),
            np.maximum(self.levels.push * factor[6:], _LEAST_PUSH * unit),
            measured,
        )

    # start

    def _first(self, group: np.ndarray) -> State:
        X, V = imposed(
            self.model, jnp.asarray(self.X[group]), jnp.asarray(self.V[group]),
            jnp.asarray(self.observed[group]), jnp.asarray(self.track.F[group]),
            jnp.asarray(self.recording.dt), self.substeps,
        )  # fmt: skip
        return State(X, V, jnp.zeros((*V.shape[:2], SIZE - 12)))

    def _prior(self, reference: State, group: np.ndarray) -> tuple[State, np.ndarray]:
        """Mean and covariance of the starts.

        A velocity that is not recorded begins anywhere within what the model reaches in this run.
        A position that is not recorded counts from the start.
        """
        here = np.asarray(self.track.lasts[group])[..., None]
        count = np.maximum(here.sum(axis=1), 1)
        speed = np.sqrt((np.asarray(reference.V) ** 2 * here).sum(axis=1) / count) + _LEAST_SPEED
        known = self.observed[group]
        X, V = (np.asarray(a[:, 0]) for a in (reference.X, reference.V))
        V = np.where(known[:, 0, 3:], V, 0.0)
        P = np.repeat(self.belief.covariance()[None], len(group), axis=0)
        index = np.arange(SIZE)
        P[:, index[:3], index[:3]] = np.where(known[:, 0, :3], 1.0, 1e-12)
        P[:, index[3:6], index[3:6]] = 0.01
        P[:, index[TWIST], index[TWIST]] = np.where(known[:, 0, 3:], 1.0, speed**2)
        others = jnp.zeros((len(group), SIZE - 12))
        return State(jnp.asarray(X), jnp.asarray(V), others), P

    # result

    def _result(
        self,
        groups: list[np.ndarray],
        before: list[State],
        after: list[State],
        found: list[Pass],
        shift: np.ndarray,
        cov: np.ndarray,
    ) -> Completed:
        data, lengths = self.recording.dataset, self.recording.lengths
        J, K, N = self.recording.mask.shape
        X, V = data["X_WB"].to_numpy().copy(), data["V_WB_B"].to_numpy().copy()
        deviation = np.full((J, K, N, 9), np.nan)
        observed, followed = np.ones((J, K, 9), bool), np.ones((J, K, 9), bool)
        force = np.full((J, K, N, 3), np.nan)
        causal, causal_cov = np.full((J, K, N, 6), np.nan), np.full((J, K, N, 6, 6), np.nan)
        for group, old, new, part in zip(groups, before, after, found, strict=True):
            spread, now, now_cov = final_covariances(part, jnp.asarray(shift), jnp.asarray(cov))
            arrays = new.X, new.V, old.V + now, spread, now_cov, new.others
            for i, g in enumerate(group):
                j, k = self.places[g]
                at = j, k, slice(int(lengths[j, k]))
                pose, twist, early, P, P_early, others = (
                    np.asarray(a[i])[: at[2].stop] for a in arrays
                )
                own = self.observed[g, 0]
                seen = V[at]
                X[at] = np.concatenate(
                    [X[at][:, :4], np.where(own[:3], X[at][:, 4:], pose[:, 4:])], axis=1
                )
                V[at] = np.where(own[3:], seen, twist)
                R = rotations(pose[:, :4].T).as_matrix()
                place = np.einsum("nij,njk,nik->ni", R, P[:, :3, :3], R)
                rest = np.diagonal(P[:, TWIST, TWIST], axis1=1, axis2=2)
                sd = np.sqrt(np.maximum(np.concatenate([place, rest], axis=1), 0.0))
                deviation[at] = np.where(own, 0.0, sd)
                observed[j, k] = followed[j, k] = own
                known = np.asarray(self.track.known[g, : at[2].stop])
                followed[j, k, 5] |= known[0, 12]
                felt = np.asarray(self.track.seen[g, : at[2].stop, 13:])
                felt = felt - _of_instrument(twist[:, 3:], others, self.recording.dt)
                force[at] = np.where(known[:, 13:], felt, np.nan)
                causal[at] = np.where(own[3:], seen, early)
                causal_cov[at] = P_early * np.outer(~own[3:], ~own[3:])
        completed = {
            name: (data[name].dims, a, data[name].attrs) for name, a in (("X_WB", X), ("V_WB_B", V))
        }
        fit = float(sum(float(part.fit) for part in found))
        return Completed(
            Recording(data.assign(completed)), deviation, observed, followed, force, causal,
            causal_cov, self.levels, self.scales, cov, fit,
        )  # fmt: skip


def _of_instrument(
    omega: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "N 34"], dt: float
) -> Float[np.ndarray, "N 3"]:
    """The part of the accelerometer's reading that is due to its bias and place."""
    bias, lever = (others[:, p.start - 12 : p.stop - 12] for p in (BIAS, LEVER))
    turned = np.cross(omega, np.cross(omega, lever))
    if len(omega) > 1:
        turned = turned + np.cross(np.gradient(omega, dt, axis=0), lever)
    return bias + turned


def _factor(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """The factor on a standard deviation; 1 for what has no effect."""
    ratio = np.where(expected > 0, found / np.where(expected > 0, expected, 1.0), 1.0)
    return np.sqrt(np.clip(ratio, 1 / 16, 16.0))
