"""Maneuvers: to the start, at rest there, then the wrenches of the maneuver and nothing else."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.integrate import rollout
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.scenarios.maneuvers import Bounds, Maneuvers, wrenches
from spinndrift.sims.scenarios.scenario import load_scenario, overridden
from spinndrift.systems.controllers.impedance import ImpedanceLaw
from spinndrift.systems.controllers.maneuvers import (
    ManeuverProgram,
    ManeuverSequence,
    Phase,
    Steadiness,
)
from spinndrift.systems.plant.wrench_limits import BoxLimits

STEP = 0.1
REST = np.zeros(6)
STEADY = Steadiness(time=0.3, limit=2.0, most=2)
VEHICLE = load_vehicle("bluerov2_heavy")
STATION = load_scenario("station_keeping_calm").station


def pose(x: float = 0.0, yaw: float = 0.0, z: float = -2.0) -> np.ndarray:
    return np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2), x, 0, z])


def sequence(health: int | None = 5) -> ManeuverSequence:
    """Two trajectories of a maneuver of four wrenches, at two starts."""
    F = np.arange(24.0).reshape(1, 4, 6) + 1
    program = ManeuverProgram(
        np.stack([pose(), pose(3.0)]), np.zeros(2, int), F, np.zeros((2, 6)), STEP,
        (("steps", 1), ("steps", 2)),
    )  # fmt: skip
    law = ImpedanceLaw(np.eye(6) * 10, np.eye(6) * 5, BoxLimits(jnp.full(6, 100.0)))
    return ManeuverSequence(program, law, STEADY, STEP / 2, health)


class Driven:
    """A sequence whose states are given by hand."""

    def __init__(self, health: int | None = 5):
        self.system = sequence(health)
        self.state, self.mean = np.array([0.0, 0, 0, -1, 0]), np.full(12, np.nan)
        self.n = 0

    def step(self, X: np.ndarray, V: np.ndarray = REST, health: float = 0.0) -> np.ndarray:
        t = np.array([self.n * STEP / 2])
        seen = X, V, np.array([health])
        F, self.state, self.mean = self.system._step(t, *seen, self.state, self.mean)
        self.n += 1
        return F

    @property
    def phase(self) -> Phase:
        return Phase(int(self.state[0]))

    def until(self, phase: Phase, X: np.ndarray) -> float:
        """Time at which a phase begins, at rest at X."""
        for _ in range(100):
            self.step(X)
            if self.phase == phase:
                return (self.n - 1) * STEP / 2
        raise AssertionError(f"{phase.name} does not come")


def test_a_vehicle_away_from_its_start_is_driven_there():
    driven = Driven()
    F = driven.step(pose(-0.5))
    assert driven.phase == Phase.APPROACH
    assert F[0] == pytest.approx(10 * 0.5)
    np.testing.assert_allclose(F[1:], 0, atol=1e-9)
    F = driven.step(pose(-0.5), np.array([0.4, 0, 0, 0, 0, 0]))
    assert F[0] == pytest.approx(10 * 0.5 - 5 * 0.4)


@pytest.mark.parametrize(
    ("X", "V"),
    [
        (pose(0.3), REST),
        (pose(0.0, yaw=0.2), REST),
        (pose(), np.array([0, 0.1, 0, 0, 0, 0])),
        (pose(), np.array([0, 0, 0, 0, 0, 0.1])),
    ],
)
def test_nothing_begins_before_all_errors_are_small(X: np.ndarray, V: np.ndarray):
    driven = Driven()
    for _ in range(39):  # just under the limit
        driven.step(X, V)
        assert driven.phase == Phase.APPROACH
    for _ in range(3):
        driven.step(X, V)
    assert driven.state[1] == 1, "left out after its limit"
    assert driven.state[4] == 1


def test_the_maneuver_is_flown_open_loop_from_a_sample_on():
    driven = Driven()
    driven.step(pose(0.5))
    begin = driven.until(Phase.OPEN_LOOP, pose())
    # 0.5 m exp(-t / 0.15 s) is below 0.2 m from the third call on, at 0.15 s; then 0.3 s at rest
    # and a multiple of 0.1 s
    assert begin == pytest.approx(0.5)
    rng, wanted = np.random.default_rng(0), driven.system.program.F_Bo_B[0]
    given = [
        driven.step(pose(rng.normal(), rng.normal()), rng.normal(size=6))
        for _ in range(2 * len(wanted) - 1)
    ]
    np.testing.assert_array_equal(given, np.repeat(wanted, 2, axis=0)[1:])
    assert driven.phase == Phase.OPEN_LOOP
    F = driven.step(pose(2.5))
    assert (driven.phase, driven.state[1], driven.state[4]) == (Phase.APPROACH, 1, 0)
    assert F[0] == pytest.approx(10 * 0.5), "towards the second start"
    driven.until(Phase.OPEN_LOOP, pose(3.0))
    driven.until(Phase.FINISHED, pose(3.0))
    assert driven.state[1] == 2


def test_motion_at_the_start_begins_the_rest_anew():
    driven = Driven()
    for _ in range(4):
        driven.step(pose())
    assert driven.phase == Phase.HOLD
    for _ in range(4):
        driven.step(pose(), np.array([0.2, 0, 0, 0, 0, 0]))
    assert driven.phase == Phase.APPROACH
    # 0.2 m/s (1 - exp(-0.2 / 0.15)) falls below 0.08 m/s within 0.1 s, at 0.45 s
    assert driven.until(Phase.OPEN_LOOP, pose()) == pytest.approx(0.8)


def test_noise_is_no_motion_and_motion_is_none_the_less():
    """A gyroscope beside running thrusters: 0.05 rad/s of noise, against a bound of 0.08 rad/s."""
    rng = np.random.default_rng(4)
    for drift, begins in ((0.0, True), (0.15, False)):
        driven, phases = Driven(), set()
        for _ in range(39):
            V = np.array([0, 0, 0, *rng.normal(size=3) * 0.05 + [0, 0, drift]])
            driven.step(pose(), V)
            phases.add(driven.phase)
        assert (Phase.OPEN_LOOP in phases) == begins


def test_a_lost_estimate_stops_the_vehicle_and_voids_its_trajectory():
    driven = Driven()
    driven.until(Phase.OPEN_LOOP, pose())
    np.testing.assert_array_equal(driven.step(pose(), health=2.0), 0)
    assert driven.state[1] == 1
    assert driven.state[4] == 1
    np.testing.assert_array_equal(driven.step(np.full(7, np.nan)), 0)
    for _ in range(45):
        driven.step(np.full(7, np.nan))
    assert driven.phase == Phase.FINISHED, "given up after two in a row"


def test_without_a_horizontal_aid_place_and_drift_do_not_matter():
    """Attitude, depth, climb and turn rate do."""
    rng = np.random.default_rng(1)
    for yaw, V in ((0.0, REST), (0.4, np.array([0.0, 0, 0.2, 0.1, -0.2, 0.3]))):
        X = pose(0.0, yaw, -2.4)
        first = Driven(None).step(X, V)
        assert np.abs(first).max() > 1
        for _ in range(3):
            moved, drifting = X.copy(), V.copy()
            moved[4:6] += rng.normal(size=2) * 50
            drifting[:2] += rng.normal(size=2)
            np.testing.assert_allclose(Driven(None).step(moved, drifting), first, atol=1e-9)
    far = pose(80.0)
    assert Driven(None).until(Phase.OPEN_LOOP, far) == pytest.approx(0.3)


@pytest.mark.slow
def test_planned_maneuvers_stay_within_their_bounds_by_the_vehicles_model():
    bounds = Bounds((0.3, 4.0), (4.0, 3.0), 1.2)
    config = Maneuvers(repeats=1, duration=8.0, bounds=bounds)
    flown = config.plan(STATION)
    assert [each.maneuver for each in flown] == list(config.maneuvers)
    F = [each.share * wrenches(each.maneuver, 1, VEHICLE, config)[0] for each in flown]
    X_0 = jnp.asarray(np.stack([each.X_WB for each in flown], axis=1))
    Xs, Vs = rollout(
        VEHICLE.dynamics(), X_0, jnp.zeros_like(X_0[:6]), jnp.asarray(np.stack(F, axis=2)), 0.05,
        substeps=8,
    )  # fmt: skip
    for n, each in enumerate(flown):
        p, V = np.asarray(Xs[:, 4:, n]), np.asarray(Vs[..., n])
        assert np.abs(p[:, 0]).max() < 4.0 - 0.35, each
        assert np.abs(p[:, 1]).max() < 3.0 - 0.35, each
        assert p[:, 2].max() < -0.3 - 0.35, each
        assert p[:, 2].min() > -4.0 + 0.35, each
        assert np.linalg.norm(V[:, 3:], axis=1).max() < 1.21, each
    shares = {each.maneuver: each.share for each in flown}
    assert shares["heave-down"] < shares["surge-forward"] <= 1, "the water is less deep than long"


def test_a_place_without_room_is_refused():
    narrow = Maneuvers(("drift",), 1, bounds=Bounds((1.0, 1.5)))
    with pytest.raises(UserError, match="maneuver 'drift' does not stay within the bounds"):
        narrow.plan(STATION)


def test_what_is_finished_is_not_flown_again():
    config = Maneuvers(("yaw-left", "drift"), 2, finished=("yaw-left 1", "drift 2"))
    assert config.wanted() == [("drift", 1), ("yaw-left", 2)]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("loop", "unknown; take one of surge-forward"),
        ("thrusters", "can't be flown here: a wrench is commanded"),
        ("battery", "a full and an empty battery"),
    ],
)
def test_maneuvers_that_cannot_be_flown_are_refused(name: str, words: str):
    with pytest.raises(UserError, match=words):
        Maneuvers((name,))


def test_a_scenario_names_maneuvers_with_their_own_criterion():
    base = load_scenario("station_keeping_calm")
    maneuvers = "controller: !Maneuvers {maneuvers: [yaw-left], rate: 20}"
    found = overridden(base, f"{maneuvers}\nsuccess: !Finish {{}}")
    assert isinstance(found.controller, Maneuvers)
    with pytest.raises(UserError, match="give !Finish"):
        overridden(base, maneuvers)
    with pytest.raises(UserError, match="give 20, the rate of the controller's commands"):
        overridden(base, f"{maneuvers}\nsuccess: !Finish {{}}\nlog: {{rate: 10}}")
