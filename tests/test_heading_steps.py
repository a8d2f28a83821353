"""Steps of the heading against the rates: found where they are, turned back, and none elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.blind import DATA, ESTIMATED, NOISE
from hidden.draw import Case
from hidden.episode import draw_episode
from hidden.scenarios import Plan
from hidden.simulator import Noise, streams
from hidden.write import write_folder
from scipy.spatial.transform import Rotation

from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.recordings.pieces import good_pieces
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.data.heading_steps import HeadingOff, in_words, turned_back
from spinndrift.training.diagnosis.findings.heading_off import off_causes
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, diagnose

RUN, SIZE, START, STOP = 3, 0.2, 2.5, 5.0
"""The fourth run has steps of yaw."""
VEHICLE = load_vehicle("bluerov2_heavy")


@pytest.fixture(scope="module")
def runs():
    """Four runs of 8 s at 50 Hz as an estimator gives them, with measured positions."""
    truth = Case(4, (), Plan(scenarios=4, runs=1, seconds=8.0, rate=50.0), ESTIMATED).simulate()
    return [
        Trajectory(
            f"run {b}", truth.X[..., b], truth.V[..., b], {"thruster_force": truth.forces[..., b]}
        )
        for b in range(4)
    ]


def turned(run, angles):
    """A run whose attitudes are turned about the vertical."""
    turn = Rotation.from_rotvec(np.asarray(angles)[:, None] * [0, 0, 1])
    X = run.X_WB.copy()
    X[:, :4] = (turn * Rotation.from_quat(X[:, :4], scalar_first=True)).as_quat(scalar_first=True)
    return replace(run, X_WB=X)


def beside_steel(run, size=SIZE, start=START, stop=STOP, dt=0.02):
    t = dt * np.arange(len(run))
    return turned(run, np.where((t >= start) & (t < stop), size, 0.0))


def reckoned(run, dt=0.02):
    """A run with the path that its attitudes and velocities make."""
    v = Rotation.from_quat(run.X_WB[:, :4], scalar_first=True).apply(run.V_WB_B[:, :3])
    X = run.X_WB.copy()
    X[1:, 4:] = X[0, 4:] + np.cumsum((v[1:] + v[:-1]) / 2 * dt, axis=0)
    return replace(run, X_WB=X)


def recorded(runs, dt=0.02):
    return Recording.from_trajectories(runs, dt)


@pytest.mark.parametrize("path", [lambda run: run, reckoned], ids=["measured", "reckoned"])
@pytest.mark.parametrize("size", [0.1, -0.3])
def test_a_heading_that_steps_is_turned_back(runs, size, path):
    """To that of the same noise without steps; a path that was integrated with it likewise."""
    right = path(runs[RUN])
    wrong = path(beside_steel(runs[RUN], size))
    mended, (off,) = turned_back(recorded([*runs[:RUN], wrong]))
    assert (off.first_run, off.last_run, off.ends) == (RUN, RUN, True)
    assert off.start == pytest.approx(START, abs=0.021)
    assert off.end == pytest.approx(STOP, abs=0.021)
    assert abs(off.offset - size) < 5 * off.error < 0.03
    X = mended.dataset["X_WB"].to_numpy()[RUN, 0]
    apart = (
        Rotation.from_quat(X[:, :4], scalar_first=True)
        * Rotation.from_quat(right.X_WB[:, :4], scalar_first=True).inv()
    )
    assert apart.magnitude().max() < 5 * off.error
    way = np.linalg.norm(np.diff(right.X_WB[:, 4:], axis=0), axis=1).sum()
    if path is reckoned:
        left, before = (np.abs(p - right.X_WB[:, 4:]).max() for p in (X[:, 4:], wrong.X_WB[:, 4:]))
        assert left < min(5 * off.error * way, before / 3)
    else:
        np.testing.assert_array_equal(X[:, 4:], wrong.X_WB[:, 4:])


def biased(run):
    return replace(run, V_WB_B=run.V_WB_B + 0.02 * np.eye(6)[5])


def late(run):
    """Attitudes by 80 ms."""
    X = run.X_WB.copy()
    X[4:, :4] = X[:-4, :4]
    return replace(run, X_WB=X)


def deviating(run):
    yaw = Rotation.from_quat(run.X_WB[:, :4], scalar_first=True).as_euler("ZYX")[:, 0]
    return turned(run, 0.2 * np.sin(yaw))


def repeating(run):
    """Attitudes of an instrument at a fifth of the rows' rate."""
    X = run.X_WB.copy()
    X[:, :4] = X[np.arange(len(X)) // 5 * 5, :4]
    return replace(run, X_WB=X)


def shaken(run):
    """Twelve times the usual noise of the attitude, and white."""
    return turned(run, 0.02 * np.random.default_rng(0).standard_normal(len(run)))


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda run: run, id="nothing"),
        biased,
        late,
        deviating,
        repeating,
        shaken,
        pytest.param(lambda run: beside_steel(run, 0.02), id="small step"),
        pytest.param(lambda run: beside_steel(run, 0.3, 2.5, 2.55), id="outlier"),
    ],
)
@pytest.mark.parametrize("every", [1, 5])
def test_what_is_no_step_is_left_as_it_is(runs, change, every):
    def fewer(run):
        changed, commands = change(run), run.commands["thruster_force"][::every]
        X, V = changed.X_WB[::every], changed.V_WB_B[::every]
        return Trajectory(run.scenario, X, V, {"thruster_force": commands})

    recording = recorded([fewer(run) for run in runs], 0.02 * every)
    mended, off = turned_back(recording)
    assert off == []
    assert mended is recording


def test_what_lasts_longest_counts_as_right(runs):
    late, early = (
        turned_back(recorded([beside_steel(runs[RUN], SIZE, start, 99.0)]))[1]
        for start in (6.5, 2.0)
    )
    (one,), (other,) = late, early
    assert (one.ends, other.ends) == (False, True)
    assert one.offset == pytest.approx(SIZE, abs=0.01)
    assert other.offset == pytest.approx(-SIZE, abs=0.01)
    assert (other.start, other.end) == (0.0, pytest.approx(2.0, abs=0.03))


def test_a_log_at_another_rate_spreads_a_step_and_keeps_it(runs):
    """Attitudes between messages are interpolated."""
    wrong = beside_steel(runs[RUN])
    X = wrong.X_WB.copy()
    between = Rotation.from_quat(X[:-1, :4], scalar_first=True)
    turn = (between.inv() * Rotation.from_quat(X[1:, :4], scalar_first=True)).as_rotvec()
    X[:-1, :4] = (between * Rotation.from_rotvec(0.6 * turn)).as_quat(scalar_first=True)
    (off,) = turned_back(recorded([*runs[:RUN], replace(wrong, X_WB=X)]))[1]
    assert off.offset == pytest.approx(SIZE, abs=0.02)
    assert off.end - off.start == pytest.approx(STOP - START, abs=0.05)


def test_a_step_at_which_a_log_was_cut_is_one_too(runs):
    """An importer takes large steps of the attitude as resets, and cuts there."""
    t = 0.02 * np.arange(len(runs[RUN]))
    good = np.all([np.abs(t - at) > 0.05 for at in (START, STOP)], axis=0)
    pieces = good_pieces(beside_steel(runs[RUN]), t, good)
    (off,) = turned_back(recorded(pieces))[1]
    assert (off.first_run, off.last_run) == (1, 1)
    assert off.offset == pytest.approx(SIZE, abs=0.02)


def test_the_largest_are_named_with_their_time():
    off = [HeadingOff(k, 1.0, k, 2.0, k > 0, 0.1 * (k + 1), 0.01) for k in range(4)]
    causes = off_causes(off, ["a", "b", "c", "d"])
    assert [c.when.first_run for c in causes if c.when is not None] == ["d", "c", "b"]
    assert causes[0].parameters["offset"].value == pytest.approx(0.4)
    (told,) = in_words(off, ["a", "b", "c", "d"])
    assert "0.4 rad, in a, b, c and 1 more runs" in told
    assert in_words([], ["a"]) == []
    (cut,) = in_words([], ["a"], ["Cut at 1 × attitude reset of the estimator.", "else"])
    assert cut.endswith("attitude reset of the estimator")
    (alone,) = off_causes(off[:1], ["a"])
    assert alone.when is not None
    assert alone.when.text == "from 1.0 s to its end"


@pytest.mark.slow
@pytest.mark.parametrize("data", ["usual", "stretches"])
def test_a_compass_beside_steel_is_named_and_nothing_else(tmp_path, data):
    plan = Plan(scenarios=5, runs=2, seconds=8.0) if data == "usual" else DATA[data](Plan())
    effect, when = draw_episode("steel", plan, streams(5, 6))
    case = Case(4, (effect,), plan, NOISE.get(data, Noise()))
    write_folder(tmp_path / "data", case.logged(), rate=plan.rate)
    recording = read_csv(tmp_path / "data", resample=False)
    d = diagnose(recording, VEHICLE, config=DiagnoseConfig(refit="none")).diagnosis
    assert [c.name for c in d.causes] == ["heading_error"], d.sentence
    found = d.causes[0].when
    assert found is not None
    assert found.start == pytest.approx(when.start, abs=0.1)
    assert found.end == pytest.approx(when.end, abs=0.1)
    assert d.verdict == "explained", d.sentence
    assert "heading jumps" in d.sentence
