"""A DVL that drops out for seconds is bridged; one that is lost ends the dive as configured."""

import numpy as np
import pytest
from scipy.stats import chi2

from spinndrift.sims.run.estimate import nees
from spinndrift.sims.run.log import RunLog
from spinndrift.sims.run.loop import simulate, simulate_seeds
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.mavlink.interface import RESOLUTION
from spinndrift.systems.mavlink.safety import SafetyConfig, Snapshot, State, Supervisor

GAPS = {4.0: 1.0, 8.0: 2.0, 13.0: 4.0}
"""Drop-outs of the DVL: when each begins and how long it is (s)."""
LOST = 20.0  # s: from here on it is silent
TIMES = [0.05 * n for n in range(round(31 / 0.05))]
# the noise of samples that are rounded to 1 mg and 1 mrad/s, at 100 Hz (`before_flight`)
DENSITY = RESOLUTION / np.sqrt(12) * np.sqrt(2 / 100)


@pytest.fixture(scope="module")
def flown() -> RunLog:
    gaps = [f"start: {start}, duration: {gap}" for start, gap in GAPS.items()]
    faults = [f"{{sensor: dvl, fault: dropout, {gap}}}" for gap in (*gaps, f"start: {LOST}")]
    noise = f"accelerometer_density: {DENSITY[0]}, gyroscope_density: {DENSITY[3]}"
    text = f"""
duration: 31
station:
  sensing:
    imu: {{integrating: false, {noise}}}
    dvl: {{dropout_share: 0, outlier_share: 0}}
    faults: [{", ".join(faults)}]
"""
    return simulate(load_scenario("station_keeping_calm", text)).log


def silent(t: float) -> float:
    """Age of the DVL's newest reading (s)."""
    found = [t - start for start, gap in GAPS.items() if start <= t < start + gap]
    return t - LOST if t >= LOST else max(found, default=0.1)


def decisions(
    config: SafetyConfig, age: str = "dead_reckoning", health: np.ndarray | None = None
) -> list:
    """What the guards decide at each sample of the dive; the estimate is good if not told."""
    here = np.array([0.0, 0.0, -1.5])
    state, supervisor, found = State("MANUAL", here), Supervisor(config), []
    for n, t in enumerate(TIMES):
        ages = {"vehicle": 0.0, "attitude": 0.0, "depth": 0.0, "imu": 0.0, age: silent(t)}
        told = 0 if health is None else int(health[n])
        seen = Snapshot(t, np.zeros(6), here, told, ages, True, "MANUAL", 16.0)
        decision = supervisor.step(state, seen)
        state = decision.state
        found.append(decision)
    return found


def test_drop_outs_of_seconds_fly_on():
    found = decisions(SafetyConfig())
    before = {d.order for d, t in zip(found, TIMES, strict=True) if t < LOST + 5}
    assert before == {"fly"}


@pytest.mark.parametrize("end", ["hold_depth", "disarm"])
def test_a_dvl_that_is_lost_ends_the_dive_as_configured(end):
    found = decisions(SafetyConfig(end=end))
    final = found[-1].state
    assert final.tripped == "dead_reckoning"
    assert final.since - LOST == pytest.approx(SafetyConfig().dead_reckoning, abs=0.1)
    assert found[-1].order == end


def test_a_shorter_limit_counts_too():
    final = decisions(SafetyConfig(dead_reckoning=3.0))[-1].state
    assert final.tripped == "dead_reckoning"
    assert final.since - 13.0 == pytest.approx(3.0, abs=0.1)
    assert "bridged the lack of a velocity or position for 3." in final.reason


def test_an_estimate_without_a_covariance_is_ended_by_the_age():
    final = decisions(SafetyConfig(), "aid")[-1].state
    assert final.tripped == "aid"
    assert final.since - 13.0 == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
def test_the_filter_is_not_lost_in_drop_outs_of_seconds(flown: RunLog):
    assert flown["health"][flown.time < LOST + 6, 0].max() < 2
    found = decisions(SafetyConfig(), health=flown["health"][: len(TIMES), 0])
    assert found[-1].state.tripped == "dead_reckoning"


@pytest.mark.slow
def test_the_longest_bridge_is_one_that_the_covariance_covers(flown: RunLog):
    bridged = [(start, start + gap) for start, gap in GAPS.items()]
    for first, last in [*bridged, (LOST, LOST + 10)]:
        during = (flown.time > first) & (flown.time < last)
        error = (flown["V_WB_B"] - flown["V_WB_B_estimate"])[during, :3]
        assert np.all(np.abs(error) < 4 * flown["error_std"][during, 6:9])
    for after, most in ((6.0, 0.3), (10.0, 1.0)):
        n = int(np.searchsorted(flown.time, LOST + after))
        place = (flown["X_WB"] - flown["X_WB_estimate"])[n, 4:6]
        claimed = float(np.linalg.norm(flown["error_std"][n, :2]))
        assert np.linalg.norm(place) < 3 * claimed
        assert claimed < most


@pytest.mark.slow
def test_without_a_dvl_velocity_is_less_known_from_second_to_second():
    """Depth and heading say nothing of the horizontal, however far its estimate is off."""
    text = f"""
duration: 40
station:
  sensing:
    imu: {{rate: 40, integrating: false, accelerometer_density: {1.6 * DENSITY[0]}}}
    dvl: {{dropout_share: 0, outlier_share: 0}}
    faults: [{{sensor: dvl, fault: dropout, start: 10}}]
"""
    within = []
    for run in simulate_seeds(load_scenario("station_keeping_calm", text), range(8)):
        log = run.log
        std = log["error_std"][np.searchsorted(log.time, np.arange(11.0, 40.0)), 6:8]
        assert np.all(np.diff(std, axis=0) > 0)
        within.append(nees(log)[log.time > 11] < chi2(3).ppf(0.9973))
    assert np.mean(within) > 0.95
