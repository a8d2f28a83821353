"""Impacts beside thrusters that act in steps: those at the steps' edges are no law of their own."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.blind import NOISE
from hidden.draw import Case
from hidden.scenarios import Plan

from spinndrift.models.effects.unknown import Unknown
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.disturbance.edges import without_commanded
from spinndrift.training.diagnosis.disturbance.laws import Law, impacts
from spinndrift.training.diagnosis.pipeline import Diagnoser

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=4, runs=1, seconds=24.0, rate=25.0, dead_reckoned=True)
STEP, LEAST = 6.7, 15.0


@pytest.fixture(scope="module")
def null(tmp_path_factory):
    folder = tmp_path_factory.mktemp("null") / "data"
    Case(7, (), PLAN, NOISE["stretches"]).write(folder)
    problem = Diagnoser(read_csv(folder, resample=False), VEHICLE).problem
    return problem, problem.evaluate(problem.believed, [])


@pytest.mark.parametrize(("where", "kept"), [("near edges", False), ("anywhere", True)])
def test_impacts_must_not_know_the_commands(null, where, kept):
    """In white innovations with 1 % of them five times as large."""
    problem, seen = null
    data, rng = problem.data, np.random.default_rng(0)
    effect = Unknown.neutral(kind="steps", acts_on="thrusters", numbers=(STEP,), thrusters=8)
    wider = problem.with_effect(effect)
    theta = wider.moved(seen.theta, problem.library)
    theta[wider.library.at("unknown", "thrusters")] = 1.0
    z = rng.standard_normal(seen.z.shape)
    away = np.abs(data.u / STEP - np.floor(data.u / STEP) - 0.5).min(axis=1)
    near = np.quantile(away[data.weight > 0], 0.1)
    hit = (
        (rng.uniform(size=away.shape) < 0.01)
        if where == "anywhere"
        else ((rng.uniform(size=away.shape) < 0.1) & (away < near))
    )
    z[:, 6] *= np.where(hit, 5.0, 1.0)
    evaluation = seen._replace(theta=theta, z=z * data.weight[:, None])
    gain, values, loss = impacts(evaluation.z[:, 6], data.weight, data.fold)
    law = Law("disturbance_impacts", "surge", values, gain, loss)
    assert law.heldout_gain > LEAST
    assert without_commanded([law], wider, evaluation, LEAST) == [law] * kept
    absent = evaluation._replace(theta=np.zeros_like(theta))
    assert without_commanded([law], wider, absent, LEAST) == [law]


@pytest.mark.parametrize(("where", "kept"), [("where commands change", False), ("anywhere", True)])
def test_impacts_must_not_come_with_changes_of_sampled_commands(null, where, kept):
    problem, seen = null
    data, rng = problem.data, np.random.default_rng(0)
    change = np.linalg.norm(np.diff(data.u, axis=0, prepend=data.u[:1]), axis=1)
    large = change > np.quantile(change[data.weight > 0], 0.9)
    hit = (
        (rng.uniform(size=change.shape) < 0.01)
        if where == "anywhere"
        else ((rng.uniform(size=change.shape) < 0.1) & large)
    )
    z = rng.standard_normal(seen.z.shape)
    z[:, 6] *= np.where(hit, 5.0, 1.0)
    evaluation = seen._replace(z=z * data.weight[:, None])
    gain, values, loss = impacts(evaluation.z[:, 6], data.weight, data.fold)
    law = Law("disturbance_impacts", "surge", values, gain, loss)
    sampled = replace(problem, data=replace(data, sampled=True))
    assert law.heldout_gain > LEAST
    assert without_commanded([law], sampled, evaluation, LEAST) == [law] * kept
    assert without_commanded([law], problem, evaluation, LEAST) == [law]
