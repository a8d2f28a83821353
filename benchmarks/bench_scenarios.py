"""Whole scenarios: speed without a planner, and how often a crossing succeeds."""

import jax
import pytest

from spinndrift.sims.run.folder import run_metrics
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.scenarios.scenario import load_scenario

SEEDS = range(1, 21)


@pytest.fixture(autouse=True)
def _as_the_command_sets_it():
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)


@pytest.mark.parametrize("engine", ["compiled", "drake"])
@pytest.mark.parametrize("name", ["station_keeping_calm", "station_keeping_harbour"])
def test_speed_without_planner(benchmark, name, engine):
    """The clock of `simulate` leaves building and compiling out; so does the figure given."""
    scenario = load_scenario(name, "duration: 60")
    speeds = []

    def fly():
        speeds.append(simulate(scenario, engine=engine).timing.speed())

    benchmark.pedantic(fly, rounds=2)
    benchmark.extra_info["times real time"] = max(speeds)


def test_pylon_crossing(benchmark):
    """Twenty seeds of the crossing in a harbour's waves, wake and current."""
    found = {}

    def fly():
        for seed in SEEDS:
            run = simulate(load_scenario("pylon_crossing_harbour").with_changes(seed=seed))
            found[seed] = run_metrics(run)

    benchmark.pedantic(fly, rounds=1)
    reasons = [values["outcome"]["reason"] for values in found.values()]
    benchmark.extra_info["reached"] = reasons.count("goal")
    benchmark.extra_info["others"] = [r for r in reasons if r != "goal"]
    paths = [values["path"] for values in found.values()]
    benchmark.extra_info["least clearance"] = min(path["min_clearance_m"] for path in paths)
    times = [path["time_to_goal_s"] for path in paths if path["time_to_goal_s"] is not None]
    benchmark.extra_info["mean time to goal"] = sum(times) / max(1, len(times))
