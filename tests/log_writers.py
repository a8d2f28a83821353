"""Tiny logs with known numbers: telemetry through pymavlink's encoder, DataFlash by its format."""

import struct
from io import BytesIO

import numpy as np
from motion import smooth_motion
from pymavlink.dialects.v20 import ardupilotmega as dialect

from spinndrift.models import frames
from spinndrift.systems.mavlink import codec

EPOCH_US = 1_700_000_000_000_000
PARAMETERS = {
    **{f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 9)},
    **{f"MOT_{n}_DIRECTION": 1.0 for n in range(1, 9)},
    "INS_GYRO_FILTER": 0.0,
    "BARO2_GND_PRESS": 101325.0,
}


def outputs(t):
    """PWM (µs) of thrusters 1 … 8 at times t: slow sines of different size, phase and period."""
    n = np.arange(8.0)
    angle = np.multiply.outer(0.5 + 0.1 * n, t) + np.add.outer(n, 0.0 * np.asarray(t))
    return np.round(1500 + np.einsum("i,i...->i...", 60 + 30 * n, np.sin(angle)))


def truth(t):
    """Pose, body twist and world velocity of the vehicle in all these logs."""
    return smooth_motion(np.asarray(t) - 100.0, speed=0.5)


def ned(t):
    """Rows (quaternion, position, velocity, body rates) at times t as the autopilot sees them."""
    X, V, v_W = truth(np.atleast_1d(t))
    q = frames.quaternion_to_flu_enu(X[:4])
    parts = (q, frames.ned_to_enu(X[4:]), frames.ned_to_enu(v_W), frames.frd_to_flu(V[3:]))
    return list(zip(*(part.T for part in parts), strict=True))


class Tlog:
    """Collects records; every packet has the time (s since boot) at which it was sent."""

    def __init__(self, version=2):
        self.records: list[tuple[float, bytes]] = []
        self.version = version
        self.encoders: dict[tuple[int, int], dialect.MAVLink] = {}

    def send(self, t, message, system=1, component=1, delay=0.004):
        key = (system, component)
        if key not in self.encoders:
            self.encoders[key] = dialect.MAVLink(BytesIO(), *key)
        encoder = self.encoders[key]
        packed = message.pack(encoder, force_mavlink1=self.version == 1)
        encoder.seq = (encoder.seq + 1) % 256
        self.records.append((t + delay, packed))

    def bytes(self, clock=lambda t: t):
        """The file; `clock` maps the vehicle's time to the logger's (both s)."""
        ordered = sorted(self.records, key=lambda record: record[0])
        return b"".join(
            struct.pack(">Q", EPOCH_US + round(clock(t) * 1e6)) + packed for t, packed in ordered
        )


def parameter(name, value):
    return dialect.MAVLink_param_value_message(name.encode(), value, 9, 1000, 1)


def heartbeat(armed=True, mode=19, kind=12, autopilot=3):
    return dialect.MAVLink_heartbeat_message(kind, autopilot, 81 + 128 * armed, mode, 4, 3)


def dive(
    start=100.0,
    duration=20.0,
    *,
    state=lambda t: (True, 19),
    parameters=PARAMETERS,
    changes=(),
    horizontal=True,
    silent=lambda t: False,
    jump=None,
    rates=(50.0, 25.0, 50.0),
    hud=None,
    version=2,
):
    """A telemetry log of `duration` s from `start` (s since boot) and its writer.

    Args:
        state: armed and mode at a time.
        changes: (time, parameter, value) reported during the dive.
        horizontal: whether there is a LOCAL_POSITION_NED.
        silent: times at which nothing is sent.
        jump: time from which positions are 2 m further north.
        rates: of attitude, position and outputs (Hz).
        hud: of VFR_HUD (Hz), which has the climb and no time; None for none.
    """
    log = Tlog(version)

    def times(rate, offset=0.0):
        grid = start + offset + np.arange(0, duration, 1 / rate)
        grid = np.round(grid * 1e3) * 1e-3
        return [t for t in grid if not silent(t)]

    def moving(rate, offset=0.0):
        grid = times(rate, offset)
        return zip(grid, ned(grid), strict=True)

    def ms(t):
        return round(t * 1e3) % 2**32

    for name, value in parameters.items():
        log.send(start + 0.3, parameter(name, value))
    for t, name, value in changes:
        log.send(t, parameter(name, value))
    for t, (q, _, _, w) in moving(rates[0]):
        log.send(t, dialect.MAVLink_attitude_quaternion_message(ms(t), *q, *w))
    for t, (_, p, v, _) in moving(rates[1], 0.003):
        if horizontal:
            shift = 2.0 if jump is not None and t >= jump else 0.0
            log.send(
                t, dialect.MAVLink_local_position_ned_message(ms(t), p[0] + shift, p[1], p[2], *v)
            )
        else:
            height, down = round(-p[2] * 1e3), round(v[2] * 1e2)
            fields = (ms(t), 0, 0, 0, height, 0, 0, down, 0)
            log.send(t, dialect.MAVLink_global_position_int_message(*fields))
    for t, (_, _, v, _) in moving(hud, 0.001) if hud else ():
        log.send(t, dialect.MAVLink_vfr_hud_message(0.0, 0.0, 0, 0, 0.0, -v[2]))
    for t in times(rates[2], 0.002):
        pwm = [int(us) for us in outputs(t)] + [0] * 8
        fields = (round(t * 1e6) % 2**32, 0, *pwm[:8], *pwm[8:])
        log.send(t, dialect.MAVLink_servo_output_raw_message(*fields))
    for t in times(1.0):
        log.send(t, heartbeat(*state(t)))
        log.send(t, dialect.MAVLink_ekf_status_report_message(831, 0, 0, 0, 0, 0))
    for t in times(2.0):
        cells = [round(16000 - 10 * (t - start)), *[65535] * 9]
        log.send(t, dialect.MAVLink_battery_status_message(0, 0, 0, 32767, cells, 0, 0, 0, 50))
    for t, (_, p, _, _) in moving(10.0):
        hPa = float(codec.pressure_from_depth(float(p[2])))
        log.send(t, dialect.MAVLink_scaled_pressure2_message(ms(t), hPa, 0.0, 1000))
    return log


_FORMATS = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (129, "QNf", "TimeUS,Name,Value"),
    "MODE": (130, "QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "ARM": (131, "QBI", "TimeUS,ArmState,ArmChecks"),
    "XKQ": (132, "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4"),
    "XKF1": (133, "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "XKF4": (134, "QBIb", "TimeUS,C,SS,PI"),
    "IMU": (135, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RCOU": (136, "QHHHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6,C7,C8"),
    "BAT": (137, "QBf", "TimeUS,Inst,Volt"),
    "ATT": (138, "QccC", "TimeUS,Roll,Pitch,Yaw"),
}
_CODES = {"M": "B", "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I"}
_SCALED = set("cCeE")


class DataFlash:
    """Collects records of a DataFlash log, each type's FMT record first."""

    def __init__(self):
        self.parts: list[bytes] = []
        for name, (number, codes, columns) in _FORMATS.items():
            size = 3 + struct.calcsize("<" + "".join(_CODES.get(c, c) for c in codes))
            self.write("FMT", number, size, name.encode(), codes.encode(), columns.encode())

    def write(self, name, *values):
        number, codes, _ = _FORMATS[name]
        packed = [round(v * 100) if c in _SCALED else v for c, v in zip(codes, values, strict=True)]
        form = "<" + "".join(_CODES.get(c, c) for c in codes)
        self.parts.append(b"\xa3\x95" + bytes([number]) + struct.pack(form, *packed))

    def bytes(self):
        return b"".join(self.parts)


def dataflash(start=100.0, duration=20.0, *, bias=0.01, aided=True, disarm=None):
    """The same dive as the autopilot's own log; `bias` (rad/s) is on each gyro axis."""
    log = DataFlash()
    us = lambda t: round(t * 1e6)  # noqa: E731
    events = []
    for name, value in PARAMETERS.items():
        events.append((start, "PARM", (name.encode(), value)))
    events.append((start, "MODE", (19, 19, 1)))
    if disarm is not None:
        events.append((disarm, "ARM", (0, 0)))
    fast, slow = start + np.arange(0, duration, 0.01), start + np.arange(0, duration, 0.02)
    for t, (q, p, v, _) in zip(slow, ned(slow), strict=True):
        for core in (1, 0):  # core 1 is the one that flies; core 0 is wrong
            wrong = 0.0 if core == 1 else 3.0
            events.append((t, "XKQ", (core, *(q if core else (1.0, 0.0, 0.0, 0.0)))))
            pos = (0.0, *(p + wrong), *np.rad2deg([bias] * 3), 0.0)
            events.append((t, "XKF1", (core, 0.0, 0.0, 0.0, *v, *pos)))
            events.append((t, "XKF4", (core, 0b111111 if aided else 0b10100111, 1)))
    for t, (_, _, _, rates) in zip(fast, ned(fast), strict=True):
        w = rates + bias
        for instance in (0, 1):
            noise = 1e-6 * (round(100 * t) % 7)  # a working sensor never gives one value for long
            force = (noise, 0.0, -codec.G)
            events.append((t, "IMU", (instance, *(w if instance else 9 * w), *force)))
    for t in start + np.arange(0, duration, 0.1):
        events.append((t, "RCOU", tuple(int(x) for x in outputs(t))))
        events.append((t, "BAT", (0, 15.5)))
    for t, name, values in sorted(events, key=lambda e: e[0]):
        log.write(name, us(t), *values)
    return log
