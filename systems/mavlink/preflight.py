"""The checks before arming: link, sensors, parameters, frame, failsafes, battery.

Pure functions of what the vehicle has `told`. Each check gives a finding with its remedy; arming
needs all of them passed.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from . import telemetry
from .codec import FRAME_THRUSTERS, MOTOR_FUNCTIONS, PASS_THROUGH_FUNCTIONS
from .config import GROUND_STATION, OBEYED
from .dialect import mavlink
from .link import Link, Statistics
from .mixer import FRAMES

FAILSAFES: Mapping[str, float] = {
    "FS_PILOT_INPUT": 2.0,  # disarm when commands stop: the only one that stops the thrusters
    "FS_PILOT_TIMEOUT": 1.0,
    "FS_GCS_ENABLE": 2.0,  # disarm when the ground station is silent
    "FS_LEAK_ENABLE": 1.0,
    "RC_OVERRIDE_TIME": 3.0,
}
"""Parameters that make the autopilot stop the thrusters by itself, with their values for a dive.

Measured on ArduSub 4.5.6: with FS_PILOT_INPUT 0 the last command is held for ever. A value that is
stricter stays: a shorter time, the surface on a leak.
"""
_TIMES = ("FS_PILOT_TIMEOUT", "RC_OVERRIDE_TIME")
_AT_LEAST = ("FS_LEAK_ENABLE",)

_MOTOR_1 = MOTOR_FUNCTIONS[0]
_TRIM_IS_NEUTRAL = (4, 7)
"""First version of ArduSub whose throttle is measured from RC3_TRIM."""
_PULSES = {"MIN": 1100.0, "TRIM": 1500.0, "MAX": 1900.0}
_LOSS, _DAMAGED = 0.05, 0.01  # shares of packets that may be lost, and damaged
_DEPTH = mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE  # ArduSub's own word on its depth sensor
_SENSORS_HEALTHY = mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
_ATTITUDE_GOOD = mavlink.ESTIMATOR_ATTITUDE


@dataclass(frozen=True)
class Requirements:
    """What a dive needs of the vehicle.

    Attributes:
        thrusters: their number in the scenario's vehicle.
        passthrough: whether thrusters are commanded one by one.
        rates: least rate (Hz) of the messages that the estimator and the guards read.
        system: our system id.
        min_voltage: least battery voltage (V); 0 does not check it.
        sets: parameters that are set before arming, with their values for the dive.
        dry: whether nothing is set or armed.
    """

    thrusters: int
    passthrough: bool = False
    rates: Mapping[str, float] = field(default_factory=dict)
    system: int = GROUND_STATION
    min_voltage: float = 13.2
    sets: Mapping[str, float] = field(default_factory=dict)
    dry: bool = False


class Facts(NamedTuple):
    """What the vehicle has told."""

    statistics: Statistics
    parameters: Mapping[str, float]
    vehicle_type: int
    """MAV_TYPE of its heartbeat."""
    autopilot: int
    """MAV_AUTOPILOT of its heartbeat."""
    armed: bool
    mode: str
    voltage: float
    """Battery (V), NaN if unknown."""
    health: int | None
    """onboard_control_sensors_health of SYS_STATUS, None if it did not come."""
    estimator: int | None
    """Flags of EKF_STATUS_REPORT, None if it did not come."""
    leak: bool
    rivals: int
    """Other ground stations with our system id."""
    given_back: bool
    """Whether no parameters of a former run wait to be restored."""
    version: tuple[int, int] | None = None
    """Of its firmware, None if unknown."""


def told(
    link: Link, parameters: Mapping[str, float], version: tuple[int, int] | None, given_back: bool
) -> Facts:
    """What a link's vehicle, whose heartbeat has been heard, tells now."""
    heartbeat, status = link.latest("HEARTBEAT"), telemetry.status(link, time.monotonic())
    assert heartbeat is not None
    assert status is not None
    system, estimator = link.latest("SYS_STATUS"), link.latest("EKF_STATUS_REPORT")
    return Facts(
        link.statistics(),
        parameters,
        int(heartbeat.message.type),
        int(heartbeat.message.autopilot),
        status.armed,
        status.mode,
        telemetry.battery(link),
        None if system is None else int(system.message.onboard_control_sensors_health),
        None if estimator is None else int(estimator.message.flags),
        status.leak,
        len(link.others()),
        given_back,
        version,
    )


class Finding(NamedTuple):
    """The result of a check."""

    name: str
    passed: bool
    words: str


def preflight(needs: Requirements, facts: Facts) -> list[Finding]:
    """All checks, in the order in which a person would go through them."""
    return [Finding(*found) for check in _CHECKS for found in check(needs, facts)]


def is_depth_healthy(health: int) -> bool:
    """Whether ArduSub takes its depth sensor for healthy, by SYS_STATUS."""
    return bool(health & _DEPTH)


def _weaker(name: str, value: float, wanted: float) -> bool:
    """Whether a failsafe stops the thrusters later, or in fewer cases, than with `wanted`."""
    if name in _TIMES:
        return not 0 < value <= wanted
    return value < wanted if name in _AT_LEAST else value != wanted


def for_dive(parameters: Mapping[str, float], system: int) -> dict[str, float]:
    """Parameters that a dive needs with other values, and these.

    They are failsafes that are weaker than `FAILSAFES`, and the id that the vehicle obeys. Those
    that it does not have are left out: the pre-flight check names them.
    """
    found = {n: v for n, v in FAILSAFES.items() if _weaker(n, parameters.get(n, v), v)}
    obeyed = {name: float(system) for name in OBEYED if name in parameters}
    return found | {name: own for name, own in obeyed.items() if parameters[name] != own}


Found = Iterator[tuple[str, bool, str]]


def _identity(needs: Requirements, facts: Facts) -> Found:
    del needs
    ardupilot = facts.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    submarine = facts.vehicle_type == mavlink.MAV_TYPE_SUBMARINE
    kind = mavlink.enums["MAV_TYPE"].get(facts.vehicle_type)
    name = kind.name if kind else facts.vehicle_type
    yield (
        "vehicle",
        ardupilot and submarine,
        "ArduSub" if ardupilot and submarine else f"is no ArduSub but {name}; check the connection",
    )


def _link(needs: Requirements, facts: Facts) -> Found:
    del needs
    s = facts.statistics
    total = max(s.received + s.lost, 1)
    lost, damaged = s.lost / total, s.damaged / total
    yield (
        "link",
        lost <= _LOSS and damaged <= _DAMAGED and s.silence < 1.0,
        f"{100 * lost:.1f} % of packets lost, {100 * damaged:.1f} % damaged, silent for "
        f"{s.silence:.1f} s",
    )
    yield (
        "ground stations",
        facts.rivals == 0,
        f"{facts.rivals} others use our system id"
        + ("; disconnect them, or give them another id" if facts.rivals else ""),
    )


def _rates(needs: Requirements, facts: Facts) -> Found:
    for name, least in needs.rates.items():
        rate = facts.statistics.rates.get(name, 0.0)
        # a rate counted over two seconds is off by one message
        yield name, rate >= 0.9 * least - 0.5, f"{rate:.1f} Hz ({least:g} Hz needed)"


def _frame(needs: Requirements, facts: Facts) -> Found:
    number = int(facts.parameters.get("FRAME_CONFIG", -1))
    fits = needs.passthrough or FRAME_THRUSTERS.get(number) == needs.thrusters
    words = f"FRAME_CONFIG {number} ({FRAMES.get(number, 'unknown')})"
    remedy = f": the scenario's vehicle has {needs.thrusters} thrusters; name the one connected"
    yield "frame", fits, words + ("" if fits else remedy)


def _outputs(needs: Requirements, facts: Facts) -> Found:
    wrong = []
    for n in range(1, needs.thrusters + 1):
        value = facts.parameters.get(f"SERVO{n}_FUNCTION")
        if value is None or int(value) != _MOTOR_1 + n - 1:
            left = value is not None and int(value) in PASS_THROUGH_FUNCTIONS
            note = " (pass-through, left by a run that died)" if left else ""
            wrong.append(f"SERVO{n}_FUNCTION {value if value is None else int(value)}{note}")
    yield (
        "outputs",
        not wrong and facts.given_back,
        "motors on outputs 1 to n"
        if not wrong and facts.given_back
        else f"{', '.join(wrong) or 'parameters of a former run'}: restore the motors' functions "
        f"{_MOTOR_1} to {_MOTOR_1 + needs.thrusters - 1} first",
    )
    for word, value in (("MIN", 1100.0), ("MAX", 1900.0)):
        found = facts.parameters.get(f"MOT_PWM_{word}", value)
        yield f"MOT_PWM_{word}", found == value, f"{found:g} µs ({value:g} is assumed)"
    if not needs.passthrough:
        trim = _throttle_trim(facts.version)
        odd = [
            f"RC{n}_{word} {found:g}"
            for n in range(1, 7)
            for word, value in _PULSES.items()
            for right in [trim if (n, word) == (3, "TRIM") else value]
            if (found := facts.parameters.get(f"RC{n}_{word}", right)) != right
        ]
        odd += [f"RC{n}_REVERSED" for n in range(1, 7) if facts.parameters.get(f"RC{n}_REVERSED")]
        assumed = f" (1100, 1500, 1900, RC3_TRIM {trim:g} and not reversed are assumed)"
        yield "RC channels", not odd, ", ".join(odd) + assumed if odd else "ok"


def _throttle_trim(version: tuple[int, int] | None) -> float:
    """RC3_TRIM with which 1500 µs is no vertical thrust.

    Up to ArduSub 4.6 the throttle's trim is its lower end: with 1500 there, 1500 is full down. From
    4.7 on it is the neutral: with 1100 there, 1500 is half up.
    """
    return _PULSES["TRIM" if version is not None and version >= _TRIM_IS_NEUTRAL else "MIN"]


def _failsafes(needs: Requirements, facts: Facts) -> Found:
    p = facts.parameters
    verb = "would be" if needs.dry else "is"
    name = next((n for n in OBEYED if n in p), OBEYED[0])
    mine = int(p.get(name, GROUND_STATION))
    words = f"the vehicle obeys system {mine}, and we are {needs.system}"
    told = f"; {name} {verb} set for the dive" if name in needs.sets else ""
    yield "ground station id", mine == needs.system or bool(told), words + told
    for name, wanted in FAILSAFES.items():
        found, weak = p.get(name), name in for_dive(p, needs.system)
        if found is None:
            yield name, False, f"is not among its parameters: set {wanted:g}"
        elif name in needs.sets:
            yield name, True, f"is {found:g}: {verb} set to {needs.sets[name]:g} for the dive"
        else:
            yield name, not weak, f"is {found:g}" + (f": set {wanted:g}" if weak else "")


def _state(needs: Requirements, facts: Facts) -> Found:
    low = needs.min_voltage > 0 and not facts.voltage >= needs.min_voltage
    yield (
        "battery",
        not low,
        f"{facts.voltage:.1f} V"
        + (f": below {needs.min_voltage:g} V; charge it, or min_voltage: 0" if low else ""),
    )
    yield "leak", not facts.leak, "water in the hull" if facts.leak else "dry"
    healthy = facts.health is not None and facts.health & _SENSORS_HEALTHY == _SENSORS_HEALTHY
    yield "inertial sensors", healthy, "healthy" if healthy else "not healthy in SYS_STATUS"
    deep = facts.health is not None and is_depth_healthy(facts.health)
    remedy = "not healthy in SYS_STATUS; check the depth sensor (BARO_PROBE_EXT) and its cable"
    yield "depth sensor", deep, "healthy" if deep else remedy
    level = facts.estimator is not None and bool(facts.estimator & _ATTITUDE_GOOD)
    yield "attitude", level, "estimated" if level else "no attitude in EKF_STATUS_REPORT; wait"
    yield "disarmed", not facts.armed, "armed by someone else" if facts.armed else "yes"


_CHECKS = (_identity, _link, _rates, _frame, _outputs, _failsafes, _state)
