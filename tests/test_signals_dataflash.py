"""The filter that flew, where a log has the records of two."""

import log_writers
import numpy as np
import pytest
from log_writers import PARAMETERS, dataflash

from spinndrift.systems.logs.load import import_log
from spinndrift.systems.logs.signals_dataflash import one_filter
from spinndrift.systems.logs.table import Table


def tables(*names, kind=None):
    found = {name: Table(name, {"t": np.zeros(1)}) for name in names}
    if kind is not None:
        named, value = np.array([b"AHRS_EKF_TYPE"]), np.array([float(kind)])
        found["PARM"] = Table("PARM", {"Name": named, "Value": value})
    return found


BOTH = ("NKF1", "NKF4", "NKQ1", "XKF1", "XKF4", "XKQ1")
OF_2 = {"XKF1": "NKF1", "XKF4": "NKF4", "XKQ": "NKQ1"}
OF_3 = {"XKF1": "XKF1", "XKF4": "XKF4", "XKQ": "XKQ1"}


@pytest.mark.parametrize(
    ("given", "taken"),
    [
        (tables(*BOTH, kind=2), OF_2),
        (tables(*BOTH, kind=3), OF_3),
        (tables(*BOTH), OF_3),
        (tables("NKF1", "NKQ", kind=3), {"XKF1": "NKF1", "XKQ": "NKQ"}),
        (tables("NKF1", "NKF4", "NKQ1", "XKQ1", kind=2), OF_2),
        (tables("NKF1", "XKF1", "XKQ", kind=2), {"XKF1": "NKF1"}),  # no attitude of another filter
        (tables("NKQ", "XKF1", "XKF4"), {"XKF1": "XKF1", "XKF4": "XKF4"}),
        (tables("XKQ"), {"XKQ": "XKQ"}),
        (tables("ATT"), {"ATT": "ATT"}),
    ],
)
def test_all_records_are_of_one_filter(given, taken):
    found = one_filter(given)
    assert {new: table.name for new, table in found.items() if new != "PARM"} == taken


def test_the_attitude_is_that_of_the_filter_that_flew(tmp_path, monkeypatch):
    """EKF2 flew; EKF3 ran beside it, and says that the vehicle never turned."""
    path = tmp_path / "dive.BIN"
    path.write_bytes(dataflash(duration=8.0).bytes())
    expected, _ = import_log(path)
    monkeypatch.setattr(log_writers, "PARAMETERS", PARAMETERS | {"AHRS_EKF_TYPE": 2.0})
    monkeypatch.setitem(log_writers._FORMATS, "XKQ1", (150, "Qffff", "TimeUS,Q1,Q2,Q3,Q4"))
    log = dataflash(duration=8.0)
    for t in 100.0 + np.arange(0, 8, 0.01):
        log.write("XKQ1", round(t * 1e6), 1.0, 0.0, 0.0, 0.0)
    data = log.bytes()
    for old, new in ((b"XKF1", b"NKF1"), (b"XKF4", b"NKF4"), (b"XKQ\0", b"NKQ\0")):
        data = data.replace(old, new)
    path.write_bytes(data)
    found, _ = import_log(path)
    for name in ("X_WB", "V_WB_B"):
        np.testing.assert_array_equal(found.dataset[name], expected.dataset[name])
