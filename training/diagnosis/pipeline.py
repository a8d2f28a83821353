"""From a recording and a believed model to named causes."""

import time
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...models.dynamics import Dynamics
from ...models.effects.base import Effect
from ...models.effects.extended import Extended
from ...models.effects.library import KINDS, Library, kind
from ...models.recordings.checks.finding import findings_of
from ...models.recordings.store import Recording
from ...models.se3 import AXES
from ...models.vehicles.vehicle import Vehicle
from .causes import (
    LAW_MARGIN,
    Progress,
    find_causes,
    law_causes,
    reported_causes,
    supported,
)
from .config import DiagnoseConfig
from .data.arrays import Data, run_labels
from .data.checks import limits, problems, require_enough, settled, unexcited, without_faults
from .data.heading_steps import in_words, turned_back
from .data.readings import with_velocity
from .disturbance.found import OF_OTHERS, all_laws, reported_laws
from .disturbance.laws import Law
from .disturbance.levels import LEVEL
from .filter.problem import DiagnosisProblem, Evaluation
from .findings import reported, result
from .findings.conclusion import conclude
from .findings.heading_off import off_causes
from .findings.ratios import ratios
from .findings.small_speeds import zone_causes
from .refitting import believed, with_refitted
from .selection.hypotheses import Fit
from .selection.model_selection import Hypothesis, parameters_of
from .selection.refit_all import identify, with_coefficients
from .selection.search import Search, refitted
from .selection.state import Fits, Selection
from .validation.blackbox import train
from .validation.claims import (
    LEFT,
    Judgement,
    asserted,
    better_in_part,
    clearly_better,
    names_of_horizons,
)
from .validation.simulation import Contender, Simulated
from .validation.validation import Judged, judge, model_gain, white_part

_RESAMPLED, _OF_A_STEP, _NO_TIME = 0.02, 0.1, 0.06
"""In resampled data: nats a sample that a law must win, and least lag or delay (share of a step).
In any data, delays below 6 % of a step are rejected: integration error looks like one. With ten
substeps a step, a pose half a substep late shows, without noise, as a clock offset of 5 %."""
_OF_A_COMMAND = 0.5
"""Least lag or delay of sampled commands, as a share of their period or, if longer, of the step
over which they were averaged: lines between samples of held commands come early by half of it."""
_FINEST = 0.02
"""Shortest step (s) that the extended model supports: it sets the length of delay buffers."""


@dataclass(frozen=True)
class Finding:
    """The diagnosis with what reports and the extended model need."""

    diagnosis: result.Diagnosis
    extended: Extended
    library: Library
    theta: Float[np.ndarray, " p"]
    data: Data
    base: Evaluation
    final: Evaluation
    fits: Fits
    laws: list[Law]
    judged: dict[str, Judged]

    @property
    def simulated(self) -> dict[str, Simulated]:
        """Simulations of each model."""
        return {name: j.simulated for name, j in self.judged.items()}

    @property
    def asserted(self) -> Judged:
        """The model that the verdict is about."""
        return self.judged[asserted(self.judged, bool(self.diagnosis.refitted))]


class Diagnoser:
    """One pass over a recording with one believed model: a `refit` of `auto` is `none` here."""

    def __init__(
        self,
        recording: Recording,
        vehicle: Vehicle,
        base: Dynamics | None = None,
        config: DiagnoseConfig | None = None,
        progress: Progress = lambda fraction, remark: None,
    ):
        config = DiagnoseConfig() if config is None else config
        self.config = replace(config, refit="none") if config.refit == "auto" else config
        self.furthest = 0.0
        self.report = progress
        recording, self.left_out = with_velocity(recording)
        recording, self.heading_off = turned_back(recording)
        self.labels = run_labels(recording)
        self.faults, faulty = problems(recording)
        self.faults += in_words(self.heading_off, self.labels, recording.notes)
        if faulty and len(faulty) == (recording.lengths > 0).sum():
            recording, faulty = without_faults(recording), []
        self.checked = [
            result.DataFinding(f.word, f.severity, f.place, f.text, f.remedy)
            for f in findings_of(recording.dataset)
        ]
        self.problem = DiagnosisProblem.of(recording, vehicle, base, faulty)
        require_enough(self.problem.data)
        if self.config.refit == "command":
            self.problem = with_coefficients(self.problem, "command")
        self.resampled = any("resampled" in note for note in recording.notes)
        self.command_period, self.sampled = recording.command_period, recording.commands_sampled
        directions = np.asarray(self.problem.model.allocate(jnp.eye(self.problem.data.u.shape[1])))
        self.quiet = unexcited(self.problem.data, directions)
        self.driven = len(self.quiet) < len(AXES)
        if not self.driven:
            self.faults.append(
                f"{recording.commands[0]} never changes: effects of the commands are not "
                "identifiable; check that the outputs of the runs were logged"
            )

    def progress(self, fraction: float, remark: str) -> None:
        """Report progress, which never decreases."""
        self.furthest = max(self.furthest, fraction)
        self.report(self.furthest, remark)

    def run(self) -> Finding:  # long: the order of the stages, one call each
        """The whole diagnosis."""
        started = time.monotonic()
        config, problem = self.config, self.problem
        self.progress(0.02, "one-step predictions")
        if config.refit == "all":
            problem = self.problem = with_coefficients(problem, "all")
        nuisance = refitted(problem, config.refit)
        if nuisance:
            remark = "all coefficients together"
            problem, base, first = with_refitted(
                problem, config.refit, lambda f: self.progress(0.03 + 0.07 * f, remark)
            )
            self.problem = problem
        else:
            base = first = believed(problem)
        start = Selection.start(problem, base, first, config.seed)
        found, nuisance, structures = self._find(start, nuisance)
        problem = found.problem
        self.progress(0.72, "all causes together")
        rows = reported.joint_rows(found, nuisance, problem)
        final = fitted = found.current
        joint = None
        if rows:
            found, rows, (theta, fitted, joint) = supported(found, nuisance, rows, self._together)
            final = problem.evaluate(theta)
        self.progress(0.78, "laws of the disturbance")
        least = self._least_gain(found)
        laws = self._laws(problem, final, least)
        groups = reported_laws(laws, problem, final, least)
        causes = reported_causes(found, nuisance, structures, final, joint, self.progress)
        of_laws, random_effects = law_causes(groups, laws, least, final, problem)
        causes += of_laws
        gain, judged = self._validate(
            problem, found, fitted, rows, groups, random_effects, bool(causes)
        )
        read_off, of_instruments = zone_causes(problem.data.zones, problem.library.effects)
        causes += [*off_causes(self.heading_off, self.labels), *read_off]
        residual = reported.residual(problem, final)
        left = reported.left_over(residual, causes, problem, final, least)
        if not self.driven:
            left.insert(0, "commands never change, so their effects are not identifiable")
        coefficients = [] if joint is None else reported.refitted(problem, final, nuisance, joint)
        found_ratios = ratios(problem, fitted, rows) if config.refit == "all" else []
        judgement = Judgement(judged, gain, config.horizon, problem.data.dt, config.seed)
        claim = judgement.of(bool(nuisance), final.noise.estimated)
        told = conclude(causes, left, claim, self.faults, coefficients, found_ratios)
        d = problem.data
        diagnosis = result.Diagnosis(
            version=result.VERSION,
            verdict=told.verdict,
            sentence=told.sentence,
            explained=claim.explained,
            left=told.left,
            causes=told.causes,
            refitted=coefficients,
            ratios=found_ratios,
            residual=residual,
            gain=gain,
            left_out=d.left_out if len(np.unique(d.fold)) > 1 else "nothing",
            data=self._summary(problem, final),
            tested=len(found.fits) + len(laws),
            threshold=found.threshold,
            alpha=config.alpha,
            seconds=time.monotonic() - started,
        )
        effects = *problem.library.used(final.theta), *random_effects, *of_instruments
        extended = Extended.create(problem.model.base, effects, problem.vehicle.thrusters())
        return Finding(
            diagnosis, extended.for_steps_of(_FINEST), problem.library, final.theta, d, base, final,
            found.fits, laws, judged,
        )  # fmt: skip

    def _find(
        self, start: Selection, nuisance: list[int]
    ) -> tuple[Selection, list[int], dict[Hypothesis, result.Structure]]:
        return find_causes(start, nuisance, self.config.refit, self._selector, self.progress)

    def _laws(self, problem: DiagnosisProblem, final: Evaluation, least: float) -> list[Law]:
        return [] if final.noise.estimated else all_laws(problem, final, least)

    def _least_gain(self, found: Selection) -> float:
        """Nats that a law must win."""
        least = found.threshold + LAW_MARGIN
        if self.resampled:  # interpolation makes the noise uneven
            least += _RESAMPLED * found.problem.data.steps
        # the residual of imperfectly fitted causes is no law
        least = max(least, OF_OTHERS * sum(choice.fit.heldout_gain for choice in found.accepted))
        return max(least, found.left_undescribed)

    def _summary(self, problem: DiagnosisProblem, final: Evaluation) -> result.DataSummary:
        d, estimated = problem.data, final.noise.estimated
        jacobian = np.einsum("njjr,nr->j", np.asarray(final.predictions.jacobian), d.weight)
        kept = jacobian[6:] / d.weight.sum()
        return result.DataSummary(
            scenarios=list(d.names),
            runs=len(np.unique(d.run)),
            seconds=d.steps * d.dt,
            step=d.dt,
            command=d.command,
            problems=self.faults,
            limits=[
                *limits(d, self.quiet, self.resampled, estimated, self.command_period),
                *(settled(kept, d.dt) if d.latent else []),
                *([self.left_out] if self.left_out else []),
            ],
            noise=reported.noise_levels(problem, final),
            findings=self.checked,
        )

    def _together(
        self, found: Selection, rows: list[int]
    ) -> tuple[np.ndarray, Evaluation, Fit | None]:
        """Joint fit of all causes and nuisance parameters."""
        problem = found.problem
        if not rows:
            return found.current.theta, found.current, None
        if self.config.refit != "all":
            return problem.polish(found.current.theta, rows)
        causes = parameters_of(problem.library, found.hypotheses)
        theta = identify(problem, start=found.current.theta, also=causes)
        fitted = problem.evaluate(theta, rows)
        return theta, fitted, fitted.evidence.fit(rows)

    def _selector(self, problem: DiagnosisProblem, nuisance: list[int]) -> Search:
        shortest = self._shortest(problem)
        config = self.config
        return Search(nuisance, config.alpha, config.most, self.quiet, shortest, config.horizon)

    def _shortest(self, problem: DiagnosisProblem) -> float:
        """Time (s) below which lags and delays are rejected."""
        shortest = (_OF_A_STEP if self.resampled else _NO_TIME) * problem.data.dt
        if self.sampled:
            period = max(self.command_period, problem.data.dt)
            shortest = max(shortest, _OF_A_COMMAND * period)
        return shortest

    def _validate(
        self,
        problem: DiagnosisProblem,
        found: Selection,
        fitted: Evaluation,
        rows: list[int],
        groups: list[list[Law]],
        random_effects: tuple[Effect, ...],
        extended: bool,
    ) -> tuple[dict[str, result.ModelGain], dict[str, Judged]]:
        """Base, base refitted, extended model and black box on data left out of their fits.

        `fitted` is the evaluation of the final fit, with sensitivities to the parameters of `rows`.
        """
        horizon, seed = self.config.horizon, self.config.seed
        self.progress(0.82, "validation: the believed model")
        R = len(problem.data.fold)
        still = np.repeat(problem.believed[:, None], R, axis=1)
        contenders = {"base": Contender(still)}
        if self.config.refit in ("none", "scales"):
            belief = refitted(problem, "linear")
            _, evaluation, _ = problem.polish(problem.believed, belief, rounds=3)
        else:
            belief = refitted(problem, self.config.refit)
            evaluation = problem.evaluate(
                problem.moved(found.first.theta, self.problem.library), belief
            )
        contenders["refitted"] = Contender(problem.without_each(evaluation, belief))
        if extended:
            laws = [law for group in groups for law in group if law.name != LEVEL]
            won = np.zeros(R)
            for law in laws:
                won += law.heldout if len(law.heldout) == R else 0.0
            white = white_part(laws, problem)
            # the level is estimated for every contender
            laws_of_it = tuple(e for e in random_effects if e.name != LEVEL)
            contenders["extended"] = Contender(
                problem.without_each(fitted, rows),
                law_gain=won,
                random_effects=laws_of_it,
                white_share=white,
            )
        contenders["black_box"] = Contender(
            still, train(found.base.predictions, problem.data, found.generator())
        )
        if rows:
            rest = train(fitted.predictions, problem.data, found.generator())
            contenders[LEFT] = Contender(problem.without_each(fitted, rows), rest)
        judged, estimated = {}, fitted.noise.estimated
        for number, (name, contender) in enumerate(contenders.items()):
            self.progress(0.84 + 0.03 * number, f"validation: {name.replace('_', ' ')}")
            in_use = [] if contender.black_box is not None else [*belief, *rows]
            judged[name] = judge(problem, contender, horizon, seed, in_use, estimated)
        gain = {
            name: model_gain(j, judged["base"], problem, horizon, np.random.default_rng(seed))
            for name, j in judged.items()
            if name != LEFT
        }
        return gain, judged


def diagnose(
    recording: Recording,
    vehicle: Vehicle,
    base: Dynamics | None = None,
    config: DiagnoseConfig | None = None,
    progress: Progress = lambda fraction, remark: None,
) -> Finding:
    """The errors of the believed model (`base`, or the vehicle's preset) on a recording.

    Raises:
        UserError: the recording lacks pose or twist, or is too short.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> made = GenerateConfig(("surge-forward", "yaw-left"), trajectories=3, duration=6.0)
        >>> config = DiagnoseConfig(refit="none", most=1, horizon=1.0)
        >>> found = diagnose(generate(made, vehicle), vehicle, config=config)
    """
    # threads of BLAS busy-wait for each other: with other load on the cores it is five times slower
    from threadpoolctl import threadpool_limits  # the import sets an environment variable

    with threadpool_limits(1, user_api="blas"):
        return _diagnose(recording, vehicle, base, config or DiagnoseConfig(), progress)


def for_all_coefficients(first: result.Diagnosis) -> str:
    """Why a diagnosis is tried again with all coefficients fitted, or nothing."""
    if first.left:
        return "left-out data speak against the verdict"
    named = {cause.name for cause in first.causes if cause.name in KINDS}
    motion = {"linear", "command", "scales"}
    several = sum(bool(motion & set(kind(name).refits)) for name in named)
    # where most coefficients are wrong, single ones explain each other's errors
    return "several coefficients are named" if several > 1 else ""


def _diagnose(
    recording: Recording,
    vehicle: Vehicle,
    base: Dynamics | None,
    config: DiagnoseConfig,
    progress: Progress,
) -> Finding:
    diagnoser = Diagnoser(recording, vehicle, base, config, progress)
    found = diagnoser.run()
    first = found.diagnosis
    why = for_all_coefficients(first)
    if config.refit != "auto" or not diagnoser.driven or not why:
        progress(1.0, "done")
        return found
    progress(0.0, f"again with all coefficients fitted, for {why}")
    again = Diagnoser(recording, vehicle, base, replace(config, refit="all"), progress).run()
    progress(1.0, "done")
    second = again.diagnosis
    models, seed = (again.asserted, found.asserted), config.seed
    horizons = names_of_horizons(models[0], config.horizon, again.data.dt)
    unopposed = not second.left and better_in_part(*models, horizons, seed)
    if not (unopposed or clearly_better(*models, seed)):
        return found
    return replace(again, diagnosis=replace(second, seconds=first.seconds + second.seconds))
