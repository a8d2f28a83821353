"""The vehicle's boot clock on the local clock: offset, wrap, reboot."""

import numpy as np
import pytest

from spinndrift.systems.mavlink.clock import (
    MICROSECONDS_32,
    MILLISECONDS_32,
    VehicleClock,
)
from spinndrift.systems.mavlink.dialect import mavlink
from spinndrift.systems.mavlink.link import boot_time

BOOT = 1234.5  # local time of the vehicle's boot (s)


def test_timesync_finds_the_offset_to_half_the_shortest_round_trip():
    rng = np.random.default_rng(0)
    clock, trips = VehicleClock(), []
    for k in range(50):
        there, back = 0.002 + rng.exponential(0.02, 2)
        sent = 2000.0 + 0.1 * k
        clock.exchanged(sent, sent + there - BOOT, sent + there + back)
        trips.append(there + back)
    assert clock.offset is not None
    assert clock.uncertainty == pytest.approx(min(trips) / 2)
    assert abs(clock.offset - BOOT) <= min(trips) / 2
    assert clock.local(10.0) == 10.0 + clock.offset


def test_without_timesync_the_smallest_delay_bounds_the_offset():
    rng = np.random.default_rng(1)
    clock = VehicleClock()
    delays = 0.004 + rng.exponential(0.03, 300)
    for k, delay in enumerate(delays):
        boot = 5.0 + 0.02 * k
        clock.arrived(boot, BOOT + boot + delay)
    assert clock.uncertainty is None
    assert clock.offset == pytest.approx(BOOT + delays.min())


def test_old_observations_are_forgotten():
    clock = VehicleClock()
    clock.arrived(0.0, BOOT)
    drift = 1e-3  # of the vehicle's clock, which is slow
    for k in range(1, 4000):
        local = 0.05 * k
        clock.arrived(local * (1 - drift), BOOT + local)
    assert clock.offset is not None
    assert abs(clock.offset - (BOOT + drift * 0.05 * 3999)) < 1.1 * 10 * drift


def test_timesync_that_stops_is_replaced_by_the_delays_of_messages():
    clock = VehicleClock()
    clock.exchanged(2000.0, 2000.0 - BOOT, 2000.0)
    for k in range(200):
        clock.arrived(2000.0 - BOOT + 0.1 * k, 2000.0 + 0.1 * k + 0.03)
    assert clock.uncertainty is None
    assert clock.offset == pytest.approx(BOOT + 0.03)


def test_a_reboot_starts_the_offset_anew():
    clock = VehicleClock()
    for k in range(100):
        clock.arrived(100 + 0.1 * k, BOOT + 100 + 0.1 * k)
    clock.arrived(109.0, BOOT + 110.0)  # late by a second
    assert clock.reboots == 0
    clock.arrived(0.5, BOOT + 120.0)
    assert clock.reboots == 1
    assert clock.offset == pytest.approx(BOOT + 119.5)


@pytest.mark.parametrize("span", [MICROSECONDS_32, MILLISECONDS_32])
def test_a_counter_goes_on_where_it_wraps(span: float):
    clock, rng = VehicleClock(), np.random.default_rng(2)
    true = span - 3.0 + 0.05 * np.arange(200)
    order = np.arange(200)
    for i in rng.permutation(198)[:40]:  # neighbours change places
        order[[i, i + 1]] = order[[i + 1, i]]
    found = []
    for k, i in enumerate(order):
        arrival = BOOT + true[k] + 0.1
        found.append(clock.continued(true[i] % span, span, arrival))
        clock.arrived(found[-1], arrival)
    np.testing.assert_allclose(found, true[order], atol=1e-6)
    assert clock.reboots == 0


@pytest.mark.parametrize("up", [30.0, 2500.0, 7200.0, 40 * 86400.0])
def test_clocks_of_any_age_agree_and_a_boot_is_counted_once(up: float):
    """A narrow and a wide counter of one vehicle, which boots anew after ten seconds."""
    clock = VehicleClock()

    def hear(boot: float, local: float) -> None:
        for span in (MICROSECONDS_32, MILLISECONDS_32):
            clock.arrived(clock.continued(boot % span, span, local), local)

    for k in range(100):
        hear(up + 0.1 * k, BOOT + 0.1 * k)
    assert clock.reboots == 0
    assert clock.local(up) == pytest.approx(BOOT)
    for k in range(1, 100):
        hear(0.1 * k, BOOT + 15.0 + 0.1 * k)
    assert clock.reboots == 1
    assert clock.local(0.0) == pytest.approx(BOOT + 15.0)


def test_a_time_of_zero_is_the_counter_where_it_wraps_and_else_none():
    def outputs(us: int):
        return mavlink.MAVLink_servo_output_raw_message(us, 0, *[1500] * 8)

    clock = VehicleClock()
    assert boot_time(outputs(0), 10.0, clock) is None
    before = boot_time(outputs(2**32 - 20_000), 10.0, clock)
    assert before is not None
    clock.arrived(before, 10.0)
    assert boot_time(outputs(0), 10.02, clock) == pytest.approx(MICROSECONDS_32)
    assert boot_time(outputs(0), 40.0 + MICROSECONDS_32 / 2, clock) is None
    imu = mavlink.MAVLink_raw_imu_message(0, *[0] * 9)
    assert boot_time(imu, 10.02, clock) is None


def test_a_silent_hour_is_no_boot():
    clock = VehicleClock()
    clock.arrived(4200.0, BOOT)
    wrapped = 4200.0 + 3600.0 - MICROSECONDS_32
    later = clock.continued(wrapped, MICROSECONDS_32, BOOT + 3600.0)
    clock.arrived(later, BOOT + 3600.0)
    assert later == pytest.approx(7800.0)
    assert clock.reboots == 0


def test_spans_are_those_of_the_fields():
    assert pytest.approx(71.58, abs=0.01) == MICROSECONDS_32 / 60
    assert pytest.approx(49.71, abs=0.01) == MILLISECONDS_32 / 86400
