"""From DataFlash records to signals."""

from collections.abc import Mapping, Sequence

import numpy as np

from ...models.errors import UserError
from ...models.resample import linear
from . import codec
from .depth import in_water
from .logs_bin import BinLog, Table
from .signals import (
    Parameter,
    Series,
    Signals,
    Spans,
    event_spans,
    sampled_spans,
    series,
    thruster_outputs,
    undelayed,
    wiring,
)
from .signals_tlog import UNAIDED

WANTED = (
    "ACC",
    "ARM",
    "ATT",
    "BARO",
    "BAT",
    "EV",
    "GYR",
    "IMU",
    "MODE",
    "PARM",
    "RATE",
    "RCIN",
    "RCOU",
    "VISO",
    "VISP",
    "VISV",
    "XKF1",
    "XKF4",
    "XKQ",
)
_HORIZ_VEL, _HORIZ_POS, _CONST_POS = 1 << 1, 1 << 3 | 1 << 4, 1 << 7
_ARMED_EVENT, _DISARMED_EVENT = 10, 11


def signals_from_bin(
    log: BinLog, motors: Sequence[float] = (1.0,) * 8, density: float | None = None
) -> Signals:
    """Convert an autopilot's own log; `motors` and `density` as in `import_log`.

    Raises:
        UserError: if attitude, rates or thruster outputs are not in the log.
    """
    tables = {name: _sorted(table) for name, table in log.tables.items()}
    core = _primary_core(tables)
    attitude = _attitude(tables, core)
    first, last = float(attitude.t[0]), float(attitude.t[-1])
    parameters = [
        Parameter(float(t), name.decode("ascii", "replace"), float(value))
        for t, name, value in _columns(tables, "PARM", "Name", "Value")
    ]
    known = {p.name: p.value for p in parameters}
    wired = wiring(parameters, first, last)
    outputs, notes = _outputs(tables, wired, motors)
    position, velocity = _motion(tables, core, known, density)
    rates, rate_notes = _rates(tables, core)
    force = _imu(tables, core, "ACC", ("AccX", "AccY", "AccZ"))
    if not rates.source.startswith("GYR"):  # GYR and ACC are the sensors before the filters
        rates, delay = undelayed(rates, known, "INS_GYRO_FILTER")
        rate_notes = (*rate_notes, *delay)
    if force is not None and force.source != "ACC":
        force, delay = undelayed(force, known, "INS_ACCEL_FILTER")
        rate_notes = (*rate_notes, *delay)
    aids = [name for name in ("VISO", "VISP", "VISV") if name in tables]
    return Signals(
        attitude=attitude,
        rates=rates,
        outputs=outputs,
        position=position,
        velocity=velocity,
        specific_force=force,
        pressure_depth=_pressure_depth(tables, known, density),
        voltage=_voltage(tables),
        rc=_rc(tables),
        spans={"wiring": wired.spans, **_states(tables, first, last), **_aiding(tables, core)},
        has=(f"Horizontal aid: {', '.join(aids)}.",) if aids else (),
        lacks=() if aids else ("No DVL, odometry or vision record in the log.",),
        notes=(*log.notes, *wired.notes, *notes, *rate_notes),
    )


def _sorted(table: Table) -> Table:
    t = table.get("SampleUS", table["TimeUS"]) * 1e-6
    order = np.argsort(t, kind="stable")
    return {"t": t[order], **{c: v[order] for c, v in table.items() if c != "t"}}


def _columns(tables: Mapping[str, Table], name: str, *columns: str) -> Sequence[tuple]:
    table = tables.get(name)
    return [] if table is None else list(zip(table["t"], *(table[c] for c in columns), strict=True))


def _primary_core(tables: Mapping[str, Table]) -> int:
    """The filter core that flew most of the log."""
    status = tables.get("XKF4")
    if status is None or "PI" not in status:
        return 0
    indices = status["PI"][status["PI"] >= 0].astype(int)
    return int(np.bincount(indices).argmax()) if indices.size else 0


def _of(table: Table, column: str, value: int) -> Table:
    """Rows of one instance; all of them if the log has no such column, the first one if not it."""
    if column not in table:
        return table
    rows = table[column] == value
    if not rows.any():
        rows = table[column] == table[column].min()
    return {c: v[rows] for c, v in table.items()}


def _attitude(tables: Mapping[str, Table], core: int) -> Series:
    found = []
    if "XKQ" in tables:
        q = _of(tables["XKQ"], "C", core)
        found.append(series(q["t"], codec.attitude(q["Q1"], q["Q2"], q["Q3"], q["Q4"]), "XKQ"))
    if "ATT" in tables:
        e = tables["ATT"]
        x = codec.attitude_from_euler(e["Roll"], e["Pitch"], e["Yaw"], degrees=True)
        found.append(series(e["t"], x, "ATT"))
    usable = [s for s in found if s is not None]
    if not usable:
        raise UserError("no attitude (XKQ, ATT) in this log; set LOG_BITMASK to its default")
    return max(usable, key=lambda s: s.rate)


def _imu(
    tables: Mapping[str, Table], core: int, raw: str, axes: tuple[str, str, str]
) -> Series | None:
    for name in ("IMU", raw):
        if name in tables:
            table = _of(tables[name], "I", core)
            return series(table["t"], codec.body_vector(*(table[a] for a in axes)), name)
    return None


def _rates(tables: Mapping[str, Table], core: int) -> tuple[Series, tuple[str, ...]]:
    gyro = _imu(tables, core, "GYR", ("GyrX", "GyrY", "GyrZ"))
    if gyro is not None:
        if "XKF1" not in tables or "GX" not in tables["XKF1"]:
            return gyro, ("Body rates are those of the gyro, with its bias left in.",)
        ekf = _of(tables["XKF1"], "C", core)
        bias = series(ekf["t"], np.deg2rad(codec.body_vector(ekf["GX"], ekf["GY"], ekf["GZ"])), "")
        if bias is None:
            return gyro, ()
        corrected = gyro.x - linear(gyro.t, bias.t, bias.x)
        return Series(gyro.t, corrected, f"{gyro.source} less XKF1's bias"), ()
    if "RATE" in tables:
        table = tables["RATE"]
        x = np.deg2rad(codec.body_vector(table["R"], table["P"], table["Y"]))
        slow = series(table["t"], x, "RATE")
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
    return in_water(series(ekf["t"], p, "XKF1"), series(ekf["t"], v, "XKF1"), known, density)


def _aiding(tables: Mapping[str, Table], core: int) -> dict[str, Spans]:
    if "XKF4" not in tables or "SS" not in tables["XKF4"]:
        return {}
    status = _of(tables["XKF4"], "C", core)
    flags = status["SS"].astype(int)
    aided = (flags & _HORIZ_VEL > 0) & (flags & _HORIZ_POS > 0) & (flags & _CONST_POS == 0)
    return {"aiding": sampled_spans(status["t"], ["" if a else UNAIDED for a in aided])}


def _states(tables: Mapping[str, Table], first: float, last: float) -> dict[str, Spans]:
    spans = {}
    number = "ModeNum" if "ModeNum" in tables.get("MODE", {}) else "Mode"
    modes = _columns(tables, "MODE", number)
    if modes:
        names = [codec.mode_name(int(mode)) for _, mode in modes]
        spans["mode"] = event_spans(np.array([t for t, _ in modes]), names, first, last)
    arming = [(t, bool(state)) for t, state in _columns(tables, "ARM", "ArmState")]
    if not arming:
        events = {_ARMED_EVENT: True, _DISARMED_EVENT: False}
        arming = [(t, events[int(i)]) for t, i in _columns(tables, "EV", "Id") if i in events]
    if arming:  # before the first change it was the other way round
        states = [(first, not arming[0][1]), *arming]
        spans["armed"] = event_spans(
            np.array([t for t, _ in states]),
            ["" if armed else "disarmed" for _, armed in states],
            first,
            last,
        )
    return spans


def _outputs(
    tables: Mapping[str, Table], wired: object, motors: Sequence[float]
) -> tuple[Series, list[str]]:
    if "RCOU" not in tables:
        raise UserError(
            "no RCOU in this log, so nothing tells what the thrusters did; "
            "set LOG_BITMASK to its default"
        )
    table = tables["RCOU"]
    channels = np.zeros((16, table["t"].size))
    for n in range(1, 15):
        if f"C{n}" in table:
            channels[n - 1] = table[f"C{n}"]
    outputs, notes = thruster_outputs(
        table["t"],
        channels,
        wired,  # pyright: ignore[reportArgumentType]
        motors,
        "RCOU",
    )
    if outputs is None:
        raise UserError("RCOU: a single record is no record of the thrusters")
    return outputs, notes


def _pressure_depth(
    tables: Mapping[str, Table], known: Mapping[str, float], density: float | None
) -> Series | None:
    if "BARO" not in tables:
        return None
    gradient = codec.pascal_per_metre(known.get("BARO_SPEC_GRAV", 1.0), density)
    baro = _of(tables["BARO"], "I", 1)
    instance = int(baro["I"][0]) if "I" in baro else 0
    surface = known.get(f"BARO{instance + 1}_GND_PRESS", 0.0) / 100
    surface = surface if 800 < surface < 1200 else codec.SURFACE_PRESSURE_HPA
    depth = codec.depth_from_pressure(baro["Press"] / 100.0, surface, gradient)
    return series(baro["t"], depth, "BARO")


def _voltage(tables: Mapping[str, Table]) -> Series | None:
    if "BAT" not in tables:
        return None
    column = "Inst" if "Inst" in tables["BAT"] else "Instance"
    battery = _of(tables["BAT"], column, 0)
    known = battery["Volt"] > 0
    return series(battery["t"][known], battery["Volt"][known], "BAT")


def _rc(tables: Mapping[str, Table]) -> Series | None:
    if "RCIN" not in tables:
        return None
    table = tables["RCIN"]
    return series(table["t"], np.stack([table[f"C{n}"] for n in range(1, 9)]), "RCIN")
