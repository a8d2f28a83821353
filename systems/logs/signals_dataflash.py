"""From DataFlash records to signals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...models.config.errors import UserError
from ...models.recordings.checks.finding import Finding
from ...models.recordings.resample import linear
from ..mavlink import codec
from .clock_dataflash import gps_findings, ordered
from .dataflash import BinLog
from .depth import in_water
from .frame import firmware_findings, frame_said
from .pressure import Followed, depth_series, followed, outside
from .signals import (
    Parameter,
    Series,
    Signals,
    Spans,
    event_spans,
    parameters_of,
    series,
    undelayed,
    witnessed_spans,
)
from .sticks import by_controllers
from .streams import UNAIDED, aid_spans, has_fix, missing_states
from .table import Table, whole
from .wiring import Wiring, direction_findings, thruster_outputs, wiring

_FILTERS = {
    3: {"XKF1": "XKF1", "XKF4": "XKF4", "XKQ": "XKQ", "XKQ1": "XKQ"},
    2: {"NKF1": "XKF1", "NKF4": "XKF4", "NKQ": "XKQ", "NKQ1": "XKQ"},
}
"""Records of EKF3 and EKF2 (AHRS_EKF_TYPE), also of versions that name each core's records, by
today's names of EKF3."""
_NAMES = {**_FILTERS[2], **_FILTERS[3]}
WANTED = (
    "ACC",
    "ARM",
    "ATT",
    "BAR2",
    "BAR3",
    "BARO",
    "BAT",
    "EV",
    "GPS",
    "GYR",
    "IMU",
    "MODE",
    "MSG",
    *_FILTERS[2],
    "PARM",
    "RATE",
    "RCIN",
    "RCO2",
    "RCO3",
    "RCOU",
    "VISO",
    "VISP",
    "VISV",
    "XKF1",
    "XKF4",
    "XKQ",
    "XKQ1",
)
_HORIZ_VEL, _HORIZ_POS, _CONST_POS = 1 << 1, 1 << 3 | 1 << 4, 1 << 7
_ARMED_EVENT, _DISARMED_EVENT = 10, 11
_AIDS = ("VISO", "VISP", "VISV")
_BAROMETERS = {"BARO": 0, "BAR2": 1, "BAR3": 2}
_LATEST_S = 1e9  # of a clock that counts from the boot


def signals_from_bin(
    log: BinLog, vehicle: str | None = None, density: float | None = None
) -> Signals:
    """Convert an autopilot's own log; `vehicle` and `density` as in `import_log`.

    Raises:
        UserError: if attitude, rates or thruster outputs are not in the log, or the vehicle is
            another.
    """
    tables, clocks = _in_time(log.tables)
    core = _primary_core(tables)
    attitude = _attitude(tables, core)
    first, last = float(attitude.t[0]), float(attitude.t[-1])
    table = tables.get("PARM")
    parameters, strange = (
        ([], []) if table is None else parameters_of(table["t"], table["Name"], table["Value"])
    )
    known = {p.name: p.value for p in parameters}
    texts = [] if "MSG" not in tables else [m.decode("ascii", "replace") for m in _messages(tables)]
    channels = _channels(tables)
    wired = wiring(parameters, first, last, vehicle, frame_said(texts), channels)
    outputs, notes, frame = _outputs(tables["RCOU"], channels, wired, vehicle is not None)
    position, velocity = _motion(tables, core, known, density)
    depth = _pressure_depth(tables, parameters, density, position)
    rates, force, low_pass, rate_notes = _inertial(tables, core, known)
    aids = [name for name in _AIDS if name in tables]
    no_aid, stops = aid_spans(tables, aids, last)
    aids += ["GPS"] if has_fix(tables.get("GPS"), "Status") else []
    states = _states(tables, first, last)
    spans = {"wiring": wired.spans, **states, **_aiding(tables, core)}
    outputs, between = by_controllers(outputs, tables.get("RATE"), (wired.spans, *states.values()))
    voltage = _voltage(tables)
    batteries = [name for name in ("BAT",) if name in tables]
    findings = [*firmware_findings("MSG", texts), *frame, *stops]
    findings += [*missing_states(spans, voltage, batteries), *direction_findings(wired)]
    findings += [*clocks, *depth.findings]
    return Signals(
        attitude=attitude,
        rates=rates,
        outputs=outputs,
        position=position,
        velocity=velocity,
        specific_force=force,
        pressure_depth=depth.depth,
        voltage=voltage,
        rc=_rc(tables),
        spans={**spans, **no_aid},
        cuts=(*((t, "step back of the clock") for t in log.boots), *wired.cuts),
        has=(f"Horizontal aid: {', '.join(aids)}.",) if aids else (),
        lacks=() if aids else ("No DVL, odometry or vision record and no GPS fix in the log.",),
        notes=(*log.notes, *strange, *wired.notes, *notes, *between, *rate_notes, *depth.told),
        findings=tuple(findings),
        estimated=True,
        low_pass=low_pass,
        **wired.of_signals(),
    )


def _messages(tables: Mapping[str, Table]) -> list[bytes]:
    return [bytes(text).strip(b"\0") for text in tables["MSG"]["Message"]]


def one_filter(tables: dict[str, Table]) -> dict[str, Table]:
    """The tables with the records of one filter under EKF3's names: the one that flew.

    It is AHRS_EKF_TYPE's if it logged a motion, else EKF3 before EKF2. Where both run, records of
    the other describe another estimate.
    """
    parameters = tables.get("PARM")
    flew = np.zeros(0)
    if parameters is not None:
        flew = parameters["Value"][parameters["Name"] == b"AHRS_EKF_TYPE"]
    order = sorted(_FILTERS, key=lambda kind: (not (flew.size and flew[-1] == kind), -kind))
    moved = [kind for kind in order if any(_FILTERS[kind].get(n) == "XKF1" for n in tables)]
    logged = [kind for kind in order if _FILTERS[kind].keys() & tables.keys()]
    chosen = next(iter([*moved, *logged]), 3)
    every = {name for names in _FILTERS.values() for name in names}
    found = {name: table for name, table in tables.items() if name not in every}
    for old, new in _FILTERS[chosen].items():
        if old in tables:
            found.setdefault(new, tables[old])
    return found


def _in_time(given: Mapping[str, Table]) -> tuple[dict[str, Table], list[Finding]]:
    """The usable tables of one filter, and what is wrong with their times."""
    usable, found = dict[str, Table](), gps_findings(given)
    for name, table in given.items():
        usable[name], told = _usable(table)
        found += told
    return one_filter({name: table for name, table in usable.items() if table["t"].size}), found


def _usable(table: Table) -> tuple[Table, list[Finding]]:
    """Messages with a valid time, in time order; numeric columns only (and the names of PARM)."""
    kept = Table(table.name)
    for column, values in table.items():
        text = (table.name, column) in (("PARM", "Name"), ("MSG", "Message"))
        if values.ndim == 1 and values.dtype.kind == ("S" if text else "f"):
            kept[column] = values
    kept["t"] = kept["SampleUS" if "SampleUS" in kept else "TimeUS"] * 1e-6
    if "shift" in kept:
        kept["t"] = kept["t"] + kept["shift"]
    kept = kept.rows((kept["t"] >= 0) & (kept["t"] < _LATEST_S))
    kept, found = ordered(kept, _NAMES.get(table.name, table.name))
    return kept.rows(np.argsort(kept["t"], kind="stable")), found


def _columns(tables: Mapping[str, Table], name: str, *columns: str) -> Sequence[tuple]:
    table = tables.get(name)
    return [] if table is None else list(zip(table["t"], *(table[c] for c in columns), strict=True))


def _primary_core(tables: Mapping[str, Table]) -> int:
    """The filter core that was primary for most of the log."""
    status = tables.get("XKF4")
    if status is None or "PI" not in status:
        return 0
    indices, counts = np.unique(status["PI"][status["PI"] >= 0], return_counts=True)
    return int(indices[counts.argmax()]) if indices.size else 0


def _of(table: Table, column: str, value: int) -> Table:
    """Rows of one instance, or of the first if it is absent; all if the log has no such column."""
    if column not in table:
        return table
    rows = table[column] == value
    if not rows.any():
        rows = table[column] == np.fmin.reduce(table[column])
    return table.rows(rows)


def _attitude(tables: Mapping[str, Table], core: int) -> Series:
    found = []
    if "XKQ" in tables:
        q = _of(tables["XKQ"], "C", core)
        found.append(
            series(q["t"], codec.attitude(q["Q1"], q["Q2"], q["Q3"], q["Q4"]), "XKQ", "attitude")
        )
    if "ATT" in tables:
        e = tables["ATT"]
        x = codec.attitude_from_euler(e["Roll"], e["Pitch"], e["Yaw"], degrees=True)
        found.append(series(e["t"], x, "ATT", "attitude"))
    usable = [s for s in found if s is not None and np.isfinite(s.x).all()]
    if not usable:
        raise UserError("no attitude (XKQ, ATT) in this log; set LOG_BITMASK to its default")
    return max(usable, key=lambda s: s.rate)


def _imu(
    tables: Mapping[str, Table], core: int, raw: str, axes: tuple[str, str, str], quantity: str
) -> Series | None:
    for name in ("IMU", raw):
        if name in tables:
            table = _of(tables[name], "I", core)
            return series(table["t"], codec.body_vector(*(table[a] for a in axes)), name, quantity)
    return None


def _inertial(
    tables: Mapping[str, Table], core: int, known: Mapping[str, float]
) -> tuple[Series, Series | None, float, tuple[str, ...]]:
    """Body rates and specific force without the delays of their filters, that of the rates (Hz)."""
    rates, notes = _rates(tables, core)
    force = _imu(tables, core, "ACC", ("AccX", "AccY", "AccZ"), "specific force")
    low_pass = 0.0
    if not rates.source.startswith("GYR"):  # GYR and ACC are the sensors before the filters
        low_pass = known.get("INS_GYRO_FILTER", 0.0)
        rates, delay = undelayed(rates, known, "INS_GYRO_FILTER")
        notes = (*notes, *delay)
    if force is not None and force.source != "ACC":
        force, delay = undelayed(force, known, "INS_ACCEL_FILTER")
        notes = (*notes, *delay)
    return rates, force, low_pass, notes


def _rates(tables: Mapping[str, Table], core: int) -> tuple[Series, tuple[str, ...]]:
    gyro = _imu(tables, core, "GYR", ("GyrX", "GyrY", "GyrZ"), "rate")
    if gyro is not None:
        if "XKF1" not in tables or "GX" not in tables["XKF1"]:
            return gyro, ("Body rates are those of the gyro, with its bias left in.",)
        ekf = _of(tables["XKF1"], "C", core)
        x = np.deg2rad(codec.body_vector(ekf["GX"], ekf["GY"], ekf["GZ"]))
        bias = series(ekf["t"], x, "XKF1", "rate")
        if bias is None:
            return gyro, ()
        corrected = gyro.x - linear(gyro.t, bias.t, bias.x)
        return replace(gyro, x=corrected, source=f"{gyro.source} less XKF1's bias"), ()
    if "RATE" in tables:
        table = tables["RATE"]
        x = np.deg2rad(codec.body_vector(table["R"], table["P"], table["Y"]))
        slow = series(table["t"], x, "RATE", "rate")
        if slow is not None:
            return slow, ()
    raise UserError("no gyro (IMU, GYR, RATE) in this log; set LOG_BITMASK to its default")


def _motion(
    tables: Mapping[str, Table], core: int, known: Mapping[str, float], density: float | None
) -> tuple[Series | None, Series | None]:
    if "XKF1" not in tables:
        return None, None
    ekf = _of(tables["XKF1"], "C", core)
    p = codec.world_vector(ekf["PN"], ekf["PE"], ekf["PD"])
    v = codec.world_vector(ekf["VN"], ekf["VE"], ekf["VD"])
    position = series(ekf["t"], p, "XKF1", "position")
    velocity = series(ekf["t"], v, "XKF1", "velocity")
    return in_water(position, velocity, known, density)


def _aiding(tables: Mapping[str, Table], core: int) -> dict[str, Spans]:
    if "XKF4" not in tables or "SS" not in tables["XKF4"]:
        return {}
    status = _of(tables["XKF4"], "C", core)
    flags = whole(status["SS"])
    aided = (flags & _HORIZ_VEL > 0) & (flags & _HORIZ_POS > 0) & (flags & _CONST_POS == 0)
    return {"aiding": witnessed_spans(status["t"], ["" if a else UNAIDED for a in aided])}


def _states(tables: Mapping[str, Table], first: float, last: float) -> dict[str, Spans]:
    spans = {}
    number = "ModeNum" if "ModeNum" in tables.get("MODE", ()) else "Mode"
    modes = tables.get("MODE")
    if modes is not None:
        names = [codec.mode_name(int(mode)) for mode in whole(modes[number])]
        spans["mode"] = event_spans(modes["t"], names, first, last)
    arming = [(t, state > 0) for t, state in _columns(tables, "ARM", "ArmState")]
    if not arming:
        events = {_ARMED_EVENT: True, _DISARMED_EVENT: False}
        arming = [(t, events[i]) for t, i in _columns(tables, "EV", "Id") if i in events]
    if arming:  # before the first change the state was the opposite
        states = [(first, not arming[0][1]), *arming]
        spans["armed"] = event_spans(
            np.array([t for t, _ in states]),
            ["" if armed else "disarmed" for _, armed in states],
            first,
            last,
        )
    return spans


def _channels(tables: Mapping[str, Table]) -> np.ndarray:
    """Pulses (µs) of all output channels (32, n)."""
    if "RCOU" not in tables:
        raise UserError(
            "no RCOU in this log, so nothing tells what the thrusters did; "
            "set LOG_BITMASK to its default"
        )
    table = tables["RCOU"]
    channels = np.zeros((32, table["t"].size))
    for rows in (tables[name] for name in ("RCOU", "RCO2", "RCO3") if name in tables):
        at = np.clip(np.searchsorted(rows["t"], table["t"], side="right") - 1, 0, None)
        for n in range(1, 33):
            if f"C{n}" in rows:
                channels[n - 1] = rows[f"C{n}"][at]
    return channels


def _outputs(
    table: Table, channels: np.ndarray, wired: Wiring, named: bool
) -> tuple[Series, list[str], list[Finding]]:
    outputs, notes = thruster_outputs(table["t"], channels, wired, "RCOU")
    if outputs is None:
        raise UserError("RCOU: a single record is no record of the thrusters")
    return outputs, notes, wired.frame_findings(channels, named)


def _pressure_depth(
    tables: Mapping[str, Table],
    parameters: Sequence[Parameter],
    density: float | None,
    position: Series | None,
) -> Followed:
    """Depth by the second barometer, which is outside the hull, or else by the first there is.

    Up to ArduSub 4.0 each has records of its own name, later those of one name have an instance.
    """
    found = next((n for n in ("BAR2", "BARO", "BAR3") if n in tables), None)
    if found is None:
        return Followed(None)
    baro = _of(tables[found], "I", 1)
    number = 1 + (int(whole(baro["I"])[0]) if "I" in baro else _BAROMETERS[found])
    depth, wrong = depth_series(baro["t"], baro["Press"] / 100, found, parameters, number, density)
    compared = followed(depth, position)
    compared = outside(compared, "the second barometer") if number == 1 else compared
    return replace(compared, findings=(*wrong, *compared.findings))


def _voltage(tables: Mapping[str, Table]) -> Series | None:
    """Voltage of the first monitor that has one."""
    if "BAT" not in tables:
        return None
    table = tables["BAT"]
    column = next((name for name in ("Inst", "Instance") if name in table), None)
    numbers = [0.0] if column is None else np.unique(table[column][np.isfinite(table[column])])
    for number in numbers:
        battery = table if column is None else table.rows(table[column] == number)
        known = battery["Volt"] > 0
        found = series(battery["t"][known], battery["Volt"][known], "BAT", "voltage")
        if found is not None:
            return found
    return None


def _rc(tables: Mapping[str, Table]) -> Series | None:
    if "RCIN" not in tables:
        return None
    table = tables["RCIN"]
    return series(table["t"], np.stack([table[f"C{n}"] for n in range(1, 9)]), "RCIN", "channel")
