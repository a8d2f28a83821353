"""The standard BlueROV2: six thrusters, pitch not actuated; diagnosed and flown like any other."""

import jax.numpy as jnp
import numpy as np
import pytest
from hidden.rotations import from_rpy
from hidden.simulator import Noise, Setup, simulate
from hidden.vehicle import Vehicle as Truth
from hidden.write import runs, write_folder

from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import dump
from spinndrift.models.recordings.csv import read_csv, write_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.cli import main
from spinndrift.sims.run.folder import report_page, run_metrics
from spinndrift.sims.run.loop import simulate as fly
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.plant.wrench_limits import ThrusterLimits
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.data.maneuvers import maneuver_wrench
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, Diagnoser

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2")
WEAK, LOST = 3, 0.4  # number of the thruster, share of its force


def hidden(tmp_path):
    """Runs of another simulator whose third thruster gives too little, in the CSV form."""
    mounts = VEHICLE.propulsion.mounts
    directions = np.array([mount.direction for mount in mounts]).T
    directions[:, WEAK - 1] *= 1 - LOST
    truth = Truth(
        mass=VEHICLE.mass,
        inertia=np.diag(VEHICLE.inertia),
        weight=VEHICLE.weight,
        buoyancy=VEHICLE.buoyancy,
        r_b=np.array(VEHICLE.center_of_buoyancy),
        added_mass=np.diag(VEHICLE.added_mass),
        linear=np.array(VEHICLE.linear_damping),
        quadratic=np.array(VEHICLE.quadratic_damping),
        positions=np.array([mount.position for mount in mounts]).T,
        directions=directions,
    )
    rng = np.random.default_rng(4)
    B, N, h = 8, 121, 0.005
    hold = 8  # samples of 0.05 s for which a command is held
    levels = rng.uniform(-8, 8, (N // hold + 1, 6, B))
    setup = Setup(
        p0=np.array([[0.0], [0.0], [-3.0]]) + np.zeros((3, B)),
        q0=from_rpy(np.zeros(B), np.zeros(B), rng.uniform(-np.pi, np.pi, B)),
        nu0=np.zeros((6, B)),
        samples=np.repeat(10 * np.arange(N)[:, None], B, axis=1),
        commands=np.repeat(levels, hold, axis=0)[:N],
        voltage=np.full(B, 16.0),
        h=h,
    )
    made = simulate(setup, noise=Noise(), seed=3, vehicle=truth)
    names = [f"steps {k // 2}" for k in range(B)]
    write_folder(tmp_path / "data", runs(made, names, "f", made.forces), "bluerov2")
    return read_csv(tmp_path / "data")


@pytest.mark.slow
def test_a_weak_thruster_of_six_is_found(tmp_path):
    recording = hidden(tmp_path)
    config = DiagnoseConfig(most=1, horizon=2.0)
    finding = Diagnoser(recording, VEHICLE, config=config).run()
    (cause,) = finding.diagnosis.causes
    assert (cause.name, cause.where) == ("thruster_gain", str(WEAK))
    gain = cause.parameters["gain"]
    error = (gain.interval95[1] - gain.interval95[0]) / 3.92
    assert abs(gain.value + LOST) < 3 * error + 1e-3
    (effect,) = finding.extended.effects
    assert effect.places == ("1", "2", "3", "4", "5", "6")


@pytest.fixture(name="flown", scope="module")
def _flown():
    change = "{station: {vehicle: bluerov2}, duration: 20, log: {samples: false}}"
    return fly(load_scenario("station_keeping_calm", change), engine="compiled")


def test_six_thrusters_keep_station(flown):
    """By the scenario's own criterion; pitch is commanded in vain, and buoyancy restores it."""
    values = run_metrics(flown)
    assert values["outcome"]["success"], values["outcome"]["words"]
    assert flown.log["pwm"].shape[1] == 6
    qw, qx, qy, qz = flown.log["X_WB"][:, :4].T
    pitch = np.degrees(np.arcsin(2 * (qw * qy - qx * qz)))
    assert np.abs(pitch).max() < 10
    assert "actuate pitch" in report_page(flown, values).html()


def test_what_is_not_actuated_is_told():
    assert VEHICLE.limitation() == "The thrusters of bluerov2 can't actuate pitch."
    assert load_vehicle("bluerov2_heavy").limitation() == ""
    limits = ThrusterLimits.create(VEHICLE.thrusters())
    axes = np.asarray(limits.axes())
    assert axes[4] == 0
    assert np.all(np.delete(axes, 4) > 1)
    wanted = jnp.array([5.0, -3.0, 4.0, 0.2, 1.5, 0.4])
    np.testing.assert_allclose(limits.clip(wanted), wanted.at[4].set(0), atol=1e-9)


FIVE = """
  mounts:
    - {position: [0.0, 0.1, 0.0], direction: [1.0, 0.0, 0.0]}
    - {position: [0.0, -0.1, 0.0], direction: [1.0, 0.0, 0.0]}
    - {position: [0.2, 0.1, 0.0], direction: [0.0, 0.0, 1.0]}
    - {position: [0.2, -0.1, 0.0], direction: [0.0, 0.0, 1.0]}
    - {position: [-0.2, 0.0, 0.0], direction: [0.0, 0.0, 1.0]}
"""


@pytest.mark.slow
def test_a_vehicle_that_cannot_sway_says_so(tmp_path, capsys):
    """Five thrusters, two of them ahead and three upright."""
    text = dump(VEHICLE)
    first, last = text.index("  mounts:"), text.index("  curve:")
    text = text[:first] + FIVE.strip("\n") + "\n" + text[last:]
    (tmp_path / "five.yaml").write_text(text.replace("name: bluerov2", "name: five"))
    vehicle = load_vehicle(tmp_path / "five.yaml")
    assert vehicle.unactuated == ("sway",)
    with pytest.raises(UserError, match="maneuver 'sway-left': the thrusters can't actuate sway"):
        maneuver_wrench("sway-left", vehicle.thrusters(), 0.5)
    wrench, forces = maneuver_wrench("surge-sway-heave", vehicle.thrusters(), 0.5)
    assert wrench[1] == 0
    assert forces.shape == (5,)
    given = f"{{station: {{vehicle: {tmp_path / 'five.yaml'}}}, duration: 0.5}}"
    scenario = ["station_keeping_calm", "--scenario-text", given, "--no-report"]
    main(["run", *scenario, "--out", str(tmp_path / "run")])
    told = " ".join(capsys.readouterr().err.split())
    assert "The thrusters of five can't actuate sway." in told


def test_forces_of_six_go_through_csv(tmp_path):
    config = GenerateConfig(trajectories=1, duration=1.0, maneuvers=("surge-yaw-left", "heave-up"))
    made = generate(config, VEHICLE)
    write_csv(made, tmp_path / "csv")
    again = read_csv(tmp_path / "csv")
    header = next((tmp_path / "csv").glob("*.csv")).read_text().splitlines()[0]
    assert [f"f{k}" for k in range(1, 7)] == [n for n in header.split(",") if n.startswith("f")]
    assert again.vehicle == "bluerov2"
    for name in ("thruster_force", "X_WB", "V_WB_B"):
        first, second = (r.dataset[name].to_numpy() for r in (made, again))
        np.testing.assert_allclose(second, first, rtol=1e-11, atol=1e-11)
    force, _ = again.thrust()
    assert force.shape[-1] == 6
