"""The simulator that hides effects for the diagnosis is right by itself."""

import ast
import sys
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest
from hidden import effects_actuation as actuation
from hidden import effects_body as body
from hidden import effects_disturbance as disturbance
from hidden import effects_environment as environment
from hidden import effects_unknown as unknown
from hidden import rotations, t200
from hidden.blind import DATA
from hidden.draw import TWINS, Case, draw, table
from hidden.effect import Effect, Moment
from hidden.effects import CAUSES, UNKNOWN, draw_effect
from hidden.faults import FAULTS, spoil
from hidden.instruments import low_pass
from hidden.oracle import predict, recorded_errors, share, windows_of
from hidden.plant import Plant
from hidden.scenarios import Plan, allocate, build, pulses
from hidden.simulator import Noise, Setup, simulate
from hidden.telemetry import BOOT, Streams, write_tlog
from hidden.vehicle import GRAVITY, Vehicle
from hidden.write import write_folder

from helpers import ROOT, run_python
from spinndrift.models.config.errors import UserError
from spinndrift.models.dynamics import Flow
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.thruster_curves import RESTING
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import load_data

SMALL = Plan(scenarios=4, runs=1, seconds=2.0, h=0.01)
EVERYTHING = [*CAUSES, *UNKNOWN]


def free(**changes) -> Vehicle:
    """A vehicle without drag, weight and restoring moment."""
    lost = {"linear": np.zeros(6), "quadratic": np.zeros(6), "r_b": np.zeros(3)}
    return Vehicle().but(**({"buoyancy": Vehicle().weight} | lost | changes))


def setup(nu0, seconds: float, h: float, thrust=None, samples: int = 2, q0=None) -> Setup:
    """Runs from the origin under constant thrust (8,), sampled evenly."""
    B = nu0.shape[1]
    q0 = rotations.from_rpy(*np.zeros((3, B))) if q0 is None else q0
    at = np.linspace(0, round(seconds / h), samples).round().astype(int)
    commands = np.zeros((samples, 8, B)) + (0 if thrust is None else thrust[:, None])
    p0 = np.zeros((3, B)) - np.array([0, 0, 5.0])[:, None]
    return Setup(p0, q0, nu0, at[:, None] + np.zeros(B, int), commands, np.full(B, 16.0), h)


def some_speeds(batch: int = 3) -> np.ndarray:
    size = np.array([0.5, 0.4, 0.3, 0.4, 0.3, 0.5])[:, None]
    return size * np.random.default_rng(1).uniform(0.5, 1, (6, batch))


# ------------------------------------------------------------------------------- independence


def test_it_imports_numpy_and_the_standard_library_alone():
    allowed = {"numpy", *sys.stdlib_module_names}
    for path in (ROOT / "tests" / "hidden").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            assert all(name.split(".")[0] in allowed for name in names), (path.name, names)
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import hidden.draw, hidden.oracle; "
        "print([m for m in sys.modules if m.split('.')[0] in ('spinndrift', 'jax', 'xarray')])"
    )
    assert run_python(code, str(ROOT / "tests")).strip() == "[]"


def test_its_nominal_numbers_are_the_default_preset():
    believed, true = load_vehicle("bluerov2_heavy"), Vehicle()
    assert (believed.mass, believed.weight, believed.buoyancy) == (13.5, true.weight, true.buoyancy)
    np.testing.assert_array_equal(np.diag(believed.inertia), true.inertia)
    np.testing.assert_array_equal(believed.center_of_buoyancy, true.r_b)
    np.testing.assert_array_equal(np.diag(believed.added_mass), true.added_mass)
    np.testing.assert_array_equal(believed.linear_damping, true.linear)
    np.testing.assert_array_equal(believed.quadratic_damping, true.quadratic)
    mounts = believed.propulsion.mounts
    np.testing.assert_allclose(np.array([m.position for m in mounts]).T, true.positions)
    np.testing.assert_allclose(np.array([m.direction for m in mounts]).T, true.directions, 1e-8)


def test_every_name_of_a_cause_is_there():
    assert len(CAUSES) == 35
    assert all(name == kind.cause for name, kind in CAUSES.items())
    assert set(TWINS) <= set(CAUSES)


# ------------------------------------------------------------------------------------ physics


def test_allocation_has_the_signs_of_ardusubs_factors():
    # AP_Motors6DOF.cpp, VECTORED_6DOF: roll, pitch, yaw, throttle (up), forward, lateral.
    factors = np.array(
        [
            [0, 0, 1, 0, -1, 1],
            [0, 0, -1, 0, -1, -1],
            [0, 0, -1, 0, 1, 1],
            [0, 0, 1, 0, 1, -1],
            [1, -1, 0, -1, 0, 0],
            [-1, -1, 0, -1, 0, 0],
            [1, 1, 0, -1, 0, 0],
            [-1, 1, 0, -1, 0, 0],
        ]
    )
    X, Y, Z, K, M, N = Vehicle().allocation()
    # ArduSub counts starboard, nose up and clockwise yaw; here y is to port.
    assert np.array_equal(np.sign(np.stack([X, -Y, Z]).round(6)).T, factors[:, [4, 5, 3]])
    vertical = np.s_[4:]
    assert np.array_equal(np.sign(np.stack([K, -M])[:, vertical]).T, factors[vertical, :2])
    assert np.array_equal(np.sign(-N[:4]), factors[:4, 2])
    wrench = np.array([5.0, -3.0, 4.0, 0.5, -0.4, 1.0])
    np.testing.assert_allclose(Vehicle().allocation() @ allocate(wrench), wrench, atol=1e-12)


def test_energy_is_kept_without_drag():
    arm, extra = np.array([0.02, -0.03, 0.04]), np.zeros((6, 6))
    extra[1, 5] = extra[5, 1] = 0.5
    vehicle = free(r_g=arm, r_b=-arm, buoyancy=120.0, added_mass=Vehicle().added_mass + extra)
    truth = simulate(setup(some_speeds(), 4.0, 0.005, samples=9), (), Noise.none(), vehicle=vehicle)
    q, p, nu = truth.X_true[:, :4], truth.X_true[:, 4:], truth.V_true
    up = rotations.up_in_body(np.moveaxis(q, 1, 0))
    height = [p[:, 2] + np.tensordot(r, up, 1) for r in (vehicle.r_g, vehicle.r_b)]
    mass = vehicle.rigid_mass() + vehicle.added_mass
    energy = 0.5 * np.einsum("nib,ij,njb->nb", nu, mass, nu)
    kinetic = np.ptp(energy)
    energy += vehicle.weight * height[0] - vehicle.buoyancy * height[1]
    assert np.ptp(energy, axis=0).max() < 1e-7 * kinetic


@pytest.mark.parametrize("axis", [0, 1, 2, 5])
def test_terminal_speed_balances_drag(axis):
    force = 2.0 if axis == 5 else 20.0
    vehicle = Vehicle().but(buoyancy=Vehicle().weight)
    thrust = allocate(force * np.eye(6)[axis])
    truth = simulate(setup(np.zeros((6, 1)), 20.0, 0.01, thrust), (), Noise.none(), vehicle=vehicle)
    d1, d2 = vehicle.linear[axis], vehicle.quadratic[axis]
    speed = (-d1 + np.sqrt(d1**2 + 4 * d2 * force)) / (2 * d2)
    assert truth.V_true[-1, axis, 0] == pytest.approx(speed, rel=1e-6)


def test_a_steady_current_only_carries_everything_along():
    nu0, q0 = some_speeds(), rotations.from_rpy(*0.3 * np.arange(9.0).reshape(3, 3))
    current = environment.CurrentSteady(0.3, -0.2)
    v_c = np.array([0.3, -0.2, 0.0])[:, None] + np.zeros((3, 3))
    moved = nu0.copy()
    moved[:3] += rotations.to_body(q0, v_c)
    thrust = allocate(np.array([10.0, 5.0, -4.0, 0.3, 0.4, 1.0]))
    still = simulate(setup(nu0, 3.0, 0.01, thrust, 4, q0), (), Noise.none())
    carried = simulate(setup(moved, 3.0, 0.01, thrust, 4, q0), [current], Noise.none())
    drift = (still.t + 0.2)[:, None] * v_c
    np.testing.assert_allclose(carried.X_true[:, :4], still.X_true[:, :4], atol=1e-7)
    np.testing.assert_allclose(carried.X_true[:, 4:], still.X_true[:, 4:] + drift, atol=1e-7)


def test_without_noise_the_order_is_four():
    # Smooth: |ν|ν is not where an axis turns.
    vehicle = Vehicle().but(quadratic=np.zeros(6), linear=np.array([20.0, 25, 40, 2, 2, 2]))
    hidden = [environment.Waves(0.3, 2.5, 0.4), actuation.ThrusterLag(None, 0.15)]
    hidden += [unknown.Memory(1, 30.0), unknown.Swirl(0.2, 0.1, 0.2)]
    thrust = allocate(np.array([15.0, 8.0, 5.0, 0.4, 0.3, 1.0]))

    def end(h: float) -> np.ndarray:
        run = setup(some_speeds(), 2.0, h, thrust)
        return simulate(run, hidden, Noise.none(), vehicle=vehicle).states[-1, :13]

    exact = end(0.005)
    errors = [np.abs(end(h) - exact).max() for h in (0.1, 0.05)]
    assert np.log2(errors[0] / errors[1]) > 3.7


def test_with_additive_noise_the_strong_order_is_one():
    plant, rng = Plant(Vehicle(), ()), np.random.default_rng(2)
    b, B, fine = np.array(Noise().diffusion)[:, None], 100, 512
    halves = np.sqrt(1.28 / fine / 2) * rng.standard_normal((2 * fine, 6, B))
    thrust = allocate(np.array([10.0, 5.0, 4.0, 0.3, 0.2, 1.0]))[:, None] + np.zeros(B)

    def end(every: int) -> np.ndarray:
        y = np.zeros((13, B))
        y[3], h = 1.0, 1.28 * every / fine
        for k in range(0, 2 * fine, 2 * every):
            y = plant.kick(y, 0.0, b, halves[k : k + every].sum(axis=0), {})
            y = plant.step(y, 0.0, h, thrust, {})
            y = plant.kick(y, 0.0, b, halves[k + every : k + 2 * every].sum(axis=0), {})
        return y

    exact = end(1)
    errors = [np.sqrt(np.mean((end(k) - exact) ** 2)) for k in (64, 32, 16)]
    assert np.all(np.log2(errors[:-1]) - np.log2(errors[1:]) > 0.85)


def test_white_wrench_and_instruments_have_their_size():
    noise, vehicle = Noise(), free()
    truth = simulate(setup(np.zeros((6, 500)), 0.5, 0.01, samples=6), (), noise, vehicle=vehicle)
    impulse = np.einsum("ij,jb->ib", vehicle.rigid_mass() + vehicle.added_mass, truth.V_true[-1])
    expected = np.array(noise.diffusion) * np.sqrt(0.7)  # 0.5 s and the lead
    np.testing.assert_allclose(impulse.std(axis=1), expected, rtol=5 / np.sqrt(2 * 500))
    np.testing.assert_allclose((truth.V - truth.V_true)[:, :3].std(), noise.velocity, rtol=0.05)
    np.testing.assert_allclose((truth.V - truth.V_true)[:, 3:].std(), noise.rate, rtol=0.05)
    gap = (truth.X - truth.X_true)[:, 4:]
    np.testing.assert_allclose(gap.std(), noise.position, rtol=0.05)


def test_t200_goes_through_the_makers_figures_and_back():
    table = t200.thrust(np.array([1100.0, 1472, 1500, 1528, 1700, 1900]), 16.0) / GRAVITY
    np.testing.assert_allclose(table, [-4.07, 0, 0, 0, 1.82, 5.25], atol=1e-12)
    np.testing.assert_allclose(t200.thrust(np.array([1900.0]), 15.0) / GRAVITY, [4.885])
    force = np.linspace(-30, 40, 71)
    np.testing.assert_allclose(t200.thrust(t200.pulse(force, 14.6), 14.6), force, atol=0.12)


# -------------------------------------------------------------------------- effects, by hand


def changed_wrench(effect: Effect, y: np.ndarray, steady: np.ndarray, t: float = 0.0) -> np.ndarray:
    """What an effect adds to M ν̇ at a state."""
    without, with_it = Plant(Vehicle(), ()), Plant(Vehicle(), [effect])
    rates = []
    for plant in (without, with_it):
        own = np.zeros((plant.size, y.shape[1]))
        own[:13] = y
        latents = {i: e.draw_latent(y.shape[1], None) for i, e in enumerate(plant.effects)}
        volts = np.full(y.shape[1], 14.0)
        rates.append(plant.rates(own, t, plant.steady_thrust(steady, volts), latents)[7:13])
    mass = Vehicle().rigid_mass() + Vehicle().added_mass
    return (mass @ (rates[1] - rates[0]))[:, 0]


U, SWAY, HEAVE, P, Q, R = 0.6, -0.3, 0.2, 0.1, -0.4, 0.5
BY_HAND = [
    (actuation.DeadZone(1, 2.0), {"f1": 10.0 - 2.0}),
    (actuation.DeadZone(1, 2.0, jump=True), {"f1": 10.0}),
    (actuation.ThrustCurve(1, 1.5), {"f1": 40 * (10 / 40) ** 1.5}),
    (actuation.ThrustAsymmetry(2, 0.8), {"f2": -0.8 * 8.0}),
    (actuation.ThrustAsymmetry(1, 0.8), {"f1": 10.0}),
    (actuation.ThrusterGain(2, -1.0), {"f2": 8.0}),
    (actuation.ThrustScale(0.9), {"f1": 9.0, "f2": -7.2}),
    (actuation.VoltageSag(2.0), {"f1": 10 * (14 / 16) ** 2, "f2": -8 * (14 / 16) ** 2}),
    (
        actuation.LoadDroop(0.05),
        {
            f"f{i}": f * (1 - 0.05 * 0.0625 * (10**1.5 + 8**1.5) / 16) ** 1.24
            for i, f in ((1, 10.0), (2, -8.0))
        },
    ),
    (body.NetBuoyancy(2.0), {"heave": 2.0}),
    (body.LinearDrag(0, 3.0), {"surge": -3.0 * U}),
    (body.QuadraticDrag(1, 10.0), {"sway": 10.0 * SWAY**2}),
    (body.DragAsymmetry(1, 0.2), {"sway": -0.2 * 75.3 * SWAY**2}),
    (body.CubicDrag(5, 2.0), {"yaw": -2.0 * R**3}),
    (body.Lift(2, 8.0), {"heave": 8.0 * U**2}),
    (
        body.Proximity("bottom", -6.0, 2.0, 0.5),
        {
            name: -2.0 * np.exp(-2.0) * (d1 + d2 * abs(v)) * v
            for name, d1, d2, v in zip(
                ("surge", "sway", "heave", "roll", "pitch", "yaw"),
                Vehicle().linear,
                Vehicle().quadratic,
                (U, SWAY, HEAVE, P, Q, R),
                strict=True,
            )
        },
    ),
    (environment.Tether(0.5, (3.0, -2.0, -5.0), (0.0, 0.0, 0.0)), {"surge": 1.5, "sway": -1.0}),
    (
        environment.Tether(0.5, (0.0, 0.0, -3.0), (-0.2, 0.0, 0.0)),
        {"surge": 0.1, "heave": 1.0, "pitch": 0.2},
    ),
]


@pytest.mark.parametrize(("effect", "told"), BY_HAND, ids=lambda x: getattr(x, "cause", ""))
def test_a_wrench_is_what_the_equation_says(effect, told):
    y = np.zeros((13, 1))
    y[2], y[3], y[7:, 0] = -5.0, 1.0, (U, SWAY, HEAVE, P, Q, R)
    steady = np.zeros((8, 1))
    steady[0], steady[1] = 10.0, -8.0
    expected = np.zeros(6)
    for name, value in told.items():
        if name.startswith("f"):
            i = int(name[1]) - 1
            expected += Vehicle().allocation()[:, i] * (value - steady[i, 0])
        else:
            axes = ("surge", "sway", "heave", "roll", "pitch", "yaw")
            expected[axes.index(name)] += value
    np.testing.assert_allclose(changed_wrench(effect, y, steady), expected, atol=1e-10)


def test_inflow_takes_from_a_thruster_that_moves_its_own_way():
    y = np.zeros((13, 1))
    y[3], y[7] = 1.0, 0.5
    steady = np.zeros((8, 1))
    steady[2] = 16.0  # rear right pushes forward at 45°
    wrench = changed_wrench(actuation.InflowThrustLoss(None, 0.6), y, steady)
    lost = 0.6 * 4.0 * 0.5 * np.sqrt(0.5)
    np.testing.assert_allclose(wrench, -lost * Vehicle().allocation()[:, 2], atol=1e-12)


def test_weight_ahead_turns_the_nose_down_and_a_load_adds_mass_and_weight():
    y, zero = np.zeros((13, 1)), np.zeros((8, 1))
    y[3] = 1.0
    plant = Plant(Vehicle(), [body.CentreOfGravity(0, 0.01)])
    wrench = (plant.rigid + plant.added) @ plant.rates(y, 0.0, zero, {0: {}})[7:13]
    nominal = np.array([0, 0, 2.0, 0, Vehicle().weight * 0.01, 0])
    np.testing.assert_allclose(wrench[:, 0], nominal, atol=1e-9)
    load = body.Payload(1.0, (0.1, -0.05, -0.12), 2700.0)
    plant = Plant(Vehicle(), [load])
    wrench = ((plant.rigid + plant.added) @ plant.rates(y, 0.0, zero, {0: {}})[7:13])[:, 0]
    w = load.parameters()["weight_in_water"]["value"]
    np.testing.assert_allclose(wrench, [0, 0, 2 - w, 0.05 * w, 0.1 * w, 0], atol=1e-9)
    extra = plant.rigid + plant.added - Vehicle().rigid_mass() - Vehicle().added_mass
    total = 1.0 + 0.5 * 1025 / 2700
    r = rotations.skew(np.array(load.position))
    lump = np.block([[np.eye(3), -r], [r, -r @ r]])
    np.testing.assert_allclose(extra, total * lump, atol=1e-12)


def test_a_drag_lever_only_takes_energy():
    rng = np.random.default_rng(3)
    y = np.zeros((13, 200))
    y[3], y[7:] = 1.0, rng.standard_normal((6, 200))
    for axis, towards in [(0, 2), (1, 0), (1, 2), (2, 0)]:
        effect = body.DragCoupling(axis, towards, 0.05)
        plant = Plant(Vehicle(), [effect])
        wrench = (plant.rigid + plant.added) @ plant.rates(y, 0.0, np.zeros((8, 200)), {0: {}})[
            7:13
        ]
        gravity = Plant(free(), ())
        rest = (gravity.rigid + gravity.added) @ gravity.rates(y, 0.0, np.zeros((8, 200)), {})[7:13]
        power = np.sum(y[7:] * (wrench - rest), axis=0) - 2.0 * y[9] - 0 * y[10]
        assert power.max() < 0
    quiet = np.zeros((13, 1))
    quiet[3], quiet[7] = 1.0, 0.5
    moment = changed_wrench(body.DragCoupling(0, 2, 0.03), quiet, np.zeros((8, 1)))
    drag = 4.03 * 0.5 + 58.42 * 0.25
    np.testing.assert_allclose(moment, [0, 0, 0, 0, -0.03 * drag, 0], atol=1e-12)
    told = body.DragCoupling(0, 2, 0.03).parameters()["coefficient"]["value"]
    assert told == pytest.approx(0.03 * 58.42)  # M = -c |u| u


def test_waves_and_eddies_move_as_water_does():
    rng = np.random.default_rng(4)
    p, h = rng.uniform(-1, 1, (3, 20)) - np.array([0, 0, 3.0])[:, None], 1e-5
    wave, phase = environment.Waves(0.2, 3.0, 0.7), {"phase": rng.uniform(0, 6, 20)}
    eddy = unknown.Swirl(0.1, -0.2, 0.3, 0.8)

    def jacobian(effect, latent):
        columns = []
        for i in range(3):
            e = h * np.eye(3)[i][:, None]
            columns.append(
                (effect.flow(p + e, 1.0, latent)[0] - effect.flow(p - e, 1.0, latent)[0]) / (2 * h)
            )
        return np.stack(columns, axis=1)  # (component, direction, point)

    for effect, latent in ((wave, phase), (eddy, {})):
        assert np.abs(np.trace(jacobian(effect, latent))).max() < 1e-9
    J = jacobian(wave, phase)
    np.testing.assert_allclose(J, J.transpose(1, 0, 2), atol=1e-9)  # no vorticity
    later, sooner = (wave.flow(p, 1.0 + s * h, phase)[0] for s in (1, -1))
    np.testing.assert_allclose((later - sooner) / (2 * h), wave.flow(p, 1.0, phase)[1], atol=1e-8)
    v, a = eddy.flow(p, 0.0, {})
    np.testing.assert_allclose(np.einsum("ijn,jn->in", jacobian(eddy, {}), v), a, atol=1e-8)


def test_memory_is_a_convolution_and_the_appendage_an_oscillator():
    effect, h, n = unknown.Memory(0, 10.0, 1.2, 0.4), 0.002, 1500
    t = h * np.arange(n + 1)
    speed = np.sin(1.3 * t) + 0.3
    zero = np.zeros((3, 1))

    def moment(v: float) -> Moment:
        nu = np.full((6, 1), v)
        return Moment(0.0, zero, np.zeros((4, 1)), nu, zero, nu, Vehicle())

    z = np.zeros((2, 1))
    for k in range(n):  # midpoint rule
        mid = z + 0.5 * h * effect.derivative(moment(speed[k]), zero, {}, z)
        z = z + h * effect.derivative(moment(0.5 * (speed[k] + speed[k + 1])), zero, {}, mid)
    s = t[-1] - t
    kernel = 10.0 * np.exp(-s / 1.2) * np.cos(2 * np.pi * 0.4 * s)
    expected = -np.trapezoid(kernel * speed, dx=h)
    assert effect.wrench(moment(0.0), {}, z)[0, 0] == pytest.approx(expected, rel=1e-4)
    hung = unknown.Appendage(0, 2.0, 1.0, 0.05, (0, 0, 0))
    a = np.array([[0.3], [0], [0], [0], [0], [0]])
    state = np.array([[-0.3 / (2 * np.pi) ** 2], [0.0]])
    still = moment(0.0)
    np.testing.assert_allclose(hung.derivative(still, a, {}, state), 0, atol=1e-15)
    assert hung.wrench(still, {}, state)[0, 0] == pytest.approx(-2.0 * 0.3)  # its inertia


def test_random_effects_have_their_law():
    rng, B = np.random.default_rng(5), 20000
    for effect, name in (
        (environment.CurrentVarying(0.2, 8.0), "v"),
        (disturbance.DisturbanceColour(1.0, 2.0), "w"),
    ):
        start = effect.draw_latent(B, rng)
        later = effect.advance(start, 1.5, rng)
        size = 0.2 if name == "v" else 1.0
        np.testing.assert_allclose(later[name].std(axis=1), size, rtol=0.03)
        alike = np.mean(start[name] * later[name], axis=1) / size**2
        np.testing.assert_allclose(alike, np.exp(-1.5 / effect.time_constant), atol=0.04)
    knocks = disturbance.DisturbanceImpacts(2.0, 0.5).impulse(B, 0.5, rng)
    assert knocks is not None
    hit = np.any(knocks != 0, axis=0)
    assert hit.mean() == pytest.approx(1 - np.exp(-0.25), rel=0.05)
    assert knocks[:3, hit].std() == pytest.approx(2.0, rel=0.03)
    grown = disturbance.DisturbanceStateDependence(3.0)
    nu = np.array([0.3, 0.4, 0, 0, 0, 1.0])[:, None]
    np.testing.assert_allclose(grown.diffusion(np.ones((6, 1)), nu), 2.5)


# ------------------------------------------------------------------------------ effects, data


@pytest.fixture(scope="module")
def null():
    return Case(1, (), SMALL).simulate()


def test_neutral_values_change_no_bit(null):
    neutral = [kind() for kind in (*CAUSES.values(), *UNKNOWN.values(), body.MunkMoment)]
    assert all(effect.neutral() for effect in neutral)
    same = Case(1, tuple(neutral), SMALL).simulate()
    for name in ("X", "V", "forces", "X_true"):
        assert np.array_equal(getattr(same, name), getattr(null, name))


@pytest.mark.parametrize("name", EVERYTHING)
def test_an_effect_is_seen_where_it_should_and_vanishes_with_its_size(null, name):
    case = draw(1, names=(name,), plan=SMALL)
    (effect,) = case.effects
    assert not effect.neutral()
    truth = case.simulate()
    motion = np.abs(truth.states[:, :13] - null.states[:, :13]).max()
    told = {
        "pose": np.abs(truth.X - null.X).max(),
        "linear": np.abs(truth.V - null.V)[:, :3].max(),
        "angular": np.abs(truth.V - null.V)[:, 3:].max(),
    }
    seen = {key for key, size in told.items() if size > 0.002}
    only = {
        "dvl_lever_arm": {"linear"},
        "dvl_misalignment": {"linear"},
        "dvl_scale": {"linear"},
        "gyro_bias": {"angular"},
        "clock_offset": set(effect.shift()),
        "heading_error": {"pose"},
    }
    if name in only:
        assert motion == 0
        assert seen == only[name]
    else:
        assert motion > 0.005
        assert "linear" in seen or "angular" in seen
    tiny = draw(1, names=(name,), plan=SMALL, size=1e-6).simulate()
    assert np.abs(tiny.V - null.V).max() < 1e-4
    assert np.abs(tiny.X - null.X).max() < 1e-4


def test_late_instruments_show_the_past():
    for effect in (draw_effect("clock_offset", np.random.default_rng(k), 1.0) for k in range(3)):
        fine = Case(2, (effect,), Plan(2, 1, 2.0, h=0.01), Noise.none())
        late, now = fine.simulate(), Case(2, (), fine.plan, Noise.none()).simulate()
        assert np.array_equal(late.X_true, now.X_true)
        d = effect.parameters()["offset"]["value"]
        grid = 0.01 * np.arange(now.states.shape[0]) - 0.2
        rows = {"linear": (slice(7, 10), slice(0, 3)), "angular": (slice(10, 13), slice(3, 6))}
        for channel in set(effect.shift()) & set(rows):
            of, to = rows[channel]
            for b in range(2):
                for i, j in zip(range(13)[of], range(6)[to], strict=True):
                    past = np.interp(late.t[:, b] - d, grid, now.states[:, i, b])
                    np.testing.assert_allclose(late.V[:, j, b], past, atol=1e-12)


# ---------------------------------------------------------------------------- files and cases


@pytest.mark.parametrize("form", ["f", "pwm", "wrench"])
@pytest.mark.parametrize("loop", ["open", "closed"])
def test_files_read_back(tmp_path, form, loop):
    case = Case(3, (), Plan(scenarios=2, runs=2, seconds=3.0, form=form, loop=loop))
    case.write(tmp_path / "data")
    recording = read_csv(tmp_path / "data")
    truth = case.simulate()
    X = recording.dataset["X_WB"].values.reshape(4, 61, 7)
    V = recording.dataset["V_WB_B"].values.reshape(4, 61, 6)
    np.testing.assert_allclose(np.abs(X), np.abs(truth.X.transpose(2, 0, 1)), atol=1e-8)
    np.testing.assert_allclose(V, truth.V.transpose(2, 0, 1), atol=1e-8)
    wrench = np.asarray(recording.wrench().values).reshape(4, 61, 6)
    nominal = truth.forces.transpose(2, 0, 1) @ case.vehicle().allocation().T
    resting = 8 * RESTING if form == "pwm" else 0.0  # what a curve says of thrusters at rest
    np.testing.assert_allclose(wrench, nominal, atol=1e-6 + resting)
    assert len(set(recording.dataset["scenario"].values.tolist())) == 2


def test_uneven_and_dead_reckoned_files_read_back(tmp_path):
    plan = Plan(scenarios=2, runs=2, seconds=3.0, even=False, dead_reckoned=True)
    logged = Case(3, (), plan).write(tmp_path / "data")
    assert np.ptp(np.diff(logged[0].columns["t"])) > 0.03
    assert read_csv(tmp_path / "data").dt == pytest.approx(0.05)


def test_a_seed_gives_the_same_files(tmp_path):
    plan = Plan(scenarios=2, runs=2, seconds=2.0)
    for name in ("a", "b"):
        draw(5, "pair", plan=plan).write(tmp_path / name)
    draw(6, "pair", plan=plan).write(tmp_path / "c")
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert all(
        (tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files
    )
    assert (tmp_path / "a" / files[-1]).read_bytes() != (tmp_path / "c" / files[-1]).read_bytes()


def test_repetitions_share_commands_and_turn_by_quarters():
    made = build(Plan(scenarios=3, runs=5, seconds=1.0), 4)
    commands = made.setup.commands
    assert isinstance(commands, np.ndarray)
    assert np.array_equal(commands[:, :, 0], commands[:, :, 4])
    assert not np.array_equal(commands[:, :, 0], commands[:, :, 5])
    yaw = rotations.heading(made.setup.q0)
    turns = np.angle(np.exp(1j * (yaw[:5] - yaw[0])))
    np.testing.assert_allclose(np.exp(1j * turns), [1, 1j, -1, -1j, 1], atol=0.01)


def test_every_axis_and_thruster_moves_and_idle_ones_do_not():
    truth = Case(1, (), Plan(runs=1)).simulate()
    assert np.sqrt((truth.V_true**2).mean(axis=(0, 2))).min() > 0.1
    assert np.abs(truth.forces).max(axis=(0, 2)).min() > 8
    idle = Case(1, (), Plan(runs=1, seconds=2.0, idle=(1, 5))).simulate()
    wrench = np.einsum("ij,njb->nib", Vehicle().allocation(), idle.forces)
    assert np.abs(wrench[:, [1, 5]]).max() < 1e-9
    assert np.abs(wrench[:, 0]).max() > 5


def test_closed_loop_follows_its_reference():
    case = Case(1, (), Plan(scenarios=4, runs=2, seconds=6.0, loop="closed"))
    truth = case.simulate()
    assert np.abs(truth.X_true[:, 4:6] - truth.X_true[:1, 4:6]).max() > 0.5
    assert np.abs(truth.V_true).max() < 3
    assert not np.array_equal(truth.forces[:, :, 0], truth.forces[:, :, 1])


def test_answers_speak_the_diagnosis_words():
    assert draw(1, "null").answer() == {"verdict": "adequate", "causes": []}
    for kind, count in (("single", 1), ("pair", 2), ("triple", 3)):
        for seed in range(20):
            answer = draw(seed, kind).answer()
            assert len(answer["causes"]) == count
            assert answer["verdict"] == "explained"
            for cause in answer["causes"]:
                assert cause["name"] in CAUSES
                assert cause["where"]
                assert all({"value", "unit"} == set(p) for p in cause["parameters"].values())
    answer = draw(1, "unknown").answer()
    assert answer["verdict"] == "unexplained"
    assert answer["causes"][0]["name"] == "unknown"


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_faults_spoil_what_they_say(tmp_path, fault):
    logged = Case(3, (), Plan(scenarios=2, runs=2, seconds=8.0, h=0.01)).logged()
    spoilt, told = spoil(logged, fault, 2)
    assert len(told) == 1
    bad = int(told[0]["file"][4:7]) - 1
    assert [a is b for a, b in zip(logged, spoilt, strict=True)].count(False) == 1
    before, after = logged[bad].columns, spoilt[bad].columns
    changed = [c for c in before if not np.array_equal(before[c], after[c])]
    assert set(told[0]["columns"]) <= set(changed)
    write_folder(tmp_path / "data", spoilt)
    if fault == "missing_cells":
        with pytest.raises(UserError):
            read_csv(tmp_path / "data")


# ----------------------------------------------------------------------------------- yardstick


@pytest.mark.parametrize("even", [True, False])
def test_without_noise_the_oracle_is_right_to_the_bit(even):
    for names in (("thruster_lag", "dvl_lever_arm"), ("waves", "clock_offset"), ("appendage",)):
        plan = Plan(scenarios=3, runs=1, seconds=2.0, even=even, h=0.01)
        case = draw(2, names=names, plan=plan, noise=Noise.none())
        truth = case.simulate(9)
        exact = predict(case, truth, [5, 12], 20, exact_start=True)
        assert max(e.max() for e in recorded_errors(exact, truth).values()) < 1e-24


def test_shares_run_from_the_belief_to_the_truth():
    case = draw(2, names=("thruster_lag",), plan=Plan(scenarios=4, runs=4, seconds=3.0, h=0.01))
    truth = case.simulate(9)
    starts = windows_of(case, 9, 3, 20)
    oracle = predict(case, truth, starts, 20)
    base = predict(case, truth, starts, 20, effects=())
    half = predict(case, truth, starts, 20, effects=[actuation.ThrusterLag(None, 0.05)])
    assert all(s["excess"] == 0 for s in share(base, base, oracle, truth).values())
    assert all(s["excess"] == 1 for s in share(base, oracle, oracle, truth).values())
    assert all(0.3 < s["excess"] < 1 for s in share(base, half, oracle, truth).values())
    errors = [recorded_errors(m, truth)["velocity"][:, 1:].mean() for m in (base, half, oracle)]
    assert errors[0] > errors[1] > errors[2]


# ------------------------------------------------------------------- two codes, one vehicle


@dataclass(frozen=True)
class _Stream(Effect):
    """Water with any velocity and acceleration at Bo."""

    v: tuple[float, float, float] = (0.3, -0.2, 0.1)
    a: tuple[float, float, float] = (-0.5, 0.4, 0.7)

    def neutral(self) -> bool:
        return False

    def flow(self, p, t, latent):
        zero = np.zeros_like(p)
        return np.array(self.v)[:, None] + zero, np.array(self.a)[:, None] + zero


@pytest.mark.parametrize("stream", [None, _Stream()], ids=["still", "moving"])
def test_believed_and_true_accelerations_are_the_same(stream):
    rng, B = np.random.default_rng(6), 8
    q = rotations.exponential(rng.standard_normal((3, B)))
    y = np.concatenate([rng.standard_normal((3, B)), q, 0.6 * rng.standard_normal((6, B))])
    thrust = 10 * rng.standard_normal((8, B))
    plant = Plant(Vehicle(), [stream] if stream else [])
    true = plant.rates(y, 0.0, thrust, {0: {}})[7:13]
    dynamics = load_vehicle("bluerov2_heavy").dynamics()
    X, V, F = np.concatenate([y[3:7], y[:3]]), y[7:], plant.allocation @ thrust
    flow = None
    if stream:
        v, a = stream.flow(y[:3], 0.0, {})
        flow = Flow(jnp.asarray(v), jnp.asarray(a))
    believed = dynamics.acceleration(jnp.asarray(X), jnp.asarray(V), jnp.asarray(F), flow)
    np.testing.assert_allclose(np.asarray(believed), true, atol=1e-9)


def test_the_blind_table_has_every_cause_at_every_size():
    rows = list(table())
    assert {(name, size) for name, size, _ in rows} >= {(n, s) for n in CAUSES for s in (0.3, 1, 3)}
    assert sum(name == "null" for name, _, _ in rows) == 20
    assert {name for name, _, _ in rows} >= set(UNKNOWN) | {"pair", "triple"}
    assert len({case.seed for _, size, case in rows if size == 0.3}) == 70


@pytest.mark.parametrize("name", ["dvl_lever_arm", "heading_error", "clock_offset", "gyro_bias"])
def test_the_belief_starts_from_the_record_as_it_is(name):
    plan = Plan(scenarios=3, runs=1, seconds=2.0, h=0.01)
    case = draw(3, names=(name,), plan=plan)
    truth = case.simulate()
    base = predict(case, truth, [10], 5, effects=())
    np.testing.assert_allclose(base.X[0, 0, 4:], truth.X[10, 4:], atol=1e-12)
    np.testing.assert_allclose(base.V[0, 0], truth.V[10], atol=1e-12)
    turn = rotations.product(rotations.conjugate(base.X[0, 0, :4]), truth.X[10, :4])
    assert np.abs(turn[1:]).max() < 1e-4  # noise and deviation commute to first order
    oracle = predict(case, truth, [10], 5)
    assert np.abs(oracle.V[0, 0] - truth.V[10]).max() < 0.03


# ----------------------------------------------------------------------------- as a vehicle logs it


def test_a_dive_as_telemetry_shows_the_importer_what_was_measured(tmp_path):
    """Written by hand and read by pymavlink and the importer: frames, units, times and outputs."""
    plan = replace(DATA["piloted"](Plan()), scenarios=2, seconds=8.0)
    case = draw(3, "null", plan=plan, noise=Noise.none())
    truth, path = case.simulate(), tmp_path / "dive.tlog"
    write_tlog(path, truth, Streams(4, 4, 1), 0.0)
    recording = load_data(path, resample=False)
    assert recording.vehicle == "bluerov2_heavy"
    runs = list(recording.trajectories())
    assert [run.scenario.split("_", 1)[1] for run in runs] == ["MANUAL", "STABILIZE"]
    for b, run in enumerate(runs):
        t = run.start + recording.dt * np.arange(len(run))  # since boot
        at = np.rint((t - BOOT - 14.0 * b) * plan.rate).astype(int)
        X, V = truth.X[at, :, b], truth.V[at, :, b]
        from_start = (run.X_WB - run.X_WB[0])[:, 4:]
        np.testing.assert_allclose(from_start, (X - X[0])[:, 4:], atol=1e-6)  # W is at the start
        assert np.abs(np.sum(run.X_WB[:, :4] * X[:, :4], axis=1)).min() > 1 - 1e-9
        np.testing.assert_allclose(run.V_WB_B, V, atol=1e-6)
        pwm = pulses(truth.forces[:, :, b, None], truth.voltage[b, None])[..., 0]
        step = round(recording.dt * plan.rate)
        held = np.stack([pwm[i : i + step].mean(axis=0) for i in at])  # over the step that begins
        assert np.sqrt(np.mean((run.commands["pwm"] - held) ** 2)) < 2.0
        assert np.ptp(held) > 100


def test_a_low_pass_has_the_gain_and_delay_of_its_cutoff():
    """Butterworth of second order: 1/√2 and 90° at the cutoff, exact by the bilinear transform."""
    h, f = 0.005, 10.0
    t = np.arange(0, 2, h)
    y = low_pass(np.sin(2 * np.pi * f * t)[None, :, None], f, h)[0, :, 0]
    late = t > 1
    parts = np.stack([np.sin(2 * np.pi * f * t), np.cos(2 * np.pi * f * t)], axis=1)[late]
    found = np.linalg.lstsq(parts, y[late], rcond=None)[0]
    np.testing.assert_allclose(found, [0.0, -np.sqrt(0.5)], atol=1e-6)


def test_a_wrong_belief_is_wrong_in_ratios_that_are_told():
    case = draw(52_000, "null", wrong=True)
    assert case.answer()["verdict"] == "explained"
    true, told = case.true_vehicle(), case.ratios()
    inertia = np.diag(true.rigid_mass() + true.added_mass)
    usual = np.diag(Vehicle().rigid_mass() + Vehicle().added_mass)
    expected = true.quadratic / inertia / (Vehicle().quadratic / usual)
    np.testing.assert_allclose(list(told["quadratic_drag"].values()), expected)
    assert max(abs(np.log(list(told["quadratic_drag"].values())))) > np.log(1.3)
    same = Case(52_000, wrong=True, plan=SMALL, noise=Noise.none()).simulate()
    other = Case(52_000, plan=SMALL, noise=Noise.none()).simulate()
    assert np.abs(same.V_true - other.V_true).max() > 0.01
