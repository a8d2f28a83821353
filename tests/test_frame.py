"""What kind of vehicle a log is of."""

import numpy as np
import pytest
from log_writers import dialect, dive, heartbeat

from spinndrift.models.config.errors import UserError
from spinndrift.systems.logs.frame import firmware_findings
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
