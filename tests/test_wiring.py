"""Which outputs are thrusters in logs that do not tell the frame."""

import log_writers
import numpy as np
import pytest
from log_writers import PARAMETERS, dataflash, dive

from spinndrift.systems.logs.load import import_log
from spinndrift.systems.logs.wiring import moving_thrusters

SIX = {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 7)}
KINDS = ("tlog", "BIN")


def imported(folder, log, kind="tlog", **options):
    path = folder / f"dive.{kind}"
    path.write_bytes(log.bytes())
    return import_log(path, **options)


@pytest.fixture
def six_move(monkeypatch):
    """Outputs 7 and 8 stand still, one of them at a lamp's pulse."""
    real = log_writers.outputs

    def outputs(t):
        pulses = np.array(real(t))
        pulses[6], pulses[7] = 1100.0, 1500.0
        return pulses

    monkeypatch.setattr(log_writers, "outputs", outputs)


def written(kind, parameters, monkeypatch):
    if kind == "tlog":
        return dive(parameters=parameters)
    monkeypatch.setattr(log_writers, "PARAMETERS", parameters)
    return dataflash()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("parameters", [{}, SIX])
@pytest.mark.usefixtures("six_move")
def test_the_outputs_that_move_tell_the_thrusters(tmp_path, monkeypatch, kind, parameters):
    """As in telemetry of QGroundControl, which downloads the parameters as a file."""
    recording, report = imported(tmp_path, written(kind, parameters, monkeypatch), kind)
    assert recording.vehicle == "bluerov2"
    told = [line for line in report.done if line.startswith("Frame not in the log: read as")]
    assert len(told) == 1
    assert "read as bluerov2, as outputs 7 and 8 do not both move" in told[0]
    named, report = imported(
        tmp_path, written(kind, parameters, monkeypatch), kind, vehicle="bluerov2_heavy"
    )
    assert named.vehicle == "bluerov2_heavy"
    assert "Frame not in the log" not in str(report)


@pytest.mark.parametrize("kind", KINDS)
def test_eight_that_move_are_read_as_eight_and_it_is_said(tmp_path, monkeypatch, kind):
    recording, report = imported(tmp_path, written(kind, {}, monkeypatch), kind)
    assert recording.vehicle == "bluerov2_heavy"
    assert "Frame not in the log: read as bluerov2_heavy (--vehicle" in str(report)


@pytest.mark.usefixtures("six_move")
def test_functions_of_outputs_that_stand_still_count_more(tmp_path):
    """Eight motors are eight, whether all of them were used or not."""
    recording, report = imported(tmp_path, dive(parameters=PARAMETERS))
    assert recording.vehicle == "bluerov2_heavy"
    assert "Frame not in the log: read as bluerov2_heavy" in str(report)


def test_a_lamp_on_the_receivers_ninth_channel_is_no_thruster(tmp_path):
    lamp = {"SERVO7_FUNCTION": 59.0, "SERVO8_FUNCTION": 7.0}
    recording, _ = imported(tmp_path, dive(parameters=SIX | lamp))
    assert recording.vehicle == "bluerov2"
    heavy = {"FRAME_CONFIG": 2.0}
    recording, report = imported(tmp_path, dive(parameters=SIX | lamp | heavy))
    pulses = next(recording.trajectories()).commands["pwm"]
    np.testing.assert_allclose(pulses[:, 6:], 1500.0)
    assert "thrusters 7, 8; they are taken as stopped" in str(report)


def test_thrusters_that_move():
    moving, still = np.array([1500.0, 1600.0]), np.array([1500.0, 1500.0])
    assert moving_thrusters(np.stack([moving] * 6 + [still] * 2)) == 6
    assert moving_thrusters(np.stack([moving] * 6)) == 6
    assert moving_thrusters(np.stack([*[moving] * 6, still, moving])) == 6  # a camera's tilt
    assert moving_thrusters(np.stack([moving] * 8)) == 8
    assert moving_thrusters(np.stack([moving] * 5 + [still] * 3)) == 8  # not all were used
