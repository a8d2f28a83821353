"""A DVL that loses small speeds is told as that: by the checks, as a cause, and as no other one."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from hidden.draw import Case
from hidden.effects_actuation import ThrusterGain
from hidden.faults import small_speeds, spoil
from hidden.scenarios import Plan
from hidden.write import Run, change, write_folder

from spinndrift.models.effects import KINDS
from spinndrift.models.effects.recent import Recent
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.checks.small_speeds import dead_zones
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.se3 import AXES
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.data.checks import problems
from spinndrift.training.diagnosis.disturbance.found import laws_of
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, Diagnoser, diagnose

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
UVW = ("u", "v", "w")
POSE, TWIST = ("qw", "qx", "qy", "qz", "x", "y", "z"), ("u", "v", "w", "p", "q", "r")


@cache
def logged(loop: str, *effects) -> tuple[Run, ...]:
    return tuple(Case(3, effects, Plan(scenarios=5, runs=2, seconds=8.0, loop=loop)).logged())


def trajectories(runs):
    def table(run, names):
        return np.stack([run.columns[n] for n in names], axis=1)

    return [Trajectory(r.scenario, table(r, POSE), table(r, TWIST), {}) for r in runs]


def recorded(tmp_path, runs):
    write_folder(tmp_path / "data", runs, rate=20.0)
    return read_csv(tmp_path / "data")


@pytest.mark.parametrize("loop", ["open", "closed"])
@pytest.mark.parametrize("columns", [("u",), ("w",), UVW])
@pytest.mark.parametrize("holds", [False, True])
def test_a_dead_zone_is_found_with_its_width_and_samples(loop, columns, holds):
    for width in (0.03, 0.08):
        runs = logged(loop)
        zones = dead_zones(trajectories([small_speeds(r, columns, width, holds) for r in runs]))
        assert [zone.axes for zone in zones] == [["uvw".index(c)] for c in columns]
        for zone, column in zip(zones, columns, strict=True):
            assert zone.holds == holds
            assert zone.interval95[0] < zone.width < zone.interval95[1]
            # the speeds next to the edge say how well it is known: three mean distances
            assert abs(zone.width - width) < zone.interval95[1] - zone.interval95[0] < 0.1 * width
            assert zone.gain.sum() > 40
            below = [np.abs(r.columns[column]) < width for r in runs]
            for lost, true in zip(zone.lost, below, strict=True):
                assert np.array_equal(lost[1:], true[1:])


def test_the_speed_of_all_components_together_may_decide():
    runs = [small_speeds(r, UVW, 0.15, speed=True) for r in logged("open")]
    (zone,) = dead_zones(trajectories(runs))
    assert (zone.where, zone.axes) == ("all", [0, 1, 2])
    assert zone.width == pytest.approx(0.15, rel=0.02)


@pytest.mark.parametrize("loop", ["open", "closed"])
def test_other_repeated_values_are_no_dead_zone(loop):
    runs = list(logged(loop))
    assert dead_zones(trajectories(runs)) == []
    for fault in ("stuck", "lost_lock", "outliers"):
        assert dead_zones(trajectories(spoil(runs, fault, 3, count=len(runs))[0])) == [], fault
    for step in (0.001, 0.01, 0.02):  # the resolution of a message
        rounded = [
            change(r, **{c: step * np.round(r.columns[c] / step) for c in UVW}) for r in runs
        ]
        assert dead_zones(trajectories(rounded)) == []
    slow = [
        change(r, **{c: r.columns[c][np.arange(r.columns[c].size) // 4 * 4] for c in UVW})
        for r in runs
    ]
    assert dead_zones(trajectories(slow)) == []
    (zone,) = dead_zones(trajectories([small_speeds(r, ("u",), 0.05) for r in slow]))
    assert zone.where == "surge"


def test_cruise_with_lost_lock_and_starts_from_rest_are_no_dead_zone():
    """Speeds may have a gap, and zeros a reason: only small speeds beside zeros tell."""
    rng, n = np.random.default_rng(0), 200
    pose = np.tile([1.0, 0, 0, 0, 0, 0, -2], (n, 1))
    cruise, starts = [], []
    for _ in range(10):
        V = 0.5 + 0.05 * rng.standard_normal((n, 6))
        V[60:90, :3] = V[150:155, :3] = 0.0
        cruise.append(Trajectory("cruise", pose, V, {}))
        V = np.tile(0.3 * np.tanh(np.arange(n)[:, None] / 10), (1, 6))
        V[:20] = 0.0
        starts.append(Trajectory("start", pose, V, {}))
    assert dead_zones(cruise) == []
    assert dead_zones(starts) == []


@pytest.mark.parametrize("holds", [False, True])
def test_checks_say_dead_zone_instead_of_stuck(tmp_path, holds):
    runs = [small_speeds(r, UVW, 0.08, holds) for r in logged("open")]
    recording = recorded(tmp_path, runs)
    told, faulty = problems(recording)
    assert faulty == []
    assert len(told) == 3
    for column, text in zip(UVW, told, strict=True):
        assert text.startswith(f"{column}: speeds below 0.08 m/s")
        assert "the DVL loses small speeds" in text
    seen = examine(recording, VEHICLE, "data")
    assert [f.word for f in findings_of(seen.dataset)] == ["velocity-dead-zone"] * 3
    assert seen.lengths.tolist() == recording.lengths.tolist(), "nothing is cut"


def test_the_effect_shows_what_the_instrument_shows():
    V = jnp.asarray(np.random.default_rng(0).normal(0, 0.1, (6, 500)))
    cls, X = KINDS["dvl_dead_zone"], jnp.tile(jnp.eye(7)[:, :1], (1, 500))

    def read(effect):
        pose, twist = effect.measure(X, V, Recent.steady(V, 0.05))
        np.testing.assert_array_equal(pose, X)
        return np.asarray(twist)

    shown = read(cls.of("sway", width=0.05))
    v = np.asarray(V)
    np.testing.assert_array_equal(shown[1], np.where(np.abs(v[1]) < 0.05, 0.0, v[1]))
    np.testing.assert_array_equal(np.delete(shown, 1, 0), np.delete(v, 1, 0))
    shown = read(cls.of(width=0.1))
    slow = np.linalg.norm(v[:3], axis=0) < 0.1
    assert not shown[:3, slow].any()
    np.testing.assert_array_equal(shown[:, ~slow], v[:, ~slow])
    np.testing.assert_array_equal(read(cls.neutral()), v)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop", "columns"),
    [pytest.param("open", ("u",), marks=pytest.mark.slow), ("closed", UVW)],
)
def test_innovations_without_the_lost_samples_are_those_of_a_null(tmp_path, loop, columns):
    """Unit variances, no impacts; and the belief's noise levels come out as on whole data."""
    runs = [small_speeds(r, columns, 0.06) for r in logged(loop)]
    problem = Diagnoser(recorded(tmp_path, runs), VEHICLE).problem
    data = problem.data
    assert data.known is not None
    seen = problem.evaluate(problem.believed, [])
    count = (data.known * data.weight[:, None]).sum(axis=(0, 2))
    square = (seen.z.astype(float) ** 2 * data.known * data.weight[:, None]).sum(axis=(0, 2))
    off = np.sqrt(2 / count)  # standard deviation of a mean square of unit Gaussians
    assert np.all(np.abs(square / count - 1) < 6 * off)
    laws = laws_of(problem, seen)
    assert max(law.heldout_gain for law in laws) < 10
    assert {law.where for law in laws} >= set(AXES[3:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop", "columns", "width", "holds"),
    [("open", ("u",), 0.05, False), ("closed", UVW, 0.08, False), ("open", ("v",), 0.08, True)],
)
def test_a_diagnosis_names_the_dead_zone_alone(tmp_path, loop, columns, width, holds):
    runs = [small_speeds(r, columns, width, holds) for r in logged(loop)]
    d = diagnose(recorded(tmp_path, runs), VEHICLE, config=DiagnoseConfig(refit="none")).diagnosis
    (cause,) = d.causes
    assert cause.name == "dvl_dead_zone"
    assert cause.where == ", ".join(AXES["uvw".index(c)] for c in columns)
    low, high = cause.parameters["width"].interval95
    assert low < width < high
    assert d.verdict == "explained"


@pytest.mark.slow
def test_a_weak_thruster_beside_a_dead_zone_is_named_too(tmp_path):
    runs = [small_speeds(r, UVW, 0.05) for r in logged("open", ThrusterGain(3, 0.7))]
    d = diagnose(recorded(tmp_path, runs), VEHICLE, config=DiagnoseConfig(refit="none")).diagnosis
    assert {(c.name, c.where) for c in d.causes} == {
        ("thruster_gain", "3"),
        ("dvl_dead_zone", "surge, sway, heave"),
    }
    (gain,) = (c.parameters["gain"] for c in d.causes if c.name == "thruster_gain")
    low, high = gain.interval95
    assert abs(gain.value + 0.3) < 3 * (high - low) / 3.92
