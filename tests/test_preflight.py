"""The checks before arming."""

import pytest

from spinndrift.systems.mavlink.dialect import mavlink
from spinndrift.systems.mavlink.link import Statistics
from spinndrift.systems.mavlink.preflight import (
    FAILSAFES,
    Facts,
    Requirements,
    for_dive,
    preflight,
)

NEEDS = Requirements(8, rates={"ATTITUDE_QUATERNION": 50.0, "SCALED_PRESSURE2": 10.0})
PARAMETERS = {
    "FRAME_CONFIG": 2.0,
    "SYSID_MYGCS": 255.0,
    "MOT_PWM_MIN": 1100.0,
    "MOT_PWM_MAX": 1900.0,
    **{f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 9)},
    **{f"RC{n}_TRIM": 1500.0 for n in range(1, 9)},
    "RC3_TRIM": 1100.0,
    **FAILSAFES,
}
FINE = Facts(
    Statistics(5000, 10, 0, 0, 0.02, {"ATTITUDE_QUATERNION": 50.0, "SCALED_PRESSURE2": 10.0}),
    PARAMETERS,
    mavlink.MAV_TYPE_SUBMARINE,
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    armed=False,
    mode="MANUAL",
    voltage=16.1,
    health=mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
    estimator=mavlink.ESTIMATOR_ATTITUDE,
    leak=False,
    rivals=0,
    given_back=True,
)


def failed(facts: Facts, needs: Requirements = NEEDS) -> dict[str, str]:
    return {found.name: found.words for found in preflight(needs, facts) if not found.passed}


def with_parameter(name: str, value: float | None) -> Facts:
    parameters = dict(PARAMETERS)
    if value is None:
        del parameters[name]
    else:
        parameters[name] = value
    return FINE._replace(parameters=parameters)


def test_a_vehicle_in_order_passes():
    assert failed(FINE) == {}


@pytest.mark.parametrize(
    ("facts", "name", "words"),
    [
        (FINE._replace(vehicle_type=mavlink.MAV_TYPE_QUADROTOR), "vehicle", "MAV_TYPE_QUADROTOR"),
        (FINE._replace(autopilot=mavlink.MAV_AUTOPILOT_PX4), "vehicle", "no ArduSub"),
        (FINE._replace(statistics=Statistics(900, 100, 0, 0, 0.0)), "link", "10.0 % of packets"),
        (FINE._replace(rivals=1), "ground stations", "our system id"),
        (
            FINE._replace(statistics=Statistics(5000, 0, 0, 0, 0.0, {})),
            "SCALED_PRESSURE2",
            "0.0 Hz",
        ),
        (with_parameter("FRAME_CONFIG", 1.0), "frame", "vectored"),
        (with_parameter("SERVO7_FUNCTION", 57.0), "outputs", "SERVO7_FUNCTION 57 (pass-through"),
        (FINE._replace(given_back=False), "outputs", "former run"),
        (with_parameter("MOT_PWM_MAX", 1800.0), "MOT_PWM_MAX", "1800"),
        (with_parameter("RC5_TRIM", 1480.0), "RC channels", "RC5_TRIM 1480"),
        (with_parameter("RC3_TRIM", 1500.0), "RC channels", "RC3_TRIM 1500 (1100"),
        (with_parameter("RC2_REVERSED", 1.0), "RC channels", "RC2_REVERSED"),
        (FINE._replace(health=3), "depth sensor", "not healthy"),
        (with_parameter("SYSID_MYGCS", 250.0), "ground station id", "system 250"),
        (with_parameter("FS_PILOT_INPUT", 0.0), "FS_PILOT_INPUT", "is 0: set 2"),
        (with_parameter("FS_PILOT_INPUT", 1.0), "FS_PILOT_INPUT", "is 1: set 2"),
        (with_parameter("FS_GCS_ENABLE", None), "FS_GCS_ENABLE", "not among"),
        (with_parameter("RC_OVERRIDE_TIME", -1.0), "RC_OVERRIDE_TIME", "is -1"),
        (FINE._replace(voltage=12.0), "battery", "below 13.2 V"),
        (FINE._replace(voltage=float("nan")), "battery", "nan V"),
        (FINE._replace(leak=True), "leak", "water"),
        (FINE._replace(health=0), "inertial sensors", "not healthy"),
        (FINE._replace(estimator=None), "attitude", "wait"),
        (FINE._replace(armed=True), "disarmed", "someone else"),
    ],
)
def test_each_fault_is_found_and_nothing_else(facts: Facts, name: str, words: str):
    found = failed(facts)
    assert words in found[name]
    beside = {"inertial sensors": {"depth sensor"}}
    assert set(found) <= {name, "ATTITUDE_QUATERNION", "SCALED_PRESSURE2", *beside.get(name, ())}


def test_the_throttle_is_measured_from_its_trim_since_4_7():
    """`norm_input` in mode_manual.cpp: the throttle itself, then half of it about the neutral."""
    middle = with_parameter("RC3_TRIM", 1500.0)
    for version in (None, (4, 5), (4, 6)):
        assert failed(FINE._replace(version=version)) == {}
        assert "RC3_TRIM 1500" in failed(middle._replace(version=version))["RC channels"]
    assert failed(middle._replace(version=(4, 7))) == {}
    assert "RC3_TRIM 1100 (" in failed(FINE._replace(version=(5, 0)))["RC channels"]


def test_a_failsafe_that_is_set_for_the_dive_is_told_with_its_present_value():
    facts = with_parameter("FS_PILOT_INPUT", 0.0)
    needs = Requirements(8, rates=NEEDS.rates, sets=FAILSAFES)
    assert failed(facts, needs) == {}
    words = {found.name: found.words for found in preflight(needs, facts)}
    assert words["FS_PILOT_INPUT"] == "is 0: is set to 2 for the dive"
    assert "FS_GCS_ENABLE" in failed(with_parameter("FS_GCS_ENABLE", None), needs)


def test_what_is_stricter_than_a_dive_needs_stays_as_it_is():
    assert for_dive(PARAMETERS, 255) == {}
    strict = PARAMETERS | {"FS_LEAK_ENABLE": 2.0, "FS_PILOT_TIMEOUT": 0.5, "RC_OVERRIDE_TIME": 1.0}
    assert for_dive(strict, 255) == {}
    for name, value in (
        ("FS_LEAK_ENABLE", 0.0),
        ("FS_PILOT_TIMEOUT", 3.0),
        ("RC_OVERRIDE_TIME", -1.0),
        ("FS_GCS_ENABLE", 4.0),
        ("FS_PILOT_INPUT", 1.0),
    ):
        assert for_dive(PARAMETERS | {name: value}, 255) == {name: FAILSAFES[name]}


@pytest.mark.parametrize("name", ["SYSID_MYGCS", "MAV_GCS_SYSID"])
def test_the_vehicle_obeys_us_for_the_dive_alone_if_we_have_an_id_of_our_own(name):
    parameters = {key: v for key, v in PARAMETERS.items() if key != "SYSID_MYGCS"} | {name: 255.0}
    sets = for_dive(parameters, 254)
    assert sets == {name: 254.0}
    needs = Requirements(8, rates=NEEDS.rates, system=254, sets=sets, dry=True)
    found = {f.name: f for f in preflight(needs, FINE._replace(parameters=parameters))}
    assert found["ground station id"].passed
    assert f"{name} would be set" in found["ground station id"].words


def test_thruster_by_thruster_needs_no_frame_that_is_known():
    facts = with_parameter("FRAME_CONFIG", 7.0)
    assert "frame" in failed(facts)
    assert failed(facts, Requirements(8, passthrough=True, rates=NEEDS.rates)) == {}
