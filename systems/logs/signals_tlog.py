"""From telemetry messages to signals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...models.config.errors import UserError
from ...models.recordings.checks.finding import Finding
from ..mavlink import codec
from .depth import in_water
from .frame import firmware_findings, frame_said, kind_findings
from .motion_tlog import motion
from .pressure import Followed, depth_series, followed, outside
from .signals import (
    Parameter,
    Series,
    Signals,
    Spans,
    parameters_of,
    sampled_spans,
    series,
    undelayed,
)
from .sticks import NAMES as STICKS
from .sticks import by_sticks
from .streams import aid_spans, has_fix, missing_states
from .table import Table
from .tlog import TlogLog
from .wiring import Wiring, direction_findings, thruster_outputs, wiring

WANTED = (
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "BATTERY_STATUS",
    "EKF_STATUS_REPORT",
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "LOCAL_POSITION_NED",
    "NAMED_VALUE_FLOAT",
    "PARAM_VALUE",
    "RAW_IMU",
    "RC_CHANNELS",
    "SCALED_IMU",
    "SCALED_PRESSURE",
    "SCALED_PRESSURE2",
    "SERVO_OUTPUT_RAW",
    "STATUSTEXT",
    "SYSTEM_TIME",
    "VFR_HUD",
    "SYS_STATUS",
)
AIDS = ("VISION_POSITION_DELTA", "VISION_POSITION_ESTIMATE", "VISION_SPEED_ESTIMATE", "ODOMETRY")
ANYONE = (*AIDS, *STICKS)
"""Messages that are taken whoever sent them."""
_BEYOND = 0.05
"""Share of the angles beyond a turn that damaged messages do not make."""


def signals_from_tlog(  # long: a line for each stream of a log
    log: TlogLog, vehicle: str | None = None, density: float | None = None
) -> Signals:
    """Convert a vehicle's messages; `vehicle` and `density` as in `import_log`.

    Raises:
        UserError: if attitude or thruster outputs are not in the log, or the vehicle is another.
    """
    tables = log.tables
    attitude = _attitude(tables)
    outputs_table = tables.get("SERVO_OUTPUT_RAW")
    if outputs_table is None:
        raise UserError(
            "no SERVO_OUTPUT_RAW in this log, so nothing tells what the thrusters did; "
            "ask for it with SET_MESSAGE_INTERVAL (50 Hz or more) while logging"
        )
    first, last = float(attitude.t[0]), float(attitude.t[-1])
    parameters, strange = _parameters(tables.get("PARAM_VALUE"))
    texts = [] if "STATUSTEXT" not in tables else _texts(tables["STATUSTEXT"]["text"])
    wired = wiring(parameters, first, last, vehicle, frame_said(texts), _pulses(outputs_table))
    known = {p.name: p.value for p in parameters}
    outputs, notes, frame = _outputs(outputs_table, wired, vehicle is not None)
    moved, aiding, motion_notes = motion(tables)
    position, velocity = in_water(*moved, known, density)
    depth = _pressure_depth(tables, parameters, density, position)
    rates, bias_note = _rates(tables, attitude)
    rates, rate_delay = undelayed(rates, known, "INS_GYRO_FILTER")
    force, force_delay = _specific_force(tables, known)
    told = [*bias_note, *rate_delay, *force_delay, *depth.told]
    aids = _aids(log)
    no_aid, stops = ({}, []) if "GPS" in aids else aid_spans(tables, AIDS, last)
    states = _states(tables)
    spans = {"wiring": wired.spans, **states, **aiding, **no_aid}
    outputs, between = by_sticks(outputs, tables, (wired.spans, *states.values()))
    voltage = _voltage(tables)
    batteries = [name for name in ("BATTERY_STATUS", "SYS_STATUS") if name in tables]
    findings = kind_findings(*log.kind) or firmware_findings("STATUSTEXT", texts, log.kind[1])
    findings += [
        *log.findings,
        *_angle_findings(tables, attitude),
        *frame,
        *stops,
        *missing_states(spans, voltage, batteries),
        *depth.findings,
    ]
    has = [f"Horizontal aid: {', '.join(aids)}."] if aids else []
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
        spans=spans,
        cuts=(
            *((t, "reboot of the autopilot") for t in log.boots),
            *wired.cuts,
        ),
        has=tuple(has),
        lacks=() if aids else ("No DVL, odometry, vision or GPS message in the log.",),
        notes=(*log.notes, *strange, *wired.notes, *notes, *between, *motion_notes, *told),
        findings=(*findings, *direction_findings(wired)),
        estimated=True,
        low_pass=known.get("INS_GYRO_FILTER", 0.0),
        **wired.of_signals(),
    )


def _parameters(table: Table | None) -> tuple[list[Parameter], list[str]]:
    if table is None:
        return [], []
    return parameters_of(table["t"], table["param_id"], table["param_value"])


def _aids(log: TlogLog) -> list[str]:
    """Names of the sources of horizontal position and velocity that were heard."""
    aids = sorted({name for name, _, _ in log.heard if name in AIDS})
    return [*aids, "GPS"] if has_fix(log.tables.get("GPS_RAW_INT"), "fix_type") else aids


def _attitude(tables: Mapping[str, Table]) -> Series:
    found = []
    if (q := tables.get("ATTITUDE_QUATERNION")) is not None:
        x = codec.attitude(q["q1"], q["q2"], q["q3"], q["q4"])
        found.append(series(q["t"], x, "ATTITUDE_QUATERNION", "attitude"))
    if (e := tables.get("ATTITUDE")) is not None:
        x = codec.attitude_from_euler(e["roll"], e["pitch"], e["yaw"])
        found.append(series(e["t"], x, "ATTITUDE", "attitude"))
    usable = [s for s in found if s is not None and np.isfinite(s.x).all()]
    if not usable:
        raise UserError("no ATTITUDE in this log; stream ATTITUDE (50 Hz is good) while logging")
    return max(usable, key=lambda s: s.t.size)


def _angle_findings(tables: Mapping[str, Table], attitude: Series) -> list[Finding]:
    """Angles that are beyond a turn in rad."""
    table = tables.get("ATTITUDE")
    if table is None or attitude.source != "ATTITUDE":
        return []
    angles = np.abs(np.stack([table[name] for name in ("roll", "pitch", "yaw")]))
    if np.mean(np.nanmax(angles, axis=0) > 2 * np.pi) < _BEYOND:
        return []
    text = f"roll, pitch and yaw reach {np.nanmax(angles):.0f}: they look like degrees"
    return [Finding("motion-contradiction", "ATTITUDE", text, "give rad, as the autopilot does")]


def _rates(tables: Mapping[str, Table], attitude: Series) -> tuple[Series, tuple[str, ...]]:
    """Body rates: those of the attitude message (without bias), or of a much faster gyro."""
    table = tables[attitude.source]
    x = codec.body_vector(table["rollspeed"], table["pitchspeed"], table["yawspeed"])
    own = series(table["t"], x, f"{attitude.source} rates", "rate")
    if own is None:
        raise UserError(f"{attitude.source}: its body rates are no numbers; log them again")
    for name in ("RAW_IMU", "SCALED_IMU"):
        imu = tables.get(name)
        if imu is None:
            continue
        gyro = series(
            imu["t"], codec.imu_angular_rate(imu["xgyro"], imu["ygyro"], imu["zgyro"]), name, "rate"
        )
        if gyro is not None and gyro.rate > 3 * own.rate:
            return gyro, (f"Body rates are those of {name}, with the gyro's bias left in.",)
    return own, ()


def _specific_force(
    tables: Mapping[str, Table], known: Mapping[str, float]
) -> tuple[Series | None, list[str]]:
    for name in ("RAW_IMU", "SCALED_IMU"):
        if (imu := tables.get(name)) is not None:
            x = codec.imu_specific_force(imu["xacc"], imu["yacc"], imu["zacc"])
            found = series(imu["t"], x, name, "specific force")
            return (None, []) if found is None else undelayed(found, known, "INS_ACCEL_FILTER")
    return None, []


def _states(tables: Mapping[str, Table]) -> dict[str, Spans]:
    beats = tables.get("HEARTBEAT")
    if beats is None:
        return {}
    armed = (beats["base_mode"] & codec.ARMED_FLAG) > 0
    return {
        "mode": sampled_spans(beats["t"], [codec.mode_name(int(m)) for m in beats["custom_mode"]]),
        "armed": sampled_spans(beats["t"], ["" if a else "disarmed" for a in armed]),
    }


def _texts(column: np.ndarray) -> list[str]:
    return [bytes(text).decode("ascii", "replace").strip("\0") for text in column]


def _outputs(table: Table, wired: Wiring, named: bool) -> tuple[Series, list[str], list[Finding]]:
    """The thrusters' PWM, by the outputs' functions whatever their port.

    Port 1 has outputs 17 to 32, or 9 to 16 of an autopilot with eight outputs a port: the functions
    tell which.
    """
    ports = {int(port): table.rows(table["port"] == port) for port in np.unique(table["port"])}
    wanted = wired.outputs
    first = 17 if any(channel > 16 for channel in wanted) else 9
    starts = {0: 1, 1: first}
    driving = [p for p, start in starts.items() if wanted & set(range(start, start + 16))]
    main = max(
        (p for p in ports if p in starts),
        key=lambda p: (p in driving and (p == 1 or not _silent(ports[p], wanted)), -p),
        default=None,
    )
    if main is None:
        raise UserError("SERVO_OUTPUT_RAW: no port 0 or 1 in the log; log the thrusters' outputs")
    t = ports[main]["t"]
    channels = np.zeros((32, t.size))
    for port in (p for p in (0, 1) if p in ports):
        rows = ports[port]
        at = np.clip(np.searchsorted(rows["t"], t, side="right") - 1, 0, None)
        for n in range(1, 17):
            place = starts[port] + n - 2
            pulses = rows[f"servo{n}_raw"][at]
            if place < 32 and (port == main or not channels[place].any()):
                channels[place] = np.where(pulses > 0, pulses, channels[place])
    outputs, notes = thruster_outputs(t, channels, wired, "SERVO_OUTPUT_RAW")
    if outputs is None:
        raise UserError("SERVO_OUTPUT_RAW: a single message is no record of the thrusters")
    return outputs, notes, wired.frame_findings(channels, named)


def _pulses(table: Table) -> np.ndarray | None:
    """Pulses (µs) of the first eight outputs of the first port that has any."""
    for port in (0, 1):
        rows = table.rows(table["port"] == port)
        pulses = np.stack([rows[f"servo{n}_raw"] for n in range(1, 9)]).astype(float)
        if pulses.any():
            return pulses
    return None


def _silent(rows: Table, wanted: set[int]) -> bool:
    """Whether port 0 never has a pulse on the outputs of thrusters."""
    return not any(rows[f"servo{c}_raw"].any() for c in wanted if c <= 16)


def _pressure_depth(
    tables: Mapping[str, Table],
    parameters: Sequence[Parameter],
    density: float | None,
    position: Series | None,
) -> Followed:
    """Depth by the second barometer, which is outside the hull, or else by the first."""
    findings: list[Finding] = []
    for name, number in (("SCALED_PRESSURE2", 2), ("SCALED_PRESSURE", 1)):
        if (table := tables.get(name)) is None:
            continue
        depth, wrong = depth_series(
            table["t"], table["press_abs"], name, parameters, number, density
        )
        findings += wrong
        if depth is not None:
            found = followed(depth, position)
            found = outside(found, "SCALED_PRESSURE2") if number == 1 else found
            return replace(found, findings=(*findings, *found.findings))
    return Followed(None, findings=tuple(findings))


def _voltage(tables: Mapping[str, Table]) -> Series | None:
    """Voltage of the first monitor that has one: 0 unless that is unknown, or has a number."""
    if (battery := tables.get("BATTERY_STATUS")) is not None:
        for number in np.unique(battery["id"]).tolist():
            rows = battery.rows(battery["id"] == number)
            volts = np.asarray(codec.pack_voltage(rows["voltages"].T.astype(float)))
            known = np.isfinite(volts)
            found = series(rows["t"][known], volts[known], "BATTERY_STATUS", "voltage")
            if found is not None:
                return found
    if (status := tables.get("SYS_STATUS")) is not None:
        volts = np.asarray(codec.volts(status["voltage_battery"]))
        known = np.isfinite(volts)
        return series(status["t"][known], volts[known], "SYS_STATUS", "voltage")
    return None


def _rc(tables: Mapping[str, Table]) -> Series | None:
    if (table := tables.get("RC_CHANNELS")) is None:
        return None
    channels = np.stack([table[f"chan{n}_raw"] for n in range(1, 9)]).astype(float)
    channels = np.where(channels == codec.UINT16_MAX, 0, channels)
    return series(table["t"], channels, "RC_CHANNELS", "channel")
