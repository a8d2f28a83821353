"""Which barometer is the water's, by its name, its parameters and the height."""

import log_writers
import numpy as np
import pytest
from log_writers import PARAMETERS, dataflash, dialect, dive, ned, truth

from spinndrift.systems.logs.load import import_log
from spinndrift.systems.logs.pressure import followed
from spinndrift.systems.logs.signals import Series, parameters_of

BAROMETER = "QffcfIff", "TimeUS,Alt,Press,Temp,CRt,SMS,Offset,GndTemp"
LAKE_PA = 97000.0
FORMER = {"GND_SPEC_GRAV": 1.02, "GND_ABS_PRESS": 103000.0, "GND_ABS_PRESS2": LAKE_PA}
NEW = {"BARO_SPEC_GRAV": 1.02, "BARO1_GND_PRESS": 103000.0, "BARO2_GND_PRESS": LAKE_PA}


def imported(folder, log, name="dive.tlog", **options):
    path = folder / name
    path.write_bytes(log.bytes())
    recording, report = import_log(path, **options)
    run = next(recording.trajectories())
    depth = run.sensors.get("pressure_depth")
    height = truth(run.start + recording.dt * np.arange(len(run)))[0][6]
    return depth, -height, report


def close(depth, expected):
    there = np.isfinite(depth)
    assert there.mean() > 0.4
    np.testing.assert_allclose(depth[there], expected[there], atol=0.01)


def test_former_names_of_parameters_are_todays():
    def read(parameters):
        names = np.array([name.encode() for name in parameters], object)
        return parameters_of(np.zeros(len(parameters)), names, np.array([*parameters.values()]))

    former, strange = read(FORMER | {"GND_ABS_PRESS3": 1.0})
    assert {p.name: p.value for p in former} == NEW | {"BARO3_GND_PRESS": 1.0}
    assert strange == []
    assert "BARO_SPEC_GRAV 7" in read({"GND_SPEC_GRAV": 7.0})[1][0]


@pytest.mark.parametrize("parameters", [FORMER, NEW])
def test_surface_pressure_and_gravity_by_former_names(tmp_path, parameters):
    log = dive(parameters={k: v for k, v in PARAMETERS.items() if "BARO" not in k} | parameters)
    water = dialect.MAVLINK_MSG_ID_SCALED_PRESSURE2
    log.records = [r for r in log.records if int.from_bytes(r[1][7:10], "little") != water]
    for t, (_, p, _, _) in zip(times := 100 + np.arange(0, 20, 0.1), ned(times), strict=True):
        hPa = LAKE_PA / 100 + 98 * 1.02 * float(p[2])
        log.send(t, dialect.MAVLink_scaled_pressure2_message(round(t * 1e3), hPa, 0.0, 1200))
    depth, expected, _ = imported(tmp_path, log)
    close(depth, expected)


def autopilots_own(monkeypatch, names, parameters):
    """A DataFlash log with records of named barometers: hull first, then the water's."""
    monkeypatch.setattr(log_writers, "PARAMETERS", PARAMETERS | parameters)
    for number, name in enumerate(names):
        monkeypatch.setitem(log_writers._FORMATS, name, (140 + number, *BAROMETER))
    log = dataflash()
    for t, (_, p, _, _) in zip(times := 100 + np.arange(0, 20, 0.1), ned(times), strict=True):
        water = LAKE_PA + 9800.0 * 1.02 * float(p[2])
        for name, pascal in zip(names, (103000.0, water), strict=False):
            log.write(name, round(t * 1e6), 0.0, pascal, 25.0, 0.0, 0, 0.0, 25.0)
    log.parts.sort(key=lambda part: 0 if part[2] == 128 else int.from_bytes(part[3:11], "little"))
    return log


def test_the_second_barometer_of_an_older_dataflash_log_is_the_waters(tmp_path, monkeypatch):
    """Up to ArduSub 4.0: BARO in the hull, BAR2 in the water, and no instance."""
    log = autopilots_own(monkeypatch, ("BARO", "BAR2"), FORMER)
    depth, expected, report = imported(tmp_path, log, "dive.BIN")
    close(depth, expected)
    assert "Depth by pressure from BAR2" in str(report)


def test_a_barometer_in_the_hull_is_no_depth(tmp_path, monkeypatch):
    depth, _, report = imported(tmp_path, autopilots_own(monkeypatch, ("BARO",), {}), "dive.BIN")
    assert depth is None
    assert "BARO changes by 0 % of the estimated height's change" in str(report)


def test_a_depth_is_compared_with_the_height_where_it_moves():
    t = np.arange(0, 60, 0.1)
    z = -3 + np.sin(0.3 * t)

    def position(x):
        return Series(t, np.stack([np.full(t.size, np.nan)] * 2 + [x]), "estimate")

    water, hull = Series(t, -1.03 * z, "water"), Series(t, np.full(t.size, 1.7), "hull")
    found = followed(water, position(z))
    assert (found.depth, found.told, found.sure) == (water, (), True)
    assert followed(water, position(z + 10.0 * (t > 30))).depth is water  # a reset of the estimate
    found = followed(hull, position(z))
    assert found.depth is None
    assert "hull changes by 0 %" in found.told[0]
    slow = followed(Series(t, 0.02 * t, "slow"), position(-0.02 * t))
    assert slow.sure
    idle = position(0.12 * np.random.default_rng(2).standard_normal(t.size))
    for unknown in (None, idle, position(0.05 * z), position(np.full(t.size, np.nan))):
        found = followed(hull, unknown)
        assert (found.depth, found.sure) == (hull, False)


@pytest.mark.parametrize(("unit", "size"), [("feet", 0.3048), ("cm", 0.01), ("mm", 0.001)])
def test_units_of_height_and_depth_are_named(unit, size):
    """A pressure is in Pa for sure, so the height is in the unit; a number may be in any."""
    t = np.arange(0, 60, 0.1)
    z = -8 + np.sin(0.3 * t)
    height = Series(t, np.stack([np.full(t.size, np.nan)] * 2 + [z]), "estimate")
    wrong = Series(t, height.x / size, "estimate")
    (found,) = followed(Series(t, -z, "pressure"), wrong).findings
    assert found.word == "motion-contradiction"
    assert f"estimate looks like {unit}" in found.text
    seen = followed(Series(t, -z / size, "/depth"), height, pressed=False)
    assert seen.depth is None
    assert f"look like {unit}" in seen.findings[0].text
    assert f"`scale: {size:g}`" in seen.findings[0].remedy
    hull = followed(Series(t, -0.01 * z, "hull"), height)  # gives way, and follows the depth
    assert (hull.depth, hull.findings) == (None, ())
