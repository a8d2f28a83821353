"""A vehicle that a file names is found from that file, and one that can't be used is refused."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion import smooth_motion

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.csv import write_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.recordings.summary import summarize
from spinndrift.models.vehicles.places import absolute, load_named, named_in
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.acceptance import acceptance
from spinndrift.sims.cli import main
from spinndrift.sims.scenarios.located import located
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.controllers.kinds import Own
from spinndrift.systems.logs.load import load_data

T = np.arange(0.0, 10.0, 0.05)


def made(command="pwm", n=8, vehicle="", t=T):
    """A recording of smooth motion with commands of no meaning, of n thrusters."""
    X, V, _ = smooth_motion(t)
    values = np.random.default_rng(0).uniform(-9, 9, (t.size, n))
    values = 1500 + 30 * values if command == "pwm" else values
    run = Trajectory("a", X.T, V.T, {command: values})
    return Recording.from_trajectories([run], 0.05, vehicle=vehicle)


def rov(folder: Path, name="my_rov.yaml") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / "models/vehicles/bluerov2.yaml", folder / name)
    return folder / name


def refused(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


# -------------------------------------------------------------------------------- where it is found


def test_a_file_is_found_beside_what_names_it_then_from_here(tmp_path, monkeypatch):
    beside, here = rov(tmp_path / "a"), rov(tmp_path / "b")
    monkeypatch.chdir(here.parent)
    assert named_in("my_rov.yaml", beside.parent) == str(beside)
    assert named_in("my_rov.yaml", tmp_path) == str(here)
    gone = str(tmp_path / "gone" / "my_rov.yaml")
    assert named_in(gone, beside.parent) == str(beside)  # both were moved
    assert named_in("none.yaml", beside.parent) == "none.yaml"
    assert named_in("x" * 5000 + ".yaml", beside.parent) == "x" * 5000 + ".yaml"
    assert named_in("bluerov2", beside.parent) == absolute("bluerov2") == "bluerov2"
    assert absolute("my_rov.yaml") == str(here)


def test_a_recording_keeps_where_its_vehicle_is(tmp_path, monkeypatch):
    path = rov(tmp_path / "a")
    monkeypatch.chdir(path.parent)
    made(n=6).save("plain.nc")
    load_data("plain.nc", vehicle="my_rov.yaml").save("mine.nc")
    monkeypatch.chdir(tmp_path)
    assert load_data("a/mine.nc").vehicle == str(path)
    os.rename(tmp_path / "a", tmp_path / "moved")
    assert load_data("moved/mine.nc").vehicle == str(tmp_path / "moved/my_rov.yaml")


def test_a_scenario_names_a_vehicle_beside_it(tmp_path, monkeypatch):
    path = rov(tmp_path / "a")
    text = (ROOT / "sims/scenarios/station_keeping_calm.yaml").read_text(encoding="utf-8")
    scenario = path.with_name("s.yaml")
    named = text.replace("vehicle: bluerov2_heavy", "vehicle: my_rov.yaml", 1)
    assert named != text
    scenario.write_text(named)
    monkeypatch.chdir(tmp_path)
    assert load_scenario("a/s.yaml").station.vehicle == str(path)
    assert load_scenario("a/s.yaml").station.load_vehicle().name == "bluerov2"
    scenario.write_text(named.replace("my_rov.yaml", "bluerov3"))
    with pytest.raises(UserError, match=r"^a/s\.yaml: station\.vehicle: vehicle `bluerov3` is no"):
        load_scenario("a/s.yaml")
    with pytest.raises(UserError, match=r"^--scenario-text: station\.vehicle: .*`none\.yaml`"):
        load_scenario("station_keeping_calm", "station: {vehicle: none.yaml}")


def test_a_scenario_names_models_and_code_beside_it(tmp_path, monkeypatch):
    folder = tmp_path / "a"
    folder.mkdir()
    shutil.copy(ROOT / "examples/own_controller.py", folder / "mine.py")
    (folder / "model.spinn").touch()
    monkeypatch.chdir(tmp_path)
    own = "controller: !Own {system: 'mine.py:PidController'}"
    controller = located(load_scenario("station_keeping_calm", own), folder).controller
    assert isinstance(controller, Own)
    assert controller.code == f"{folder / 'mine.py'}:PidController"
    scenario = load_scenario("station_keeping_calm")
    named = replace(scenario, station=replace(scenario.station, model=Path("model.spinn")))
    assert located(named, folder).station.model == folder / "model.spinn"
    assert located(named, tmp_path) == named  # it is nowhere
    assert located(scenario, folder) == scenario


# ---------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize("named", ["bluerov3", "not_here.yaml"])
def test_an_import_refuses_a_vehicle_that_is_not_there(tmp_path, capsys, named):
    write_csv(made(vehicle=named), tmp_path / "runs")
    out = tmp_path / "out.nc"
    said = refused(capsys, "import", tmp_path / "runs", "--out", out)
    assert said.startswith(f"spinndrift: {tmp_path / 'runs'}: vehicle `{named}`")
    assert "--vehicle" in said
    assert not out.exists()
    with pytest.raises(UserError, match=r"^mine: vehicle .* \(--vehicle names another\)$"):
        load_named(named, "mine")


@pytest.mark.parametrize(("n", "vehicle", "own"), [(7, "bluerov2", 6), (6, "bluerov2_heavy", 8)])
@pytest.mark.parametrize("command", ["pwm", "thruster_force"])
def test_an_import_refuses_another_number_of_thrusters(tmp_path, capsys, command, n, vehicle, own):
    made(command, n).save(tmp_path / "data.nc")
    out = tmp_path / "out.nc"
    told = (tmp_path / "data.nc", "--vehicle", vehicle, "--out", out)
    said = refused(capsys, "import", *told)
    expected = f"{command}: the recording has {n} thrusters, {vehicle} {own};"
    assert said.startswith(f"spinndrift: {tmp_path / 'data.nc'}: {expected}")
    assert not out.exists()
    with pytest.raises(UserError, match=expected):
        examine(load_data(tmp_path / "data.nc"), load_vehicle(vehicle), "data.nc")


# --------------------------------------------------------------------------------- what is accepted


def lines(recording):
    return dict(line.split(": ", 1) for line in acceptance(recording))


def test_acceptance_knows_the_vehicle():
    for vehicle, why in (("bluerov3", "`bluerov3` is no preset"), ("bluerov2", "8 thrusters")):
        told = lines(made(vehicle=vehicle))
        for command in ("train", "evaluate", "diagnose"):
            assert told[command].startswith("nothing (")
            assert why in told[command]
    unnamed = lines(made(n=6))
    assert "bluerov2_heavy, which is taken where none is named, 8" in unnamed["diagnose"]
    assert lines(made(n=6, vehicle="bluerov2"))["diagnose"] == "10 s"


def test_acceptance_follows_the_command_that_each_command_reads():
    """`train` and `evaluate` take a recorded wrench as it is, `diagnose` the thrusters' forces."""
    run = next(iter(made("thruster_force", vehicle="bluerov2").trajectories()))
    both = replace(run, commands={"F_Bo_B": np.ones((T.size, 6)), **run.commands})
    told = lines(Recording.from_trajectories([both], 0.05, vehicle="bluerov2"))
    assert told["evaluate"] == "8 s in windows of 4 s"
    assert "thruster_force: the recording has 8 thrusters" in told["diagnose"]


def test_acceptance_says_which_part_is_too_short():
    """Of 10 s a quarter is held out, 50 samples less 20 of the gap: 29 steps."""
    told = lines(made())["train"]
    assert "held out (the last 25% of each, less a gap of 1 s) lasts 1.45 s" in told
    assert "a window needs 4 s" in told


# ---------------------------------------------------------------------------- what is named wrongly


def test_a_folder_and_exchanged_arguments_are_told(tmp_path, capsys):
    folder = tmp_path / "runs"
    folder.mkdir()
    said = refused(capsys, "evaluate", folder, tmp_path / "mine.spinn")
    assert f"comes first and the data second: spinndrift evaluate {tmp_path / 'mine.spinn'}" in said
    (folder / "model.spinn").touch()
    said = refused(capsys, "evaluate", folder, tmp_path / "mine.nc")
    assert f"{folder}: is a folder; name a model file, such as {folder / 'model.spinn'}" in said


def test_options_are_named_as_they_are_given(tmp_path, capsys):
    made().save(tmp_path / "a.nc")
    where = tmp_path / "a.nc"
    said = refused(capsys, "export", where, tmp_path / "a.mcap", "--scenario", "nope")
    assert said.startswith(
        f"spinndrift: {where}: --scenario nope: is not here; the recording has a"
    )
    said = refused(capsys, "import", where, "--out", tmp_path / "b.nc", "--water-density", "1025")
    assert said.startswith(f"spinndrift: {where}: --water-density is for logs of a vehicle")
    said = refused(capsys, "generate", "--out", tmp_path / "c.nc", "--maneuvers")
    assert said.startswith("spinndrift: --maneuvers: give at least one")


def test_an_effect_on_a_thruster_that_is_not_there_is_told_by_its_field(tmp_path):
    text = (ROOT / "sims/scenarios/station_keeping_calm.yaml").read_text(encoding="utf-8")
    effect = "{name: thruster_gain, where: '9', parameters: {gain: 0.5}}"
    path = tmp_path / "s.yaml"
    path.write_text(text.replace("station:\n", f"station:\n  effects: [{effect}]\n", 1))
    with pytest.raises(UserError, match=r"s\.yaml: station\.effects\[0\]: .* 8 thrusters; give a"):
        load_scenario(path)


def test_pulses_are_summed_up_as_whole_numbers():
    pulses = made().dataset["pwm"].to_numpy()
    expected = f"pwm (us): {pulses.min():.0f} … {pulses.max():.0f}"
    assert expected in summarize(made()).split("\n")
