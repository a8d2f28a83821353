"""Times of DataFlash records: stamps that jitter, run back or repeat, and a clock that drifts.

Records are written one after another, so the order of the file is that of time. Stamps of one
sensor that run back are wrong. Where stamps jitter about a steady rate, the motion tells whether
the source did (`models/recordings/steady_times.py`). The time of a GPS fix is another clock.
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Bool, Float

from ...models.recordings.checks.finding import Finding
from ...models.recordings.resample import continuous
from ...models.recordings.steady_times import Steady, steady_times
from .clock import rate_findings
from .streams import FIX_3D
from .table import Table

_SMOOTH = {
    "XKQ": ("Q1", "Q2", "Q3", "Q4"),
    "ATT": ("Roll", "Pitch", "Yaw"),
    "XKF1": ("VN", "VE", "VD", "PN", "PE", "PD"),
    "IMU": ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"),
    "GYR": ("GyrX", "GyrY", "GyrZ"),
    "ACC": ("AccX", "AccY", "AccZ"),
    "RATE": ("R", "P", "Y"),
}
"""Numbers that change smoothly with the motion, by record."""
_ORDERED = (*_SMOOTH, "RCOU")
_INSTANCE = ("C", "I", "Inst", "Instance")
_JITTER_S = 2e-3
"""Median deviation of the intervals (s) below which no motion shows a jitter."""
_FEWEST = 3
"""Records; fewer have no order."""
_SINGLE = 0.1
"""Share of records that run back from which on stamps jitter, and none of them is better."""
_WEEK_S = 604800.0
_RUNS = 5
"""Places of records that run back that are told one by one."""


def ordered(table: Table, name: str) -> tuple[Table, list[Finding]]:
    """The records, in the order of the file, with steady times, or without those that run back.

    `name` is today's name of the record; the table has `t`, the order of the file, and the columns.
    """
    if name not in _ORDERED or table["t"].size < _FEWEST:
        return table, []
    t = table["t"].copy()
    kept = np.ones(t.size, bool)
    jitter, back = [], []
    for rows in _instances(table):
        own = t[rows]
        steady = _steady(table.rows(rows), name) if _jitters(own) else None
        if steady is not None and (np.diff(steady.t) > 0).all():
            t[rows] = steady.t
            jitter.append(steady)
            continue
        good = in_order(own)
        if np.count_nonzero(~good) < _SINGLE * own.size:
            kept[rows] = good
            back += own[~good].tolist()
    found = []
    if jitter:
        rms, rate = max(s.jitter for s in jitter), jitter[0].rate
        text = (
            f"its TimeUS jitters by {1e3 * rms:.2g} ms (rms) about steady {rate:.3g} Hz, at which "
            "its numbers are smoother: steady times were taken"
        )
        found.append(Finding("clock-jitter", table.name, text, "update the autopilot's firmware"))
    elif back:
        found.append(_backwards(table.name, sorted(back)))
    return Table(table.name, {**table, "t": t}).rows(kept), found


def in_order(t: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Times of the longest sequence that does not run back (Schensted 1961); NaN are kept."""
    known = np.flatnonzero(np.isfinite(t))
    kept = np.ones(t.size, bool)
    if (np.diff(t[known]) >= 0).all():
        return kept
    ends: list[float] = []
    last: list[int] = []  # index of the record that ends the best sequence of each length
    before = np.full(t.size, -1)
    for i in known.tolist():
        n = bisect_right(ends, t[i])
        before[i] = last[n - 1] if n else -1
        ends[n : n + 1], last[n : n + 1] = [t[i]], [i]
    kept[known] = False
    i = last[-1]
    while i >= 0:
        kept[i] = True
        i = int(before[i])
    return kept


def gps_findings(tables: Mapping[str, Table]) -> list[Finding]:
    """A clock that runs apart from that of GPS fixes."""
    table = tables.get("GPS")
    if table is None or not {"GWk", "GMS", "Status"} <= table.keys():
        return []
    fix = (table["Status"] >= FIX_3D) & np.isfinite(table["GMS"]) & (table["GWk"] > 0)
    own, stamps = table["t"][fix], (table["GWk"] * _WEEK_S + table["GMS"] * 1e-3)[fix]
    new = np.concatenate([[True], np.diff(stamps) > 0])[: own.size]  # a second receiver repeats it
    order = (np.diff(own[new], prepend=-np.inf) > 0) if own.size else new
    own, stamps = own[new][order], stamps[new][order]
    return rate_findings(own, stamps, "that of GPS") if own.size else []


def _instances(table: Table) -> Iterator[np.ndarray]:
    """Indices of the records of each sensor or core."""
    column = next((name for name in _INSTANCE if name in table), None)
    if column is None:
        yield np.arange(table["t"].size)
        return
    for value in np.unique(table[column]):
        yield np.flatnonzero(table[column] == value)


def _jitters(t: np.ndarray) -> bool:
    steps = np.diff(t)
    return bool(steps.size) and float(np.median(np.abs(steps - np.median(steps)))) > _JITTER_S


def _steady(table: Table, name: str) -> Steady | None:
    """Steady times by the numbers that change with the motion; None if the stamps are right."""
    columns = [table[column] for column in _SMOOTH.get(name, ()) if column in table]
    if not columns:
        return None
    x = np.stack(columns)
    if name == "XKQ" and (np.linalg.norm(x, axis=0) > 0).all():
        x = continuous(x)
    if name == "ATT" and np.isfinite(x).all():
        x = np.unwrap(x, period=360.0, axis=1)
    return steady_times(table["t"], x)


def _backwards(name: str, times: list[float]) -> Finding:
    told = ", ".join(f"{t:.1f}" for t in times[:_RUNS]) + (", …" if len(times) > _RUNS else "")
    many = len(times) > 1
    return Finding(
        "clock-order",
        f"{name}, stamped {told} s",
        f"the time of {len(times)} record{'s' * many} is not between those of the records before "
        f"and after; {'they were' if many else 'it was'} left out",
        "download the log again, or look for a faulty clock",
    )
