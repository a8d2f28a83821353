"""Guards of a dive."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spinndrift.models.config.errors import UserError
from spinndrift.systems.mavlink.safety import (
    GUARDS,
    SafetyConfig,
    Snapshot,
    State,
    Supervisor,
    limited,
)

AGES = {"vehicle": 0.05, "attitude": 0.05, "depth": 0.1, "aid": 0.2, "plan": 0.3, "loop": 0.1}
AGES |= {"dead_man": 0.2, "imu": 0.02, "dead_reckoning": 0.3}
CONFIG = SafetyConfig(dead_man=1.0)
START = State("MANUAL", np.array([5.0, -3.0, -1.0]))


def snapshot(t: float, **changes) -> Snapshot:
    """A healthy dive at time t, with changes."""
    ages = AGES | changes.pop("ages", {})
    fine = Snapshot(t, np.zeros(6), np.array([5.0, -3.0, -1.0]), 0, ages, True, "MANUAL", 15.8)
    return fine._replace(**changes)


FAULTS = {
    "pilot": {"mode": "STABILIZE"},
    "disarmed": {"armed": False},
    "rival": {"rivals": 1},
    "outputs": {"outputs": 2.1},
    "failsafe": {"failsafe": "Leak Detected"},
    "silence": {"ages": {"vehicle": 1.1}},
    "attitude": {"ages": {"attitude": float("inf")}},
    "depth": {"ages": {"depth": 0.6}},
    "depth_sensor": {"depth_healthy": False},
    "imu": {"ages": {"imu": 0.6}},
    "aid": {"ages": {"aid": 2.1}},
    "dead_reckoning": {"ages": {"dead_reckoning": 6.1}},
    "loop": {"ages": {"loop": 0.6}},
    "estimate": {"health": 2},
    "plan": {"ages": {"plan": 2.5}},
    "dead_man": {"ages": {"dead_man": 1.2}},
    "depth_limits": {"p_WBo": np.array([5.0, -3.0, -30.5])},
    "fence": {"p_WBo": np.array([5.0, 18.0, -1.0])},
    "battery": {"voltage": 12.9},
    "wrench": {"F_Bo_B": np.array([np.nan, 0, 0, 0, 0, 0])},
}
ENDS = {"pilot": "yield", "disarmed": "yield", "silence": "disarm", "depth": "disarm"}
ENDS |= {"depth_limits": "disarm", "depth_sensor": "disarm"}


def dive(supervisor: Supervisor, seconds: float = 4.0, at: float = 1.0, **fault) -> list:
    """Orders every 20 ms; the fault begins at `at` and lasts half a second."""
    state, decisions = START, []
    for k in range(round(seconds / 0.02)):
        t = 0.02 * k
        # the estimator is lost only after a second
        lasts = 1.5 if "health" in fault else 0.5
        seen = snapshot(t, **(fault if at <= t < at + lasts else {}))
        decision = supervisor.step(state, seen)
        state = decision.state
        decisions.append((t, decision))
    return decisions


def test_every_guard_has_a_fault_here():
    assert set(FAULTS) == set(GUARDS)


def test_a_healthy_dive_flies():
    assert {decision.order for _, decision in dive(Supervisor(CONFIG))} == {"fly"}


@pytest.mark.parametrize("name", FAULTS)
def test_a_guard_ends_the_dive_for_good_and_only_that_guard_does(name: str):
    decisions = dive(Supervisor(CONFIG), **FAULTS[name])
    orders = [decision.order for _, decision in decisions]
    first = next(i for i, order in enumerate(orders) if order != "fly")
    assert 1.0 <= decisions[first][0] <= (2.2 if name == "estimate" else 1.02)
    assert orders[first : first + 25] == ["neutral"] * 25  # half a second
    assert set(orders[first + 26 :]) == {ENDS.get(name, "hold_depth")}
    assert all(np.all(decision.F_Bo_B == 0) for _, decision in decisions[first:])
    final = decisions[-1][1].state
    assert final.tripped == name
    assert final.reason
    # without the guard the dive goes on
    others = {k: guard for k, guard in GUARDS.items() if k != name}
    if name != "wrench":
        blind = dive(Supervisor(CONFIG, others), **FAULTS[name])
        assert {decision.order for _, decision in blind} == {"fly"}


def test_an_estimator_that_recovers_in_time_is_no_reason():
    state, supervisor, orders = START, Supervisor(CONFIG), set()
    for k in range(200):
        t = 0.02 * k
        decision = supervisor.step(state, snapshot(t, health=2 if (t % 1.0) < 0.8 else 0))
        state = decision.state
        orders.add(decision.order)
    assert orders == {"fly"}


def test_without_aid_plan_or_key_their_guards_are_silent():
    ages = {name: AGES[name] for name in ("vehicle", "attitude", "depth")}
    decision = Supervisor().step(START, snapshot(0.0)._replace(ages=ages))
    assert decision.order == "fly"


def test_the_end_may_be_to_disarm():
    decisions = dive(Supervisor(SafetyConfig(end="disarm")), **FAULTS["fence"])
    assert decisions[-1][1].order == "disarm"


@given(
    st.lists(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6), min_size=1, max_size=20),
    st.floats(0.0, 0.1),
)
def test_the_wrench_keeps_its_limits_and_rates(wanted: list[list[float]], dt: float):
    before = np.zeros(6)
    for F in wanted:
        after = limited(CONFIG, before, np.array(F), dt)
        assert np.all(np.abs(after) <= np.asarray(CONFIG.max_wrench) + 1e-12)
        steps = np.asarray(CONFIG.max_wrench_rate) * dt
        assert np.all(np.abs(after - before) <= steps + 1e-9)
        before = after


@pytest.mark.parametrize(
    "field", [{"silence": 0.0}, {"fence": (0.0, 1.0)}, {"max_depth": -1.0}, {"dead_man": -1.0}]
)
def test_limits_that_make_no_sense_are_refused(field: dict):
    with pytest.raises(UserError, match=f"SafetyConfig.{next(iter(field))}"):
        SafetyConfig(**field)
