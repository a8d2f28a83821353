"""A verdict and its sentence: what a reader acts on, first."""

from collections.abc import Mapping, Sequence

import numpy as np

from ....models.effects.added_mass import AddedMass
from ....models.effects.drag import LinearDrag, QuadraticDrag
from ....models.effects.load import NetBuoyancy
from ....models.effects.unknown import Unknown
from . import result

_OFF = 0.05
"""Least relative difference of a coefficient that is worth a word."""
_NONE = 0.05
"""Share of the believed value below which a coefficient counts as absent."""
_LOST = 0.25
"""Share of the believed thrust of an axis below which commands do not explain the motion there."""
OF_THRUST = 0.02
"""Least share of the thrust that is worth a word: net buoyancy in heave, spread between runs."""
_THRUST = ("half_thrust", "thrust")
_WORDS = {
    "half_thrust": "thrust at half command in {}",
    "thrust": "thrust in {}",
    QuadraticDrag.name: "quadratic drag in {}",
    LinearDrag.name: "linear drag in {}",
    "restoring": "righting moment in {}",
    "inertia": "inertia in {}",
}


def verdict(
    causes: Sequence[result.Cause], left: Sequence[str] = (), coefficients: bool = False
) -> result.Verdict:
    """The verdict on causes, on `coefficients` that are off, and on what they leave."""
    unknown = [c.name == Unknown.name for c in causes]
    if coefficients or not all(unknown):
        return "partly_explained" if left or any(unknown) else "explained"
    return "unexplained" if left or causes else "adequate"


def sentence(
    causes: Sequence[result.Cause],
    problems: Sequence[str],
    refitted: bool = False,
    left: Sequence[str] = (),
    shares: Mapping[str, result.Interval] | None = None,
    coefficients: str = "",
) -> str:
    """The diagnosis in a few lines.

    `refitted` tells that coefficients were fitted first, `coefficients` what was wrong with them,
    `shares` which part of the forecast error is explained.
    """
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    parts = [f"The data have faults: {problems[0]}{more}."] if problems else []
    parts += [coefficients] if coefficients else []
    named = ", ".join(f"{c.name} ({c.place})" for c in causes if c.name != Unknown.name)
    subject = "your model, its coefficients refitted," if refitted else "your model"
    parts += [f"The data differ from {subject} by: {named}."] if named else []
    parts += [
        f"No name explains {c.structure.description}." for c in causes if c.structure is not None
    ]
    told = _share(shares or {}) if causes or coefficients else ""
    parts += [told] if told else []
    if not causes and left:
        parts.append(f"No name explains {'the rest' if coefficients else 'the data'}: {left[0]}.")
        left = left[1:]
    elif not causes and refitted:
        parts.append("With its coefficients refitted, your model is adequate at this noise.")
    elif not causes:
        parts.append("Your model is adequate at this noise.")
    parts += [f"But {one}." for one in left]
    return " ".join(parts)


def _share(shares: Mapping[str, result.Interval]) -> str:
    """Which share of the forecast error is explained, over the horizons."""
    finite = {h: s.value for h, s in shares.items() if np.isfinite(s.value)}
    listed = ", ".join(f"{100 * max(v, 0.0):.0f} % over {h} s" for h, v in finite.items())
    return f"That explains {listed} of the forecast error." if listed else ""


# ----------------------------------------------------------------------------- coefficients


def _ratio(r: result.Ratio) -> float:
    return r.found.value / r.believed if r.believed else np.inf


def _size(r: result.Ratio) -> float:
    """Distance from the believed value in logarithms; infinite for nothing or the wrong sign."""
    share = _ratio(r)
    absent = share <= _NONE or r.found.interval95[0] * np.sign(r.believed) <= 0
    return np.inf if absent else abs(float(np.log(share)))


def lost_axes(ratios: Sequence[result.Ratio]) -> list[result.Ratio]:
    """Thrust of the axes that a refit has brought to nothing, or turned."""
    return [
        r
        for r in ratios
        if r.name in _THRUST and r.believed > 0 and r.found.value < _LOST * r.believed
    ]


def commands_lost(ratios: Sequence[result.Ratio]) -> str:
    """A sentence where commands do not explain the motion along some axes."""
    lost = lost_axes(ratios)
    if not lost:
        return ""
    shares = sorted(_ratio(r) for r in lost)
    between = f"{shares[0]:.2f}" + (f" to {shares[-1]:.2f}" if len(lost) > 1 else "")
    axes = ", ".join(r.where for r in lost)
    return (
        f"the commands do not explain the motion in {axes}: fitted to the data, their thrust there "
        f"is {between.replace('-', '−')} of yours; check columns, units, signs and axes of the "
        "commands"
    )


def differing(ratios: Sequence[result.Ratio]) -> list[result.Ratio]:
    """Ratios that are off by a practical size: largest first, then those that are absent."""
    thrust = {r.where: r.believed for r in ratios if r.name in _THRUST}
    off = []
    for r in ratios:
        low, high = r.found.interval95
        if low <= r.believed <= high:
            continue
        if r.name == NetBuoyancy.name:
            far = abs(r.found.value - r.believed) > OF_THRUST * thrust.get(r.where, 0.0)
        else:
            far = r.name in _WORDS and bool(r.believed) and _size(r) > np.log1p(_OFF)
        off += [r] if far else []
    sizes = {id(r): _size(r) for r in off}
    return sorted(off, key=lambda r: (sizes[id(r)] == np.inf, -sizes[id(r)]))


def in_words(r: result.Ratio) -> tuple[str, str]:
    """A ratio in the user's words: its name, and what it is of the believed value."""
    name = _WORDS.get(r.name, r.name.replace("_", " ") + " in {}").format(r.where)
    if _size(r) < np.inf:
        return name, f"{_ratio(r):.2g} of yours"
    turned = r.believed and r.found.interval95[1] * np.sign(r.believed) < 0
    return name, "reversed" if turned else "none"


def coefficients_off(diagnosis_ratios: Sequence[result.Ratio], added: Sequence[str] = ()) -> str:
    """Which coefficients are off by a practical size, largest ratio first; empty if none is.

    `added` are axes without added mass.
    """
    off: dict[str, list[result.Ratio]] = {}
    for r in differing(diagnosis_ratios):
        off.setdefault(r.name, []).append(r)
    there = [rows for name, rows in off.items() if name in _WORDS]
    here = [[r for r in rows if _size(r) < np.inf] for rows in there]
    parts = [_kind(rows) for rows in sorted(filter(None, here), key=lambda g: -_size(g[0]))]
    for rows in there:
        lasting = [r for r in rows if _size(r) == np.inf]
        gone = [r.where for r in lasting if r.found.interval95[1] * np.sign(r.believed) >= 0]
        turned = [r.where for r in rows if r.where not in gone and _ratio(r) < 0]
        name = _WORDS[rows[0].name]
        parts += [f"no {name.format(', '.join(gone))}"] if gone else []
        parts += [f"{name.format(', '.join(turned))} is reversed"] if turned else []
    parts += [f"no added mass in {', '.join(added)}"] if added and off else []
    parts += [
        f"net buoyancy is {r.found.value:.3g} m/s² (yours: {r.believed:.3g})"
        for r in off.get(NetBuoyancy.name, ())
    ]
    return f"Over inertia, your coefficients are off: {'; '.join(parts)}." if parts else ""


def _kind(rows: Sequence[result.Ratio]) -> str:
    """Ratios of one kind: the largest, and the range of the others."""
    first, *rest = rows
    text = f"{_WORDS[first.name].format(first.where)} is {_ratio(first):.2g} of yours"
    if not rest:
        return text
    shares = sorted(_ratio(r) for r in rest)
    between = f"{shares[0]:.2g}" + (f" to {shares[-1]:.2g}" if len(rest) > 1 else "")
    return f"{text} ({', '.join(r.where for r in rest)}: {between})"


def without_added_mass(refitted: Sequence[result.Refitted]) -> list[str]:
    """Axes whose believed added mass a refit has brought to nothing."""
    return [
        r.where
        for r in refitted
        if r.name == AddedMass.name and r.believed > 0 and r.fitted.value < _NONE * r.believed
    ]
