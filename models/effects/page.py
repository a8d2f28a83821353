"""The table of all effects, `docs/effects.md`."""

import inspect
import math

from ..se3 import AXES
from .base import ByThruster, Effect, Parameter
from .library import KINDS

_FAMILIES = {
    "actuation": "Thrusters and their supply",
    "body": "Body",
    "environment": "Water and tether",
    "disturbance": "Laws of the disturbance",
    "measurement": "Instruments",
}
_HEAD = """# Effects

An effect is one difference between a simulation and the world. `spinndrift diagnose` names it in
data, and a scenario adds it to the plant:

```yaml
station: {effects: [{name: thruster_gain, where: "3", parameters: {gain: -0.5}}]}
```

A parameter of zero changes nothing. *where* is an axis of the body, a thruster (from 1), or a place
that the effect names itself. The ranges are those that a diagnosis admits. This page is written
from the classes in `models/effects/` (`spinndrift.models.effects.page.effects_page()`), which have
the equations and their sources.
"""


def effects_page() -> str:
    """The text of `docs/effects.md`."""
    lines = [_HEAD]
    for family, title in _FAMILIES.items():
        lines += [f"## {title}", "", "| name | what | where | parameters |", "|---|---|---|---|"]
        for kind in KINDS.values():
            if kind.family == family:
                numbers = "; ".join(_number(p) for p in kind.parameters)
                lines.append(f"| `{kind.name}` | {_what(kind)} | {_where(kind)} | {numbers} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _what(kind: type[Effect]) -> str:
    """The first sentence of its docstring."""
    text = " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())
    return text.partition(". ")[0].rstrip(".").replace("|", "\\|")


def _where(kind: type[Effect]) -> str:
    own, places = "", tuple(kind.neutral().places)
    if issubclass(kind, ByThruster):
        own, places = "a thruster", kind.common
    elif places == AXES:
        own, places = "an axis", ()
    return ", ".join([*(f"`{place}`" for place in places), *([own] if own else [])])


def _number(p: Parameter) -> str:
    unit = "" if p.unit == "1" else f" ({p.unit})"
    usual = f", {p.usual:g} if left out" if p.usual else ""
    low, high = (f"{end + p.usual:g}".replace("-", "−") for end in (p.low, p.high))
    ends = [
        *([] if math.isinf(p.low) else [f"from {low}"]),
        *([] if math.isinf(p.high) else [f"to {high}"]),
    ]
    return f"`{p.name}`{unit}{usual}" + (f" {' '.join(ends)}" if ends else "")
