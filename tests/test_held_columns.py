"""One of two vertical thrusters of six whose record stands still: its partner tells, and roll."""

import numpy as np
import pytest
from hidden.rotations import from_rpy
from hidden.simulator import Noise, Setup, simulate
from hidden.vehicle import Vehicle as Truth
from hidden.write import runs, write_folder
from recordings_changed import changed

from spinndrift.models.recordings.checks.commands import command_findings
from spinndrift.models.recordings.checks.held_columns import _factors
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle

SIX, HEAVY = load_vehicle("bluerov2"), load_vehicle("bluerov2_heavy")


def dive(folder, gains) -> Recording:
    """Four runs of 20 s of another simulator: multisines of surge, sway, heave and yaw by a mixer.

    `gains` of each thruster's command.
    """
    mounts = SIX.propulsion.mounts
    truth = Truth(
        mass=SIX.mass,
        inertia=np.diag(SIX.inertia),
        weight=SIX.weight,
        buoyancy=SIX.buoyancy,
        r_b=np.array(SIX.center_of_buoyancy),
        added_mass=np.diag(SIX.added_mass),
        linear=np.array(SIX.linear_damping),
        quadratic=np.array(SIX.quadratic_damping),
        positions=np.array([mount.position for mount in mounts]).T,
        directions=np.array([mount.direction for mount in mounts]).T,
    )
    B, N, dt = 4, 401, 0.05
    rng = np.random.default_rng(2)
    t = dt * np.arange(N)[:, None, None]
    rate, phase = rng.uniform(0.4, 2.5, (2, 4, B, 8)), rng.uniform(0, 2 * np.pi, (4, B, 8))
    axes = np.sin(rate[0] * t[..., None] + phase).sum(axis=-1)  # (N, 4, B)
    mixer = np.sign(np.asarray(SIX.thrusters().allocation)[[0, 1, 2, 5]]).T
    commands = np.einsum("ma,nab->nmb", mixer * [1, 1, 1, 0.5], 2 * axes)
    setup = Setup(
        p0=np.array([[0.0], [0.0], [-5.0]]) + np.zeros((3, B)),
        q0=from_rpy(np.zeros(B), np.zeros(B), rng.uniform(-np.pi, np.pi, B)),
        nu0=np.zeros((6, B)),
        samples=np.repeat(3 * np.arange(N)[:, None], B, axis=1),
        commands=commands * np.array(gains)[:, None],
        voltage=np.full(B, 16.0),
        h=dt / 3,
    )
    made = simulate(setup, noise=Noise(), seed=3, vehicle=truth)
    write_folder(folder, runs(made, ["dive"] * B, "f", made.forces), "bluerov2")
    return read_csv(folder)


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> Recording:
    return dive(tmp_path_factory.mktemp("driven") / "data", np.ones(6))


@pytest.mark.parametrize("thruster", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_a_vertical_thruster_that_stands_still_in_the_record_alone(driven, thruster):
    """It heaves, and the moment in roll that its partner alone would make is not there."""
    assert command_findings(driven, SIX) == []

    def held(f):
        return np.where(np.arange(6) == thruster - 1, 0.0, f)

    (found,) = command_findings(changed(driven, "thruster_force", held), SIX)
    assert found.word == "output-held"
    assert f"thruster {thruster}" in found.text


def test_a_vertical_thruster_that_did_stand_still_is_no_finding(tmp_path):
    """Then the vehicle rolls."""
    assert command_findings(dive(tmp_path / "data", [1, 1, 1, 1, 0, 1]), SIX) == []


def test_the_mixer_leaves_open_what_two_thrusters_drive_alone():
    none = np.zeros((0, 5)), np.zeros(0)
    weights = np.asarray(SIX.thrusters().allocation)
    found = {axis: factors for factors, axis in _factors(*none, weights, 4)}
    np.testing.assert_allclose(found[3], [0, 0, 0, 0, 1], atol=1e-9)  # no roll: as thruster 6
    np.testing.assert_allclose(found[2], [0, 0, 0, 0, -1], atol=1e-9)  # no heave: its opposite
    eight = np.asarray(HEAVY.thrusters().allocation)
    ((factors, axis),) = _factors(np.zeros((0, 7)), np.zeros(0), eight, 4)
    assert axis is None
    assert np.count_nonzero(np.abs(factors) > 1e-9) == 3
