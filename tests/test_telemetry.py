"""Readings of a DVL that its driver puts on the link."""

import numpy as np
import pytest

from spinndrift.systems.mavlink import telemetry
from spinndrift.systems.mavlink.clock import VehicleClock
from spinndrift.systems.mavlink.dialect import mavlink
from spinndrift.systems.mavlink.link import Link, Received

BOOT = 1000.0  # s of the local clock at the vehicle's boot


def link(*messages, boot: float | None = 20.0, arrival: float = BOOT + 20.1) -> Link:
    """A link whose newest messages are these; its clock is known."""
    clock = VehicleClock()
    clock.exchanged(BOOT + 9.99, 10.0, BOOT + 10.01)
    kept = {m.get_type(): Received(m, arrival, boot) for m in messages}
    made = Link.__new__(Link)  # without a connection
    made.clock, made._newest = clock, kept
    return made


def moved(*displacement: float, dt: float = 0.2, confidence: float = 90.0):
    delta = list(displacement)
    return mavlink.MAVLink_vision_position_delta_message(
        0, round(1e6 * dt), [0] * 3, delta, confidence
    )


def test_a_displacement_is_a_velocity_in_b_at_its_stamp():
    found = telemetry.dvl(link(moved(0.1, 0.02, -0.04)), {})
    assert found is not None
    np.testing.assert_allclose(found.value[:4], [0.5, -0.1, 0.2, 1.0], atol=1e-9)
    assert np.isnan(found.value[4])
    assert found.taken == pytest.approx(BOOT + 20.0)


@pytest.mark.parametrize("boot", [None, 3.0, 1.7e9])
def test_a_stamp_of_another_clock_counts_as_arrival_less_the_autopilots_delay(boot: float | None):
    found = telemetry.dvl(link(moved(0.1, 0, 0), boot=boot), {"VISO_DELAY_MS": 80.0})
    assert found is not None
    assert found.taken == pytest.approx(BOOT + 20.1 - 0.08)


@pytest.mark.parametrize("bad", [{"confidence": 0.0}, {"dt": 0.0}])
def test_no_confidence_and_no_interval_are_no_velocity(bad: dict):
    found = telemetry.dvl(link(moved(0.1, 0, 0, **bad)), {})
    assert found is not None
    np.testing.assert_array_equal(found.value[:4], 0.0)


def test_a_displacement_that_is_not_finite_is_not_valid():
    found = telemetry.dvl(link(moved(np.nan, 0, 0)), {})
    assert found is not None
    np.testing.assert_array_equal(found.value[:4], 0.0)


def test_the_altitude_is_that_of_a_rangefinder_that_looks_down():
    def range_at(orientation: int, cm: int):
        return mavlink.MAVLink_distance_sensor_message(0, 5, 5000, cm, 1, 0, orientation, 255)

    def altitude(*more) -> float:
        found = telemetry.dvl(link(moved(0, 0, 0), *more), {})
        assert found is not None
        return float(found.value[4])

    assert altitude(range_at(25, 321)) == pytest.approx(3.21)
    assert np.isnan(altitude(range_at(0, 321)))
    assert np.isnan(altitude(range_at(25, 5000)))


def test_odometry_in_the_body_is_a_velocity():
    zeros = [0.0] * 21
    frames = (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    pose = (0.0, 0.0, 0.0, [1.0, 0, 0, 0])
    message = mavlink.MAVLink_odometry_message(
        0, *frames, *pose, 0.3, 0.1, -0.2, 0.0, 0.0, 0.0, zeros, zeros, 0, 0, 100
    )
    found = telemetry.dvl(link(message), {})
    assert found is not None
    np.testing.assert_allclose(found.value[:4], [0.3, -0.1, 0.2, 1.0], atol=1e-9)


def test_without_messages_there_is_no_reading():
    assert telemetry.dvl(link(), {}) is None
