"""Streams that stop, or that are there and empty."""

from collections.abc import Mapping, Sequence

import numpy as np

from ...models.recordings.checks.finding import Finding
from .signals import Series, Spans, silences
from .table import Table

DEAD_RECKONING = "dead-reckoning"
UNAIDED = "unaided"
FIX_3D = 3
"""Least kind of a GPS fix with a position and a height, in MAVLink and DataFlash alike."""


def has_fix(table: Table | None, field: str) -> bool:
    """Whether a GPS has had a 3-D fix most of the time; `field` has the kind of its fixes."""
    fixes = np.zeros(0) if table is None or field not in table else table[field]
    return fixes.size > 0 and bool(np.median(fixes) >= FIX_3D)


def aid_spans(
    tables: Mapping[str, Table], names: Sequence[str], last: float
) -> tuple[dict[str, Spans], list[Finding]]:
    """Spans with and without messages of a horizontal aid, and a finding for each without.

    While the messages stop the autopilot's estimate runs on from the accelerometer alone.
    `last` (s) is the end of the log.
    """
    times = [tables[name]["t"] for name in names if name in tables and tables[name]["t"].size > 2]
    if not times:
        return {}, []
    t = np.unique(np.concatenate(times))
    t = t[np.isfinite(t)]
    stops = silences(np.append(t, last))
    if not stops:
        return {}, []
    edges = [-np.inf, *(x for stop in stops for x in stop), np.inf]
    spans = Spans(
        np.array(edges[:-1]),
        np.array(edges[1:]),
        tuple(DEAD_RECKONING if i % 2 else "" for i in range(len(edges) - 1)),
    )
    told = ", ".join(name for name in names if name in tables)
    found = [
        Finding(
            "dead-reckoning",
            f"{a:.1f} to {b:.1f} s on the vehicle's clock",
            f"{told} stops while the estimate goes on: velocity and position are dead reckoning "
            "there, and the stretch is set apart",
            "leave it out of training, or restore the aid",
        )
        for a, b in stops
    ]
    return {"aid": spans}, found


def missing_states(
    spans: Mapping[str, Spans],
    voltage: Series | None,
    batteries: Sequence[str],
    arming: str = "HEARTBEAT, or ARM records (LOG_DISARMED 0 starts the log at arming)",
) -> list[Finding]:
    """What the log does not tell of arming and voltage, although it could by messages `arming`."""
    found = []
    if "armed" not in spans:
        found.append(
            Finding(
                "armed-unknown",
                "",
                "the log does not tell when the vehicle was armed, so all of it is taken",
                f"log {arming}",
            )
        )
    if voltage is None and batteries:
        found.append(
            Finding(
                "no-voltage",
                ", ".join(batteries),
                "no battery voltage in them: 0 or unknown",
                "check the battery monitor (BATT_MONITOR)",
            )
        )
    return found
