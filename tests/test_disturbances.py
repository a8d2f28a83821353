"""Disturbances against the laws they claim: variances, spectra, kinematics, drag of a line."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.disturbances import (
    Combined,
    Disturbance,
    GaussMarkovCurrent,
    JonswapWaves,
    OrnsteinUhlenbeckWrench,
    ShipWake,
    Surface,
    Tether,
    WhiteWrench,
    jonswap,
    orbital_factors,
    preset,
    preset_names,
    wave_number,
)
from spinndrift.models.dynamics import Flow

KEY = jax.random.key(7)
# Each test that compares a sample moment with its law allows four standard errors.


def pose(x=0.0, y=0.0, z=-1.5, rpy=(0.0, 0.0, 0.0), batch=(), dtype=jnp.float64):
    X = se3.from_position_rpy(jnp.asarray([x, y, z], dtype), jnp.asarray(rpy, dtype))
    return jnp.broadcast_to(X.reshape((7,) + (1,) * len(batch)), (7, *batch))


def still(batch=(), dtype=jnp.float64):
    return jnp.zeros((6, *batch), dtype)


def start(kind: Disturbance, batch=(), key=KEY, dtype=jnp.float64):
    return kind.initial(jax.random.normal(key, (kind.initial_noise_size, *batch), dtype))


def history(kind: Disturbance, steps: int, dt: float, samples: int, key=KEY):
    """State after every advance, (steps, state_size, samples)."""
    X, V = pose(batch=(samples,)), still((samples,))

    def body(state, k):
        i, k = k
        w = jax.random.normal(k, (kind.noise_size, samples), jnp.float64)
        state = kind.advance(state, X, V, i * dt, dt, w)
        return state, state

    @jax.jit
    def run(state, keys):
        return jax.lax.scan(body, state, (jnp.arange(steps, dtype=jnp.float64), keys))[1]

    return run(start(kind, (samples,), key), jax.random.split(key, steps))


def assert_variance(samples, variance):
    """Sample variance of independent Gaussians of known mean zero, within four standard errors."""
    error = variance * math.sqrt(2 / samples.size)
    assert abs(float(jnp.mean(samples**2)) - variance) < 4 * error


KINDS = [
    WhiteWrench(),
    OrnsteinUhlenbeckWrench(frame="world"),
    GaussMarkovCurrent(std_vertical=0.02, profile_depth=10.0),
    JonswapWaves(),
    JonswapWaves(spreading=5.0),
    ShipWake(),
    Tether(),
    Surface(100.0, 3.0),
    preset("harbour"),
    Combined(),
]


class TestContract:
    @pytest.mark.parametrize("kind", KINDS, ids=lambda kind: type(kind).__name__)
    def test_a_batch_equals_its_members_in_both_precisions(self, kind):
        w0 = jax.random.normal(KEY, (kind.initial_noise_size, 2))
        w = jax.random.normal(KEY, (kind.noise_size, 2))
        X = pose(1.0, 2.0, -1.0, (0.1, -0.2, 0.7), (2,))
        V = 0.1 * jax.random.normal(KEY, (6, 2))

        @jax.jit
        def run(w0, w, X, V):
            state = kind.advance(kind.initial(w0), X, V, 30.0, 0.02, w)
            flow = kind.flow(state, X, 30.01)
            return state, kind.wrench(state, X, V, 30.01), flow.v_WC_W, flow.a_WC_W

        both = run(w0, w, X, V)
        one = run(w0[:, 1], w[:, 1], X[:, 1], V[:, 1])
        short = jax.eval_shape(run, *(a.astype(jnp.float32) for a in (w0, w, X, V)))
        sizes = (kind.state_size, 6, 3, 3)
        for batch, single, single_precision, size in zip(both, one, short, sizes, strict=True):
            assert batch.shape == single_precision.shape == (size, 2)
            assert batch.dtype == jnp.float64
            assert single_precision.dtype == jnp.float32
            np.testing.assert_allclose(batch[:, 1], single, rtol=1e-12, atol=1e-12)

    @pytest.mark.parametrize("kind", KINDS, ids=lambda kind: type(kind).__name__)
    def test_text_and_back(self, kind):
        assert typed_yaml.loads(type(kind), typed_yaml.dump(kind)) == kind
        assert hash(typed_yaml.loads(type(kind), typed_yaml.dump(kind))) == hash(kind)

    def test_a_scenario_names_kinds_by_tags(self):
        text = (
            "members:\n  - !JonswapWaves {significant_height: 0.3, peak_period: 3}\n  - !Tether\n"
        )
        sea = JonswapWaves(significant_height=0.3, peak_period=3.0)
        assert typed_yaml.loads(Combined, text) == Combined((sea, Tether()))

    @pytest.mark.parametrize(
        ("make", "field"),
        [
            (lambda: WhiteWrench((-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)), "intensity"),
            (lambda: OrnsteinUhlenbeckWrench(time_constant=(0.0,) * 6), "time_constant"),
            (lambda: GaussMarkovCurrent(max_speed=-1.0), "max_speed"),
            (lambda: JonswapWaves(peak_period=0.0), "peak_period"),
            (lambda: JonswapWaves(components=10), "components"),
            (lambda: JonswapWaves(direction=math.nan), "direction"),
            (lambda: ShipWake(earliest_start=2.0), "latest_start"),
            (lambda: Tether(anchor=(0.0, 0.0)), "anchor"),
            (lambda: preset("storm"), "storm"),
        ],
    )
    def test_bad_fields_are_named(self, make, field):
        # a tuple of the wrong size is found first by the type checker that tests switch on
        with pytest.raises((UserError, TypeError), match=field):
            make()

    def test_members_add_up(self):
        members = (OrnsteinUhlenbeckWrench(), JonswapWaves(), WhiteWrench(), GaussMarkovCurrent())
        whole = Combined(members)
        w0 = jax.random.normal(KEY, (whole.initial_noise_size,))
        w = jax.random.normal(KEY, (whole.noise_size,))
        X, V = pose(), still()
        state = whole.advance(whole.initial(w0), X, V, 0.0, 0.1, w)
        wrench, velocity = jnp.zeros(6), jnp.zeros(3)
        i = j = 0
        for member in members:
            own = member.initial(w0[i : i + member.initial_noise_size])
            own = member.advance(own, X, V, 0.0, 0.1, w[j : j + member.noise_size])
            i, j = i + member.initial_noise_size, j + member.noise_size
            wrench = wrench + member.wrench(own, X, V, 0.05)
            velocity = velocity + member.flow(own, X, 0.05).v_WC_W
        np.testing.assert_allclose(whole.wrench(state, X, V, 0.05), wrench, rtol=1e-14)
        np.testing.assert_allclose(whole.flow(state, X, 0.05).v_WC_W, velocity, rtol=1e-14)

    def test_every_set_runs(self):
        for name in preset_names():
            kind = preset(name)
            assert jnp.all(jnp.isfinite(start(kind)))
        assert preset("calm").flow(start(preset("calm")), pose(), 0.0).v_WC_W.tolist() == [0, 0, 0]


class TestWrenches:
    @pytest.mark.parametrize("dt", [0.5, 0.05])
    def test_impulse_variance_does_not_depend_on_the_step(self, dt):
        kind = WhiteWrench((0.5, 1.0, 2.0, 0.1, 0.2, 0.3))
        duration, samples = 2.0, 4000
        states = history(kind, round(duration / dt), dt, samples)
        impulse = jnp.sum(states, axis=0) * dt
        for axis in range(6):
            assert_variance(impulse[axis], kind.intensity[axis] ** 2 * duration)

    def test_ornstein_uhlenbeck_is_stationary_with_exponential_memory(self):
        kind = OrnsteinUhlenbeckWrench(
            std=(1.0, 2.0, 3.0, 0.1, 0.2, 0.3), time_constant=(1.0, 2.0, 4.0, 0.5, 1.0, 3.0)
        )
        dt, steps, samples = 0.5, 5, 20000
        first = start(kind, (samples,))
        last = history(kind, steps, dt, samples)[-1]
        for axis in range(6):
            variance = kind.std[axis] ** 2
            assert_variance(first[axis], variance)
            assert_variance(last[axis], variance)
            rho = math.exp(-steps * dt / kind.time_constant[axis])
            innovation = last[axis] - rho * first[axis]
            assert_variance(innovation, variance * (1 - rho**2))
            correlation = float(jnp.mean(innovation * first[axis]))
            assert abs(correlation) < 4 * variance * math.sqrt((1 - rho**2) / samples)

    def test_world_frame_pushes_keep_their_direction(self):
        kind = OrnsteinUhlenbeckWrench(frame="world")
        state = jnp.asarray([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        X = pose(rpy=(0.3, -0.4, 2.0))
        F_B = kind.wrench(state, X, still(), 0.0)
        np.testing.assert_allclose(se3.rotate(X, F_B[:3]), state[:3], rtol=1e-13)
        np.testing.assert_allclose(se3.rotate(X, F_B[3:]), state[3:], rtol=1e-13)


class TestCurrent:
    def test_speed_process_is_stationary_and_the_speed_clipped(self):
        kind = GaussMarkovCurrent(mean_speed=0.25, std_speed=0.2, time_constant=10.0)
        samples = 5000
        states = history(kind, 40, 1.0, samples)
        assert_variance(states[-1, 0], 0.2**2)
        assert_variance(states[-1, 1], kind.std_direction**2)
        flow = kind.flow(states[-1], pose(batch=(samples,)), 40.0)
        speed = jnp.hypot(flow.v_WC_W[0], flow.v_WC_W[1])
        # at the end of the ramp the water's speed is the clipped process, limits included
        np.testing.assert_allclose(speed, jnp.clip(0.25 + states[-1, 0], 0, 0.5), atol=1e-12)
        assert float(jnp.mean(speed == 0)) == pytest.approx(0.1056, abs=0.02)  # Φ(−1.25)

    def test_acceleration_is_the_derivative_and_integrates_to_the_change(self):
        kind = GaussMarkovCurrent(
            mean_speed=0.1, std_speed=0.2, time_constant=5.0, std_vertical=0.1
        )
        dt, samples = 0.1, 8
        X = pose(batch=(samples,))
        flow = jax.jit(kind.flow)
        states = history(kind, 100, dt, samples)
        total = jnp.zeros((3, samples))
        before = flow(states[0], X, 0.0).v_WC_W
        for i, state in enumerate(states):
            t = i * dt
            a, b = flow(state, X, t), flow(state, X, t + dt)
            np.testing.assert_allclose((b.v_WC_W - a.v_WC_W) / dt, a.a_WC_W, atol=1e-11)
            np.testing.assert_allclose(a.v_WC_W, before, atol=1e-12)  # continuous between steps
            before, total = b.v_WC_W, total + dt * a.a_WC_W
        first = flow(states[0], X, 0.0).v_WC_W
        np.testing.assert_allclose(total, before - first, atol=1e-11)

    def test_seventh_power_profile(self):
        kind = GaussMarkovCurrent(std_speed=0.0, std_direction=0.0, profile_depth=10.0)
        top, half = (kind.flow(start(kind), pose(z=z), 0.0).v_WC_W[0] for z in (0.0, -5.0))
        assert float(top) == pytest.approx(0.2)
        assert float(half / top) == pytest.approx(0.5 ** (1 / 7))


class TestWaves:
    @pytest.mark.parametrize("xp", [np, jnp])
    def test_dispersion(self, xp):
        omega = xp.asarray(np.geomspace(0.05, 30, 60))
        k = wave_number(omega, 10.0, 9.81, xp=xp)
        np.testing.assert_allclose(9.81 * k * np.tanh(10.0 * np.asarray(k)), omega**2, rtol=1e-13)

    def test_orbits_reach_the_limits_of_shallow_and_deep_water(self):
        horizontal, vertical = orbital_factors(np.asarray([50.0]), -1.0, 10.0, xp=np)
        np.testing.assert_allclose([horizontal[0], vertical[0]], math.exp(-50), rtol=1e-12)
        horizontal, vertical = orbital_factors(np.asarray([1e-3]), np.float64(-7.5), 10.0, xp=np)
        assert horizontal[0] == pytest.approx(1 / (1e-3 * 10), rel=1e-4)
        assert vertical[0] == pytest.approx(0.25, rel=1e-4)
        assert orbital_factors(np.asarray([1.0]), -10.0, 10.0, xp=np)[1][0] == 0

    def test_published_normalisation_gives_the_significant_height(self):
        omega = np.linspace(0.5, 60, 200_000)
        m0 = np.trapezoid(jonswap(omega, 0.3, 3.0, 3.3), omega)
        # 1 − 0.287 ln γ is a fit; DNV-RP-C205 has it good to about 1 %
        assert 4 * math.sqrt(m0) == pytest.approx(0.3, rel=0.01)

    # rms horizontal orbital velocity (m/s) at 0.5, 1, 2, 3, 5 and 8 m below the surface, 10 m of
    # water, from direct quadrature of the spectrum; figures rounded to 1 mm/s
    TABLE = (
        (0.1, 2.0, (0.044, 0.025, 0.010, 0.004, 0.001, 0.000)),
        (0.2, 2.5, (0.089, 0.060, 0.030, 0.016, 0.006, 0.002)),
        (0.3, 3.0, (0.128, 0.094, 0.057, 0.036, 0.016, 0.006)),
        (0.5, 3.5, (0.201, 0.158, 0.106, 0.074, 0.040, 0.021)),
        (0.3, 6.0, (0.094, 0.085, 0.072, 0.063, 0.051, 0.042)),
    )

    @pytest.mark.parametrize(("height", "period", "row"), TABLE)
    def test_orbital_velocity_decays_with_depth(self, height, period, row):
        kind = JonswapWaves(significant_height=height, peak_period=period)
        samples = 4000
        depths = jnp.asarray([0.5, 1, 2, 3, 5, 8])
        state = start(kind, (1, samples))
        X = jnp.broadcast_to(pose()[:, None, None], (7, 6, samples))
        X = X.at[6].set(jnp.broadcast_to(-depths[:, None], (6, samples)))
        state = jnp.broadcast_to(state, (kind.state_size, 6, samples))
        u = jax.jit(kind.flow)(state, X, 0.0).v_WC_W[0]
        rms = jnp.sqrt(jnp.mean(u**2, axis=1))
        # 4 standard errors of a standard deviation and half a unit of the table's last digit
        allowed = 4 * rms / math.sqrt(2 * samples) + 0.0005
        assert jnp.all(jnp.abs(rms - jnp.asarray(row)) < allowed)

    def test_elevation_has_the_significant_height(self):
        kind = JonswapWaves(significant_height=0.3, peak_period=3.0, spreading=4.0)
        state = start(kind, (20000,))
        eta = jax.jit(kind.elevation)(state, jnp.ones((3, 20000)), 12.0)
        assert_variance(eta, 0.3**2 / 16)

    def test_spreading_follows_its_law(self):
        kind = JonswapWaves(spreading=6.0)
        theta = start(kind, (500,))[kind.components :].ravel()
        # the mean of cos θ under cos²ˢ(θ/2) is s / (s + 1)
        error = float(jnp.std(jnp.cos(theta))) / math.sqrt(theta.size)
        assert abs(float(jnp.mean(jnp.cos(theta))) - 6 / 7) < 4 * error
        assert abs(float(jnp.mean(theta))) < 4 * float(jnp.std(theta)) / math.sqrt(theta.size)


class TestKinematics:
    KINDS = (
        JonswapWaves(direction=0.7),
        JonswapWaves(spreading=3.0, water_depth=4.0),
        ShipWake(direction=-2.0, water_depth=5.0),
    )

    @pytest.mark.parametrize("kind", KINDS, ids=lambda kind: type(kind).__name__)
    def test_acceleration_is_the_derivative_at_a_fixed_point(self, kind):
        state, X, h = start(kind), pose(1.0, -2.0, -0.8), 1e-4
        flow = jax.jit(kind.flow)
        for t in (3.0, 20.0, 41.7):
            numeric = (flow(state, X, t + h).v_WC_W - flow(state, X, t - h).v_WC_W) / (2 * h)
            np.testing.assert_allclose(flow(state, X, t).a_WC_W, numeric, atol=1e-7)

    def test_surface_rises_with_the_water_and_the_sea_has_no_source(self):
        kind = JonswapWaves(spreading=3.0, water_depth=6.0)
        state = start(kind)
        h = 1e-5
        surface = pose(0.3, 0.4, 0.0)
        rate = (
            kind.elevation(state, surface[4:], 5.0 + h)
            - kind.elevation(state, surface[4:], 5.0 - h)
        ) / (2 * h)
        np.testing.assert_allclose(kind.flow(state, surface, 5.0).v_WC_W[2], rate, atol=1e-8)

        X = pose(0.3, 0.4, -1.0)
        gradient = jax.jacfwd(lambda p: kind.flow(state, X.at[4:].set(p), 5.0).v_WC_W)(X[4:])
        assert abs(float(jnp.trace(gradient))) < 1e-13  # incompressible
        np.testing.assert_allclose(gradient, gradient.T, atol=1e-13)  # irrotational
        bed = kind.flow(state, pose(0.3, 0.4, -6.0), 5.0)
        assert abs(float(bed.v_WC_W[2])) < 1e-15


class TestShipWake:
    # orbital amplitude u (m/s) at 1, 2, 3, 5 and 8 m in 10 m of water, rounded to 1 mm/s
    TABLE = (
        (0.2, 2.5, (0.132, 0.069, 0.036, 0.010, 0.002)),
        (0.3, 3.0, (0.201, 0.129, 0.082, 0.034, 0.010)),
        (0.5, 4.0, (0.309, 0.241, 0.189, 0.119, 0.070)),
        (0.3, 5.0, (0.172, 0.147, 0.127, 0.097, 0.074)),
    )

    @pytest.mark.parametrize(("height", "period", "row"), TABLE)
    def test_amplitude_at_the_middle(self, height, period, row):
        kind = ShipWake(height=height, period=period)
        phases = jnp.linspace(0, 2 * math.pi, 721)
        state = jnp.stack([jnp.zeros_like(phases), phases])
        flow = jax.jit(kind.flow)
        for depth, expected in zip((1.0, 2.0, 3.0, 5.0, 8.0), row, strict=True):
            u = flow(state, pose(z=-depth, batch=(721,)), kind.duration / 2).v_WC_W[0]
            assert float(jnp.max(u)) == pytest.approx(expected, abs=0.0006)

    def test_long_waves_come_first_and_the_packet_ends(self):
        kind = ShipWake(duration=60.0, earliest_start=5.0, latest_start=15.0)
        state = start(kind)
        assert 5 < float(state[0]) < 15
        t = jnp.linspace(0.0, 90.0, 9001)
        many = jnp.broadcast_to(state[:, None], (2, 9001))
        X = pose(batch=(9001,))
        flow = jax.jit(jax.vmap(kind.flow, (1, 1, 0), 1))(many, X, t)
        u = np.asarray(flow.v_WC_W[0])
        outside = np.asarray((t < state[0]) | (t > state[0] + 60))
        assert np.all(np.abs(u[outside]) < 1e-15)
        assert np.all(np.abs(np.asarray(flow.a_WC_W)[:, outside]) < 1e-15)
        crossings = np.asarray(t[:-1])[(u[:-1] < 0) & (u[1:] >= 0)]
        periods = np.diff(crossings)
        assert np.all(np.diff(periods) < 0.02)  # never longer again, to twice the sampling step
        # from 3·1.4 = 4.2 s to 3/1.4 = 2.1 s, the ends seen one wave in
        assert 3.9 < periods[0] < 4.2
        assert 2.1 < periods[-1] < 2.3


class TestTether:
    LINE = Tether(anchor=(0.0, 0.0, -5.0), attachment=(0.0, 0.0, 0.0), weight=0.0, length=20.0)

    @staticmethod
    def flow(*v):
        return Flow(jnp.asarray(v), jnp.zeros(3))

    def test_nothing_moves_nothing_pulls(self):
        F = self.LINE.wrench(jnp.zeros(0), pose(x=12.0, z=-5.0), still(), 0.0)
        assert float(jnp.max(jnp.abs(F))) < 1e-6

    def test_broadside_drag_of_twenty_metres(self):
        # ½·1025·1.2·0.0076·0.5²·20 = 23.4 N, of which the vehicle carries half
        X = pose(x=19.99, z=-5.0)
        F = self.LINE.wrench(jnp.zeros(0), X, still(), 0.0, self.flow(0.0, 0.5, 0.0))
        half = 0.5 * 0.5 * 1025 * 1.2 * 0.0076 * 0.25 * 20
        # the line is bowed by some 1 m, so drag falls short by the square of its slope's cosine
        assert 0.95 * half < float(F[1]) < half
        assert float(F[0]) < -float(F[1])  # nearly straight, so it pulls harder than the flow
        assert abs(float(F[2])) < 1e-9

    def test_ends_share_the_drag_of_a_moving_vehicle_unevenly(self):
        # the line's speed grows from nothing to the vehicle's, u = s V, and the lever rule weighs
        # with s: ∫ s³ ds = 1/4 of the drag it would have if all of it moved (4 points: 0.9 % less)
        V = still().at[1].set(0.5)
        F = self.LINE.wrench(jnp.zeros(0), pose(x=19.99, z=-5.0), V, 0.0)
        full = 0.5 * 1025 * 1.2 * 0.0076 * 0.25 * 20
        assert 0.93 * full / 4 < -float(F[1]) < full / 4

    def test_a_sinking_line_hangs(self):
        line = Tether(anchor=(0.0, 0.0, -5.0), attachment=(0.0, 0.0, 0.0), weight=0.1, length=20.0)
        D, L = 16.0, 20.0
        F = line.wrench(jnp.zeros(0), pose(x=D, z=-5.0), still(), 0.0)
        assert float(F[2]) == pytest.approx(-0.1 * L / 2, rel=1e-6)
        # two-segment statics, H = w L D / (8 s); the catenary of the same length pulls 0.92 N
        sag = 0.5 * math.sqrt((L - D + line.taut_range / 2) * (L + D))
        assert -float(F[0]) == pytest.approx(0.1 * L * D / (8 * sag), rel=1e-3)

    def test_it_goes_taut_without_a_jump(self):
        pull = jax.jit(
            lambda x: (
                -self.LINE.wrench(
                    jnp.zeros(0), pose(z=-5.0).at[4].set(x), still(), 0.0, self.flow(0.0, 0.2, 0.0)
                )[0]
            )
        )
        xs = jnp.linspace(15.0, 23.0, 801)
        force = np.asarray([pull(x) for x in xs])
        slope = np.diff(force) / 0.01
        assert np.all(slope > 0)
        assert np.max(slope) < 1.1 * self.LINE.stiffness  # no step anywhere
        assert force[-1] == pytest.approx(force[-101] + self.LINE.stiffness, rel=0.01)

    def test_a_slack_line_obeys_the_statics_of_two_hinged_links(self):
        # links of length l under an even normal load q, at the angle b to the chord: half their
        # load and q l (1/2 - cos² b) / sin b along the chord, outward once b passes 45°
        line = Tether(
            anchor=(0.0, 0.0, -5.0),
            attachment=(0.0, 0.0, 0.0),
            weight=0.0,
            tangential_drag=0.0,
            length=20.0,
            taut_range=1e-3,
        )
        for D in (12.0, 17.0):
            F = line.wrench(jnp.zeros(0), pose(x=D, z=-5.0), still(), 0.0, self.flow(0.0, 0.3, 0.0))
            cos = D / 20
            sin = math.sqrt(1 - cos**2)
            load = 0.5 * 1025 * 1.2 * 0.0076 * (0.3 * cos) ** 2 * 10
            assert float(F[1]) == pytest.approx(load * cos, rel=1e-3)
            assert float(F[0]) == pytest.approx(load * (0.5 - cos**2) / sin, rel=2e-3)

    def test_gradients_are_finite_anywhere(self):
        @jax.jit
        def slopes(X, V):
            def wrench(X, V):
                return self.LINE.wrench(jnp.zeros(0), X, V, 0.0)

            return jax.jacfwd(wrench, (0, 1))(X, V)

        for x in (0.0, 1e-3, 10.0, 20.0, 25.0):
            for V in (still(), still().at[0].set(-1.0)):
                both = slopes(pose(x=x, z=-5.0), V)
                assert all(jnp.all(jnp.isfinite(slope)) for slope in both)

    def test_the_force_acts_at_the_attachment(self):
        line = Tether(anchor=(0.0, 0.0, 0.0), length=10.0)
        X = pose(4.0, 2.0, -3.0, (0.2, 0.1, 2.0))
        F = line.wrench(jnp.zeros(0), X, still(), 0.0, self.flow(0.4, 0.0, 0.0))
        np.testing.assert_allclose(F[3:], np.cross(line.attachment, F[:3]), rtol=1e-12)

    def test_combined_lets_the_current_drag_the_line(self):
        current = GaussMarkovCurrent(mean_speed=0.4, std_speed=0.0, std_direction=0.0)
        kind = Combined((self.LINE, current))
        X = pose(y=19.0, z=-5.0)
        F = kind.wrench(start(kind), X, still(), 0.0)
        alone = self.LINE.wrench(jnp.zeros(0), X, still(), 0.0, self.flow(0.4, 0.0, 0.0))
        np.testing.assert_allclose(F, alone, rtol=1e-13)
        assert float(F[0]) > 5
