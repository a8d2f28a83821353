"""Outputs that stand still in the record alone: one thruster's column, or all of them."""

import numpy as np
import pytest
from recordings_changed import changed

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.checks.commands import command_findings
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.checks.held_outputs import stands
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import import_log

HEAVY = load_vehicle("bluerov2_heavy")


@pytest.fixture(scope="module")
def dive() -> Recording:
    """A minute of each stretch of the packaged dive: all axes, then thruster by thruster."""
    return import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0].cut(0.0, 60.0)


def held(thruster, value, part=slice(None)):
    """Pulses of a thruster (from 1) that stand still at a value in a part of each run."""

    def change(pwm):
        pwm = pwm.copy()
        pwm[:, :, part, thruster - 1] = value
        return pwm

    return change


def test_stretches_that_stand_still_are_much_longer_than_the_usual_holds():
    x = np.repeat(np.arange(100.0), 10)[:, None]
    assert not stands(x, 0.05).any()
    x[300:450] = 7.0
    np.testing.assert_array_equal(np.flatnonzero(stands(x, 0.05)), np.arange(300, 450))
    assert stands(np.ones((100, 2)), 0.05).all()


@pytest.mark.parametrize(
    ("thruster", "value"),
    [(3, 1580.0), *(pytest.param(k, 1500.0, marks=pytest.mark.slow) for k in (1, 6))],
)
def test_a_column_that_stands_still_while_the_motion_shows_its_thrust(dive, thruster, value):
    stuck = changed(dive.select(dive.scenarios[0]), "pwm", held(thruster, value))
    (found,) = command_findings(stuck, HEAVY)
    assert found.word == "output-held"
    assert f"thruster {thruster}" in found.text
    with pytest.raises(UserError, match=rf"thruster {thruster}.*--accept output-held"):
        examine(stuck, HEAVY, "dive.nc")


def test_a_column_that_stands_still_in_a_part(dive):
    """The others tell what it was, by how they went together where it moved."""
    first = dive.select(dive.scenarios[0])
    (found,) = command_findings(changed(first, "pwm", held(4, 1533.0, slice(600, None))), HEAVY)
    assert found.word == "output-held"
    start = float(first.dataset["start_time"][0, 0])
    assert f"{start + 30:.1f} to" in found.place


def test_a_thruster_that_is_not_driven_is_no_finding(dive):
    """In the second stretch thrusters are driven one after another: the others stand still."""
    assert command_findings(dive.select(dive.scenarios[1]), HEAVY) == []


def test_a_stretch_in_which_all_commands_stand_still_is_left_out(dive):
    first = dive.select(dive.scenarios[0])

    def lost(pwm):
        pwm = pwm.copy()
        pwm[:, :, 400:700] = pwm[:, :, 400:401]
        return pwm

    seen = examine(changed(first, "pwm", lost), HEAVY, "dive.nc")
    (found,) = findings_of(seen.dataset)
    assert found.word == "commands-held"
    start = float(first.dataset["start_time"][0, 0])
    assert f"{start + 20:.1f} to {start + 35:.1f} s" in found.place
    np.testing.assert_array_equal(seen.lengths, [[400, 500]])


def test_a_vehicle_that_coasts_is_no_lost_record(dive):
    """Under a constant command, or none, inertia and drag balance: a simulated body at 20 Hz."""
    first = dive.select(dive.scenarios[0])
    dt, n = first.dt, first.mask.shape[2]
    V = first.dataset["V_WB_B"].to_numpy().copy()
    m, d = HEAVY.mass + HEAVY.added_mass[0], HEAVY.linear_damping[0]
    V[0, 0, 400:700, 0] = V[0, 0, 400, 0] * np.exp(-d / m * dt * np.arange(300))
    V[0, 0, 400:700, 1:] = V[0, 0, 400, 1:] * np.exp(-dt * np.arange(300))[:, None]
    coasting = changed(first, "V_WB_B", lambda _: V)
    still = changed(coasting, "pwm", lambda pwm: np.where(
        ((np.arange(n) >= 400) & (np.arange(n) < 700))[:, None], 1500.0, pwm
    ))  # fmt: skip
    found = findings_of(examine(still, HEAVY, "dive.nc", ["output-held"]).dataset)
    assert "commands-held" not in [f.word for f in found]


def test_commands_that_never_change_are_refused(dive):
    constant = changed(dive.select(dive.scenarios[0]), "pwm", lambda pwm: np.full_like(pwm, 1560.0))
    with pytest.raises(UserError, match=r"no command ever changes.*--accept output-held"):
        examine(constant, HEAVY, "dive.nc")
