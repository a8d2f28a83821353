"""What to do next: maneuvers that tell names apart are found, by as many nats as it takes."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.draw import draw
from hidden.scenarios import Plan

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.findings.experiments import (
    _information,
    _opponents,
    _ratios,
    experiments,
)
from spinndrift.training.diagnosis.findings.maneuver_library import (
    MANEUVERS,
    VARIANTS,
    simulate_maneuvers,
)
from spinndrift.training.diagnosis.pipeline import Diagnoser
from spinndrift.training.diagnosis.selection.model_selection import Choice

VEHICLE = load_vehicle("bluerov2_heavy")
LAG, DELAY = ("thruster_lag", "all"), ("actuation_delay", "all")


@pytest.fixture(scope="module")
def lagging(tmp_path_factory):
    """A lag found in two minutes of data: the bench, the look with it, its fit."""
    folder = tmp_path_factory.mktemp("lag")
    draw(5, names=("thruster_lag",), plan=Plan(runs=2, seconds=6.0)).write(folder / "data")
    problem = Diagnoser(read_csv(folder / "data", resample=False), VEHICLE).problem
    theta = problem.believed.copy()
    theta[problem.library.at(*LAG)] = 0.05
    theta, evaluation, fit = problem.polish(theta, problem.library.at(*LAG))
    return problem, evaluation, fit


def test_all_maneuvers_are_flown_as_they_say(lagging):
    problem, evaluation, _ = lagging
    seen: dict[str, list] = {}
    for names, data in simulate_maneuvers(problem, evaluation.theta):
        assert data.u.shape == problem.data.u.shape
        for r, name in enumerate(names):
            seen.setdefault(name, []).append((data.u[..., r], data.V[..., r], data.weight[:, r]))
    fill = seen.pop("", [])
    assert not any(weight.any() for _, _, weight in fill)
    assert set(seen) == set(MANEUVERS)
    bare = replace(problem, data=replace(problem.data, has_voltage=False, command="F_Bo_B"))
    names = {name for names, _ in simulate_maneuvers(bare, evaluation.theta) for name in names}
    assert names - {""} == set(MANEUVERS) - {"battery", "thrusters"}, "which these data can't show"
    low, high = VEHICLE.thrusters().curve.limits(VEHICLE.thrusters().nominal_voltage)
    for name, pieces in seen.items():
        assert len(pieces) == VARIANTS
        for u, V, weight in pieces:
            assert weight[0] == 1, name
            assert np.all((u >= float(low) - 1e-6) & (u <= float(high) + 1e-6)), name
            assert np.isfinite(V).all()
            assert not V[0].any(), "from rest"
    assert not any(u.any() for u, _, _ in seen["drift"])
    for k, (u, _, _) in enumerate(seen["thrusters"]):
        assert np.flatnonzero(u.any(axis=0)).tolist() == [k % 8], "one thruster alone"


@pytest.mark.slow
def test_a_chirp_tells_a_lag_from_a_delay_and_drifting_tells_nothing(lagging):
    problem, evaluation, fit = lagging
    choice = Choice(LAG, fit, (DELAY,), ())
    found = experiments(problem, evaluation, [choice], [])[LAG]
    assert max(found.nats, key=lambda name: found.nats[name]) == "chirp"
    assert found.nats["drift"] == pytest.approx(0, abs=0.1)
    assert found.text.startswith("to distinguish it from actuation_delay: chirp one axis")
    # what has the cause as a part of itself can't be told from it by any maneuver
    nothing = Choice(LAG, fit, (), ())
    alone = experiments(problem, evaluation, [nothing], [])[LAG]
    assert alone.text.startswith("to measure it better")
    assert 0 < max(alone.nats.values()) < max(found.nats.values()), "its size is well known"


def test_unmodelled_structure_is_a_rival_as_any_other(lagging):
    _, _, fit = lagging
    structure = ("unknown", "surge")
    assert _opponents(Choice(LAG, fit, (structure,), ()), [LAG]) == [structure]
    assert _opponents(Choice(LAG, fit, (), ((structure, 1.0),)), [LAG]) == [structure]
    assert _opponents(Choice(structure, fit, (LAG,), ()), [structure]) == [LAG]


def test_expected_nats_are_those_of_least_squares(lagging):
    """What a rival can't explain of the cause, in old and new data together less in the old."""
    problem, evaluation, _ = lagging
    own, rival = problem.library.at(*LAG), problem.library.at("linear_drag", "surge")
    there = problem.evaluate(
        evaluation.theta, sorted([*own, *rival]), evaluation.kalman, previous=evaluation
    ).plain
    rng = np.random.default_rng(0)
    J = rng.standard_normal((40, 2)) * [300.0, 1.0]  # responses of a maneuver: lag, drag
    new = np.zeros_like(there.total)
    a, b = there.column(own[0]), there.column(rival[0])
    new[np.ix_([a, b], [a, b])] = J.T @ J
    change = evaluation.theta - problem.believed
    before, got = _ratios(there, new, own, rival, change)

    def left(T):
        size = evaluation.theta[own[0]]
        H, g = T[b, b] + there.prior(rival)[0], T[a, b] * size
        return (T[a, a] * size**2 - g**2 / H * (2 - T[b, b] / H)) / 2

    assert got == pytest.approx(left(there.total + new) - left(there.total), rel=1e-9)
    assert got > 0
    # what the data have decided is no information: standard errors shrink by e to its power
    told = _information(there, new, own, rival, change)
    assert np.exp(2 * told) == pytest.approx((1 + 2 * (before + got)) / (1 + 2 * before))
