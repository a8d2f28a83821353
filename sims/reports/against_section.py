"""The section of a diagnosis' page on what has changed since the healthy runs."""

import math

from ...training.diagnosis.findings.result import Against, Value
from .pages import Page

_VERDICTS = {
    "unchanged": "no test exceeds what healthy data do when they are left out",
    "changed": "named causes have changed by more than healthy data differ among themselves",
    "changed_without_name": "a test exceeds what healthy data do, but no cause holds",
}
_UNITS = {"scenario": "scenarios", "run": "runs", "stretch": "stretches of runs"}


def add_against(page: Page, against: Against) -> None:
    """Changes with intervals, sizes of errors, and what the rate of false alarms rests on."""
    page.section("Changes since the healthy runs")
    page.text(
        f"Verdict: **{against.verdict.replace('_', ' ')}** ({_VERDICTS[against.verdict]}), against "
        f"{against.baseline}."
    )
    if against.changes:
        page.table(
            [
                (
                    c.text,
                    "; ".join(f"{k} {v:.4g} {_unit(c.change[k])}" for k, v in c.before.items()),
                    "; ".join(f"{k} {_valued(v)}" for k, v in c.change.items()),
                    "–" if c.ratio is None else _valued(c.ratio),
                    f"{c.p_value:.2g}".replace("-", "−"),
                )
                for c in against.changes
            ],
            ("change", "before", "new less healthy (95 %)", "new over healthy (95 %)", "p"),
        )
        page.text(
            "The healthy model is held. Intervals hold the noise and the differences between "
            f"healthy {_UNITS[against.unit]}."
        )
    if against.noise:
        page.text("One-step errors that the changes leave, over those of the healthy runs:")
        page.table({name: _valued(v) for name, v in against.noise.items()})
    page.table(
        {
            f"healthy {_UNITS[against.unit]}, each left out in turn": against.units,
            f"new {_UNITS[against.unit]}": against.judged,
            "rate of false alarms asked for": against.rate,
            "least rate that so many can show by count": against.counted_rate,
            "largest change of a cause (−log p)": against.score,
            "threshold of causes": against.threshold,
            "largest change of the size of errors (−log p)": against.noise_score,
            "threshold of sizes": against.noise_threshold,
            "left out and above a threshold": against.alarms,
        },
        caption="Changes are judged by the scatter between healthy units. Those left out were "
        "judged alike: one by one, by the runs or scenarios they belong to, and in random splits.",
    )


def _valued(v: Value) -> str:
    low, high = v.interval95
    between = f"({low:.4g} … {high:.4g})" if math.isfinite(low) else "(not estimated)"
    return f"{v.value:.4g} {between} {_unit(v)}".rstrip().replace("-", "−")


def _unit(v: Value) -> str:
    return "" if v.unit == "1" else v.unit
