"""Changes in words."""

from collections.abc import Mapping, Sequence

from ....models.effects.added_mass import AddedMass
from ....models.effects.drag import LinearDrag, QuadraticDrag
from ....models.effects.load import NetBuoyancy
from ....models.effects.thrust import ThrusterGain, ThrustScale
from ..findings.result import Change, Value
from .baseline import Limits

FACTORS = (ThrusterGain.name, ThrustScale.name)
"""Causes whose parameter p means a factor 1 + p."""
COEFFICIENTS = {
    QuadraticDrag.name: "quadratic drag in {}",
    LinearDrag.name: "linear drag in {}",
    AddedMass.name: "added mass in {}",
}
"""Causes whose parameter adds to a coefficient of the vehicle."""
_UNITS = {"scenario": "scenarios", "run": "runs", "stretch": "stretches"}
_NOISE = 3
"""Most channels that a sentence names."""


def text_of(
    name: str, where: str, before: Mapping[str, float], change: Mapping[str, Value],
    ratio: Value | None,
) -> str:  # fmt: skip
    """A change in words."""
    if ratio is not None and name == ThrustScale.name:
        return f"all thrusters give {_number(ratio.value)} of what they gave"
    if ratio is not None and name == ThrusterGain.name:
        return f"thruster {where} gives {_number(ratio.value)} of what it gave"
    if ratio is not None and name in COEFFICIENTS:
        what = COEFFICIENTS[name].format(where)
        return f"{what} is {_number(ratio.value)} of what it was"
    if name == NetBuoyancy.name:
        force = change["force"].value
        side = "more" if force > 0 else "less"
        at = "" if where == "all" else ", at the centre of buoyancy"
        return f"buoyancy is {abs(force):.2g} N {side} than before{at}"
    unlike = [k for k, v in change.items() if v.interval95[0] * v.interval95[1] > 0] or list(change)
    parts = [
        f"{k.replace('_', ' ')} {before[k] + change[k].value:.3g} {_unit(change[k])}"
        f"(before: {before[k]:.2g})"
        for k in unlike
    ]
    return f"{name} ({where}): {', '.join(parts)}".replace("-", "−")


def sentence_of(
    changes: Sequence[Change], noise: Mapping[str, Value], alarm: bool, found: Limits, unit: str
) -> str:  # fmt: skip
    """The verdict in words, with the rate of false alarms and what it rests on."""
    if changes:
        told = f"Against the healthy runs: {'; '.join(c.text for c in changes)}."
    elif alarm:
        told = "The data differ from the healthy runs, but no single cause explains how."
    else:
        told = "Nothing has changed against the healthy runs."
    loud = sorted(noise, key=lambda name: -noise[name].value)[:_NOISE]
    if loud:
        sizes = ", ".join(f"{name} {noise[name].value:.2g}" for name in loud)
        told += f" Errors of a step are other than before, by a factor: {sizes}."
    return f"{told} {rate_of(found, unit)}"


def rate_of(found: Limits, unit: str) -> str:
    """The rate of false alarms and what it rests on."""
    units = f"{found.causes.units} healthy {_UNITS[unit]}, each left out in turn"
    if found.counted <= found.rate:
        return f"Rate of false alarms: {found.rate:.2g}, counted on {units}."
    return (
        f"Rate of false alarms: {found.rate:.2g} by theory; the {units}, can show no less than "
        f"{found.counted:.2g} by count."
    )


def _number(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")


def _unit(value: Value) -> str:
    return "" if value.unit == "1" else f"{value.unit} "
