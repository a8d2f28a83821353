"""What a diagnosis tells a user to act on, as sections of a page: of the report and of the demo."""

import math
from collections.abc import Callable

import numpy as np

from ...training.diagnosis.findings.result import Cause, Diagnosis, Interval, Ratio, Value
from ...training.diagnosis.findings.sentences import differing, in_words
from .pages import Page

VERDICTS = {
    "adequate": "left-out data show no difference of a practical size",
    "explained": "named causes or coefficients explain every difference that the data show",
    "partly_explained": "named causes or coefficients, and errors that they do not explain",
    "unexplained": "structure or errors that no cause explains",
}
MODELS = {
    "base": "belief", "refitted": "refitted", "extended": "with the causes",
    "black_box": "black box",
}  # fmt: skip
"""The models' names on the page."""
_QUANTITIES: dict[str, tuple[str, Callable]] = {
    "position": ("m", lambda g: g.position_rmse),
    "rotation": ("rad", lambda g: g.rotation_rmse),
    "velocity": ("m/s", lambda g: g.velocity_rmse),
}


def verdict_words(d: Diagnosis) -> str:
    """The verdict with its meaning."""
    return f"Verdict: **{d.verdict.replace('_', ' ')}** ({VERDICTS[d.verdict]})."


def add_answer(page: Page, d: Diagnosis) -> Page:
    """Ratios, causes, what to check, what to fly next, and what is gained, in this order."""
    page.section("What is wrong")
    _add_ratios(page, d)
    _add_causes(page, d)
    page.section("What to check")
    _add_list(page, checks(d), "The data have no faults, and nothing is left to explain.")
    page.section("What to fly next")
    _add_list(page, flights(d), "No cause is open that another maneuver would decide.")
    page.section("What it gains", gain_words(d))
    return page.table(gain_rows(d), ("model", *_header(d), "inside 50 %", "inside 90 %"))


# -------------------------------------------------------------------------------- what is wrong


def _add_ratios(page: Page, d: Diagnosis) -> None:
    rows = [(*in_words(r), f"{r.believed:.4g}", valued(r.found)) for r in differing(d.ratios)]
    if rows:
        page.table(
            rows,
            ("over inertia", "is", "yours", "found (95 %)"),
            "Motion alone determines coefficients only over the inertia. Largest ratio first.",
        )
    elif d.ratios:
        page.text("All coefficients over inertia are yours within 5 % or their intervals.")
    _add_fitted(page, d)


def _add_fitted(page: Page, d: Diagnosis) -> None:
    """Everything that was fitted, closed."""
    if d.ratios:
        page.table(
            [(_name(r), r.where, f"{r.believed:.4g}", valued(r.found)) for r in d.ratios],
            ("over inertia", "where", "yours", "found (95 %)"),
            fold="All coefficients over inertia",
        )
    if d.refitted:
        page.table(
            [
                (r.name.replace("_", " "), r.where, f"{r.believed:.4g}", valued(r.fitted))
                for r in d.refitted
            ],
            ("coefficient", "where", "yours", "fitted (95 %)"),
            "A common scale of masses, drag and thrust is not determined, hence wide intervals.",
            fold="All fitted coefficients",
        )


def _name(r: Ratio) -> str:
    return r.name.replace("_", " ")


def _add_causes(page: Page, d: Diagnosis) -> None:
    if not d.causes:
        page.text(
            f"None of {d.tested} causes explains more than noise alone can, at a false-alarm rate "
            f"of {d.alpha:g}."
        )
        return
    page.table(
        [
            (
                c.name.replace("_", " "),
                c.place,
                cause_values(c),
                ", ".join(c.indistinguishable_from) or "–",
            )
            for c in d.causes
        ],
        ("cause", "where", "size (95 %)", "not distinguishable from"),
    )
    page.table(
        [
            (f"{c.name} ({c.place})", f"{c.evidence.heldout_gain:.0f}",
             probability(c.evidence.p_value), _rivals(c))
            for c in d.causes
        ],
        ("cause", "gain / nats", "p", "rivals, with their gain"),
        f"Log likelihood won on data left out of the fit; noise alone can win {d.threshold:.1f} "
        "nats. What wins n nats makes the data eⁿ times as likely.",
        fold="Evidence for the causes",
    )  # fmt: skip


def _rivals(c: Cause) -> str:
    return ", ".join(f"{r.name} ({r.where}) {r.heldout_gain:.0f}" for r in c.rivals) or "–"


def cause_values(c: Cause) -> str:
    """The parameters of a cause with their intervals."""
    return "; ".join(f"{k.replace('_', ' ')} {valued(v)}" for k, v in c.parameters.items())


def valued(v: Value) -> str:
    """An estimate with its interval and unit."""
    low, high = v.interval95
    between = f"({low:.4g} … {high:.4g})" if math.isfinite(low) else "(not estimated)"
    text = f"{v.value:.4g} {between}" + ("" if v.unit == "1" else f" {v.unit}")
    return text.replace("-", "−")


def probability(p: float) -> str:
    """A p value to two digits, or the bound below which it underflows."""
    text = "< 1e-300" if p == 0 else f"{p:.2g}" if math.isfinite(p) else "–"
    return text.replace("-", "−")


# --------------------------------------------------------------------------------- what it gains


def last_model(d: Diagnosis) -> str:
    """The model that the verdict is about: with the causes, else refitted, else the belief."""
    if "extended" in d.gain:
        return "extended"
    return "refitted" if d.refitted else "base"


def gain_words(d: Diagnosis) -> str:
    """What the diagnosis gains, in errors of forecasts on data left out."""
    name = last_model(d)
    if name == "base":
        return "The belief is judged on data left out of the fits of the others."
    before, after = d.gain["base"], d.gain[name]
    parts, horizon = [], ""
    for quantity, (unit, of) in _QUANTITIES.items():
        if not of(before):
            continue
        horizon = list(of(before))[-1]
        was, now = of(before)[horizon].value, of(after)[horizon].value
        if math.isfinite(was) and math.isfinite(now):
            parts.append(f"{quantity} from {was:.2g} to {now:.2g} {unit}")
    if not parts:
        return ""
    told = f"Over {horizon} s, on left-out data, forecast errors change: {', '.join(parts)}."
    return f"{told} {one_step_words(d, name)}"


def one_step_words(d: Diagnosis, name: str) -> str:
    """The gain in log score as the error of a forecast over one step.

    If errors and bands of k channels shrink alike to a share s, the log score rises by -k log s.
    """
    measured = [r for r in d.residual.values() if np.isfinite(r.variance_ratio)]
    won = d.gain[name].log_score_gain.value
    if not measured or not math.isfinite(won) or won <= 0:
        return ""
    share = 100 * math.exp(-won / len(measured))
    return f"Errors of a forecast over one step shrink to {share:.0f} % of what they were."


def gain_rows(d: Diagnosis) -> list[tuple[str, ...]]:
    """One row per model: errors over the longest horizon, and shares inside the bands there."""
    rows = []
    for name, g in d.gain.items():
        errors = [_at_end(of(g), "–") for _, of in _QUANTITIES.values() if of(g)]
        shares = [_at_end(g.coverage.get(band, {}), "–", 2) for band in ("50 %", "90 %")]
        rows.append((MODELS[name], *errors, *shares))
    return rows


def _header(d: Diagnosis) -> list[str]:
    g = d.gain["base"]
    return [
        f"{quantity} over {list(of(g))[-1]} s / {f'({unit})' if '/' in unit else unit}"
        for quantity, (unit, of) in _QUANTITIES.items()
        if of(g)
    ]


def _at_end(table: dict[str, Interval], missing: str, digits: int = 3) -> str:
    return interval(list(table.values())[-1], digits) if table else missing


def interval(v: Interval, digits: int = 3) -> str:
    """A number with its interval."""
    low, high = v.interval95
    return f"{v.value:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})".replace("-", "−")


# ----------------------------------------------------------------------- what to check, and to fly


def checks(d: Diagnosis) -> list[str]:
    """Faults of the data, what speaks against the verdict, and what has several explanations."""
    found = [f"**Data:** {problem}" for problem in d.data.problems]
    found += [f"**Left:** {one}" for one in d.left]
    found += [f"**No name:** {c.structure.description}" for c in d.causes if c.structure]
    found += [
        f"**Open:** {c.name.replace('_', ' ')} ({c.place}) or {', '.join(c.indistinguishable_from)}"
        for c in d.causes
        if c.indistinguishable_from
    ]
    return found


def flights(d: Diagnosis) -> list[str]:
    """The next experiment of each cause, then what these data do not determine."""
    found = [f"**{c.name.replace('_', ' ')} ({c.place}):** {c.next_experiment}" for c in d.causes]
    return found + [f"**Not determined by these data:** {limit}" for limit in d.data.limits]


def _add_list(page: Page, lines: list[str], nothing: str) -> None:
    for line in lines or [nothing]:
        page.text(line if line.endswith(".") else f"{line}.")
