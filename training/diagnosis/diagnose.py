"""From a recording and a belief to named causes."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ...models.checks import check_numbers, require
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.effects.library import KINDS, Library, kind
from ...models.recording import Recording
from ...models.vehicle import Vehicle
from . import result
from .checks import problems, unexcited
from .data import Data, make_data
from .experiments import next_experiment
from .gain import GROUPS, rmse, simulation_errors
from .gram import gram
from .hypotheses import Design, Evidence, Fit
from .innovations import Predictions, predict
from .laws import Law, find_laws, run_constants
from .naming import Choice, Hypothesis, admissible, choose, parameters_of
from .noise import Filter, Noise, estimate, make_filter, mean_jacobian
from .responses import LANES, respond

Progress = Callable[[float, str], None]
BELIEFS = ("added_mass", "linear_drag", "quadratic_drag", "net_buoyancy")
"""Coefficients that a user would expect fitted."""
_RANDOM = ("waves", "current_varying")
_HORIZONS = (0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class DiagnoseConfig:
    """How to look.

    Attributes:
        alpha: rate of false alarms over all names together.
        refit: what is fitted before and beside every cause: `none` (every difference from the
            belief is a cause), `scales` (one factor on all thrust) or `linear` (added masses,
            drag, buoyancy).
        most: causes at most.
        horizon: length of the simulations that the gain is told by (s).
        seed: of bootstraps.
    """

    alpha: float = 0.01
    refit: Literal["none", "scales", "linear"] = "none"
    most: int = 6
    horizon: float = 4.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_numbers(self)
        require(0 < self.alpha < 0.5, self, "alpha", "give a rate between 0 and 0.5")
        require(self.most >= 1, self, "most", "give at least 1")
        require(self.horizon > 0, self, "horizon", "give a positive time")


class Look(NamedTuple):
    """All that one set of parameters shows."""

    theta: Float[np.ndarray, " p"]
    predictions: Predictions
    noise: Noise
    kalman: Filter
    evidence: Evidence
    z: Float[np.ndarray, "N 12 R"]
    loss: float


@dataclass(frozen=True)
class Finding:
    """The diagnosis with what reports and the extended model need."""

    diagnosis: result.Diagnosis
    extended: Extended
    library: Library
    theta: Float[np.ndarray, " p"]
    data: Data
    base: Look
    final: Look
    fits: dict[Hypothesis, Fit]
    laws: list[Law]


class Diagnoser:
    """One recording under one belief."""

    def __init__(
        self,
        recording: Recording,
        vehicle: Vehicle,
        base: Dynamics | None = None,
        config: DiagnoseConfig | None = None,
        progress: Progress = lambda fraction, remark: None,
    ):
        self.config = DiagnoseConfig() if config is None else config
        self.progress = progress
        self.recording, self.vehicle = recording, vehicle
        self.data = make_data(recording, vehicle)
        believed = vehicle.dynamics() if base is None else base
        effects = believed.effects if isinstance(believed, Extended) else ()
        core = believed.base if isinstance(believed, Extended) else believed
        self.model = Extended.create(core, (), vehicle.thrusters())
        self.library, self.believed = self._library(effects)
        self.mass = np.asarray(self.model.inertia().matrix)
        self.rng = np.random.default_rng(self.config.seed)

    def _library(self, effects: tuple) -> tuple[Library, np.ndarray]:
        floor = float(self.data.X[:, 6].min()) - 0.3
        options = {"proximity": {"floor": floor}}
        left_out = set(_RANDOM) | (set() if self.data.has_voltage else {"voltage_sag"})
        kinds = [k for k in KINDS.values() if k.family != "disturbance" and k.name not in left_out]
        library = Library([k.neutral(**options.get(k.name, {})) for k in kinds])
        theta = np.zeros(library.size)
        for effect in effects:
            rows = [i for i, e in enumerate(library.entries) if e.cause == effect.name]
            theta[rows] = np.asarray(effect.values)
        return library, theta

    # ------------------------------------------------------------------------------- looking

    def predict(self, theta: np.ndarray) -> tuple[Predictions, Noise, Filter]:
        """Predictions with the noise and the filter that they ask for."""
        p = predict(self.model, self.library, theta, self.data)
        error, weight = np.asarray(p.error), self.data.weight
        A = mean_jacobian(np.asarray(p.jacobian), weight)
        noise = estimate(error, weight, A, self.mass, self.data.dt)
        inverse = np.linalg.inv(self.mass)
        kalman = make_filter(noise, A, inverse, self.data.dt, len(self.data.u))
        return p, noise, kalman

    def look(
        self, theta: np.ndarray, chosen: list[int] | None = None, kalman: Filter | None = None
    ) -> Look:
        """Innovations at θ and the responses to the parameters chosen.

        By default all but those in single thrusters of causes that may be in all of them.
        """
        p, noise, own = self.predict(theta)
        kalman = own if kalman is None else kalman
        if chosen is None:
            first = parameters_of(self.library, self.library.hypotheses(single=False))
            chosen = sorted({*first, *np.flatnonzero(theta).tolist()})
        design = Design.of(self.library, theta, chosen)
        z = respond(self.model, self.library, theta, design.probes, self.data, p, kalman)
        evidence = Evidence(self.library, theta, design, gram(z), self.data.run, self.data.scenario)
        own_z = z[0].reshape(len(self.data.u), 12, -1)
        return Look(theta, p, noise, kalman, evidence, own_z, float(evidence.total[0, 0]) / 2)

    def polish(
        self, theta: np.ndarray, chosen: list[int], kalman: Filter | None = None, rounds: int = 4
    ) -> tuple[np.ndarray, Look, Fit]:
        """Gauss–Newton on the parameters chosen, with exact predictions at every step."""
        assert len(chosen) <= LANES
        low = np.array([self.library.entries[i].parameter.low for i in chosen])
        high = np.array([self.library.entries[i].parameter.high for i in chosen])
        theta = theta.copy()
        theta[chosen] = np.clip(theta[chosen], low, high)
        best: tuple[np.ndarray, Look, Fit] | None = None
        for _ in range(rounds):
            seen = self.look(theta, chosen, kalman)
            fit = seen.evidence.fit(chosen)
            if best is not None and kalman is not None and seen.loss > best[1].loss:
                break
            best = theta.copy(), seen, fit
            step = fit.values.copy()
            theta[chosen] = np.clip(theta[chosen] + step, low, high)
            if np.all(np.abs(step) < 0.15 * fit.errors + 1e-12):
                break
        assert best is not None
        return best

    # ---------------------------------------------------------------------------- searching

    def nuisance(self) -> list[int]:
        """Parameters that are free beside every cause."""
        names = {"none": (), "scales": ("thrust_scale",), "linear": BELIEFS}[self.config.refit]
        return [i for i, e in enumerate(self.library.entries) if e.cause in names]

    def search(self) -> tuple[Look, Look, dict, list[tuple[Choice, Fit]], float, dict]:
        """Forward selection with re-linearisation and backward checks."""
        config, nuisance = self.config, self.nuisance()
        theta = self.believed.copy()
        self.progress(0.02, "one-step predictions")
        first = base = self.look(theta)
        if nuisance:
            fit = base.evidence.fit(nuisance)
            theta[nuisance] += fit.values
            first = self.look(theta)
        accepted: list[tuple[Choice, Fit]] = []
        current, first_fits, threshold = first, {}, 0.0
        names = self.library.hypotheses(single=False)
        for number in range(config.most):
            self.progress(0.15 + 0.6 * number / config.most, f"{number} causes so far")
            taken = [c.hypothesis for c, _ in accepted]
            beside = nuisance + parameters_of(self.library, taken)
            open_names = [h for h in names if h not in taken and not self._is_belief(h)]
            sets = [self.library.at(*h) for h in open_names]
            threshold = current.evidence.null_quantile(sets, beside, config.alpha, self.rng)
            fits = {
                h: current.evidence.fit(s, beside) for h, s in zip(open_names, sets, strict=True)
            }
            first_fits = first_fits or fits
            gains = {c.hypothesis[0]: f.heldout_gain for c, f in accepted}
            choice = choose(self.library, current.theta, fits, threshold, config.alpha, gains)
            if choice is not None and self._about_thrust(choice):
                fits = fits | self._single_thrusters(current, beside, taken)
                choice = choose(self.library, current.theta, fits, threshold, config.alpha, gains)
            laws = self.laws(current)
            if choice is None or laws[0].heldout_gain > choice.fit.heldout_gain:
                break  # what is left is random: names of structure would only imitate it
            choice, theta = self._refine(choice, fits, current, taken, nuisance)
            accepted.append((choice, choice.fit))
            current = self.look(theta)
            accepted = self._backward(accepted, current, threshold)
        return base, current, first_fits, accepted, threshold, {}

    def _about_thrust(self, choice: Choice) -> bool:
        """Whether the best names so far leave it open that a single thruster is at fault."""
        names = [choice.hypothesis[0], *(h[0] for h, _ in choice.rivals[:2])]
        level = self.data.command != "F_Bo_B"
        return level and any(kind(name).family == "actuation" for name in names)

    def _single_thrusters(
        self, current: Look, beside: list[int], taken: list[Hypothesis]
    ) -> dict[Hypothesis, Fit]:
        """Fits of causes in one thruster each, by the filter of the other names."""
        names = [h for h in self.library.hypotheses(single=True) if h not in taken]
        chosen = sorted({*parameters_of(self.library, names), *beside})
        seen = self.look(current.theta, chosen, current.kalman)
        return {h: seen.evidence.fit(self.library.at(*h), beside) for h in names}

    def laws(self, look: Look) -> list[Law]:
        """Laws of the disturbance in what is left, largest gain first."""
        data = self.data
        speed = np.linalg.norm(data.V[:-1, :3], axis=1)
        found = find_laws(look.z.astype(float), speed, data.weight, data.scenario, data.dt)
        rows = self.library.at("current_steady", "W")
        owned = set(look.evidence.design.owner.tolist())
        if set(rows) <= owned and len(look.evidence.runs) > 2:
            evidence = look.evidence
            columns = [evidence.column(i) for i in rows]
            sizes = np.array([self.library.entries[i].parameter.probes[0] for i in rows])
            gain, values = run_constants(evidence.runs, columns, sizes, evidence.fold)
            values["time_constant"] = float(data.weight.sum(axis=0).mean() * data.dt)
            found.append(Law("current_varying", "W", values, gain))
        return sorted(found, key=lambda law: -law.heldout_gain)

    def _is_belief(self, h: Hypothesis) -> bool:
        return self.config.refit == "linear" and h[0] in BELIEFS

    def _start(self, h: Hypothesis, fit: Fit, theta: np.ndarray) -> np.ndarray:
        moved = theta.copy()
        moved[list(fit.parameters)] += fit.values
        for i, change in fit.others.items():
            moved[i] += change
        return moved

    def _refine(
        self,
        choice: Choice,
        fits: dict[Hypothesis, Fit],
        current: Look,
        taken: list[Hypothesis],
        nuisance: list[int],
    ) -> tuple[Choice, np.ndarray]:
        """Fit the name with exact predictions; let close rivals try the same, and take the best."""
        beside = nuisance + parameters_of(self.library, taken)

        def fitted(h: Hypothesis, kalman: Filter | None) -> tuple[np.ndarray, Look]:
            chosen = [*self.library.at(*h), *beside][:LANES]
            theta, seen, _ = self.polish(self._start(h, fits[h], current.theta), chosen, kalman)
            return theta, seen

        theta, seen = fitted(choice.hypothesis, None)
        close = [h for h, g in choice.rivals[:2] if g > 0.7 * choice.fit.heldout_gain]
        if not close:
            return choice, theta
        top, best = (
            choice.hypothesis,
            self.polish(
                theta, [*self.library.at(*choice.hypothesis), *beside][:LANES], seen.kalman, 2
            )[1],
        )
        start_loss = best.loss
        for h in close:
            if h[0] in kind(top[0]).simpler:
                continue
            other, rival = fitted(h, seen.kalman)
            within = admissible(self.library, np.zeros_like(other), _as_fit(self.library, h, other))
            if within and rival.loss < best.loss - (2.0 if best.loss == start_loss else 0.0):
                top, theta, best = h, other, rival
        if top == choice.hypothesis:
            return choice, theta
        rivals = ((choice.hypothesis, choice.fit.heldout_gain), *choice.rivals)
        return Choice(top, fits[top], choice.ties, rivals), theta

    def _backward(
        self, accepted: list[tuple[Choice, Fit]], current: Look, threshold: float
    ) -> list[tuple[Choice, Fit]]:
        """Drop causes that those found later have made needless."""
        chosen = parameters_of(self.library, [c.hypothesis for c, _ in accepted])
        kept = []
        for choice, fit in accepted:
            own = self.library.at(*choice.hypothesis)
            others = [i for i in chosen if i not in own]
            again = current.evidence.fit(own, others)
            ratio = current.theta[own] / np.maximum(again.errors, 1e-300)
            if float(np.sum(ratio**2)) / 2 > threshold:
                kept.append((choice, fit))
            else:
                current.theta[own] = 0.0
        return kept

    # ------------------------------------------------------------------------------ telling

    def run(self) -> Finding:
        """All of it."""
        started = time.monotonic()
        base, final, fits, accepted, threshold, _ = self.search()
        self.progress(0.8, "laws of the disturbance")
        laws = self.laws(final)
        tested = len(fits) + len(laws)
        law_threshold = threshold + 5.0  # a grid of sizes and times on every axis
        passing = [law for law in laws if law.heldout_gain > law_threshold]
        causes = [self._cause(choice, fit, final, tested) for choice, fit in accepted]
        causes += _law_causes(passing, final, self.mass, self.data.dt)
        self.progress(0.85, "gain on scenarios left out")
        gain = self._gain(base, final, [c.hypothesis for c, _ in accepted])
        verdict: result.Verdict = "explained" if causes else "adequate"
        found = problems(self.recording)
        limits = unexcited(self.data)
        if self.data.command == "F_Bo_B":
            limits.append("commands are wrenches: single thrusters can't be told apart")
        if not self.data.has_voltage:
            limits.append("no voltage was recorded: voltage_sag can't be told")
        if len(self.data.names) == 1:
            limits.append("there is one scenario: nothing could be left out, gains are in-sample")
        diagnosis = result.Diagnosis(
            version=result.VERSION,
            verdict=verdict,
            sentence=_sentence(causes),
            causes=causes,
            residual=self._residual(final),
            gain=gain,
            data=result.DataSummary(
                scenarios=list(self.data.names),
                runs=len(np.unique(self.data.run)),
                seconds=self.data.steps * self.data.dt,
                step=self.data.dt,
                command=self.data.command,
                problems=found,
                limits=limits,
                noise=_noise_words(final.noise),
            ),
            tested=tested,
            threshold=threshold,
            alpha=self.config.alpha,
            seconds=time.monotonic() - started,
        )
        extended = Extended.create(
            self.model.base, self.library.used(final.theta), self.vehicle.thrusters()
        )
        self.progress(1.0, "done")
        return Finding(
            diagnosis, extended, self.library, final.theta, self.data, base, final, fits, laws
        )

    def _cause(self, choice: Choice, fit: Fit, final: Look, tested: int) -> result.Cause:
        name, where = choice.hypothesis
        rows = self.library.at(name, where)
        others = parameters_of(self.library, [])
        errors = final.evidence.fit(rows, others).errors
        values = {}
        for i, error in zip(rows, errors, strict=True):
            p = self.library.entries[i].parameter
            v = float(final.theta[i])
            values[p.name] = result.Value(v, p.unit, (v - 1.96 * error, v + 1.96 * error))
        rivals = [result.Rival(h[0], h[1], float(g)) for h, g in choice.rivals]
        return result.Cause(
            name=name,
            where=where,
            parameters=values,
            evidence=result.Support(min(1.0, fit.p_value * tested), fit.heldout_gain),
            rivals=rivals,
            indistinguishable_from=list(dict.fromkeys(h[0] for h in choice.ties if h[0] != name)),
            next_experiment=next_experiment(
                name, kind(name).family, [*(h[0] for h in choice.ties), *(r.name for r in rivals)]
            ),
        )

    def _residual(self, final: Look) -> dict[str, result.AxisResidual]:
        names = ("x", "y", "z", "roll", "pitch", "yaw", "u", "v", "w", "p", "q", "r")
        w = self.data.weight
        found = {}
        for i, name in enumerate(names):
            z = final.z[:, i] * w
            n = w.sum()
            found[name] = result.AxisResidual(
                float((z**2).sum() / n),
                float((z[1:] * z[:-1]).sum() / max((z**2).sum(), 1e-300)),
                float(z.sum() / np.sqrt(n)),
            )
        return found

    def _gain(
        self, base: Look, final: Look, chosen: list[Hypothesis]
    ) -> dict[str, result.ModelGain]:
        """Base and extended model on scenarios that were left out of the fit."""
        parameters = parameters_of(self.library, chosen)
        R = self.data.X.shape[2]
        theta = np.repeat(final.theta[:, None], R, axis=1)
        evidence = final.evidence
        if parameters and len(evidence.folds) > 1:
            columns = [evidence.column(i) for i in parameters]
            for f, label in enumerate(np.unique(evidence.fold)):
                T = evidence.total - evidence.folds[f]
                change = -np.linalg.solve(T[np.ix_(columns, columns)], T[columns, 0])
                out = np.flatnonzero(self.data.scenario == label)
                theta[np.array(parameters)[:, None], out] += change[:, None]
        thetas = {"base": np.repeat(self.believed[:, None], R, axis=1)}
        if parameters:
            thetas["extended"] = theta
        found = {}
        for name, values in thetas.items():
            look = base if name == "base" else final
            score = -(look.z**2).sum(axis=(0, 1)) / 2 - look.kalman.log_det @ self.data.weight
            errors = simulation_errors(
                self.model, self.library, values, self.data, self.config.horizon
            )
            tables = {}
            horizons = [h for h in _HORIZONS if h <= errors.shape[1] * self.data.dt + 1e-9]
            for group in GROUPS:
                value, spread = rmse(errors, group, self.data.scenario, self.rng)
                at = [round(h / self.data.dt) - 1 for h in horizons]
                tables[group] = {
                    f"{h:g}": _interval(value[k], spread[:, k])
                    for h, k in zip(horizons, at, strict=True)
                }
            found[name] = result.ModelGain(
                self._score(score), tables["position"], tables["rotation"], tables["velocity"]
            )
        return found

    def _score(self, score: np.ndarray) -> result.Interval:
        labels = np.unique(self.data.scenario)
        sums = np.array([score[self.data.scenario == f].sum() for f in labels])
        counts = np.array([self.data.weight[:, self.data.scenario == f].sum() for f in labels])
        drawn = self.rng.integers(len(labels), size=(200, len(labels)))
        return _interval(sums.sum() / counts.sum(), sums[drawn].sum(1) / counts[drawn].sum(1))


def _as_fit(library: Library, h: Hypothesis, theta: np.ndarray) -> Fit:
    rows = library.at(*h)
    return Fit(tuple(rows), theta[rows], {}, np.zeros(len(rows)), 0.0, np.zeros(1), 1.0)


def _interval(value: float, draws: np.ndarray) -> result.Interval:
    low, high = np.percentile(draws, (2.5, 97.5))
    return result.Interval(float(value), (float(low), float(high)))


def _noise_words(noise: Noise) -> dict[str, float]:
    groups = ("position_m", "attitude_rad", "velocity_m_s", "rate_rad_s")
    found = {g: float(np.mean(noise.record[3 * i : 3 * i + 3])) for i, g in enumerate(groups)}
    axes = ("surge", "sway", "heave", "roll", "pitch", "yaw")
    return found | {f"diffusion_{a}": float(b) for a, b in zip(axes, noise.diffusion, strict=True)}


def _law_causes(laws: list[Law], final: Look, mass: np.ndarray, dt: float) -> list[result.Cause]:
    """The best law as a cause, its numbers turned into those of the effect (without intervals)."""
    if not laws:
        return []
    top = laws[0]
    same = [law.where for law in laws if law.name == top.name]
    axes = ("surge", "sway", "heave", "roll", "pitch", "yaw")
    b = float(final.noise.diffusion[axes.index(top.where)]) if top.where in axes else 0.0
    numbers = dict(top.parameters)
    if top.name == "disturbance_impacts":
        numbers = {"impulse": b * np.sqrt(dt) * numbers["size"], "rate": numbers["share"] / dt}
    elif top.name == "disturbance_colour":
        share, tau = numbers["share"], numbers["time_constant"]
        numbers = {"std": b * np.sqrt(share / dt), "time_constant": tau}
    units = {p.name: p.unit for p in kind(top.name).parameters}
    nan = float("nan")
    values = {k: result.Value(float(v), units[k], (nan, nan)) for k, v in numbers.items()}
    rivals = [result.Rival(r.name, r.where, r.heldout_gain) for r in laws if r.name != top.name]
    return [
        result.Cause(
            top.name,
            ", ".join(same),
            values,
            result.Support(float(np.exp(-top.heldout_gain)), top.heldout_gain),
            rivals[:4],
            [],
            next_experiment(top.name, "disturbance", [r.name for r in rivals]),
        )
    ]


def _sentence(causes: list[result.Cause]) -> str:
    if not causes:
        return "Your model is adequate at this noise."
    named = ", ".join(f"{c.name} ({c.where})" for c in causes)
    return f"The data differ from your model by: {named}."


def diagnose(
    recording: Recording,
    vehicle: Vehicle,
    base: Dynamics | None = None,
    config: DiagnoseConfig | None = None,
    progress: Progress = lambda fraction, remark: None,
) -> Finding:
    """What the belief (`base`, or the vehicle's preset) gets wrong about a recording.

    Raises:
        UserError: the recording lacks pose or twist, or is too short.
    """
    return Diagnoser(recording, vehicle, base, config, progress).run()
