"""The filter's algorithm: Jacobians, consistency over many seeds, gates, late readings."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.stats import chi2

from spinndrift.models import se3
from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.estimation import error_state as es
from spinndrift.systems.estimation import measurement, recovery
from spinndrift.systems.estimation.config import EkfConfig
from spinndrift.systems.estimation.delayed import DelayedFilter
from spinndrift.systems.estimation.state import FilterState, Readings

pytestmark = pytest.mark.whole

SEEDS, STEPS = 40, 600
RNG = np.random.default_rng(0)
AIDS = (Dvl(), DepthSensor(), Compass())
SHOWN = es.INERTIAL + len(AIDS)
VALUES = sum(each.value_size for each in AIDS)
ERRORS = SHOWN + 2 * VALUES
transition = jax.jit(partial(es.transition, imu=Imu(), aids=AIDS))
update = jax.jit(measurement.update)


def navigation(scale: float = 1.0) -> es.Navigation:
    draw = lambda *shape: jnp.asarray(scale * RNG.standard_normal(shape))  # noqa: E731
    X = se3.from_position_rpy(draw(3), 0.5 * draw(3))
    return es.Navigation(X, draw(3), 0.01 * draw(3), 0.1 * draw(3), 0.01 * draw(3 + 2 * VALUES))


def test_the_errors_of_sensors_decay_and_drift():
    x, T = navigation(), jnp.asarray(0.3)
    np.testing.assert_allclose(es.passed(AIDS, x.sensors, T), sensors_after(x.sensors, T))


def sensors_after(errors: Array, T: Array) -> Array:
    """The compass' wander decays, offsets drift."""
    slow, offsets, drifts = errors[:3], errors[3 : 3 + VALUES], errors[3 + VALUES :]
    decay = jnp.stack([1.0, 1.0, jnp.exp(-T / Compass().wander_time)])
    return jnp.concatenate([slow * decay, offsets + drifts * T, drifts])


# --------------------------------------------------------------------------- increments, Jacobians


def test_chained_increments_are_single_steps_one_after_the_other():
    n, h, gravity = 13, 0.01, 9.81
    force, rate = jnp.asarray(RNG.standard_normal((3, n))), jnp.asarray(RNG.standard_normal((3, n)))
    time = jnp.full(n, h).at[jnp.array([2, 7])].set(0.0)  # slots without a sample change nothing
    x = navigation()
    samples = jax.jit(es.sample_increment)(force, rate, time)
    apply = jax.jit(partial(es.apply, gravity=gravity))
    at_once = apply(x, jax.jit(es.chain_all)(samples))
    for i in range(n):
        x = apply(x, jax.tree.map(lambda leaf, i=i: leaf[..., i], samples))
    for a, b in zip(at_once, x, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_an_increment_follows_newtons_law():
    """A constant force in W: p = p₀ + v t + a t²/2, v = v₀ + a t whatever the attitude."""
    a_W, t = jnp.array([0.3, -0.2, 0.5]), 0.4
    x = navigation()
    f = se3.rotate_inverse(x.X_WB, a_W + jnp.array([0, 0, 9.81]))
    after = es.apply(x, es.sample_increment(f, jnp.zeros(3), jnp.asarray(t)), 9.81)
    v_W = se3.rotate(x.X_WB, x.v_B)
    np.testing.assert_allclose(after.X_WB[4:], x.X_WB[4:] + v_W * t + a_W * t * t / 2, rtol=1e-12)
    np.testing.assert_allclose(se3.rotate(after.X_WB, after.v_B), v_W + a_W * t, rtol=1e-12)


@pytest.mark.parametrize("time", [0.01, 0.1])
def test_the_transition_is_the_derivative_of_a_step(time):
    imu = Imu()
    x, force, rate = navigation(), jnp.array([0.5, -0.3, 9.9]), jnp.array([0.3, -0.5, 0.4])
    T = jnp.asarray(time)

    def step(state: es.Navigation) -> es.Navigation:
        sample = es.sample_increment(
            force + x.accel_bias - state.accel_bias, rate + x.gyro_bias - state.gyro_bias, T
        )
        after = es.apply(state, sample, imu.gravity)
        return after._replace(sensors=sensors_after(after.sensors, T))

    after = jax.jit(step)(x)
    F, _ = transition(x, after, force, rate, T)
    exact = jax.jacfwd(lambda d: es.error(after, step(es.retract(x, d))))(jnp.zeros(ERRORS))
    angle = float(jnp.linalg.norm(rate)) * time
    np.testing.assert_allclose(F, exact, atol=max(1e-12, 10 * angle**4))


def test_without_a_force_the_transition_is_the_derivative_of_a_velocity_that_is_held():
    imu, x, rate = Imu(), navigation(), jnp.array([0.3, -0.5, 0.4])
    T = jnp.asarray(0.05)

    def step(state: es.Navigation) -> es.Navigation:
        omega = rate + x.gyro_bias - state.gyro_bias
        force = es.held_force(state, omega, imu.gravity)
        after = es.apply(state, es.sample_increment(force, omega, T), imu.gravity)
        return after._replace(sensors=sensors_after(after.sensors, T))

    after = jax.jit(step)(x)
    unmeasured = es.Unmeasured(T, jnp.asarray(0.3), jnp.asarray(0.0))
    force = es.held_force(x, rate, imu.gravity)
    F, Q = transition(x, after, force, rate, T, unmeasured=unmeasured)
    exact = jax.jacfwd(lambda d: es.error(after, step(es.retract(x, d))))(jnp.zeros(ERRORS))
    # what is held is so to first order in the angle, and gravity turns with it
    angle = float(jnp.linalg.norm(rate) * T)
    size = angle * max(float(jnp.linalg.norm(x.v_B)), imu.gravity * float(T))
    np.testing.assert_allclose(F[es.VELOCITY], exact[es.VELOCITY], atol=size)
    to_B = es.body_axes(after)[0]
    in_body = to_B @ F @ es.body_axes(x)[1]
    np.testing.assert_allclose(in_body[es.VELOCITY, es.ROTATION], 0, atol=1e-15)
    np.testing.assert_allclose(jnp.diag(to_B @ Q @ to_B.T)[es.VELOCITY], 0.3, rtol=1e-3)


def test_the_transitions_noise_is_that_of_many_small_steps():
    imu = Imu()
    x = navigation()
    force, rate = se3.rotate_inverse(x.X_WB, jnp.array([0, 0, imu.gravity])), jnp.zeros(3)
    x = x._replace(v_B=jnp.zeros(3))
    P, n, T = jnp.zeros((ERRORS, ERRORS)), 64, 0.1
    F, Q = transition(x, x, force, rate, jnp.asarray(T / n))
    for _ in range(n):
        P = F @ P @ F.T + Q
    _, Q = transition(x, x, force, rate, jnp.asarray(T))
    fine, coarse = jnp.diag(P), jnp.diag(Q)
    np.testing.assert_allclose(coarse[3:6], fine[3:6], rtol=1e-3)
    np.testing.assert_allclose(coarse[9:], fine[9:], rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(coarse[6:9], fine[6:9], rtol=0.2)


@jax.jit
def _innovations(x: es.Navigation) -> list[measurement.Innovation]:
    rate = jnp.array([0.2, -0.1, 0.3])
    values = [jnp.zeros(each.value_size) for each in AIDS]
    return measurement.innovations(AIDS, x, rate, jnp.zeros((3, 3)), values)


@jax.jit
def _residuals(x: es.Navigation, delta: Array) -> Array:
    return jnp.concatenate([found.residual for found in _innovations(es.retract(x, delta))])


def test_measurement_jacobians_agree_with_finite_differences():
    x, h = navigation(), 1e-6
    steps = h * jnp.eye(ERRORS)
    columns = [(_residuals(x, -step) - _residuals(x, step)) / (2 * h) for step in steps]
    H = jnp.concatenate([found.H for found in _innovations(x)])
    np.testing.assert_allclose(H, jnp.stack(columns, axis=1), atol=1e-8)


def test_readings_of_a_while_ago_are_those_of_their_latency():
    """Of what was true τ before its time the innovation is zero, and H its derivative in τ."""
    x, rate, late = navigation(0.3), jnp.array([0.2, -0.1, 0.3]), jnp.array([0.02, 0.03, 0.01])
    acceleration, omega = jnp.array([0.5, -0.4, 0.3]), rate - x.gyro_bias
    dvl, depth, compass = AIDS
    slow, rest = x.sensors[: len(AIDS)], jnp.zeros(2 * VALUES)
    before = [
        (
            se3.compose(x.X_WB, se3.exp(-tau * jnp.concatenate([x.v_B, omega]))),
            jnp.concatenate([x.v_B - tau * acceleration, omega]),
        )
        for tau in late
    ]
    values = [
        -dvl.innovation(*before[0], slow[:1], jnp.zeros(3)).residual,
        depth.expected(before[1][0]) + slow[1],
        compass.expected(before[2][0]) + slow[2],
    ]

    @jax.jit
    def innovations(assumed: Array) -> list[measurement.Innovation]:
        given = x._replace(sensors=jnp.concatenate([slow, assumed, rest]))
        noise = jnp.zeros((3, 3))
        return measurement.innovations(AIDS, given, rate, noise, values, acceleration, 0.0)

    h = 1e-5
    found, none = innovations(late), innovations(0 * late)
    less, more = innovations(late - h), innovations(late + h)
    for i, tau in enumerate(late):
        np.testing.assert_allclose(found[i].residual, 0, atol=tau**2)
        assert np.abs(none[i].residual).max() > 10 * np.abs(found[i].residual).max()
        slope = (less[i].residual - more[i].residual) / (2 * h)
        np.testing.assert_allclose(found[i].H[:, es.INERTIAL + len(AIDS) + i], slope, rtol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6])
def test_small_inverse(size):
    A = RNG.standard_normal((size, size))
    S = A @ A.T + np.eye(size)
    np.testing.assert_allclose(
        measurement.small_inverse(jnp.asarray(S)), np.linalg.inv(S), rtol=1e-9
    )


# -------------------------------------------------------------------------------------- the update


def random_covariance() -> Array:
    A = RNG.standard_normal((ERRORS, ERRORS)) * 0.05
    return jnp.asarray(A @ A.T + 1e-4 * np.eye(ERRORS))


@pytest.mark.parametrize("used", [(True, True, True), (True, False, False), (False, True, True)])
def test_an_update_is_the_conditional_gaussian(used):
    """Without the move to the corrected pose: P − P Hᵀ S⁻¹ H P, and δ = P Hᵀ S⁻¹ r."""
    x, P = navigation(), random_covariance()
    found = [
        each._replace(residual=jnp.asarray(0.02 * RNG.standard_normal(each.residual.size)))
        for each in _innovations(x)
    ]
    gates = [np.inf] * 3
    after, P_after, nis, accepted, _ = update(x, P, found, jnp.array(used), gates)
    np.testing.assert_array_equal(accepted, used)
    r, H, R = measurement.together([f for f, use in zip(found, used, strict=True) if use])
    S = H @ P @ H.T + R
    K = P @ H.T @ jnp.linalg.inv(S)
    np.testing.assert_allclose(es.error(x, after), K @ r, atol=1e-9)
    gamma = es.moved(x, K @ r)
    np.testing.assert_allclose(P_after, gamma @ (P - K @ S @ K.T) @ gamma.T, atol=1e-11)
    for each, score in zip(found, nis, strict=True):
        S = each.H @ P @ each.H.T + each.R
        expected = each.residual @ jnp.linalg.solve(S, each.residual)
        np.testing.assert_allclose(score, expected, rtol=1e-9)


def test_the_covariance_moves_by_the_derivative_of_the_error():
    x, d = navigation(), jnp.asarray(0.01 * RNG.standard_normal(ERRORS))
    for scale in (1.0, 0.1):
        after = es.retract(x, scale * d)
        exact = jax.jacfwd(lambda e: es.error(after, es.retract(x, e)))(scale * d)  # noqa: B023
        error = jnp.abs(es.moved(x, scale * d) - exact).max()
        assert error < scale**2 * jnp.abs(d).max() ** 2


def test_body_axes_are_those_of_pose_and_velocity_in_the_body():
    x = navigation()
    R = se3.rotation_matrix(x.X_WB)

    def in_body(e: Array) -> Array:
        y = es.retract(x, e)
        place = R.T @ (y.X_WB[4:] - x.X_WB[4:])
        turned = se3.local(x.X_WB, y.X_WB)[3:]
        return jnp.concatenate([place, turned, y.v_B - x.v_B, e[9:]])

    C, C_inverse = es.body_axes(x)
    np.testing.assert_allclose(C, jax.jacfwd(in_body)(jnp.zeros(ERRORS)), atol=1e-12)
    np.testing.assert_allclose(C @ C_inverse, jnp.eye(ERRORS), atol=1e-12)


@pytest.mark.parametrize("part", [es.POSITION, es.VELOCITY])
def test_what_is_unknown_along_the_horizontal_stays_out_of_the_vertical(part: slice):
    """However large it is, and whatever the errors of attitude and the rotation since."""
    x, rng = navigation(), np.random.default_rng(4)
    for _ in range(5):
        e = jnp.asarray(rng.normal(0, 0.2, ERRORS)).at[part].set([30.0, -50.0, 0.0])
        y, none = es.retract(x, e), es.retract(x, e.at[part].set(0))
        climb, still = (se3.rotate(z.X_WB, z.v_B)[2] for z in (y, none))
        np.testing.assert_allclose(climb, still, atol=1e-12)
        np.testing.assert_allclose(y.X_WB[6], none.X_WB[6], atol=1e-12)


def test_a_gated_reading_changes_nothing():
    x, P = navigation(), random_covariance()
    found = _innovations(x)
    found[1] = found[1]._replace(residual=jnp.array([1e3]))
    used, gates = jnp.array([False, True, False]), [float(chi2.ppf(0.999, 1))] * 3
    after, P_after, nis, accepted, _ = update(x, P, found, used, gates)
    assert not np.any(accepted)
    assert nis[1] > 1e3
    np.testing.assert_allclose(P_after, P, rtol=1e-12)
    np.testing.assert_allclose(es.error(x, after), np.zeros(ERRORS), atol=1e-15)


# --------------------------------------------------------------------------- the filter over seeds


class Run(NamedTuple):
    """Histories with leading axes (seed, step)."""

    error: Array
    P: Array
    status: Array
    bias_error: Array


def _twist(t: Array, phase: Array) -> Array:
    size = jnp.array([0.4, 0.3, 0.2, 0.15, 0.12, 0.25])
    return size * jnp.sin(jnp.array([0.62, 0.46, 0.8, 2.2, 1.8, 0.34]) * t + phase)


def _truth(X: Array, V: Array, states: list[Array]) -> es.Navigation:
    imu, dvl, depth, compass = states
    slow = jnp.concatenate([dvl[1:2], depth[:1], compass[:1], jnp.zeros(2 * VALUES)])
    return es.Navigation(X, V[:3], imu[3:6], imu[:3], slow)


def simulate(core: DelayedFilter, key: Array, steps: int, blind_after: Array, gross: Array) -> Run:
    """A vehicle that swings and swims, its sensors and the filter.

    The DVL is lost after `blind_after` (s); a share `gross` of its readings is off by 1 m/s.
    """
    h, slots = core.period, core.slots
    sensors = (core.imu, *core.aids)
    keys = jax.random.split(key, 5)
    phase = jax.random.uniform(keys[0], (6,)) * 6.28
    X0 = se3.from_position_rpy(jnp.array([0.0, 0, -3]), jnp.array([0.0, 0, 1]))
    V0 = _twist(jnp.zeros(()), phase)
    states0 = [
        s.initial(jax.random.normal(k, (s.initial_noise_size,)))
        for s, k in zip(sensors, jax.random.split(keys[1], 4), strict=True)
    ]
    start = core.init(X0, V0)
    drawn = jnp.where(jnp.arange(ERRORS) < 9, jax.random.normal(keys[2], (ERRORS,)), 0)
    from_B = es.body_axes(start.nominal)[1]
    nominal = es.retract(start.nominal, from_B @ (drawn * core.deviations()))
    start = start._replace(nominal=nominal)
    every = [round(core.imu.rate / s.rate) for s in sensors]

    def body(carry, n):
        X, V, states, state, past = carry
        k = n.astype(X.dtype)
        t = k * h
        noises = [
            jax.random.normal(jax.random.fold_in(key, n), (s.noise_size,))
            for s, key in zip(sensors, jax.random.split(keys[3], 4), strict=True)
        ]
        V_new = _twist(t, phase)
        X_new = jnp.where(n > 0, se3.retract(X, _twist(t - h / 2, phase) * h), X)
        A = jnp.where(n > 0, (V_new - V) / h, 0)
        here = _truth(X_new, V_new, states)
        past = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), past, here)
        states = [
            jnp.where(n % m == 0, s.measure(old, X_new, V_new, A, t, w), old)
            for s, old, m, w in zip(sensors, states, every, noises, strict=True)
        ]
        dvl = core.aids[0].reading(states[1], t)
        valid = jnp.where(dvl[6] < blind_after, dvl[3:4], 0)

        ping = jax.random.fold_in(keys[4], jnp.round(dvl[6] / h).astype(int))
        off = jnp.where(jax.random.uniform(ping) < gross, jax.random.normal(ping, (3,)), 0)

        def stamped(i: int) -> Array:
            time = (n // every[i] * every[i]).astype(X.dtype) * h
            return jnp.concatenate([sensors[i].reading(states[i], t), jnp.stack([1.0, time])])

        readings = Readings(
            core.imu.reading(states[0], t),
            (jnp.concatenate([dvl[:3] + off, valid, dvl[6:]]), stamped(2), stamped(3)),
        )
        state = core.step(state, readings, k)
        true = jax.tree.map(lambda leaf: leaf[0], past)
        P = core.covariance(state)
        error, P = es.error(state.nominal, true)[:SHOWN], P[:SHOWN, :SHOWN]
        out = Run(error, P, core.status(state, k), error[9:15])
        return (X_new, V_new, states, state, past), out

    past = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf[None], (slots + 1, *leaf.shape)), _truth(X0, V0, states0)
    )
    return jax.lax.scan(body, (X0, V0, states0, start, past), jnp.arange(steps))[1]


@eqx.filter_jit
def _many(core: DelayedFilter, seed: Array, blind_after: Array, gross: Array) -> Run:
    keys = jax.random.split(jax.random.key(seed), SEEDS)
    run = partial(simulate, core, steps=STEPS, blind_after=blind_after, gross=gross)
    return jax.lax.map(run, keys)  # under vmap every sample would fuse


def many(seed: int, blind_after: float = np.inf, gross: float = 0.0) -> Run:
    """All seeds at once; the arguments are traced, so one compilation serves all tests."""
    honest = core(dvl=Dvl(outlier_share=0.0))
    values = (jnp.asarray(seed), jnp.asarray(blind_after), jnp.asarray(gross))
    return jax.tree.map(np.asarray, _many(honest, *values))


def core(dvl: Dvl = AIDS[0], config: EkfConfig | None = None) -> DelayedFilter:
    return DelayedFilter(Imu(), (dvl, *AIDS[1:]), config or EkfConfig())


@pytest.fixture(scope="module")
def honest() -> Run:
    """Readings without outliers."""
    return many(0)


def nees(run: Run, at: int) -> np.ndarray:
    solved = np.linalg.solve(run.P[:, at], run.error[:, at, :, None])[..., 0]
    return np.sum(run.error[:, at] * solved, axis=-1)


@pytest.mark.parametrize("at", [25, 200, 400, 599])
def test_errors_are_as_large_as_the_covariance_says(honest, at):
    """The sum of all seeds' NEES is chi-square; the bounds hold with probability 99.8 %."""
    total = nees(honest, at).sum()
    low, high = chi2.ppf([0.001, 0.999], SHOWN * SEEDS)
    assert low < total < high


@pytest.mark.parametrize(("which", "size"), [(1, 3), (2, 1), (3, 1)])
def test_innovations_are_as_large_as_their_covariance_says(honest, which, size):
    """NIS of readings half a second apart, nearly all of which are fused."""
    values = honest.status[:, 120::40, which]
    total, count = values.sum(), values.size
    # The gate cuts one in a thousand: the mean falls by less than 2 %.
    low, high = chi2.ppf([0.0005, 0.9995], size * count)
    assert low * 0.98 < total < high


def test_each_error_has_its_own_scale(honest):
    """No component hides behind the others: RMS over seeds against its sigma, 5 sigma bounds."""
    sigma = np.sqrt(np.diagonal(honest.P[:, -1], axis1=-2, axis2=-1).mean(axis=0))
    ratio = np.sqrt((honest.error[:, -1] ** 2).mean(axis=0)) / sigma
    spread = 5 / np.sqrt(2 * SEEDS)
    assert np.all(ratio > 1 - spread)
    assert np.all(ratio < 1 + spread)


def test_covariances_are_symmetric_and_positive(honest):
    P = honest.P[:, ::50].reshape(-1, SHOWN, SHOWN)
    np.testing.assert_array_equal(P, P.swapaxes(-1, -2))
    assert np.linalg.eigvalsh(P / P.diagonal(axis1=-2, axis2=-1).mean(axis=0).max()).min() > 0


def test_biases_are_found(honest):
    """What gravity and depth tell of shrinks: horizontal gyroscopes, vertical accelerometer."""
    first, last = (np.sqrt((honest.bias_error[:, at] ** 2).mean(axis=0)) for at in (30, -1))
    assert np.all(last[:2] < 0.3 * first[:2])
    assert last[5] < 0.1 * first[5]


def test_horizontal_position_is_dead_reckoning(honest):
    """Its variance grows, that of depth does not."""
    early, late = (honest.P[:, at, :3, :3] for at in (25, 599))
    assert np.all(np.linalg.eigvalsh(late)[:, 1:] > np.linalg.eigvalsh(early)[:, 1:])
    assert np.all(np.linalg.eigvalsh(late)[:, 0] < 0.02**2)


def test_outliers_are_shut_out():
    run = many(1, gross=0.1)
    assert np.mean(run.status[:, ::20, 1] > chi2.ppf(0.999, 3)) > 0.05
    speed = np.sqrt((run.error[:, -1, 6:9] ** 2).sum(axis=-1))
    assert np.median(speed) < 0.02
    # Few small outliers pass, so the errors are a little larger than P says, not many times.
    assert np.median(nees(run, -1)) < 2 * SHOWN


def test_without_the_dvl_the_uncertainty_grows(honest):
    blind = many(0, blind_after=2.5)
    before, after = (np.trace(blind.P[:, at, :2, :2], axis1=-2, axis2=-1) for at in (270, 599))
    seen = np.trace(honest.P[:, 599, :2, :2], axis1=-2, axis2=-1)
    assert np.all(after > 4 * before)
    assert np.all(after > 2 * seen)
    assert np.all(blind.status[:, -1, 7] > 3)  # and the status says since when
    low, high = chi2.ppf([0.001, 0.999], SHOWN * SEEDS)
    assert low < nees(blind, 599).sum() < high


# ------------------------------------------------------------------------- late readings, patience


def still_readings(k: int, late: int, lost: bool = False) -> Readings:
    """At rest; every tenth sample a DVL reading that shows up `late` samples after its time."""
    shown = (k - late) // 10 * 10
    valid = 1.0 if shown >= 0 and not lost else 0.0
    v = jnp.array([0.02 * np.sin(shown), 0.01 * np.cos(shown), 0.01 * np.sin(2 * shown)])
    dvl = jnp.concatenate([v, jnp.array([valid, max(shown, 0) * 0.01])])
    never = jnp.array([0.0, 0, 0])
    return Readings(jnp.array([0.01, 0.02, 9.80665, 0.001, 0, 0]), (dvl, never, never))


def rested(core: DelayedFilter) -> FilterState:
    return core.init(jnp.array([1.0, 0, 0, 0, 0, 0, -3]), jnp.zeros(6))


def test_late_readings_give_the_estimate_of_prompt_ones():
    filter_ = core(dvl=Dvl(outlier_share=0.0))
    step = jax.jit(filter_.step)
    states = []
    for late in (0, 7, 20):
        state = rested(filter_)
        for k in range(120):
            state = step(state, still_readings(k, late), jnp.asarray(float(k)))
        states.append((state.nominal, state.P))
    for other in states[1:]:
        for a, b in zip(jax.tree.leaves(states[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(a, b)
    assert float(jnp.linalg.norm(states[0][0].v_B)) > 0


def test_readings_older_than_the_horizon_are_left_out():
    filter_ = core()
    step = jax.jit(filter_.step)
    state, blind = rested(filter_), rested(filter_)
    for k in range(100):
        state = step(state, still_readings(k, filter_.slots + 1), jnp.asarray(float(k)))
        blind = step(blind, still_readings(k, 0, lost=True), jnp.asarray(float(k)))
    np.testing.assert_array_equal(state.P, blind.P)


def test_a_lost_filter_opens_its_gate_after_some_patience():
    filter_ = core(config=EkfConfig(patience=5))
    step = jax.jit(filter_.step)
    state = rested(filter_)
    wrong = state.nominal._replace(v_B=jnp.array([3.0, 0, 0]))
    state = state._replace(nominal=wrong)
    counts, rng = [], np.random.default_rng(0)
    for k in range(150):
        still = still_readings(k, 0)
        imu = still.imu + 1e-3 * rng.standard_normal(6)  # without noise it is stuck
        state = step(state, still._replace(imu=imu), jnp.asarray(float(k)))
        counts.append(int(state.trust.rejected[0]))
    assert 2 <= max(counts) < 5  # alike rejections need less patience
    assert counts[-1] == 0
    assert abs(float(state.nominal.v_B[0])) < 0.05
    assert (
        float(jnp.linalg.norm(state.nominal.accel_bias)) < 0.2
    )  # the biases were not dragged along


# ------------------------------------------------------------------------------------ finding back


def test_the_force_shows_where_up_is_after_a_gap_and_is_not_asked_before():
    gravity, usual = 9.81, jnp.asarray(0.3**2)
    x = navigation()._replace(v_B=jnp.zeros(3))
    tilt = 0.2 * jnp.array([1.0, -1.0, 0.0])
    turned = es.retract(x, jnp.zeros(ERRORS).at[es.ROTATION].set(tilt))
    force = es.held_force(turned, jnp.zeros(3), gravity)
    given = (force, jnp.array(True), jnp.zeros(3), usual, gravity)
    eye = jnp.eye(ERRORS)
    level = jax.jit(lambda P: recovery.levelled(x, P, eye, *given))
    found, P, _ = level((0.3**2 * eye).at[es.ACCEL_BIAS, es.ACCEL_BIAS].set(0))
    up = jnp.array([0.0, 0.0, 1.0])
    left = se3.rotate_inverse(found.X_WB, up) - se3.rotate_inverse(turned.X_WB, up)
    assert jnp.linalg.norm(left) < 0.3 / gravity
    tilts = jnp.linalg.eigvalsh(P[es.ROTATION, es.ROTATION])
    np.testing.assert_allclose(jnp.sqrt(tilts[:2]), 0.3 / gravity, rtol=0.05)
    np.testing.assert_allclose(jnp.sqrt(tilts[2]), 0.3, rtol=0.05)  # no force shows the heading
    certain = 0.01**2 * eye
    np.testing.assert_array_equal(level(certain)[1], certain)


def test_an_outlier_that_decided_alone_is_outvoted_by_the_next_two():
    """Velocity was unknown; the first DVL reading is an outlier, those after it are right."""
    config = EkfConfig(velocity_std=(1.0, 1.0, 1.0), attitude_std=(1e-3, 1e-3, 1e-3))
    core = DelayedFilter(Imu(), (Dvl(),), config)
    start = se3.identity(jnp.float64)
    step, present = jax.jit(core.step), jax.jit(lambda state: core.present(state, core.period))
    still = jnp.array([0, 0, 9.80665, 0, 0, 0])
    state, errors, v = core.init(start, jnp.zeros(6)), [], jnp.zeros(3)
    rng = np.random.default_rng(0)
    noise = 0.01 * rng.standard_normal((5, 3))
    for k in range(100):
        n = (k - 20) // 20
        shown = noise[n] + (np.array([0.4, -0.3, 0.2]) if n == 0 else 0)
        reading = jnp.asarray([*shown, float(k >= 20), 0.2 * n + 0.05])
        imu = still + 1e-3 * jnp.asarray(rng.standard_normal(6))  # without noise it is stuck
        state = step(state, Readings(imu, (reading,)), jnp.asarray(float(k)))
        _, V, P = present(state)
        v = V[:3]
        errors.append(float(v @ jnp.linalg.solve(P[es.VELOCITY, es.VELOCITY], v)))
    assert max(errors) > 14.2, "the outlier was not believed"
    assert errors[-1] < 14.2
    assert float(jnp.linalg.norm(v)) < 0.03  # three deviations of a reading
