"""Changes against healthy runs: rates of false alarms are those asked for, changes are found."""

import numpy as np
import pytest
import scipy.stats
from hidden.draw import draw
from hidden.scenarios import Plan

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.against.calibration import calibrate
from spinndrift.training.diagnosis.against.pipeline import ChangeDiagnoser, Healthy
from spinndrift.training.diagnosis.against.scatter import (
    Units,
    changes,
    directions,
    moderated,
    noise_changes,
)
from spinndrift.training.diagnosis.selection.state import Selection

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=6, runs=1, seconds=6.0)


# ------------------------------------------------------------------------------- calibration


@pytest.mark.parametrize(("n", "rate", "true"), [(19, 0.1, 2 / 20), (39, 0.05, 2 / 40)])
def test_healthy_units_exceed_the_threshold_at_the_rate_asked_for(n, rate, true):
    """Whatever the distribution of scores: here one without a variance."""
    rng, trials = np.random.default_rng(0), 20_000
    hits = 0
    for scores in rng.standard_cauchy((trials, n + 1)):
        found = calibrate(scores[:n], rate)
        assert found.counted == rate
        hits += scores[n] > found.threshold
    assert hits / trials == pytest.approx(true, abs=4 * np.sqrt(true * (1 - true) / trials))


def test_few_units_say_how_coarse_they_are():
    scores = np.array([3.0, 1.0, 2.0, 5.0])
    found = calibrate(scores, 0.01, expected=4.0)
    assert found.threshold == 5.0
    assert found.counted == pytest.approx(1 / 5)
    assert calibrate(scores, 0.01, expected=9.0).threshold == 9.0
    assert calibrate(scores, 0.2, expected=9.0).threshold == 5.0  # counted: theory is not asked
    assert calibrate(scores, 0.4).threshold == 3.0
    assert calibrate(scores, 0.4).alarms == 1
    with pytest.raises(ValueError, match="scores is empty"):
        calibrate(np.zeros(0), 0.1)


# ----------------------------------------------------------------------------------- scatter


def drawn(rng, n, tau, change=0.0, phi=1.0):
    """Units that each show one parameter with information of their own."""
    i = rng.gamma(4.0, 25.0, n)
    x = change + tau * rng.standard_normal(n)
    score = i * x + np.sqrt(phi * i) * rng.standard_normal(n)
    return Units(score[:, None], i[:, None, None])


@pytest.mark.parametrize(("tau", "phi"), [(0.0, 1.0), (0.5, 1.0), (0.0, 9.0)])
def test_intervals_hold_the_change_whatever_makes_healthy_units_differ(tau, phi):
    """No scatter, parameters that differ from unit to unit, or correlated innovations."""
    rng, inside, of = np.random.default_rng(1), 0, 0
    for _ in range(25):
        sets = [
            directions(drawn(rng, 9, tau, phi=phi), drawn(rng, 5, tau, 0.3, phi)) for _ in range(20)
        ]
        for found in changes(sets):
            assert found is not None
            t = scipy.stats.t.ppf(0.975, min(found.freedom, 1e6))
            inside += abs(found.change[0] - 0.3) < t * found.errors[0]
            of += 1
    assert inside / of == pytest.approx(0.95, abs=0.03)  # 4 standard errors of 500


def test_parameters_that_act_together_are_told_apart():
    """Two parameters with correlated responses: the change is that of least squares."""
    rng = np.random.default_rng(2)
    turn = np.array([[1.0, 0.8], [0.0, 0.6]])

    def units(n, change):
        score, information = [], []
        for _ in range(n):
            J = rng.standard_normal((40, 2)) @ turn
            score.append(J.T @ (J @ change + rng.standard_normal(40)))
            information.append(J.T @ J)
        return Units(np.array(score), np.array(information))

    healthy, new = units(8, np.zeros(2)), units(6, np.array([0.0, 1.0]))
    found = changes([directions(healthy, new)])[0]
    assert found is not None
    a, b = (np.linalg.solve(u.information.sum(axis=0), u.score.sum(axis=0)) for u in (healthy, new))
    np.testing.assert_allclose(found.healthy, a, rtol=1e-6)
    np.testing.assert_allclose(found.change, b - a, rtol=1e-6)
    off = found.change - [0.0, 1.0]
    assert off @ np.linalg.solve(found.covariance, off) < scipy.stats.f.isf(1e-4, 2, 7) * 2


def test_parameters_that_healthy_units_can_not_tell_apart_change_together():
    """Rounding makes their information indefinite; the change of what they share remains."""
    rng = np.random.default_rng(6)
    alike = np.array([[1.0, 1.0], [1.0, 1.0 - 1e-9]])
    sets = []
    for n, change in ((8, 0.0), (6, 1.0)):
        one = drawn(rng, n, 0.0, change)
        sets.append(Units(np.repeat(one.score, 2, axis=1), one.information * alike))
    found = changes([directions(*sets)])[0]
    assert found is not None
    spread = np.sqrt(np.ones(2) @ found.covariance @ np.ones(2))
    assert found.change.sum() == pytest.approx(1.0, abs=5 * spread)
    assert found.change[0] == pytest.approx(found.change[1], rel=1e-6)


def test_what_healthy_units_do_not_show_is_not_tested():
    rng = np.random.default_rng(3)
    new = drawn(rng, 5, 0.0, 3.0)
    nothing = Units(np.zeros((6, 1)), np.zeros((6, 1, 1)))
    assert directions(nothing, new) is None
    one = drawn(rng, 6, 0.0)
    one.information[1:] *= 1e-6  # a single unit shows it: its scatter is not known
    one.score[1:] *= 1e-6
    assert directions(one, new) is None


def test_dispersions_are_shrunk_as_far_as_they_agree():
    """The distribution that they were drawn from is found again (Smyth 2004, section 6.2)."""
    rng, freedom = np.random.default_rng(4), np.full(4000, 5.0)
    alike = 2.0 * rng.chisquare(5, 4000) / 5
    kept, free = moderated(alike, freedom)
    assert np.var(np.log(kept)) < np.var(np.log(alike)) / 20
    assert free.min() > 10 * 5
    own = 2.0 * 6 / rng.chisquare(6, 4000) * rng.chisquare(5, 4000) / 5
    kept, free = moderated(own, freedom)
    np.testing.assert_allclose(free - 5, 6.0, rtol=0.2)
    np.testing.assert_allclose((kept * free - own * 5) / (free - 5), 2.0, rtol=0.1)


def test_sizes_of_errors_are_compared_by_channel():
    rng = np.random.default_rng(5)
    healthy, new = rng.normal(0, 0.1, (10, 12)), rng.normal(0, 0.1, (10, 12))
    new[:, 3] += 2 * np.log(3.0)
    off, width, score = noise_changes(healthy, new)
    assert np.argmax(score) == 3
    assert np.exp(off[3] / 2) == pytest.approx(3.0, rel=0.1)
    assert np.sum(np.abs(np.delete(off, 3)) > np.delete(width, 3)) <= 3
    assert np.sort(score)[-2] < 8


# --------------------------------------------------------------------- an independent simulator


def recorded(folder, seed, *names):
    case = draw(seed, "single" if names else "null", names=names or None, plan=PLAN)
    case.write(folder / "data")
    return case, read_csv(folder / "data")


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    _, recording = recorded(tmp_path_factory.mktemp("healthy"), 101)
    return Healthy(recording, VEHICLE.dynamics(), "healthy")


def changed(recording, healthy):
    diagnoser = ChangeDiagnoser(recording, VEHICLE, healthy)
    problem = diagnoser.problem
    found = diagnoser.changed(Selection.start(problem, problem.evaluate(problem.believed)))
    return diagnoser, found


@pytest.mark.slow
def test_healthy_runs_are_unchanged_and_a_weak_thruster_is_named(tmp_path, healthy):
    _, recording = recorded(tmp_path / "same", 303)
    diagnoser, found = changed(recording, healthy)
    assert diagnoser.limits.causes.units == 6
    assert diagnoser.limits.counted == pytest.approx(2 / 7)
    assert not found.accepted
    assert not diagnoser.limits.exceeded(diagnoser.scores)
    case, recording = recorded(tmp_path / "weak", 200, "thruster_gain")
    diagnoser, found = changed(recording, healthy)
    truth = case.effects[0].parameters()["gain"]["value"] - 1
    [choice] = found.accepted
    assert choice.hypothesis == ("thruster_gain", case.effects[0].where)
    [row] = diagnoser.problem.library.at(*choice.hypothesis)
    tested = diagnoser.baseline.tests(diagnoser.baseline.side(found.current.theta))[0]
    error = tested[choice.hypothesis].errors[0]
    assert found.current.theta[row] == pytest.approx(truth, abs=4 * error)
