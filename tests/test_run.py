"""Runs repeat themselves, end as they should, and leave whole folders."""

import json
import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from killing import killed, litter

from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.files.owned import MARKER
from spinndrift.models.recordings.store import Recording
from spinndrift.sims.cli import main
from spinndrift.sims.run import folder as run_folder
from spinndrift.sims.run.folder import new_folder, write_run
from spinndrift.sims.run.log import RunLog
from spinndrift.sims.run.loop import simulate, simulate_seeds
from spinndrift.sims.run.signals import mean_over
from spinndrift.sims.scenarios.scenario import Scenario, load_scenario, overridden
from spinndrift.systems.closed_loop import Signal

pytestmark = pytest.mark.whole

CROSSING = """
duration: 0.6
controller:
  planner: {horizon: 10, sequences: 16, realisations: 1, knots: [2], effective_samples: 4,
    shown_paths: 4}
"""
EXAMPLE = """
from run_example import example_log
from spinndrift.sims.run import loop
from spinndrift.sims.scenarios.criteria import Outcome
made = example_log(2.0, planned=False), Outcome("duration", 2.0, "over"), loop.Timing()
loop.simulate = lambda scenario, *_, **__: loop.Run(scenario, *made)
"""
HOLD = """
name: hold
duration: 0.5
controller: !TrackReference
  path: !HoldPose {at: {position: [0, 0, -1.5]}}
success: !FollowPath {}
"""


@pytest.fixture(name="crossing", scope="module")
def _crossing():
    return simulate(load_scenario("pylon_crossing_harbour", CROSSING))


def test_same_seed_same_log_bit_for_bit(crossing):
    again = simulate(crossing.scenario)
    first, second = crossing.log.recording.dataset, again.log.recording.dataset
    assert set(first) == set(second)
    for name in first:
        np.testing.assert_array_equal(first[name].to_numpy(), second[name].to_numpy(), str(name))
    assert again.outcome == crossing.outcome


@pytest.mark.slow
def test_another_seed_is_another_run(crossing):
    other = simulate(crossing.scenario.with_changes(seed=crossing.scenario.seed + 1))
    for name in ("X_WB", "X_WB_estimate", "flow_W", "F_Bo_B", "sample_p_WB"):
        one, two = (r.log.recording.dataset[name].to_numpy() for r in (crossing, other))
        assert not np.array_equal(one[..., -1, :], two[..., -1, :]), name


def test_runs_of_one_diagram_are_those_of_their_own(crossing):
    seed = crossing.scenario.seed
    other, again = simulate_seeds(crossing.scenario, [seed + 1, seed])
    assert (other.scenario.seed, again.scenario) == (seed + 1, crossing.scenario)
    first, second = crossing.log.recording.dataset, again.log.recording.dataset
    for name in first:
        np.testing.assert_array_equal(first[name].to_numpy(), second[name].to_numpy(), str(name))
    assert not np.array_equal(other.log["X_WB"], again.log["X_WB"])
    assert again.timing.compilation < other.timing.compilation  # nothing is left to compile


def test_log_holds_what_happened(crossing):
    log, n = crossing.log, 13
    assert log.time.size == n
    assert log["error_std"].shape == (n, 18)
    assert log["error_std"].min() >= 0
    blocks = log["error_covariance"].reshape(n, 3, 3, 3)
    variances = np.diagonal(blocks, axis1=2, axis2=3).reshape(n, 9)
    np.testing.assert_allclose(np.sqrt(variances), log["error_std"][:, :9], rtol=1e-12)
    assert log["nis"].shape == log["rejected"].shape == (n, 3)
    assert log["nis"][-1].min() > 0
    assert log["pwm"].shape == (n, 8)
    plans = log.plans
    assert plans is not None
    np.testing.assert_allclose(plans.time, [0.0, 0.2, 0.4])
    assert plans.X_WB.shape == (3, 3, 7)
    assert plans.p_WB.shape == (3, 2, 3, 4)
    # a plan starts where the filter thinks the vehicle is (float32 in the planner)
    at = np.searchsorted(log.time, plans.time[1:] - 1e-9)
    for k, n in enumerate(at, start=1):
        gap = plans.X_WB[k, 0, 4:] - log["X_WB_estimate"][n - 1, 4:]
        assert np.linalg.norm(gap) < 1e-5


def test_folder_is_whole(crossing, tmp_path):
    values = write_run(crossing, tmp_path / "run")
    names = {"scenario.yaml", "log.nc", "metrics.json", "report.html", "meshcat.html", MARKER}
    assert {path.name for path in (tmp_path / "run").iterdir()} == names
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    text = (tmp_path / "run" / "scenario.yaml").read_text(encoding="utf-8")
    assert typed_yaml.loads(Scenario, text) == crossing.scenario
    told = json.loads((tmp_path / "run" / "metrics.json").read_text(encoding="utf-8"))
    assert told == values
    assert told["seed"] == crossing.scenario.seed
    assert told["outcome"]["reason"] == "duration"
    assert told["timing"]["real_time_factor"] > 0
    assert Recording.load(tmp_path / "run" / "log.nc").vehicle == "bluerov2_heavy"
    assert (tmp_path / "run" / "report.html").stat().st_size < 5e6
    with pytest.raises(UserError, match="holds a run already"):
        write_run(crossing, tmp_path / "run")
    assert RunLog.load(tmp_path / "run" / "log.nc").plans is not None


def test_a_failure_leaves_nothing(crossing, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_folder, "write_replay", fail)
    with pytest.raises(KeyboardInterrupt):
        write_run(crossing, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_folders_count_up(tmp_path):
    scenario = overridden(HOLD, "{}")
    for name in ("hold-0", "hold-0-2", "hold-0-3"):
        with new_folder(None, scenario, tmp_path) as folder:
            assert folder.name == name
            (folder / "log.nc").write_text("a")

    def fail():
        with new_folder(None, scenario, tmp_path) as folder:
            assert folder.name == "hold-0-4"
            raise RuntimeError

    for _ in range(2):  # what was never written into is gone
        with pytest.raises(RuntimeError):
            fail()
    assert len(list(tmp_path.iterdir())) == 3


def test_two_runs_at_once_take_two_folders(tmp_path, monkeypatch):
    scenario = overridden(HOLD, "{}")
    with new_folder(None, scenario, tmp_path) as first:
        there = os.path.lexists  # both looked before either was there
        monkeypatch.setattr(os.path, "lexists", lambda p: there(p) and Path(p) != first)
        with new_folder(None, scenario, tmp_path) as second:
            assert (first.name, second.name) == ("hold-0", "hold-0-2")


@pytest.mark.usefixtures("interruptible")
def test_interrupt_keeps_what_was_flown():
    def press(fraction: float, remark: str) -> None:
        if fraction > 0.3:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    run = simulate(overridden(HOLD, "duration: 2"), press)
    assert signal.getsignal(signal.SIGINT) is before
    assert run.outcome.reason == "interrupted"
    assert 0.6 < run.outcome.time < 1.0
    assert run.log.time[-1] == pytest.approx(run.outcome.time)


def test_collision_ends_the_run():
    pylon = "obstacles: [{x: 0.5, y: 0.0, name: the post}], start_twist: [1, 0, 0, 0, 0, 0]"
    run = simulate(overridden(HOLD, f"station: {{{pylon}}}"))
    assert run.outcome.reason == "collision"
    assert "the post" in run.outcome.sentence
    assert 0.1 < run.outcome.time < 0.3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "station: {obstacles: [{x: 0.2, y: 0.0, name: post}]}",
            r"station.start: .* 0\.1\d m inside the pylon `post`, a certain collision",
        ),
        (
            "{success: !ReachGoal {goal: [3, 0, -1.5]}, station: {obstacles: [{x: 3.1, y: 0.0}]}}",
            r"success.goal: .* inside the pylon at \(3.1, 0\)",
        ),
        (
            "{station: {obstacles: [{x: 4.5, y: -2.3, name: post}]}}",
            r"controller.task.goal: .* inside the pylon `post`",
        ),
    ],
)
def test_no_run_starts_or_ends_in_an_obstacle(text, message):
    crossing = "controller" in message
    scenario = load_scenario("pylon_crossing_calm", text) if crossing else overridden(HOLD, text)
    with pytest.raises(UserError, match=message):
        simulate(scenario)


@pytest.mark.slow
def test_a_ringed_goal_is_said_and_the_vehicle_stays(crossing, tmp_path):
    angles = 2 * np.pi * np.arange(12) / 12
    pylons = ", ".join(
        f"{{x: {4.5 + np.cos(a):.3f}, y: {-2 + np.sin(a):.3f}, diameter: 0.35}}" for a in angles
    )
    text = f"{{duration: 0.5, station: {{disturbance_set: still, obstacles: [{pylons}]}}}}"
    base = typed_yaml.dump(crossing.scenario)
    run = simulate(overridden(base, text))
    assert run.outcome.reason == "no safe plan"
    found = re.search(r"every passage .* risk of ([\d.]+) % or more; 5 % is", run.outcome.sentence)
    assert found, run.outcome.sentence
    assert float(found[1]) > 90
    assert np.linalg.norm(run.log["X_WB"][-1] - run.log["X_WB"][0]) < 0.02
    values = write_run(run, tmp_path / "run", report=False)
    assert values["planner"]["least_risk_to_goal"] == pytest.approx(float(found[1]) / 100, abs=1e-3)
    assert values["planner"]["allowed_collision_probability"] == 0.05
    assert values["outcome"]["words"] == run.outcome.sentence
    assert not values["outcome"]["success"]


BAD = """
import numpy as np
from pydrake.systems.framework import LeafSystem
from spinndrift.systems.planning.plan import PlanLayout

class Bad(LeafSystem):
    def __init__(self, start: float = -1.0, plan: bool = False):
        super().__init__()
        self.start = start
        self.DeclareVectorInputPort("X_WB", 7)
        self.DeclareVectorInputPort("V_WB_B", 6)
        self.DeclareVectorOutputPort("F_Bo_B", 6, self.calc)
        if plan:
            self.layout = PlanLayout(1, 1.0)
            self.DeclareStateOutputPort("plan", self.DeclareDiscreteState(self.layout.size))

    def calc(self, context, output):
        output.SetFromVector(np.full(6, np.nan if context.get_time() > self.start else 0.0))

class BadInUpdate(Bad):
    def __init__(self):
        super().__init__(1.0)
        self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, self.update)
        self.F = self.DeclareDiscreteState(6)

    def update(self, context, state):
        state.set_value(self.F, [np.nan] * 6)

    def calc(self, context, output):
        output.SetFromVector(context.get_discrete_state(self.F).value())
"""
REACH = "success: !ReachGoal {goal: [9, 0, -1.5]}"


def _bad(folder, name="Bad", more="", success=REACH):
    (folder / "bad.py").write_text(BAD)
    own = f"{{system: '{folder}/bad.py:{name}', parameters: {{{more}}}}}"
    return overridden(HOLD, f"controller: !Own {own}\n{success}")


def test_a_controller_of_nan_ends_the_run(tmp_path):
    run = simulate(_bad(tmp_path, more="start: 0.22"))
    assert run.outcome.reason == "not finite"
    assert "not finite" in run.outcome.sentence
    assert run.log.time[-1] == pytest.approx(0.2)
    assert np.isfinite(run.log["F_Bo_B"]).all()
    assert run.log.plans is None


@pytest.mark.parametrize("name", ["Bad", "BadInUpdate"])
def test_nan_from_the_start_is_no_flight(tmp_path, name):
    with pytest.raises(UserError, match=rf"^controller {name}: its F_Bo_B is not finite at t = 0"):
        simulate(_bad(tmp_path, name))


def test_a_plan_that_is_judged_has_to_be_told(tmp_path):
    follow = "success: !FollowPath {}"
    with pytest.raises(UserError, match=r"FollowPath judges .* the controller Bad tells none"):
        simulate(_bad(tmp_path, success=follow))
    run = simulate(_bad(tmp_path, more="start: 0.22, plan: true", success=follow))
    assert run.outcome.reason == "not finite"
    assert not run.log["plan_valid"].any()


def test_whose_code_runs_is_said_before(tmp_path, capsys):
    scenario = tmp_path / "mine.yaml"
    scenario.write_text(typed_yaml.dump(_bad(tmp_path, "Missing")))
    with pytest.raises(SystemExit):
        main(["run", str(scenario), "--quiet", "--out", str(tmp_path / "out")])
    said, refused = capsys.readouterr().err.splitlines()
    assert said == f"{scenario} runs the code of {tmp_path}/bad.py:Missing"
    assert "no Drake system called `Missing`" in refused


def test_commands_are_averaged_over_the_steps_of_the_log():
    t = 0.01 * np.arange(11)
    signal = Signal(t, np.stack([np.arange(11.0), np.ones(11)], axis=1))
    found = mean_over(signal, np.array([0.0, 0.05, 0.1]), 0.05)
    np.testing.assert_allclose(found, [[2, 1], [7, 1], [10, 1]])


@pytest.mark.parametrize(
    "arguments",
    [
        ["storm"],
        ["station_keeping_calm", "--scenario-text", "durations: 3"],
        ["station_keeping_calm", "--model", "none.spinn"],
        ["pylon_crossing_calm", "--model", "none.spinn"],
        ["station_keeping_calm", "--seed", "-1"],
        ["station_keeping_calm", "--out", __file__],
    ],
)
def test_bad_input_exits_with_two_and_a_sentence(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["run", *arguments])
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("spinndrift: ")
    assert list(tmp_path.iterdir()) == []


def test_command(tmp_path, capsys):
    """A process that is killed as it writes leaves a folder that the same command takes."""
    (tmp_path / "hold.yaml").write_text(HOLD)
    out = tmp_path / "flown"
    killed("metrics.json", 1, EXAMPLE, "run", tmp_path / "hold.yaml", "--out", out, "--no-report")
    assert (out / MARKER).exists()
    assert len(litter(tmp_path)) == 2
    main(["run", str(tmp_path / "hold.yaml"), "--seed", "4", "--out", str(out), "--no-report"])
    assert {p.name for p in out.iterdir()} == {"scenario.yaml", "log.nc", "metrics.json", MARKER}
    assert json.loads((out / "metrics.json").read_text())["seed"] == 4
    assert "wrote" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["run", str(tmp_path / "hold.yaml"), "--out", str(out)])
    assert "holds a run already" in capsys.readouterr().err
