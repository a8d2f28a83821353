"""Unmodelled structure: what innovations hold of a group is matched with its weight."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.blind import NOISE
from hidden.draw import Case
from hidden.scenarios import Plan

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.candidates.groups import groups
from spinndrift.training.diagnosis.candidates.structures import Screen
from spinndrift.training.diagnosis.pipeline import Diagnoser

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=4, runs=1, seconds=24.0, rate=25.0, dead_reckoned=True)


@pytest.mark.slow
def test_correlated_innovations_do_not_change_a_weight(tmp_path):
    """They count for fewer samples, in innovations and sensitivities alike."""
    Case(7, (), PLAN, NOISE["stretches"]).write(tmp_path / "data")
    problem = Diagnoser(read_csv(tmp_path / "data", resample=False), VEHICLE).problem
    plain = problem.evaluate(problem.believed, [])
    memory = np.linspace(1.0, 20.0, 12)
    less = plain.kalman.whiten / np.sqrt(memory)[:, None, None]
    seen = plain._replace(kalman=replace(plain.kalman, whiten=less, memory=memory))
    group = next(g for g in groups(problem, seen) if g.effect.kind == "slew")
    of_data = Screen(problem, plain, None, whole=True).sensitivities(group)
    made = -0.7 * of_data[3].reshape(seen.z.shape)
    screen = Screen(problem, seen._replace(z=made), None, whole=True)
    J = screen.sensitivities(group)[3].astype(float).ravel()
    assert J @ screen.z[0].ravel() / (J @ J) == pytest.approx(-0.7, rel=1e-5)
    gain = screen.match(group, 0.01, np.random.default_rng(0)).gain
    least = np.sum(made.astype(float) ** 2 / memory[:, None]) / 2
    assert gain == pytest.approx(least, rel=0.05)
