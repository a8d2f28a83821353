"""Presets are sourced, physical, and reach the speeds that their numbers promise."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import dump, loads
from spinndrift.models.config.yaml_text import Tagged, parse
from spinndrift.models.integrate import rollout
from spinndrift.models.vehicles.vehicle import Vehicle, load_vehicle, vehicle_names

VEHICLES = {name: load_vehicle(name) for name in vehicle_names()}
AXES = {"surge": (0, 1), "sway": (1, 1), "down": (2, -1), "up": (2, 1), "yaw": (5, 1)}

every = pytest.mark.parametrize("name", VEHICLES)
run = eqx.filter_jit(rollout)
SUBSTEPS = 5  # at full yaw the simulated ArduSub relaxes within 7 ms: I / (2 d r) at 2.7 rad/s


def reach(vehicle, axis, sign, volts=16.0):
    """Largest wrench component along an axis in N or N·m."""
    thrusters = vehicle.thrusters()
    F = thrusters.wrench(thrusters.allocate(jnp.zeros(6).at[axis].set(1e4 * sign), volts))
    np.testing.assert_allclose(jnp.delete(F, axis), 0, atol=1e-9)
    return abs(float(F[axis]))


def terminal(vehicle, axis, push):
    """Positive root of drag = push: d |v| v + l v = push."""
    l, d = vehicle.linear_damping[axis], vehicle.quadratic_damping[axis]
    return (-l + np.sqrt(l * l + 4 * d * push)) / (2 * d)


# ------------------------------------------------------------------------------------------ presets


def test_presets_are_there():
    wanted = ["_von_benzon", "_ng", "_eiva", "_ignition"]
    assert {"bluerov2_heavy", "bluerov2", "ardusub_sitl"} <= set(VEHICLES)
    assert {f"bluerov2_heavy{end}" for end in wanted} <= set(VEHICLES)


@every
def test_every_number_has_a_source(name):
    vehicle = VEHICLES[name]
    assert vehicle.name == name

    def numbers(value, path):
        if isinstance(value, Tagged):
            value = value.value
        if isinstance(value, dict):
            for key, part in value.items():
                yield from numbers(part, (*path, key))
        elif isinstance(value, list):
            for part in value:
                yield from numbers(part, path)
        elif isinstance(value, float | int):
            yield path

    plain = parse(dump(vehicle), name)[0]
    sourced = set(plain.pop("sources"))
    paths = set(numbers(plain, ()))
    assert len(paths) > 15
    for path in paths:
        above = {".".join(path[:end]) for end in range(1, len(path) + 1)}
        assert above & sourced, f"{'.'.join(path)} has no source"
    assert all(len(text) > 3 for text in vehicle.sources.values())


@every
def test_round_trip_through_yaml(name):
    assert loads(Vehicle, dump(VEHICLES[name])) == VEHICLES[name]


@every
def test_mass_is_symmetric_positive_and_drag_dissipates(name):
    dynamics = VEHICLES[name].dynamics()
    V = jnp.asarray(np.random.default_rng(0).normal(size=(6, 1000)) * 3)
    M = np.asarray(dynamics.coefficients(V).mass.matrix())
    np.testing.assert_array_equal(M, M.T)
    assert np.linalg.eigvalsh(M)[0] > 0
    assert jnp.all(jnp.sum(V * dynamics.drag_wrench(V), axis=0) < 0)  # νᵀ D(ν) ν > 0


@every
def test_coriolis_matrix_is_skew(name):
    dynamics = VEHICLES[name].dynamics()
    basis = jnp.eye(6)
    for V in jnp.asarray(np.random.default_rng(1).normal(size=(5, 6))):
        momentum = dynamics.coefficients(V).mass.matvec(V)
        C = -se3.coad_apply(basis, jnp.broadcast_to(momentum[:, None], (6, 6)))
        np.testing.assert_allclose(C, -C.T, atol=1e-12)
        assert float(jnp.max(jnp.abs(C))) > 0.1


# ------------------------------------------------------------------------------- speeds and periods


@every
def test_simulated_terminal_speeds_balance_drag_and_thrust(name):
    vehicle = dataclasses.replace(VEHICLES[name], buoyancy=VEHICLES[name].weight)
    pushes = np.array([reach(vehicle, axis, sign) for axis, sign in AXES.values()])
    speeds = [
        terminal(vehicle, axis, push) for (axis, _), push in zip(AXES.values(), pushes, strict=True)
    ]
    F, expected = np.zeros((6, len(AXES))), np.zeros((6, len(AXES)))
    for k, (axis, sign) in enumerate(AXES.values()):
        F[axis, k], expected[axis, k] = sign * pushes[k], sign * speeds[k]
    X = jnp.broadcast_to(se3.identity(jnp.float64)[:, None], (7, len(AXES)))
    held = jnp.broadcast_to(jnp.asarray(F), (1500, *F.shape))
    _, V = run(vehicle.dynamics(), X, jnp.zeros_like(F), held, 0.02, substeps=SUBSTEPS)
    np.testing.assert_allclose(V[-1], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "surge"),
    [
        ("bluerov2_heavy_von_benzon", (0.91, 0.84, 0.76)),
        ("bluerov2", (2.56, 2.37, 2.14)),
        ("bluerov2_heavy_ng", (1.51, 1.37, 1.20)),
        ("bluerov2_heavy_ignition", (1.49, 1.38, 1.25)),
        ("bluerov2_heavy_eiva", (1.92, 1.78, 1.62)),
    ],
)
def test_surge_of_published_sets(name, surge):
    """At 16, 14 and 12 V; computed by hand from the sets and the maker's thrust, to two digits."""
    vehicle = VEHICLES[name]
    for volts, speed in zip((16.0, 14.0, 12.0), surge, strict=True):
        assert terminal(vehicle, 0, reach(vehicle, 0, 1, volts)) == pytest.approx(speed, abs=0.011)


def test_default_vehicle_is_plausible():
    vehicle = VEHICLES["bluerov2_heavy"]
    net = vehicle.buoyancy - vehicle.weight
    speed = {
        key: terminal(vehicle, axis, reach(vehicle, axis, sign) + (sign * net if axis == 2 else 0))
        for key, (axis, sign) in AXES.items()
    }
    assert speed["surge"] == pytest.approx(1.5, rel=0.1)  # maker: about 3 kn
    assert 0.7 < speed["sway"] < speed["surge"]  # broader abeam than ahead
    assert 0.7 < speed["up"] < speed["surge"]
    assert 0.7 < speed["down"] < speed["surge"]
    assert 1.5 < speed["yaw"] < 4.0
    assert 1 <= net <= 4  # N: ballasted to float up slowly
    displaced = vehicle.buoyancy / (9.80665 * vehicle.water_density)
    assert displaced < np.prod(vehicle.size)


def test_default_vehicle_rolls_with_its_period():
    # without net buoyancy: a vehicle that rises sways as it rolls, and swings 3 % faster for it
    vehicle = VEHICLES["bluerov2_heavy"]
    vehicle = dataclasses.replace(vehicle, buoyancy=vehicle.weight)
    stiffness = vehicle.buoyancy * vehicle.center_of_buoyancy[2]
    period = 2 * np.pi * np.sqrt((vehicle.inertia[0] + vehicle.added_mass[3]) / stiffness)
    assert 1.3 < period < 4.0
    X = se3.from_position_rpy(jnp.zeros(3), jnp.array([0.02, 0.0, 0.0]))
    steps = 4000
    Xs, _ = run(vehicle.dynamics(), X, jnp.zeros(6), jnp.zeros((steps, 6)), 0.002)
    roll = np.asarray(se3.rpy(jnp.moveaxis(Xs, 0, 1))[0])
    crossings = np.flatnonzero(np.diff(np.sign(roll)))
    seen = 2 * 0.002 * np.mean(np.diff(crossings))
    assert seen == pytest.approx(period, rel=0.01)  # light damping lengthens it by about ζ²/2


def test_simulated_ardusub_reaches_the_speeds_measured_on_the_wire():
    vehicle = VEHICLES["ardusub_sitl"]
    thrusters = vehicle.thrusters()
    ahead = jnp.array([1100.0, 1100, 1900, 1900, 1500, 1500, 1500, 1500])
    right = jnp.array(
        [1900.0, 1100, 1100, 1900, 1500, 1500, 1500, 1500]
    )  # yaw clockwise from above
    F = thrusters.wrench(thrusters.force(jnp.stack([ahead, right], axis=1)))
    F = F.at[2].add(vehicle.weight - vehicle.buoyancy)  # depth held
    X = jnp.broadcast_to(se3.identity(jnp.float64)[:, None], (7, 2))
    held = jnp.broadcast_to(F, (1000, 6, 2))
    _, V = run(vehicle.dynamics(), X, jnp.zeros((6, 2)), held, 0.02, substeps=SUBSTEPS)
    assert float(V[-1, 0, 0]) == pytest.approx(2.06, abs=0.01)
    assert float(V[-1, 5, 1]) == pytest.approx(-2.70, abs=0.01)
    np.testing.assert_allclose(F[:, 0], [4 * 51.48, 0, 0.0 + F[2, 0], 0, 0, 0], atol=1e-9)
    # accelerations from rest: 51.48 N / 10.5 kg per thruster, 51.48 N × 0.25 m / 0.2681 kg m²
    dV = vehicle.dynamics().acceleration(X, jnp.zeros((6, 2)), F)
    assert float(dV[0, 0]) == pytest.approx(4 * 51.48 / 10.5)
    assert float(dV[5, 1]) == pytest.approx(-4 * 51.48 * 0.25 / 0.2681)


def test_simulated_ardusub_rights_itself_and_floats_up_as_written():
    dynamics = VEHICLES["ardusub_sitl"].dynamics()
    X = se3.from_position_rpy(jnp.zeros(3), jnp.array([np.pi / 2, 0.0, 0.0]))
    wrench = dynamics.potential_wrench(X)
    assert float(wrench[3]) == pytest.approx(-6.0, rel=1e-4)  # 40 N × 0.15 m
    up = dynamics.acceleration(se3.identity(jnp.float64), jnp.zeros(6), jnp.zeros(6))
    np.testing.assert_allclose(up, [0, 0, 0.0597, 0, 0, 0], atol=1e-4)


# ------------------------------------------------------------------------------------- reading them


def test_precision_and_diffusion_are_taken_over():
    vehicle = VEHICLES["bluerov2_heavy"]
    dynamics = vehicle.dynamics(diffusion=np.arange(6.0), dtype=jnp.float32)
    assert dynamics.diffusion.dtype == jnp.float32
    np.testing.assert_array_equal(dynamics.diffusion, np.arange(6))
    assert vehicle.thrusters(jnp.float32).allocation.dtype == jnp.float32
    assert vehicle.thrusters().allocation.shape == (6, 8)


def test_own_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(dump(dataclasses.replace(VEHICLES["bluerov2_heavy"], mass=14.0)))
    assert load_vehicle(path).mass == 14.0
    assert load_vehicle(str(path)).mass == 14.0
    with pytest.raises(UserError, match=r"vehicle `\S*other\.yaml`: there is no such file"):
        load_vehicle(tmp_path / "other.yaml")
    with pytest.raises(UserError, match="`bluerov3` is no preset; take one of ardusub_sitl"):
        load_vehicle("bluerov3")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": -1.0}, r"mass.*positive"),
        ({"mass": float("nan")}, r"mass.*finite"),
        ({"added_mass": (-6.0, 0.0, 0.0, 0.0, 0.0, 0.0)}, r"added_mass.*magnitudes"),
        ({"inertia": (0.1, 0.1, 0.9)}, r"inertia.*moment"),
        ({"size": (0.4, 0.5, 0.0)}, r"size"),
        (
            {"propulsion": dataclasses.replace(VEHICLES["bluerov2"].propulsion, mounts=())},
            "mounts has 0",
        ),
    ],
)
def test_impossible_vehicles_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(VEHICLES["bluerov2_heavy"], **change)


def test_fault_in_a_file_is_named_with_its_line():
    text = dump(VEHICLES["bluerov2_heavy"]).replace("mass: 13.5", "mass: heavy")
    with pytest.raises(
        UserError, match=r"mine\.yaml:\d+: mass: found `heavy` \(text\); write a number"
    ):
        loads(Vehicle, text, "mine.yaml")
