"""Maneuvers are collected over several calls: what is finished stays, the rest is flown again."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_cli import called

from spinndrift.models.config.errors import UserError
from spinndrift.models.files.owned import run_folder
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.run.collection import COLLECTION, Collected, collect, maneuver_scenario
from spinndrift.sims.run.experiment import chosen_maneuvers
from spinndrift.sims.run.log import RunLog, without_horizontal
from spinndrift.sims.scenarios.maneuvers import Maneuvers
from spinndrift.sims.scenarios.scenario import Scenario, load_scenario
from spinndrift.systems.controllers.maneuvers import Phase, Steadiness
from spinndrift.training.data.groups import group_labels
from spinndrift.training.data.maneuvers import maneuver_wrench
from spinndrift.training.data.windows import make_windows

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
SETTINGS = Maneuvers(("surge-forward", "yaw-left"), 2, duration=1.0, steady=Steadiness(time=0.2))


def wanted(settings: Maneuvers = SETTINGS) -> Scenario:
    return maneuver_scenario(load_scenario("station_keeping_calm"), settings)


@pytest.fixture(name="collected", scope="module")
def _collected(tmp_path_factory) -> tuple[Path, list[Collected]]:
    """A collection of three calls: the first is interrupted in its third trajectory."""
    out = tmp_path_factory.mktemp("collect") / "out"

    def interrupt(fraction: float, words: str) -> None:
        if "3 of 4" in words and "open loop" in words:
            signal.raise_signal(signal.SIGINT)

    calls, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)
    for progress in (interrupt, None, None):
        told = {} if progress is None else {"progress": progress}
        with run_folder(out, COLLECTION) as folder:
            calls.append(collect(wanted(), folder, engine="drake", report=False, **told))
    signal.signal(signal.SIGINT, before)
    return out, calls


def test_the_next_call_goes_on_with_what_is_missing(collected):
    _, (first, second, third) = collected
    assert first.outcome is not None
    assert second.outcome is not None
    assert (first.outcome.reason, first.added, first.there, first.wanted) == (
        "interrupted",
        2,
        2,
        4,
    )
    assert (second.outcome.reason, second.added, second.there) == ("finished", 2, 4)
    assert third.outcome is None, "nothing is left to fly"
    assert third.there == 4


def test_the_recording_has_each_maneuver_from_rest_under_its_constant_wrench(collected):
    out, _ = collected
    recording = Recording.load(out / "recording.nc")
    assert recording.scenarios == ("surge-forward", "yaw-left")
    lead = 4  # samples of the 0.2 s at rest
    assert recording.lengths.tolist() == [[21 + lead] * 2] * 2
    np.testing.assert_array_equal(
        recording.dataset["open_loop"].to_numpy().reshape(4, -1),
        np.tile([0] * lead + [1] * 20 + [0], (4, 1)),
    )
    assert recording.dt == 0.05
    assert recording.vehicle == "bluerov2_heavy"
    np.testing.assert_array_equal(recording.dataset["repeat"][..., 0], [[1, 2], [1, 2]])
    steady = SETTINGS.steady
    for run in recording.trajectories():
        # the second maneuver has less effort: 0.9 of the rate at which a run counts as spinning
        share = 1.0 if run.scenario == "surge-forward" else 2**-0.5
        F, _ = maneuver_wrench(run.scenario, VEHICLE.thrusters(), 0.3)
        # a command acts from the plant's next period on, a fifth of a step later
        np.testing.assert_allclose(
            run.commands["F_Bo_B"][lead + 1 :], np.tile(share * F, (20, 1)), atol=0.1
        )
        assert np.ptp(run.commands["pwm"][lead:], axis=0).max() == 0
        # the filter's estimate was steady; the truth is within its errors
        assert np.linalg.norm(run.V_WB_B[0, :3]) < steady.speed + 0.05
        assert np.linalg.norm(run.V_WB_B[0, 3:]) < steady.turn_rate + 0.05
        assert np.linalg.norm(run.X_WB[0, 4:] - [0, 0, run.X_WB[0, 6]]) < steady.position + 0.2
    surge = recording.dataset["V_WB_B"].sel(scenario="surge-forward").to_numpy()[:, -1, 0]
    assert (surge > 0.2).all()
    assert not np.array_equal(*recording.dataset["X_WB"].to_numpy()[0]), "each has its own noise"


def test_train_and_diagnose_take_it_as_it_is(collected):
    recording = Recording.load(collected[0] / "recording.nc")
    assert examine(recording, VEHICLE, "recording", ()).duration == recording.duration
    windows = make_windows(recording, length_s=0.5, stride_s=0.25)
    pairs = np.unique(group_labels(windows), return_counts=True)[1]
    assert (pairs == 2).all(), "repeats are observations of one law"


def test_the_log_of_a_dive_has_its_phases(collected):
    out, _ = collected
    assert {p.name for p in out.iterdir() if p.is_dir()} == {"dive-1", "dive-2"}
    state = RunLog.load(out / "dive-2" / "log.nc")["maneuver"]
    open_loop = state[:, 0] == Phase.OPEN_LOOP
    assert np.count_nonzero(open_loop) == 2 * 20
    assert json.loads((out / "dive-2" / "metrics.json").read_text())["outcome"]["success"]
    assert not json.loads((out / "dive-1" / "metrics.json").read_text())["outcome"]["success"]


def test_other_settings_need_another_folder(collected):
    out, _ = collected
    for changed, words in (
        ({"duration": 2.0}, "duration 1.0, these 2.0"),
        ({"effort": 0.2}, "effort None, these 0.2"),
        ({"maneuvers": ("yaw-left",)}, "maneuvers surge-forward, yaw-left, these yaw-left"),
    ):
        with run_folder(out, COLLECTION) as folder, pytest.raises(UserError, match=words):
            collect(wanted(replace(SETTINGS, **changed)), folder)


def test_nothing_is_driven_blindly_between_obstacles():
    with pytest.raises(UserError, match="pylon_crossing_calm has 3"):
        maneuver_scenario(load_scenario("pylon_crossing_calm"), SETTINGS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--arm",), "--arm: scenario station_keeping_calm has no vehicle_link"),
        (("--maneuver", "loop"), "maneuver 'loop' is unknown"),
        (("--maneuver", "missing.json"), "missing.json: no such file"),
        (("--maneuver", "adequate.json"), "no maneuver helps this diagnosis: it names no cause"),
        (("--maneuver", "list.json"), "list.json: is no diagnosis.json"),
        (("--repeats", "0"), "--repeats 0: give a number from 1"),
        (("--effort", "2"), "--effort 2: give a number above 0, at most 1"),
    ],
)
def test_what_cannot_be_flown_is_refused_before_any_work(
    arguments, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "adequate.json").write_text('{"causes": []}')
    (tmp_path / "list.json").write_text("[1]")
    before = sorted(tmp_path.rglob("*"))
    assert called("collect", "station_keeping_calm", *arguments) == 2
    assert words in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_diagnosis_gives_the_best_maneuver_that_can_be_flown(tmp_path):
    def cause(name: str, **nats: float) -> dict:
        return {"name": name, "next_experiment": "in words", "experiments": nats}

    path = tmp_path / "diagnosis.json"
    causes = [
        cause("lag", chirp=3.0, coast=1.0),
        cause("gain", thrusters=5.0, steps=2.0),
        cause("law"),
        cause("drag", chirp=0.4),
    ]
    path.write_text(json.dumps({"causes": causes}))
    said: list[str] = []
    assert chosen_maneuvers((str(path),), said.append) == ("chirp", "steps")
    assert any("thrusters can't be flown here" in s and "next best is steps" in s for s in said)
    assert chosen_maneuvers((str(tmp_path), "coast")) == ("chirp", "steps", "coast")


def test_without_a_horizontal_aid_the_recording_has_climb_and_depth_alone():
    rng = np.random.default_rng(2)
    R = Rotation.from_euler("ZYX", rng.uniform(-0.5, 0.5, (5, 3)))
    v_W = np.column_stack([np.zeros((5, 2)), rng.normal(size=5)])
    X = np.column_stack([R.as_quat(scalar_first=True), rng.normal(size=(5, 3))])
    V = np.column_stack([R.inv().apply(v_W), rng.normal(size=(5, 3))])
    X1, V1, climb = without_horizontal(X, V)
    assert np.isnan(X1[:, 4:6]).all()
    assert np.isnan(V1[:, :2]).all()
    np.testing.assert_array_equal(X1[:, [0, 1, 2, 3, 6]], X[:, [0, 1, 2, 3, 6]])
    np.testing.assert_array_equal(V1[:, 3:], V[:, 3:])
    np.testing.assert_allclose(climb, v_W[:, 2])
    np.testing.assert_allclose(V1[:, 2], V[:, 2], atol=1e-12)  # it moves up and down alone
