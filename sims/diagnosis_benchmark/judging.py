"""Judges one case: names, parameters, and gain relative to the true model's."""

from dataclasses import asdict, dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.recordings.csv import read_csv
from ...models.recordings.store import Recording
from ...models.vehicles.vehicle import Vehicle, load_vehicle
from ...training.diagnosis.data.arrays import make_data
from ...training.diagnosis.findings.result import Cause, Diagnosis
from ...training.diagnosis.pipeline import DiagnoseConfig, Finding, diagnose
from ...training.diagnosis.validation.forecast import Learned, forecast
from ..progress import Update
from .cases import Case, HiddenCause, Truth, read_oracle

CLOSE = 3.0
"""Standard errors within which a parameter is right."""
AT = 0.5
"""Time (s) within which the begin and the end of a part are right."""


@dataclass(frozen=True)
class Judgement:
    """Comparison of a diagnosis with the truth.

    Attributes:
        case, kind, label, size, data: of the case.
        verdict, verdict_right: the verdict, and whether it is right.
        hidden, named: names of the hidden causes and of the reported ones.
        first_right: the first reported cause is a hidden one, or a twin of one.
        declared: `first_right`, or a hidden cause is reported as indistinguishable from the first.
        place_right: the place of the first cause is right; None if it is not judged.
        when_right: it acts in the part of the data that is reported, or always, as reported.
        recalled, spurious: numbers of hidden causes that were named and of wrong names.
        z: deviation of each judged parameter in standard errors, by cause and name.
        ratio: found over true value.
        coefficients: of each coefficient over inertia whose truth is stated, by name and axis:
            deviation in standard errors, and found over true value.
        gain: share of the true model's gain over the belief, by part of the state and over `all`
            (m, rad, m/s and rad/s weighted equally); 1 is as good as the true model.
        told: whether each fault and limit of the data was reported; None if there are none.
        seconds: of the diagnosis.
    """

    case: str
    kind: str
    label: str
    size: float
    data: str
    verdict: str
    verdict_right: bool
    hidden: list[str]
    named: list[str]
    first_right: bool
    declared: bool
    place_right: bool | None
    when_right: bool
    recalled: int
    spurious: int
    z: dict[str, float] = field(default_factory=dict)
    ratio: dict[str, float] = field(default_factory=dict)
    coefficients: dict[str, tuple[float, float]] = field(default_factory=dict)
    gain: dict[str, float] = field(default_factory=dict)
    told: bool | None = None
    seconds: float = 0.0

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def fits(hidden: HiddenCause, found: Cause) -> bool:
    """Whether a named cause is the hidden one or one of its twins."""
    if hidden.name == "unknown":
        if found.name != "unknown":
            return False
        seen = found.structure.variables if found.structure is not None else []
        return not hidden.variables or bool(set(hidden.variables) & set(seen))
    return found.name == hidden.name or found.name in hidden.twins


def acts_when(hidden: HiddenCause, found: Cause) -> bool:
    """Whether a cause acts in the part of the data in which the hidden one does."""
    true, said = hidden.when, found.when
    if true is None or said is None:
        return true is None and said is None
    if true.kind != said.kind or true.kind == "drift":
        return true.kind == said.kind
    near = abs(said.start - true.start) <= AT and said.first_run == true.run
    return near and (true.kind == "onwards" or abs(said.end - true.end) <= AT)


def compare(truth: Truth, d: Diagnosis) -> dict[str, Any]:
    """All fields of a `Judgement` that depend on the truth, except the gain."""
    causes = d.causes
    first = causes[0] if causes else None
    matched = [h for h in truth.causes if first is not None and fits(h, first)]
    alike = () if first is None else first.indistinguishable_from
    indistinguishable = [h for h in truth.causes if h.name in alike]
    place = None
    if first is not None and matched and matched[0].where and matched[0].name == first.name:
        places = {w.strip() for w in first.where.split(",")}
        places |= {c.where for c in causes if c.name == first.name}
        place = matched[0].where in places
    z, ratio = {}, {}
    for h in truth.causes:
        same = [c for c in causes if c.name == h.name and h.where in ("", c.where)]
        same = same or [c for c in causes if c.name == h.name]
        for name, true in h.parameters.items() if same else ():
            value = same[0].parameters.get(name)
            if value is None:
                continue
            error = (value.interval95[1] - value.interval95[0]) / 3.92
            if not np.isfinite(error):
                continue  # reported as not identified
            off = max(abs(value.value - true) - h.tolerance * abs(true), 0.0)
            key = f"{h.name}.{name}"
            z[key] = float(np.copysign(off / max(error, 1e-300), value.value - true))
            if true:
                ratio[key] = value.value / true
    told = None
    if truth.problems or truth.limits:
        faults, limits = " ".join(d.data.problems), " ".join(d.data.limits)
        told = all(w in faults for w in truth.problems) and all(w in limits for w in truth.limits)
    return {
        "verdict": d.verdict,
        "verdict_right": d.verdict == truth.verdict,
        "hidden": [h.name for h in truth.causes],
        "named": [c.name for c in causes],
        "first_right": bool(matched) if truth.causes else not causes,
        "declared": bool(matched or indistinguishable) if truth.causes else not causes,
        "place_right": place,
        "when_right": first is None or all(acts_when(h, first) for h in matched),
        "recalled": sum(any(fits(h, c) for c in causes) for h in truth.causes),
        "spurious": sum(not any(fits(h, c) for h in truth.causes) for c in causes),
        "z": z,
        "ratio": ratio,
        "coefficients": coefficients(truth, d),
        "told": told,
    }


def coefficients(truth: Truth, d: Diagnosis) -> dict[str, tuple[float, float]]:
    """Deviation in standard errors, and found over true value, of each stated ratio."""
    found = {}
    for r in d.ratios:
        name = "thrust" if r.name == "half_thrust" else r.name
        true = truth.ratios.get(name, {}).get(r.where)
        low, high = r.found.interval95
        if true is None or not r.believed or not high > low:
            continue
        expected = true * r.believed
        z = (r.found.value - expected) / ((high - low) / 3.92)
        found[f"{name}.{r.where}"] = (float(z), float(r.found.value / expected))
    return found


def gain_of(case: Case, base: Extended, extended: Extended, vehicle: Vehicle) -> dict[str, float]:
    """1 - |extended - oracle|² / |base - oracle|² over all windows of the fresh runs.

    The recorded noise cancels, because forecasts are compared with those of the true model and all
    three start from the same records.
    """
    return share_of_gain(case, vehicle, (base, None), (extended, None))


def share_of_gain(
    case: Case,
    vehicle: Vehicle,
    base: tuple[Extended, Learned | None],
    better: tuple[Extended, Learned | None],
) -> dict[str, float]:
    """As `gain_of`, for models with a learned residual."""
    fresh = read_csv(case.folder / "fresh", resample=False)
    data = make_data(fresh, vehicle, segment=10**9, remembered=0.0)
    truths = read_oracle(case.folder / "oracle")
    every = case.truth.every
    off = [_off(forecast(model, data, every, rest), truths) for model, rest in (base, better)]
    for one in off:
        one["all"] = sum(one.values())
    return {part: 1 - off[1][part] / max(off[0][part], 1e-300) for part in off[0]}


def believed(truth: Truth, recording: Recording) -> tuple[Vehicle, Dynamics | None]:
    """The vehicle of a case's belief, and its dynamics if the case states a diffusion."""
    vehicle = load_vehicle(truth.vehicle or recording.vehicle or "bluerov2_heavy")
    if not truth.diffusion:
        return vehicle, None
    return vehicle, vehicle.dynamics(np.array(truth.diffusion, float))


def _off(
    forecasts: tuple[Float[np.ndarray, "N 7 R"], Float[np.ndarray, "N 6 R"]],
    truths: list[tuple[np.ndarray, np.ndarray]],
) -> dict[str, float]:
    total = {"position": 0.0, "rotation": 0.0, "velocity": 0.0, "rate": 0.0}
    for r, (X, V) in enumerate(truths):
        count = min(X.shape[1] - 1, len(forecasts[0]))
        X1, V1 = jnp.asarray(X[:, 1 : 1 + count]), V[:, 1 : 1 + count]
        X2, V2 = jnp.asarray(forecasts[0][:count, :, r].T), forecasts[1][:count, :, r].T
        turn = se3.log(se3.compose(se3.inverse(X1), X2))[3:]
        parts = (np.asarray(X2 - X1)[4:], np.asarray(turn), V2[:3] - V1[:3], V2[3:] - V1[3:])
        for name, part in zip(total, parts, strict=True):
            total[name] += float(np.sum(part**2))
    return total


def judge(case: Case, alpha: float, progress: Update) -> tuple[Judgement, Finding]:
    """Diagnose the data of a case, then compare with its truth.

    Raises:
        UserError: the data can't be read.
    """
    recording, truth = case.read(), case.truth
    vehicle, base = believed(truth, recording)
    finding = diagnose(recording, vehicle, base, DiagnoseConfig(alpha=alpha), progress)
    d = finding.diagnosis
    gain = {}
    if case.has_oracle and truth.causes:
        gain = gain_of(case, finding.extended.with_effects(()), finding.extended, vehicle)
    compared = compare(truth, d)
    about = {"case": case.name, "kind": truth.kind, "label": truth.called, "size": truth.size}
    return Judgement(**about, data=truth.data, **compared, gain=gain, seconds=d.seconds), finding
