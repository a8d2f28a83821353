"""Columns of commands that are exchanged from some time on, with nothing that tells of it."""

import numpy as np
import pytest
from recordings_changed import as_wrench, changed

from helpers import ROOT
from spinndrift.models.recordings.checks.commands import command_findings
from spinndrift.models.recordings.checks.response import responses, responses_along
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import import_log

HEAVY = load_vehicle("bluerov2_heavy")
AFTER_S = 30.0


@pytest.fixture(scope="module")
def dive() -> Recording:
    whole = import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0]
    return whole.select(whole.scenarios[0]).cut(0.0, 70.0)


def exchanged(a, b, part):
    """Columns a and b exchanged in a part of each run."""

    def change(values):
        found = values.copy()
        found[:, :, part, a], found[:, :, part, b] = values[:, :, part, b], values[:, :, part, a]
        return found

    return change


@pytest.mark.parametrize("late", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_channels_that_are_exchanged_in_a_part_are_named_with_the_time(dive, late):
    n = round(AFTER_S / dive.dt)
    part = slice(n, None) if late else slice(n)
    (found,) = command_findings(changed(dive, "pwm", exchanged(4, 6, part)), HEAVY)
    assert found.word == "thruster-exchanged"
    assert "pwm5, pwm7" in found.place
    at = float(dive.dataset["start_time"][0, 0]) + AFTER_S
    # blocks of 5 s begin at multiples of them, so the change is at the edge of one
    assert (f"from {at:.0f} s on" if late else f"until {at:.0f} s") in found.place
    assert "in this part of the record alone" in found.text


@pytest.mark.slow
def test_columns_of_a_wrench_that_are_exchanged_in_a_part(dive):
    wrench = as_wrench(dive, HEAVY)
    part = slice(round(AFTER_S / dive.dt), None)
    (found,) = command_findings(changed(wrench, "F_Bo_B", exchanged(0, 1, part)), HEAVY)
    assert found.word == "columns-exchanged"
    assert " s on" in found.place


def test_columns_that_are_exchanged_throughout_have_no_time(dive):
    (found,) = command_findings(changed(dive, "pwm", exchanged(4, 6, slice(None))), HEAVY)
    assert found.place == "columns pwm5, pwm7"


def test_responses_of_blocks_add_up_to_those_of_the_whole(dive):
    forces, _ = dive.thrust(HEAVY)
    whole = responses(dive, forces, dive.command_period)
    blocks = responses_along(dive, forces, dive.command_period, 5.0)
    assert [sample for _, sample, _ in blocks] == [100 * n for n in range(len(blocks))]
    for i, r in whole.items():
        for name in ("RR", "RC", "CC", "count", "windows"):
            total = sum(np.asarray(getattr(axes[i], name)) for _, _, axes in blocks)
            np.testing.assert_allclose(total, getattr(r, name), rtol=1e-9)
