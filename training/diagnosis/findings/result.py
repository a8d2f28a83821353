"""The result of a diagnosis: the content of `diagnosis.json`, and its schema."""

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ....models.files.atomic import atomic_path
from .data_summary import DataFinding, DataSummary
from .schema import described, plain, schema_of

__all__ = ["DataFinding", "DataSummary", "described"]

Verdict = Literal["adequate", "explained", "partly_explained", "unexplained"]
VERSION = 5


@dataclass(frozen=True)
class Value:
    """An estimate with its 95 % interval.

    Attributes:
        value: the estimate, in `unit`.
        unit: as text; 1 where it has none.
        interval95: lower and upper end, in `unit`; of Student's t, clustered by runs.
    """

    value: float
    unit: str
    interval95: tuple[float, float]

    @property
    def with_unit(self) -> str:
        """The estimate to four digits with its unit; a bare number if it is dimensionless."""
        return f"{self.value:.4g}" if self.unit == "1" else f"{self.value:.4g} {self.unit}"


@dataclass(frozen=True)
class Support:
    """Evidence for a cause: a p value over all causes tried, and nats on data left out.

    The p value is of a test clustered by runs; where few runs bound it, and the gain is clear (1.5
    to 5 times what noise wins), of the gain divided by that factor in noise alone.

    Attributes:
        p_value: probability that in noise alone the best of all causes fits as well; 0 where below
            1e-300.
        heldout_gain: log likelihood won on data left out of the fit (nats, in all).
    """

    p_value: float
    heldout_gain: float


@dataclass(frozen=True)
class Rival:
    """Another cause and the gain that it would have had.

    Attributes:
        name: of the effect.
        where: axis, thruster or frame, as of a cause.
        heldout_gain: what it would have won in the cause's place on data left out (nats, in all).
    """

    name: str
    where: str
    heldout_gain: float


@dataclass(frozen=True)
class Structure:
    """Structure that no cause explains: where it acts and what it depends on.

    Attributes:
        acts_on: axes, thruster or frame that it acts on.
        variables: what it depends on, most informative first.
        description: one sentence.
        lag: time constant of its memory (s), if it has one.
        frequency: of its oscillation (Hz), if it has one.
        region: of each variable, where it was seen: 2nd and 98th percentile (m, rad, m/s, rad/s,
            N).
        heldout_gain: won on data left out (nats, in all).
        best_name_gain: what the best named cause would have won instead (nats, in all).
    """

    acts_on: str
    variables: list[str]
    description: str
    lag: float | None
    frequency: float | None
    region: dict[str, tuple[float, float]]
    heldout_gain: float
    best_name_gain: float


@dataclass(frozen=True)
class When:
    """The part of the data in which a cause acts.

    Attributes:
        kind: `window` within a run, `onwards` from a time to the end of the data, or `drift` from
            none at the start of the data to all of it at their end.
        first_run: run in which it begins, by scenario.
        start: time in that run (s).
        last_run: run in which it ends.
        end: time in that run (s).
        text: the same in words.
    """

    kind: Literal["window", "onwards", "drift"]
    first_run: str
    start: float
    last_run: str
    end: float
    text: str


@dataclass(frozen=True)
class Cause:
    """One named cause.

    Attributes:
        name: of the effect, or `unknown` for structure that no effect explains.
        where: axis, thruster (1 to n, or `all`) or frame it is in.
        parameters: estimates by name, each with its unit.
        evidence: p value and held-out gain.
        rivals: causes that would have won most in its place, best first.
        indistinguishable_from: causes that these data do not distinguish from it and that are not
            named; of the same name with the place.
        next_experiment: what would distinguish it from these, or measure it better, in words.
        experiments: expected information of each maneuver beyond the data's (nats a minute): the
            logarithm by which the standard error of what the rival can't explain shrinks; empty
            where maneuvers don't matter.
        structure: what is known of the structure of an `unknown`; null for a named cause.
        when: the part of the data in which it acts; null for all of it. Parameters are then the
            changes there, and those of a drift the changes at its end.
    """

    name: str
    where: str
    parameters: dict[str, Value]
    evidence: Support
    rivals: list[Rival]
    indistinguishable_from: list[str]
    next_experiment: str
    experiments: dict[str, float] = field(default_factory=dict)
    structure: Structure | None = None
    when: When | None = None

    @property
    def place(self) -> str:
        """Where it acts, and when if not always."""
        return self.where if self.when is None else f"{self.where}, {self.when.text}"


@dataclass(frozen=True)
class AxisResidual:
    """The residual on an axis, against the predicted noise.

    Attributes:
        variance_ratio: innovations' variance over the predicted one, dimensionless; 1 where noise
            explains all, null (all three) where nothing was measured.
        autocorrelation: of innovations one step apart, dimensionless; 0 for white.
        mean: of innovations, in standard errors of a mean of independent numbers.
    """

    variance_ratio: float
    autocorrelation: float
    mean: float


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval by bootstrap over what was left out in turn.

    Attributes:
        value: in the unit of the field that holds it; null for simulations that diverged.
        interval95: lower and upper end, in the same unit.
    """

    value: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class ModelGain:
    """A model on data left out of its fit; horizons are seconds as text.

    Attributes:
        log_score: log density of the innovations (nats a sample); larger is better.
        log_score_gain: gain over the base (nats a sample).
        energy_score: by horizon, of simulations with noise: their mean distance from the record
            less half their mean distance from each other, m, rad, m/s and rad/s counted alike;
            smaller is better.
        position_rmse: by horizon, root mean square error of noise-free simulations (m).
        rotation_rmse: by horizon, of the rotation (rad).
        velocity_rmse: by horizon, of the velocity (m/s).
        coverage: by band (`50 %`, `90 %`) and horizon, share of records inside the band, 0 to 1,
            mean over axes.
    """

    log_score: Interval
    log_score_gain: Interval
    energy_score: dict[str, Interval]
    position_rmse: dict[str, Interval]
    rotation_rmse: dict[str, Interval]
    velocity_rmse: dict[str, Interval]
    coverage: dict[str, dict[str, Interval]]


@dataclass(frozen=True)
class Refitted:
    """A coefficient that was fitted before any cause was named: believed and fitted value.

    Attributes:
        name: of the effect that changes it.
        where: axis or thruster.
        parameter: of the effect.
        believed: value of the believed model, in the unit of `fitted`.
        fitted: value found.
    """

    name: str
    where: str
    parameter: str
    believed: float
    fitted: Value


@dataclass(frozen=True)
class Ratio:
    """A coefficient over inertia, which data determine without the mass: believed and found.

    Attributes:
        name: of the coefficient.
        where: axis.
        believed: value of the believed model, in the unit of `found`.
        found: value found.
    """

    name: str
    where: str
    believed: float
    found: Value


@dataclass(frozen=True)
class Change:
    """A cause that has changed since the healthy runs.

    Attributes:
        name: of the effect.
        where: axis, thruster (1 to n, or `all`) or frame it is in.
        text: the change in words.
        before: value of each parameter in the healthy runs, in the unit of `change`.
        change: new less healthy, by parameter; intervals hold the scatter between healthy units.
        ratio: new over healthy, where the parameter is a factor or a coefficient of the vehicle.
        p_value: probability of such a change of any cause between healthy data, from the scatter
            between healthy units.
    """

    name: str
    where: str
    text: str
    before: dict[str, float]
    change: dict[str, Value]
    ratio: Value | None
    p_value: float


@dataclass(frozen=True)
class Against:
    """What differs from the healthy runs, with a rate of false alarms that these have set.

    Attributes:
        verdict: unchanged (no test exceeds what healthy units do when left out), changed (by the
            named `changes`), changed_without_name (a test does, but no cause holds).
        sentence: the verdict in words.
        baseline: the diagnosis, or the healthy data.
        changes: causes that differ, first found first.
        noise: size of one-step errors over that of the healthy runs, by channel (x, y, z, roll,
            pitch, yaw, u, v, w, p, q, r), where the changes leave a difference.
        unit: what was left out of the healthy data in turn: scenario, run or stretch of a run.
        units: number of healthy units.
        judged: number of new units.
        rate: of false alarms that was asked for.
        counted_rate: least rate that so many healthy units can show by count; above `rate` where
            they are too few, and the threshold is then that of the theory or the largest score of
            healthy units, whichever is higher.
        score: of the new data, the largest over all causes: minus the logarithm of the p value.
        threshold: of the score; exceeded at half of the rate by healthy data.
        noise_score: the same of the sizes of errors, the largest over all channels.
        noise_threshold: of that score, for the other half of the rate.
        alarms: number of healthy units above a threshold when left out.
    """

    verdict: Literal["unchanged", "changed", "changed_without_name"]
    sentence: str
    baseline: str
    changes: list[Change]
    noise: dict[str, Value]
    unit: Literal["scenario", "run", "stretch"]
    units: int
    judged: int
    rate: float
    counted_rate: float
    score: float
    threshold: float
    noise_score: float
    noise_threshold: float
    alarms: int


@dataclass(frozen=True)
class Diagnosis:
    """The whole diagnosis.

    Attributes:
        version: of this format.
        verdict: adequate (no cause, and left-out data show none), explained (all by named causes,
            or by coefficients), partly_explained (named causes or coefficients, and `unknown` or
            what is in `left`), unexplained (`unknown` or `left` alone).
        sentence: the verdict in words.
        causes: those found, first found first.
        refitted: coefficients fitted before any cause was named.
        ratios: coefficients over inertia from such a fit; with `--refit all`, or where `auto` took
            that fit.
        residual: left by the causes, by channel: x, y, z, roll, pitch, yaw, u, v, w, p, q, r.
        gain: of base (the believed model), refitted (its coefficients fitted, no cause named),
            extended (with the causes, if any) and black_box (the base with a learned correction).
        left_out: what was left out in turn, for gains here and in causes.
        data: summary of the data.
        tested: number of causes tried.
        threshold: gain that noise exceeds over all causes with probability `alpha` (nats, in all).
        alpha: rate of false alarms over all causes together.
        seconds: computing time (s).
        explained: by horizon, share of the belief's forecast error on left-out data (root sum of
            squares over position, rotation and velocity, m, rad and m/s counted alike) that causes
            and refitted coefficients explain; empty where there are none.
        left: what data speak against the claim that only noise is left, a sentence each.
        against: with `--against`, what differs from the healthy runs; causes are then those that
            have changed, and the believed model is that of the healthy runs.
    """

    version: int
    verdict: Verdict
    sentence: str
    causes: list[Cause]
    refitted: list[Refitted]
    ratios: list[Ratio]
    residual: dict[str, AxisResidual]
    gain: dict[str, ModelGain]
    left_out: Literal["scenario", "run", "block", "nothing"]
    data: DataSummary
    tested: int
    threshold: float
    alpha: float
    seconds: float = field(default=0.0)
    explained: dict[str, Interval] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)
    against: Against | None = None

    def as_json(self) -> str:
        """Text of `diagnosis.json`; numbers that are not finite become null."""
        return json.dumps(plain(dataclasses.asdict(self)), indent=2, ensure_ascii=False) + "\n"

    def save(self, path: Path) -> None:
        """Write it as JSON; whole or not at all."""
        with atomic_path(path) as partial:
            partial.write_text(self.as_json(), encoding="utf-8")


def schema(cls: Any = None) -> dict[str, Any]:
    """JSON Schema (2020-12) of `diagnosis.json`."""
    return schema_of(Diagnosis if cls is None else cls)
