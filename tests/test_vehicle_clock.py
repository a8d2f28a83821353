"""The vehicle's boot clock on the local clock: offset, wrap, reboot."""

import numpy as np
import pytest

from spinndrift.systems.mavlink.clock import (
    MICROSECONDS_32,
    MILLISECONDS_32,
    Unwrapped,
    VehicleClock,
)

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
    unwrapped, rng = Unwrapped(span), np.random.default_rng(2)
    true = span - 3.0 + 0.05 * np.arange(200)
    order = np.arange(200)
    for i in rng.permutation(198)[:40]:  # neighbours change places
        order[[i, i + 1]] = order[[i + 1, i]]
    found = [unwrapped(true[i] % span) for i in order]
    np.testing.assert_allclose(found, true[order], atol=1e-6)


def test_spans_are_those_of_the_fields():
    assert pytest.approx(71.58, abs=0.01) == MICROSECONDS_32 / 60
    assert pytest.approx(49.71, abs=0.01) == MILLISECONDS_32 / 86400
