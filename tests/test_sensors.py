"""Sensors against kinematics differentiated numerically, and against the laws of their errors."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu, Sensor, wrap

KEY = jax.random.key(3)
# Each test that compares a sample moment with its law allows four standard errors.


def pose(x=0.0, y=0.0, z=-1.5, rpy=(0.0, 0.0, 0.0), batch=()):
    X = se3.from_position_rpy(jnp.asarray([x, y, z]), jnp.asarray(rpy))
    return jnp.broadcast_to(X.reshape((7,) + (1,) * len(batch)), (7, *batch))


def motion(t):
    """Pose g, twist V = g⁻¹ ġ and its rate at time t of a smooth motion, by differentiation."""

    def body(t):
        p = jnp.stack([jnp.sin(t), 0.5 * jnp.cos(2 * t), -1.5 + 0.3 * jnp.sin(1.7 * t)])
        rpy = jnp.stack([0.4 * jnp.sin(1.3 * t), 0.3 * jnp.cos(t), 0.8 * t])
        return se3.from_position_rpy(p, rpy)

    def twist(t):
        X, dX = jax.jvp(body, (t,), (jnp.ones_like(t),))
        R, dR = jax.jvp(se3.rotation_matrix, (X,), (dX,))
        W = R.T @ dR
        return jnp.concatenate([R.T @ dX[4:], jnp.stack([W[2, 1], W[0, 2], W[1, 0]])])

    V, dV = jax.jvp(twist, (t,), (jnp.ones_like(t),))
    return body(t), V, dV


motion_at = jax.jit(motion)


def run(sensor: Sensor, steps, samples, X, V, dV, key=KEY):
    """States after each of many measurements of one constant motion, (steps, state, samples)."""

    def body(state, i_k):
        i, k = i_k
        w = jax.random.normal(k, (sensor.noise_size, samples), jnp.float64)
        state = sensor.measure(state, X, V, dV, i / sensor.rate, w)
        return state, state

    @jax.jit
    def scan(w0, keys):
        return jax.lax.scan(body, sensor.initial(w0), (jnp.arange(steps, dtype=jnp.float64), keys))

    w0 = jax.random.normal(key, (sensor.initial_noise_size, samples))
    return scan(w0, jax.random.split(key, steps))[1]


def still(samples=()):
    return pose(batch=samples), jnp.zeros((6, *samples)), jnp.zeros((6, *samples))


def assert_variance(x, variance):
    error = variance * math.sqrt(2 / x.size)
    assert abs(float(jnp.mean(x**2)) - variance) < 4 * error


SENSORS = [Imu(position=(0.1, 0.2, 0.3), rpy=(0.1, 0.2, 0.3)), Dvl(), DepthSensor(), Compass()]


class TestContract:
    @pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
    def test_a_batch_equals_its_members_in_both_precisions(self, sensor):
        w0 = jax.random.normal(KEY, (sensor.initial_noise_size, 2))
        w = jax.random.normal(KEY, (sensor.noise_size, 2))
        X = pose(1.0, 2.0, -3.0, (0.1, -0.2, 0.7), (2,))
        V = jax.random.normal(KEY, (6, 2))

        @jax.jit
        def once(w0, w, X, V):
            state = sensor.measure(sensor.initial(w0), X, V, 2 * V, 1.0, w)
            return state, sensor.reading(state, 1.2)

        both, one = once(w0, w, X, V), once(w0[:, 1], w[:, 1], X[:, 1], V[:, 1])
        short = jax.eval_shape(once, *(a.astype(jnp.float32) for a in (w0, w, X, V)))
        sizes = (sensor.state_size, sensor.reading_size)
        for batch, single, single_precision, size in zip(both, one, short, sizes, strict=True):
            assert batch.shape == single_precision.shape == (size, 2)
            assert batch.dtype == jnp.float64
            assert single_precision.dtype == jnp.float32
            np.testing.assert_allclose(batch[:, 1], single, rtol=1e-12, atol=1e-14)

    @pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
    def test_text_and_back(self, sensor):
        assert typed_yaml.loads(type(sensor), typed_yaml.dump(sensor)) == sensor

    @pytest.mark.parametrize(
        ("make", "field"),
        [
            (lambda: Imu(rate=0.0), "rate"),
            (lambda: Imu(gyroscope_walk=-1.0), "gyroscope_walk"),
            (lambda: Dvl(latest_latency=0.3), "latest_latency"),
            (lambda: Dvl(dropout_length=0.1), "dropout_length"),
            (lambda: Dvl(dropout_share=0.9), "dropout_share"),
            (lambda: DepthSensor(assumed_density=0.0), "assumed_density"),
            (lambda: Compass(wander_time=0.0), "wander_time"),
            (lambda: Compass(noise=math.inf), "noise"),
        ],
    )
    def test_bad_fields_are_named(self, make, field):
        with pytest.raises(UserError, match=field):
            make()


class TestImu:
    def test_specific_force_on_a_lever_arm_is_the_second_derivative_of_its_path(self):
        imu = Imu(position=(0.12, -0.2, 0.07), rpy=(0.3, -0.5, 1.1))
        h = 1e-4

        def sensor_pose(t):
            return se3.compose(motion_at(t)[0], imu.mount(jnp.dtype("float64")))

        for t in (0.3, 2.0):
            before, now, after = (sensor_pose(jnp.asarray(t + s)) for s in (-h, 0.0, h))
            acceleration = (before[4:] - 2 * now[4:] + after[4:]) / h**2
            f = se3.rotate_inverse(now, acceleration + jnp.asarray([0.0, 0.0, imu.gravity]))
            rate = se3.log(se3.compose(se3.inverse(before), after))[3:] / (2 * h)
            z = imu.expected(*motion_at(jnp.asarray(t)))
            np.testing.assert_allclose(z[:3], f, atol=2e-6)
            np.testing.assert_allclose(z[3:], rate, atol=1e-7)

    def test_at_rest_it_feels_the_support(self):
        z = Imu().expected(*still())
        np.testing.assert_allclose(z, [0, 0, 9.80665, 0, 0, 0], atol=1e-14)

    def test_the_means_of_an_integrating_unit_add_up_to_what_happened(self):
        """Turns and changes of velocity from its readings, whatever happened between them."""
        imu = Imu(
            **{
                f"{kind}_{x}": 0.0
                for kind in ("accelerometer", "gyroscope")
                for x in ("bias", "walk")
            },
            **dict.fromkeys(("accelerometer_density", "gyroscope_density"), 0.0),
            rate=20.0,
            position=(0.12, -0.2, 0.07),
            rpy=(0.3, -0.5, 1.1),
        )
        measure = jax.jit(lambda state, t: imu.measure(state, *motion(t), t, jnp.zeros(12)))
        state, states = imu.initial(jnp.zeros(6)), []
        for n in range(11):
            state = measure(state, jnp.asarray(n / imu.rate))
            states.append(state)
        mount = imu.mount(jnp.dtype("float64"))

        def sensor(t):
            X, V, _ = motion_at(jnp.asarray(t))
            v = V[:3] + jnp.cross(V[3:], mount[4:])
            return se3.compose(X, mount), se3.rotate(X, v)

        (X, v), end = sensor(0.0), sensor(10 / imu.rate)
        np.testing.assert_allclose(imu.reading(states[0], 0.0), imu.expected(*motion_at(0.0)))
        for state in states[1:]:
            reading = imu.reading(state, 0.0)
            turn = se3.exp(jnp.concatenate([jnp.zeros(3), reading[3:] / imu.rate]))
            X = se3.compose(X, turn)
            fall = jnp.array([0, 0, imu.gravity])
            v = v + (se3.rotate(X, reading[:3]) - fall) / imu.rate
        np.testing.assert_allclose(v, end[1], atol=1e-12)
        np.testing.assert_allclose(se3.rotation_matrix(X), se3.rotation_matrix(end[0]), atol=1e-12)

    def test_noise_and_walk_have_their_densities(self):
        imu = Imu(
            accelerometer_bias=0.0, gyroscope_bias=0.0, accelerometer_walk=1e-2, gyroscope_walk=1e-3
        )
        samples, steps = 4000, 100
        states = run(imu, steps, samples, *still((samples,)))
        first = imu.reading(states[0], 0.0)
        # bench figures at 100 Hz: 6.9e-3 m/s² and 4.9e-4 rad/s
        assert_variance(first[0], (9.8e-4 * math.sqrt(50)) ** 2)
        assert_variance(first[4], (7.0e-5 * math.sqrt(50)) ** 2)
        assert_variance(states[-1, 1], 1e-4 * steps / imu.rate)
        assert_variance(states[-1, 5], 1e-6 * steps / imu.rate)

    def test_readings_saturate(self):
        imu = Imu(accelerometer_range=5.0, gyroscope_range=1.0)
        X, V, dV = still()
        state = imu.measure(imu.initial(jnp.zeros(6)), X, V.at[5].set(-3.0), dV, 0.0, jnp.zeros(12))
        reading = imu.reading(state, 0.0)
        assert float(reading[2]) == 5.0
        assert float(reading[5]) == -1.0


class TestDvl:
    def test_velocity_on_a_lever_arm_is_the_derivative_of_its_path(self):
        dvl = Dvl(position=(-0.2, 0.1, -0.15), rpy=(math.pi, 0.0, 0.3))
        h = 1e-5
        mount = dvl.mount(jnp.dtype("float64"))
        for t in (0.3, 2.0):
            before, now, after = (
                se3.compose(motion_at(jnp.asarray(t + s))[0], mount) for s in (-h, 0.0, h)
            )
            velocity = se3.rotate_inverse(now, (after[4:] - before[4:]) / (2 * h))
            np.testing.assert_allclose(
                dvl.expected(motion_at(jnp.asarray(t))[1]), velocity, atol=1e-9
            )

    def test_an_aft_facing_mount_turns_the_signs(self):
        V = jnp.asarray([0.5, 0.2, 0.1, 0, 0, 0])
        z = Dvl(position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, math.pi)).expected(V)
        np.testing.assert_allclose(z, [-0.5, -0.2, 0.1], atol=1e-15)

    def test_readings_come_late_with_their_time_of_validity(self):
        dvl = Dvl(dropout_share=0.0, outlier_share=0.0, noise=0.0, scale_std=0.0)
        samples = 2000
        X, _, dV = still((samples,))
        state = dvl.initial(jnp.zeros((2, samples)))
        assert jnp.all(dvl.reading(state, 0.0)[3] == 0)
        for i in range(3):
            V = jnp.zeros((6, samples)).at[0].set(0.1 * (i + 1))
            w = jax.random.normal(jax.random.fold_in(KEY, i), (9, samples))
            state = dvl.measure(state, X, V, dV, 0.2 * i, w)
        for t, share in ((0.4, 0.0), (0.499, 0.0), (0.55, 0.5), (0.6001, 1.0)):
            reading = dvl.reading(state, t)
            new = reading[6] == 0.4
            error = math.sqrt(share * (1 - share) / samples)
            assert abs(float(jnp.mean(new)) - share) <= 4 * error
            # velocity belongs to the time of validity, whichever of the two is shown
            np.testing.assert_allclose(reading[0], jnp.where(new, 0.3, 0.2), rtol=1e-12)
            assert jnp.all(new | (reading[6] == 0.2))
            assert jnp.all(reading[3] == 1)

    def test_drop_outs_have_their_share_and_length(self):
        dvl = Dvl(dropout_share=0.1, dropout_length=1.0, outlier_share=0.0)
        samples, steps = 2000, 100
        states = run(dvl, steps, samples, *still((samples,)))
        dropped = np.asarray(states[:, 0] > 0.5)
        # measurements decorrelate as (1 − leave − enter)ⁿ with leave = 1/5, so a run of `steps`
        # is worth steps / ((1 + r) / (1 - r)) independent ones
        leave, share = 0.2, 0.1
        r = 1 - leave - leave * share / (1 - share)
        error = math.sqrt(share * (1 - share) / (samples * steps) * (1 + r) / (1 - r))
        assert abs(dropped.mean() - share) < 4 * error
        assert abs(dropped[0].mean() - share) < 4 * math.sqrt(share * (1 - share) / samples)
        stays = dropped[1:][dropped[:-1]]
        spread = math.sqrt(leave * (1 - leave) / stays.size)
        assert abs(stays.mean() - (1 - leave)) < 4 * spread
        invalid = dvl.reading(states[-1], 100.0)
        assert np.array_equal(np.asarray(invalid[3] == 0), dropped[-1])
        assert jnp.all(jnp.where(invalid[3] == 0, jnp.abs(invalid[0]), 0) == 0)

    def test_noise_scale_and_outliers(self):
        dvl = Dvl(dropout_share=0.0, outlier_share=0.2, outlier_std=1.0, scale_std=0.01)
        samples = 20000
        X, V, dV = still((samples,))
        V = V.at[0].set(2.0)
        states = run(dvl, 1, samples, X, V, dV)
        z = dvl.reading(states[0], 1.0)
        # along x the scale adds 0.02 m/s; a mixture's fourth moment sets the standard error
        for axis, true in ((0, 2.0), (1, 0.0)):
            base = 0.01**2 + (0.01 * true) ** 2
            variance = base + 0.2
            fourth = 3 * (0.8 * base**2 + 0.2 * (base + 1) ** 2)
            error = math.sqrt((fourth - variance**2) / samples)
            assert abs(float(jnp.mean((z[axis] - true) ** 2)) - variance) < 4 * error
        far = jnp.abs(z[1]) > 0.05
        inside = math.erf(0.05 / math.sqrt(2 * (1 + 1e-4)))  # outliers that hide near the truth
        share = 0.2 * (1 - inside)
        assert abs(float(jnp.mean(far)) - share) < 4 * math.sqrt(share * (1 - share) / samples)

    def test_no_bottom_no_velocity(self):
        dvl = Dvl(dropout_share=0.0, water_depth=60.0, position=(0.0, 0.0, -0.1))
        _, V, dV = still()
        for z, speed, valid in ((-1.0, 0.0, 0), (-20.0, 0.0, 1), (-59.87, 0.0, 0), (-20.0, 4.0, 0)):
            state = dvl.measure(
                dvl.initial(jnp.zeros(2)), pose(z=z), V.at[0].set(speed), dV, 0.0, jnp.zeros(9)
            )
            reading = dvl.reading(state, 0.2)
            assert float(reading[3]) == valid
            if valid:
                assert float(reading[4]) == pytest.approx(z - 0.1 + 60)


class TestDepth:
    def test_tilt_moves_the_gauge(self):
        gauge = DepthSensor(position=(-0.15, 0.0, 0.05))
        level = gauge.expected(pose(z=-3.0))
        np.testing.assert_allclose(level, [2.95], rtol=1e-14)
        # nose up by 30° (pitch −30° with z up) lowers the stern
        tilted = gauge.expected(pose(z=-3.0, rpy=(0.0, -math.pi / 6, 0.0)))
        np.testing.assert_allclose(
            tilted, [3 + 0.15 * 0.5 - 0.05 * math.cos(math.pi / 6)], rtol=1e-14
        )

    def test_salt_water_read_as_fresh(self):
        gauge = DepthSensor(position=(0.0, 0.0, 0.0), assumed_density=1000.0)
        np.testing.assert_allclose(gauge.expected(pose(z=-10.0)), [10.25])

    def test_offset_stays_and_noise_does_not(self):
        gauge = DepthSensor(position=(0.0, 0.0, 0.0))
        samples = 4000
        states = run(gauge, 2, samples, *still((samples,)))
        errors = [gauge.reading(state, 0.0)[0] - 1.5 for state in states]
        assert_variance(errors[0], gauge.noise**2 + gauge.offset_std**2)
        assert_variance(errors[1] - errors[0], 2 * gauge.noise**2)


class TestCompass:
    def test_wander_is_stationary_and_slow(self):
        compass = Compass(noise=0.0, wander=0.1, wander_time=2.0)
        samples, steps = 8000, 21
        states = run(compass, steps, samples, *still((samples,)))
        first, last = compass.reading(states[0], 0.0)[0], compass.reading(states[-1], 0.0)[0]
        assert_variance(first, 0.01)
        assert_variance(last, 0.01)
        rho = math.exp(-1.0)  # 20 samples at 10 Hz are one time constant
        assert_variance(last - rho * first, 0.01 * (1 - rho**2))

    def test_white_noise(self):
        compass = Compass(noise=0.02, wander=0.0)
        reading = compass.reading(run(compass, 1, 4000, *still((4000,)))[0], 0.0)
        assert_variance(reading[0], 0.02**2)

    def test_reading_is_wrapped(self):
        compass = Compass(noise=0.1, wander=0.0)
        X, V, dV = still()
        X = pose(rpy=(0.1, 0.2, math.pi - 0.01))
        state = compass.measure(jnp.zeros(2), X, V, dV, 0.0, jnp.asarray([1.0, 0.0]))
        np.testing.assert_allclose(compass.reading(state, 0.0), [-math.pi + 0.09], atol=1e-12)
        np.testing.assert_allclose(wrap(jnp.asarray([3 * math.pi, -math.pi])), -math.pi, rtol=1e-15)
