"""The example on the gain in closed loop: what it hides, what it flies, how it judges."""

import json
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from helpers import load_example
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.extended import Extended
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.controllers.kinds import MppiImpedance

example = load_example("closed_loop_gain")
VEHICLE = load_vehicle("bluerov2_heavy")
REST = jnp.array([1.0, 0, 0, 0, 0, 0, -2.0]), jnp.zeros(6)
SURGE = jnp.array([20.0, 0, 0, 0, 0, 0])


def flight(reason="goal", time=10.0, **changes):
    values = {"clearance": 0.2, "off_plan": 0.05, "depth": 0.1, "force": 20.0}
    return example.Flight(reason, time, path=[[0, 0, -1.5], [1, 0, -1.5]], **(values | changes))


def left_over(name):
    """The wrench of the hidden model less that of the preset, at rest under 20 N of surge."""
    model = example.hidden_causes()[name].model(VEHICLE, [0.0] * 6)
    both = [m.balance(*REST, SURGE)[1] for m in (model, VEHICLE.dynamics())]
    return np.asarray(both[0] - both[1])


def test_what_is_hidden_acts_in_the_plant():
    """In closed form: a push, a share, and a thruster whose part of the surge is missing."""
    np.testing.assert_allclose(left_over("ballast"), [0, 0, -20, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(left_over("weak_thrust"), -0.5 * SURGE, atol=1e-9)
    thrusters = VEHICLE.thrusters()
    part = np.asarray(thrusters.allocation[:, 1] * (thrusters.inverse @ SURGE)[1])
    np.testing.assert_allclose(left_over("dead_thruster"), -part, atol=1e-9)
    # water comes at 0.25 m/s from ahead and at 0.35 m/s from the right: linear and square drag
    current = [-4.03 * 0.25 - 58.42 * 0.25**2, 6.22 * 0.35 + 75.3 * 0.35**2]
    np.testing.assert_allclose(left_over("current")[:2], current, atol=1e-9)


def test_plant_and_planner_have_models_of_their_own(tmp_path):
    causes = example.hidden_causes()
    plant, planner = tmp_path / "plant.spinn", tmp_path / "planner.spinn"
    save_model(plant, causes["ballast"].model(VEHICLE, [0.0] * 6))
    save_model(planner, causes["current"].model(VEHICLE, [3.0] * 6))
    scenario = example.prepared(load_scenario("pylon_crossing_calm"), plant, planner)
    assert isinstance(scenario.controller, MppiImpedance)
    flown, believed = scenario.station.dynamics(), scenario.controller.dynamics(scenario.station)
    for model, name, b in ((flown, "net_buoyancy", 0.0), (believed, "current_steady", 3.0)):
        assert isinstance(model, Extended)
        assert [e.name for e in model.effects] == [name]
        np.testing.assert_array_equal(model.coefficients(jnp.zeros(6)).diffusion, b)
    same = example.prepared(load_scenario("pylon_crossing_calm"), None, None)
    assert same == load_scenario("pylon_crossing_calm")


def test_models_are_made_once(tmp_path, monkeypatch):
    """Planners differ in their effects alone; a second call reads what the first has written."""
    scenario, hidden = load_scenario("pylon_crossing_calm"), example.hidden_causes()["ballast"]
    found = hidden.model(VEHICLE, [0.0] * 6)

    class Diagnosis:
        sentence, seconds = "a push", 1.0

        def save(self, path):
            cause = {"name": "net_buoyancy", "where": "all"}
            values = {"force": {"value": -20.01, "unit": "N", "interval95": [-21, -19]}}
            path.write_text(json.dumps({"causes": [cause | {"parameters": values}]}))

    class Finding:
        diagnosis, extended = Diagnosis(), found

    asked = []
    monkeypatch.setattr(example, "read_csv", asked.append)
    monkeypatch.setattr(example, "diagnose", lambda recording, vehicle: Finding())
    hidden = example.dataclasses.replace(hidden, write=lambda folder: folder.mkdir(parents=True))
    paths = example.models("ballast", hidden, scenario, tmp_path, lambda text: None)
    assert paths == example.models("ballast", hidden, scenario, tmp_path, lambda text: None)
    assert len(asked) == 1
    diffusion = np.array(example.planner_of(scenario).diffusion)
    for planner in example.PLANNERS:
        model = load_model(paths[planner], float)[0]
        np.testing.assert_allclose(model.coefficients(jnp.zeros(6)).diffusion, diffusion)
    plant = load_model(paths["plant"], float)[0]
    np.testing.assert_array_equal(plant.coefficients(jnp.zeros(6)).diffusion, 0)
    assert example.found_in(tmp_path / "ballast") == "`net_buoyancy` all: -20 N"


def test_only_missing_seeds_are_flown(tmp_path, monkeypatch):
    scenario, asked = load_scenario("pylon_crossing_calm"), []

    class Run:
        def __init__(self, seed):
            self.scenario = scenario.with_changes(seed=seed)
            self.outcome = type("Outcome", (), {"sentence": "reached"})

    def fly(scenario, seeds):
        asked.append(list(seeds))
        return map(Run, seeds)

    monkeypatch.setattr(example, "simulate_seeds", fly)
    monkeypatch.setattr(example, "reduced", lambda run: flight(time=float(run.scenario.seed)))
    given = (tmp_path, "belief", lambda text: None)
    first = example.flown(scenario, [1, 3], *given)
    second = example.flown(scenario, [1, 2, 3], *given)
    assert asked == [[1, 3], [2]]
    assert [f.time for f in first] == [1.0, 3.0]
    assert [f.time for f in second] == [1.0, 2.0, 3.0]
    assert first == [second[0], second[2]]


def test_bootstrap_is_that_of_a_mean():
    """For many numbers the interval comes to 1.96 standard errors; NaN don't count."""
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    mean, low, high = example.bootstrap(np.append(values, np.nan))
    error = values.std() / np.sqrt(values.size)
    assert mean == pytest.approx(values.mean())
    # the quantiles of 10 000 draws are known to 3 % of the standard error
    np.testing.assert_allclose([mean - low, high - mean], 1.96 * error, atol=0.15 * error)
    assert example.bootstrap(np.full(3, 1.5)) == (1.5, 1.5, 1.5)
    assert np.isnan(example.bootstrap(np.array([np.nan]))).all()


def test_tables_pair_seeds():
    belief = [flight(time=12.0), flight("collision", 5.0, clearance=0.0), flight(time=14.0)]
    extended = [flight(time=11.0), flight(time=9.0), flight(time=13.0)]
    flights = {"nothing": {"belief": belief}, "current": {"belief": belief, "extended": extended}}
    rows = example.table(flights).splitlines()
    assert len(rows) == 5
    assert rows[2].startswith("| nothing | belief | 2 of 3 (")
    assert "| 13.0 (12.0 to 14.0) |" in rows[2]  # the flight that hit a pylon has no time
    (row,) = example.differences(flights).splitlines()[2:]
    # one seed was reached by the extended model alone; the two others are a second faster each
    assert row.startswith("| current | extended | 1, 0 | -1.0 (-1.0 to -1.0) | ")
    assert "| +0.07 (+0.00 to +0.20) |" in row


def test_the_figure_shows_every_hidden_cause(tmp_path):
    flights = {
        name: {planner: [flight(), flight("collision")] for planner in example.PLANNERS}
        for name in ("current", "ballast")
    }
    example.draw(flights, load_scenario("pylon_crossing_calm"), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000


def test_errors_are_one_sentence(monkeypatch):
    with pytest.raises(UserError, match="`storm` is none of dead_thruster"):
        example.main(["--only", "storm"])
    with pytest.raises(UserError, match="not steered by MppiImpedance"):
        example.planner_of(load_scenario("station_keeping_calm"))
    monkeypatch.setitem(sys.modules, "hidden.blind", None)
    with pytest.raises(UserError, match="PYTHONPATH=tests"):
        example.main([])
