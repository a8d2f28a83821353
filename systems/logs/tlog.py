"""MAVLink telemetry log (.tlog) into arrays on the vehicle's own clock.

A record is eight bytes of the logger's clock (big-endian µs) and a MAVLink 1 or 2 packet, in both
directions and of every system on the link. `packets.py` finds them; this module makes tables.

Clocks. Logger clocks jump and links have latency, so samples use the vehicle's time since boot:
`time_boot_ms` unchanged; the 32-bit `time_usec`, which wraps after 71.6 minutes, unwrapped next to
the last `time_boot_ms` before it; a message without a time has that of the last message with one,
plus the elapsed time on the logger's clock, at most one second. A reboot starts a new stretch.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from ...models.config.errors import UserError
from ...models.recordings.checks.finding import Finding
from ...models.recordings.steady_times import steady_times
from .clock import REBOOT_S, Drift, drift, epochs, in_words, least_latencies, rate_findings
from .log_bytes import Progress, no_progress
from .packets import Packets, message_id, message_name, repeated, rows_of, scan
from .table import Table, numbers

_GROUND_STATION, _NO_AUTOPILOT, _SUBMARINE = 6, 8, 12
_CLOCKS = ("ATTITUDE", "ATTITUDE_QUATERNION", "SYSTEM_TIME")
_WRAP_US_S = 2**32 * 1e-6
_STREAMS = (
    "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "RAW_IMU",
    "SCALED_IMU", "SCALED_PRESSURE", "SCALED_PRESSURE2", "SERVO_OUTPUT_RAW", "VFR_HUD",
)  # fmt: skip
"""Messages that are sent at a steady rate."""

RENAMED = {"t": "roll"}
"""Columns of fields whose name is that of the times: MANUAL_CONTROL's `t`, right side down."""

System = tuple[int, int]


@dataclass(frozen=True)
class TlogLog:
    """Tables of one vehicle's messages by name, each with `t` (s since first boot) and its fields.

    `kind` are MAV_TYPE and MAV_AUTOPILOT of its heartbeat, -1 without one.
    `boots` are the times at which a later boot starts, or the clock stepped back, `heard` counts
    all messages of all systems by (name, system, component).
    """

    tables: Mapping[str, Table]
    system: System
    kind: tuple[int, int]
    boots: tuple[float, ...]
    heard: Mapping[tuple[str, int, int], int]
    notes: tuple[str, ...]
    findings: tuple[Finding, ...] = ()


def read_tlog(
    data: bytes,
    wanted: Collection[str],
    system: int | None = None,
    progress: Progress = no_progress,
    anyone: Collection[str] = (),
) -> TlogLog:
    """Decode the wanted messages of one autopilot: of `system` if given, else of the busiest.

    Those of `anyone` are taken whoever sent them.

    Raises:
        UserError: if the log has no messages of an autopilot, or none of the chosen system.
    """
    packets = scan(data, progress)
    heard = _heard(packets)
    chosen, kind, notes = _choose(data, packets, heard, system)
    own = (packets.system == chosen[0]) & (packets.component == chosen[1])
    twice = repeated(data, packets, own)
    own &= ~twice
    tables: dict[str, Table] = {}
    index: dict[str, np.ndarray] = {}
    broken = 0
    names = sorted(set(wanted) | set(_CLOCKS) | set(anyone))
    for n, name in enumerate(names):
        from_it = own | (name in anyone)
        candidates = np.flatnonzero(from_it & (packets.message == message_id(name)))
        if candidates.size:
            rows, good = rows_of(data, packets, candidates, name)
            broken += int(candidates.size - good.size)
            if good.size:
                index[name] = good
                columns = {RENAMED.get(f, f): rows[f] for f in rows.dtype.names or ()}
                clean = {f: numbers(x) if x.dtype.kind == "f" else x for f, x in columns.items()}
                tables[name] = Table(name, clean)
        progress(0.7 + 0.1 * n / len(names))
    boots, clock_note, findings = _put_on_vehicle_clock(tables, index, packets.stamps(data))
    if twice.any():
        notes.append(
            f"{np.count_nonzero(twice)} messages came twice, as by two links, and were read once."
        )
    if packets.skipped:
        notes.append(f"{packets.skipped} of {len(data)} bytes are damaged and were skipped.")
    if broken:
        notes.append(f"{broken} messages with a wrong checksum were left out.")
    notes.extend(clock_note)
    return TlogLog(tables, chosen, kind, boots, heard, tuple(notes), tuple(findings))


def _heard(packets: Packets) -> dict[tuple[str, int, int], int]:
    keys = np.stack([packets.message, packets.system, packets.component])
    kinds, counts = np.unique(keys, axis=1, return_counts=True)
    return {
        (message_name(int(m)), int(s), int(c)): int(n)
        for (m, s, c), n in zip(kinds.T, counts, strict=True)
    }


def _choose(
    data: bytes,
    packets: Packets,
    heard: Mapping[tuple[str, int, int], int],
    system: int | None,
) -> tuple[System, tuple[int, int], list[str]]:
    autopilots: dict[System, tuple[int, int]] = {}
    beats = np.flatnonzero(packets.message == message_id("HEARTBEAT"))
    rows, good = rows_of(data, packets, beats, "HEARTBEAT")
    for row, i in zip(rows, good, strict=True):
        key = (int(packets.system[i]), int(packets.component[i]))
        if row["autopilot"] != _NO_AUTOPILOT and row["type"] != _GROUND_STATION:
            autopilots.setdefault(key, (int(row["type"]), int(row["autopilot"])))
    if not autopilots:  # no heartbeat: a system that reports an attitude is an autopilot
        autopilots = {(s, c): (-1, -1) for (n, s, c) in heard if n.startswith("ATTITUDE")}
    if not autopilots:
        speakers = sorted({f"{s}/{c}" for _, s, c in heard})
        raise UserError(
            f"no autopilot speaks in this log (systems heard: {', '.join(speakers) or 'none'}); "
            "log what the vehicle sends, not only what the ground station sends"
        )
    spoken = Counter()
    for (_, s, c), n in heard.items():
        spoken[(s, c)] += n
    mine = [key for key in autopilots if system is None or key[0] == system]
    if not mine:
        raise UserError(
            f"--system {system}: not an autopilot of this log; give one of "
            f"{', '.join(map(str, sorted({s for s, _ in autopilots})))}"
        )
    submarines = [key for key in mine if autopilots[key][0] == _SUBMARINE]
    chosen = max(submarines or mine, key=lambda key: spoken[key])
    notes = []
    if len(autopilots) > 1:
        notes.append(
            f"Several autopilots in the log ({sorted(s for s, _ in autopilots)}): "
            f"system {chosen[0]} was taken."
        )
    return chosen, autopilots[chosen], notes


def _put_on_vehicle_clock(
    tables: dict[str, Table], index: dict[str, np.ndarray], stamps: np.ndarray
) -> tuple[tuple[float, ...], list[str], list[Finding]]:
    """Add the column `t` to every table and sort by it; see the module's docstring."""
    timed = [name for name in tables if "time_boot_ms" in tables[name]]
    if not timed:
        raise UserError(
            "no message with the vehicle's time (ATTITUDE and the like) in this log; "
            "stream ATTITUDE and LOCAL_POSITION_NED while logging"
        )
    at = np.concatenate([index[name] for name in timed])
    raw = np.concatenate([tables[name]["time_boot_ms"] * 1e-3 for name in timed])
    order = np.argsort(at, kind="stable")
    at, raw = at[order], raw[order]
    shift, boots, steps = epochs(raw)
    base = raw + shift
    jumped = _clock_notes(base, stamps[at], boots)
    notes = [*in_words(boots, steps), *jumped]
    found = _of_own_clock(tables, index, at, base, shift)
    if not jumped:
        found += _run_alike(tables, {name: stamps[rows] for name, rows in index.items()})
    right = np.concatenate([tables[name]["t"] for name in timed])[order]
    newest = np.maximum.accumulate(right)  # a message that came late tells no time to others
    latest = np.maximum.accumulate(np.where(right == newest, np.arange(right.size), 0))
    for name, table in tables.items():
        if "t" not in table:
            i = _before(at, index[name])
            elapsed = np.clip(stamps[index[name]] - stamps[at[latest[i]]], -1.0, 1.0)
            table["t"], jitter = _steadied(name, table, newest[i] + elapsed)
            found += jitter
        tables[name] = table.rows(np.argsort(table["t"], kind="stable"))
    order = np.argsort(base, kind="stable")
    return boots, notes, [*rate_findings(base[order], stamps[at][order]), *found]


def _before(at: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The last message with a time before each of some, or the first."""
    return np.clip(np.searchsorted(at, rows, side="right") - 1, 0, at.size - 1)


def _of_own_clock(
    tables: Mapping[str, Table],
    index: Mapping[str, np.ndarray],
    at: np.ndarray,
    base: np.ndarray,
    shift: np.ndarray,
) -> list[Finding]:
    """Add `t` to the tables of messages with a time of their own."""
    found = []
    for name, table in tables.items():
        i = _before(at, index[name])
        if "time_boot_ms" in table:
            t = table["time_boot_ms"] * 1e-3 + shift[i]
        elif "time_usec" in table:
            near = base[i] - shift[i]
            usec = table["time_usec"] * 1e-6
            if table["time_usec"].dtype.itemsize == 4:
                usec = usec + _WRAP_US_S * np.round((near - usec) / _WRAP_US_S)
            t = np.where(np.abs(usec - near) < REBOOT_S, usec, near) + shift[i]
        else:
            continue
        table["t"], jitter = _steadied(name, table, t)
        found += jitter
    return found


def _steadied(name: str, table: Table, t: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """Steady times of a stream whose times jitter, as its numbers say, and a finding on it."""
    several = any(key in table and np.ptp(table[key]) > 0 for key in ("port", "id"))
    if name not in _STREAMS or several:
        return t, []
    rows = [
        values.astype(float)
        for key, values in table.items()
        if not key.startswith("time_") and values.ndim == 1 and values.dtype.kind in "fiu"
    ]
    timed = "time_boot_ms" in table or "time_usec" in table
    steady = steady_times(t, np.stack(rows), late=not timed)
    if steady is None:
        return t, []
    text = (
        f"its times{'' if timed else ' of arrival'} jitter by {1e3 * steady.jitter:.2g} ms (rms) "
        f"about steady {steady.rate:.3g} Hz, at which its numbers are smoother: steady times were "
        "taken"
    )
    return steady.t, [Finding("clock-jitter", name, text, "log the times of measurement")]


def _run_alike(tables: Mapping[str, Table], arrived: Mapping[str, np.ndarray]) -> list[Finding]:
    """Put streams whose times drift against those of most others on their clock, in place.

    Least latencies on the logger's clock tell; what its clock does is common to all.
    """
    timed = [
        name
        for name in _STREAMS
        if name in tables and ("time_boot_ms" in tables[name] or "time_usec" in tables[name])
    ]
    if len(timed) < 2:
        return []
    apart = {
        (one, other): None if one == other else _drift(tables, arrived, one, other)
        for one in timed
        for other in timed
    }
    alike = {other: sum(apart[one, other] is None for one in timed) for other in timed}
    first = max(timed, key=lambda name: alike[name])
    found = []
    for name in timed:
        line = apart[name, first]
        if line is None:
            continue
        table = tables[name]
        table["t"] = table["t"] + line.at(arrived[name])
        text = (
            f"its times drift by {abs(line.change):.2g} s against those of {first}; they were "
            "corrected by the least latencies on the logger's clock"
        )
        found.append(Finding("clock-rate", name, text, "log the times of one clock"))
    return found


def _drift(
    tables: Mapping[str, Table], arrived: Mapping[str, np.ndarray], one: str, other: str
) -> Drift | None:
    """How the latencies of a stream drift against the least ones of another."""
    stamps, latency = least_latencies(arrived[other], arrived[other] - tables[other]["t"])
    own = arrived[one]
    if not stamps.size:
        return None
    return drift(own, own - tables[one]["t"] - np.interp(own, stamps, latency))


def _clock_notes(base: np.ndarray, stamps: np.ndarray, boots: tuple[float, ...]) -> list[str]:
    notes = []
    lag = stamps - base
    jumps = np.abs(np.diff(lag)) > 2.0
    jumps &= ~np.isin(np.searchsorted(boots, base[1:]) - np.searchsorted(boots, base[:-1]), (1,))
    if jumps.any():
        worst = np.abs(np.diff(lag)[jumps]).max()
        notes.append(
            f"The logger's clock or link jumped by up to {worst:.0f} s; "
            "the vehicle's own clock was used."
        )
    return notes
