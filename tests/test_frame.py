"""What kind of vehicle a log is of."""

import numpy as np
import pytest
from log_writers import dialect, dive, heartbeat
from recordings_changed import changed

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.systems.logs.frame import firmware_findings, settled
from spinndrift.systems.logs.load import import_log

BOARD = "PX4: 8d505a02 NuttX: 1a99ba58"


def saying(*texts, maker=3):
    log = dive(duration=8.0)
    if maker != 3:
        log.records = [r for r in log.records if r[1][7:10] != b"\0\0\0"]
        for t in np.arange(100.0, 108.0):
            log.send(t, heartbeat(autopilot=maker))
    for text in texts:
        log.send(100.5, dialect.MAVLink_statustext_message(6, text.encode()))
    return log.bytes()


def test_the_board_of_an_older_ardusub_is_no_firmware(tmp_path):
    """ArduPilot up to 3.5 names the drivers of a Pixhawk PX4 and NuttX."""
    path = tmp_path / "dive.tlog"
    for texts in (("ArduSub V3.5.4 (f2ca1e3c)", BOARD), (BOARD,)):
        path.write_bytes(saying(*texts))
        assert import_log(path)[0].vehicle == "bluerov2_heavy"
    path.write_bytes(saying(BOARD, maker=12))
    with pytest.raises(UserError, match="its autopilot is PX4"):
        import_log(path)


@pytest.mark.parametrize("own", ["ArduSub V3.5.4 (f2ca1e3c)", "APM:Sub V3.5-dev"])
def test_firmware_is_what_names_itself(own):
    assert firmware_findings("MSG", [BOARD, own]) == []
    assert firmware_findings("MSG", [BOARD], 3) == []
    for other in ("ArduCopter V4.3.6", "Rover V4.2"):
        (found,) = firmware_findings("MSG", [BOARD, other], 3)
        assert other in found.text
    (found,) = firmware_findings("MSG", [BOARD])
    assert found.word == "not-a-submarine"


@pytest.fixture(scope="module")
def recorded():
    """The packaged dive: none of its outputs is reversed, whatever a parameter says."""
    return import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0].cut(0.0, 40.0)


@pytest.mark.parametrize("turned", [(1, 2), (1, 2, 3, 4), (5, 6, 7, 8), (2, 5)])
def test_the_motion_decides_on_outputs_that_are_reversed_together(recorded, turned):
    """Two mirrored thrusters may look like other faults than themselves, as a reversed axis."""
    signs = np.where(np.isin(np.arange(1, 9), turned), -1, 1)
    mirrored = changed(recorded, "pwm", lambda pwm: 1500 + signs * (pwm - 1500))
    restored, found = settled(mirrored, turned)
    np.testing.assert_allclose(
        restored.dataset["pwm"].to_numpy(), recorded.dataset["pwm"].to_numpy()
    )
    assert [f.place for f in found] == [f"SERVO{k}_REVERSED of thruster {k}" for k in turned]
    assert all("the motion says that it is not" in f.text for f in found)


@pytest.mark.parametrize("turned", [(1, 2), (1, 2, 3, 4), (5, 6, 7, 8), (2, 5)])
def test_outputs_that_are_reversed_stay_mirrored(recorded, turned):
    kept, found = settled(recorded, turned)
    assert kept.dataset["pwm"].equals(recorded.dataset["pwm"])
    assert all("its PWM is mirrored" in f.text for f in found)
