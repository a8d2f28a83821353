"""Positions and velocities all in another unit of length, told by the commands."""

import numpy as np
import pytest
from recordings_changed import changed

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.checks.commands import command_findings
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.checks.hypotheses import Driven
from spinndrift.models.recordings.checks.lengths import fitted, length_findings
from spinndrift.models.recordings.checks.response import LAGS_S, AxisResponse
from spinndrift.models.recordings.conventions import LENGTHS
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import import_log

HEAVY, SITL = load_vehicle("bluerov2_heavy"), load_vehicle("ardusub_sitl")


@pytest.fixture(scope="module")
def dive() -> Recording:
    return import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0].cut(0.0, 30.0)


def in_unit(recording: Recording, size: float) -> Recording:
    scale = np.where(np.arange(7) < 4, 1.0, 1 / size)
    moved = changed(recording, "X_WB", lambda X: X * scale)
    return changed(moved, "V_WB_B", lambda V: V * np.where(np.arange(6) < 3, 1 / size, 1.0))


@pytest.mark.parametrize(
    "unit", ["feet", "cm", *(pytest.param(u, marks=pytest.mark.slow) for u in ("inches", "mm"))]
)
@pytest.mark.parametrize("vehicle", [HEAVY, pytest.param(SITL, marks=pytest.mark.slow)])
def test_all_lengths_in_another_unit(dive, unit, vehicle):
    """Also with numbers of a vehicle that is three times as heavy: thrust then explains it too."""
    (found,) = command_findings(in_unit(dive, LENGTHS[unit]), vehicle)
    assert found.word == "length-unit" or (found.word, unit) == ("length-doubtful", "feet")
    assert unit in found.text


def test_speeds_beyond_a_vehicle_that_the_commands_explain_are_a_unit_and_no_failure(dive):
    with pytest.raises(UserError, match=r"all positions and velocities look like cm.*length-unit"):
        examine(in_unit(dive, 0.01), HEAVY, "dive.nc")


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("name", ["mass", "added_mass", "quadratic_damping", "thrust"])
def test_other_numbers_of_the_vehicle_are_no_unit(name, factor):
    """Exact responses of a body whose numbers, or thrust, are not those of the file."""
    rigid = np.array((HEAVY.mass,) * 3 + HEAVY.inertia)
    added, drag = np.array(HEAVY.added_mass), np.array(HEAVY.quadratic_damping)
    one = np.where(np.arange(6) < 3, factor, 1.0)  # of translation only, the worst case
    m = rigid * (one if name == "mass" else 1) + added * (one if name == "added_mass" else 1)
    e = drag * (one if name == "quadratic_damping" else 1)
    assert length_findings(exact(m, e, 1 / factor if name == "thrust" else 1.0), HEAVY) == []


def exact(m, e, gain) -> Driven:
    """400 windows of independent v̇, v, |v| v, and the commands that make them."""
    rng = np.random.default_rng(0)
    axes = {}
    for i in range(6):
        R = rng.standard_normal((400, 3))
        F = gain * (R @ [m[i], HEAVY.linear_damping[i], e[i]])[:, None] * np.eye(6)[i]
        L = LAGS_S.size
        axes[i] = AxisResponse(
            R.T @ R, np.stack([R.T @ F] * L), np.stack([F.T @ F] * L), 100.0, len(R)
        )
    mass = np.array((HEAVY.mass,) * 3 + HEAVY.inertia) + HEAVY.added_mass
    needed = dict.fromkeys(range(6), 1.0)
    return Driven(axes, np.eye(6), tuple("XYZKMN"), needed, needed, dict(enumerate(mass.tolist())))


def test_fitted_numbers_are_those_of_the_motion():
    data = exact(np.arange(1.0, 7.0), np.full(6, 3.0), 1.0)
    for i, r in data.axes.items():
        found, _ = fitted(r, data.weights[i])
        np.testing.assert_allclose(found, [i + 1.0, HEAVY.linear_damping[i], 3.0], rtol=1e-6)
