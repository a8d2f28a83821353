"""The filter before a flight: what the vehicle's streams, noise and parameters make of it."""

import math
from unittest.mock import MagicMock

import pytest

from spinndrift.sims.run import before_flight
from spinndrift.sims.run.before_flight import as_granted
from spinndrift.sims.scenarios.scenario import Scenario, load_scenario
from spinndrift.systems.mavlink import telemetry
from spinndrift.systems.mavlink.codec import filter_delay
from spinndrift.systems.mavlink.driver import Driver

PARAMETERS = {
    "INS_GYRO_FILTER": 20.0,
    "INS_ACCEL_FILTER": 10.0,
    "EK3_GBIAS_P_NSE": 1e-3,
    "EK3_ABIAS_P_NSE": 0.02,
}


def granted(
    monkeypatch: pytest.MonkeyPatch,
    rate: float,
    text: str = "",
    noise: dict[str, float] | None = None,
    parameters: dict[str, float] | None = None,
) -> tuple[Scenario, list[str]]:
    """The scenario for a vehicle that sends inertial samples at a rate (Hz), and what was said."""
    monkeypatch.setattr(before_flight, "resting_noise", lambda *_: noise or {})
    driver = MagicMock(spec=Driver, link=MagicMock())
    driver.link.statistics.return_value.rates = {telemetry.IMUS[0]: rate}
    driver.parameters = PARAMETERS if parameters is None else parameters
    said: list[str] = []
    return as_granted(load_scenario("pylon_crossing_vehicle", text), driver, said.append), said


@pytest.mark.parametrize(("sent", "used"), [(103.0, 100), (95.0, 100), (50.0, 40), (26.0, 20)])
def test_the_filter_runs_at_a_multiple_of_its_outputs_that_the_vehicle_sends(
    monkeypatch: pytest.MonkeyPatch, sent: float, used: float
):
    sensing = granted(monkeypatch, sent)[0].station.sensing
    assert sensing.imu.rate == used
    assert sensing.imu.rate / sensing.ekf.output_rate == pytest.approx(
        round(sensing.imu.rate / sensing.ekf.output_rate)
    )
    assert not sensing.imu.integrating
    # when a reading was true is known to a sample on either side
    assert sensing.ekf.timing_std >= 1 / used / math.sqrt(3)


def test_samples_are_awaited_for_their_messages_a_period_and_the_slower_low_pass(
    monkeypatch: pytest.MonkeyPatch,
):
    ekf = granted(monkeypatch, 50.0, noise={"delay": 0.01})[0].station.sensing.ekf
    assert ekf.imu_latency == pytest.approx(0.01 + 1 / 40 + filter_delay(10.0))
    none = granted(monkeypatch, 50.0, noise={"delay": 0.01}, parameters={})[0]
    assert none.station.sensing.ekf.imu_latency == pytest.approx(0.01 + 1 / 40)
    long = granted(monkeypatch, 50.0, noise={"delay": 5.0})[0].station.sensing
    aids = [each for each in long.sensors.values() if each.observes is not None]
    assert long.ekf.imu_latency < min(1 / each.rate + each.latencies[0] for each in aids)


def test_noise_at_rest_and_the_walks_of_biases_only_ever_enlarge_what_is_configured(
    monkeypatch: pytest.MonkeyPatch,
):
    loud = {"depth": 0.5, "force": 2.0, "rate": 0.3}
    before = load_scenario("pylon_crossing_vehicle").station.sensing
    found, said = granted(monkeypatch, 50.0, noise=loud)
    imu, depth = found.station.sensing.imu, found.station.sensing.depth
    assert (imu.accelerometer_density, imu.gyroscope_density) == (2.0, 0.3)
    assert depth is not None
    assert depth.noise == 0.5
    assert any("depth scatters by 0.500 m" in line for line in said)
    # EKF3 adds (parameter · period)² to a bias' variance in each step of its period of 12 ms
    assert imu.accelerometer_walk**2 == pytest.approx((0.02 * 0.012) ** 2 / 0.012)
    assert imu.gyroscope_walk**2 == pytest.approx((1e-3 * 0.012) ** 2 / 0.012)
    quiet = granted(monkeypatch, 50.0, noise={"depth": 1e-6, "force": 1e-9}, parameters={})[0]
    after = quiet.station.sensing
    assert after.depth == before.depth
    assert after.imu.accelerometer_density >= before.imu.accelerometer_density
    assert after.imu.gyroscope_walk == before.imu.gyroscope_walk


def test_without_a_sensor_of_horizontal_motion_the_fence_is_off_and_said(
    monkeypatch: pytest.MonkeyPatch,
):
    found, said = granted(monkeypatch, 50.0, "station: {sensing: {dvl: null}}")
    assert found.vehicle_link is not None
    assert min(found.vehicle_link.safety.fence) > 1e5
    assert any("the fence is off" in line for line in said)
    aided, said = granted(monkeypatch, 50.0)
    assert aided.vehicle_link is not None
    assert max(aided.vehicle_link.safety.fence) < 1e3
    assert not said
