"""From healthy runs, their model and new recordings to what has changed."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from ....models.dynamics import Dynamics
from ....models.recordings.store import Recording
from ....models.vehicles.vehicle import Vehicle
from ..causes import Progress
from ..config import DiagnoseConfig
from ..data.heading_steps import turned_back
from ..disturbance.laws import Law
from ..filter.problem import DiagnosisProblem, Evaluation
from ..findings import result
from ..findings.reported import unit
from ..pipeline import Diagnoser, Finding
from ..selection.model_selection import Hypothesis
from ..selection.state import Selection
from .baseline import Baseline
from .scatter import Change
from .search import ChangeSearch
from .words import COEFFICIENTS, FACTORS, sentence_of, text_of


@dataclass(frozen=True)
class Healthy:
    """Healthy runs, the model that a diagnosis of them found, and what both are called."""

    recording: Recording
    model: Dynamics
    name: str


class ChangeDiagnoser(Diagnoser):
    """A diagnosis of new runs, with healthy ones as the belief and as the measure of chance."""

    def __init__(
        self,
        recording: Recording,
        vehicle: Vehicle,
        healthy: Healthy,
        config: DiagnoseConfig | None = None,
        progress: Progress = lambda fraction, remark: None,
    ):
        config = replace(DiagnoseConfig() if config is None else config, refit="none")
        super().__init__(recording, vehicle, healthy.model, config, progress)
        self.healthy = healthy
        shortest = self._shortest(self.problem)
        runs, new = (turned_back(given)[0] for given in (healthy.recording, recording))
        self.baseline = Baseline(runs, new, vehicle, healthy.model, shortest)
        self.problem = self.baseline.new

    def run(self) -> Finding:
        """The whole diagnosis, with what has changed."""
        finding = super().run()
        causes = finding.diagnosis.causes
        told = self._against(finding.theta, causes)
        d = replace(
            finding.diagnosis, against=told, sentence=told.sentence, alpha=self.config.alpha
        )
        return replace(finding, diagnosis=d)

    def changed(self, start: Selection) -> Selection:
        """The selection of what has changed."""
        side = self.baseline.side(start.current.theta)
        self.judged = len(side.products)
        self.limits = self.baseline.limits(self.config.alpha, self.judged, self.config.seed)
        self.scores = self.baseline.tests(side)[1]
        search = ChangeSearch(
            **vars(self._selector(start.problem, [])),
            baseline=self.baseline,
            limits=self.limits,
        )
        if not self.limits.exceeded(self.scores):
            return replace(search.propose(start), proposal=None, done=True)
        return search.run(start, progress=lambda f, remark: self.progress(0.2 + 0.5 * f, remark))

    def _find(
        self, start: Selection, nuisance: list[int]
    ) -> tuple[Selection, list[int], dict[Hypothesis, result.Structure]]:
        self.progress(0.1, "healthy runs, each left out in turn")
        return self.changed(start), nuisance, {}

    def _laws(self, problem: DiagnosisProblem, final: Evaluation, least: float) -> list[Law]:
        """None: sizes of errors are compared with those of the healthy runs."""
        return []

    def _against(self, theta: np.ndarray, causes: list[result.Cause]) -> result.Against:
        side, baseline, limits = self.baseline.side(theta), self.baseline, self.limits
        causes = [c for c in causes if c.when is None]  # what acts in a part is read off
        names = [(c.name, c.where) for c in causes]
        changes = []
        for cause, h in zip(causes, names, strict=True):
            tested = baseline.tests(side, [other for other in names if other != h])[0].get(h)
            if tested is not None:
                p = cause.evidence.p_value
                changes.append(reported_change(baseline.new, theta, h, tested, p))
        noise = {
            name: _size(off, width)
            for name, (off, width, score) in baseline.noise_tests(side).items()
            if score > limits.noise.threshold
        }
        alarm = limits.exceeded(self.scores)
        verdict = "changed" if changes else "changed_without_name" if alarm else "unchanged"
        return result.Against(
            verdict=verdict,
            sentence=sentence_of(changes, noise, alarm, limits, baseline.level),
            baseline=self.healthy.name,
            changes=changes,
            noise=noise,
            unit=baseline.level,
            units=baseline.units,
            judged=self.judged,
            rate=limits.rate,
            counted_rate=limits.counted,
            score=self.scores.causes,
            threshold=limits.causes.threshold,
            noise_score=self.scores.noise,
            noise_threshold=limits.noise.threshold,
            alarms=limits.causes.alarms + limits.noise.alarms,
        )


def _size(off: float, width: float) -> result.Value:
    """A factor of standard deviations from a change of log variance and its half-width."""
    middle, low, high = (float(np.exp(x / 2)) for x in (off, off - width, off + width))
    return result.Value(middle, "1", (low, high))


def reported_change(
    problem: DiagnosisProblem,
    theta: np.ndarray,
    h: Hypothesis,
    tested: Change,
    p_value: float,
) -> result.Change:
    """A change in numbers and words, from the exact fit, with the errors of its test.

    What healthy units estimate of the cause beside their model is part of the value before.
    """
    name, where = h
    rows = problem.library.at(*h)
    t = float(scipy.stats.t.ppf(0.975, min(tested.freedom, 1e6)))
    before, change, ratio = {}, {}, None
    for i, healthy, error in zip(rows, tested.healthy, tested.errors, strict=True):
        p = problem.library.entries[i].parameter
        old = p.usual + float(problem.believed[i] + healthy)
        value = p.usual + float(theta[i]) - old
        ends = (value - t * float(error), value + t * float(error))
        before[p.name] = old
        change[p.name] = result.Value(value, unit(p.unit, where), ends)
        base = 1.0 if name in FACTORS else 0.0
        if name in COEFFICIENTS:
            base = problem.believes(name, where)
        if name in FACTORS or (name in COEFFICIENTS and base + old > 0):
            whole = base + old
            ratio = result.Value(1 + value / whole, "1", (1 + ends[0] / whole, 1 + ends[1] / whole))
    return result.Change(
        name, where, text_of(name, where, before, change, ratio), before, change, ratio, p_value
    )


def diagnose_against(
    recording: Recording,
    vehicle: Vehicle,
    healthy: Healthy,
    config: DiagnoseConfig | None = None,
    progress: Progress = lambda fraction, remark: None,
) -> Finding:
    """What differs in a recording from healthy runs, by causes and with a rate of false alarms.

    `config.alpha` is the rate. The healthy model is the belief, and its coefficients are held: a
    cause is a change of it. Tests and intervals take their scale from the scatter between healthy
    units (scenarios, runs or stretches), and the threshold from units left out in turn.

    Raises:
        UserError: the recordings lack what a diagnosis needs, or were not recorded alike.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> made = GenerateConfig(("surge-forward", "yaw-left"), trajectories=3, duration=6.0)
        >>> healthy = Healthy(generate(made, vehicle), vehicle.dynamics(), "generated")
        >>> new = generate(replace(made, seed=1), vehicle)
        >>> diagnose_against(new, vehicle, healthy).diagnosis.against.verdict
        'unchanged'
    """
    from threadpoolctl import threadpool_limits  # the import sets an environment variable

    with threadpool_limits(1, user_api="blas"):
        found = ChangeDiagnoser(recording, vehicle, healthy, config, progress).run()
    progress(1.0, "done")
    return found
