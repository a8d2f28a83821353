"""The filter along a recorded dive of a real ArduSub, fed as a flight feeds it.

The log keeps when each message arrived, and the autopilot's simulator logged the truth (SIM_STATE).
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pymavlink import mavutil
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from helpers import shared_data
from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.estimation.config import EkfConfig
from spinndrift.systems.estimation.delayed import DelayedFilter
from spinndrift.systems.estimation.state import FilterState, Readings
from spinndrift.systems.mavlink import codec
from spinndrift.systems.mavlink.inertial_samples import InertialSamples
from spinndrift.systems.mavlink.interface import HELD, RESOLUTION

pytestmark = pytest.mark.slow

START, END, RATE = 45.0, 300.0, 50.0  # s, s, Hz
LOW_PASS = codec.filter_delay(20.0)  # INS_GYRO_FILTER and INS_ACCEL_FILTER
DELAY = 0.036  # s that 2 % of the messages exceed
AIDS = (
    Dvl(
        rate=10.0,
        position=(0.0, 0.0, 0.0),
        dropout_share=0.0,
        earliest_latency=0.0,
        latest_latency=0.1,
        water_depth=60.0,
    ),
    DepthSensor(position=(0.0, 0.0, 0.0), noise=0.011),
    Compass(),
)
HANGS = ((100.0, 100.15), (120.0, 120.15), (121.0, 121.15), (140.0, 140.3), (160.0, 160.5))


def imu() -> Imu:
    """With the noise of the messages' resolution and dither, and EKF3's walks of the biases."""
    rounding = RESOLUTION / np.sqrt(6) * np.sqrt(2 / RATE)
    step = np.sqrt(0.012)
    return Imu(
        rate=RATE,
        integrating=False,
        accelerometer_density=float(np.hypot(9.8e-4, rounding[0])),
        gyroscope_density=float(np.hypot(7e-5, rounding[3])),
        accelerometer_walk=float(0.02 * step),
        gyroscope_walk=float(1e-3 * step),
    )


class Came(NamedTuple):
    """A reading: when it came and was true (s), and its values."""

    arrival: float
    stamp: float
    values: np.ndarray


class Dive(NamedTuple):
    """All readings by sensor, and the truth: times (s), attitudes and velocities in W."""

    readings: dict[str, list[Came]]
    times: np.ndarray
    attitudes: Rotation
    v_W: np.ndarray

    def at(self, t: np.ndarray) -> tuple[Rotation, np.ndarray]:
        """True attitudes, and velocities in B."""
        i = np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1)
        share = (t - self.times[i - 1]) / (self.times[i] - self.times[i - 1])
        turn = (self.attitudes[i - 1].inv() * self.attitudes[i]).as_rotvec()
        R = self.attitudes[i - 1] * Rotation.from_rotvec(share[:, None] * turn)
        v = np.stack([np.interp(t, self.times, component) for component in self.v_W.T], axis=1)
        return R, R.inv().apply(v)


@cache
def dive() -> Dive:
    link = mavutil.mavlink_connection(str(shared_data("data", "sitl_log", "dive.tlog")))
    found: dict[str, list[Came]] = {"imu": [], "dvl": [], "depth": [], "attitude": []}
    truth = []
    kinds = ("RAW_IMU", "ATTITUDE_QUATERNION", "SIM_STATE", "SCALED_PRESSURE2")
    while (m := link.recv_match(type=[*kinds, "VISION_POSITION_DELTA"])) is not None:
        kind, came = m.get_type(), m._timestamp
        if kind == "RAW_IMU":
            force = codec.imu_specific_force(m.xacc, m.yacc, m.zacc)
            rate = codec.imu_angular_rate(m.xgyro, m.ygyro, m.zgyro)
            found["imu"].append(Came(came, m.time_usec * 1e-6, np.r_[force, rate]))
        elif kind == "ATTITUDE_QUATERNION":
            q = codec.attitude(m.q1, m.q2, m.q3, m.q4)
            found["attitude"].append(Came(came, m.time_boot_ms * 1e-3, q))
        elif kind == "SIM_STATE":
            q = codec.attitude(m.q1, m.q2, m.q3, m.q4)
            truth.append(np.r_[q, codec.world_vector(m.vn, m.ve, m.vd)])
        elif kind == "SCALED_PRESSURE2":
            depth = codec.depth_from_pressure(m.press_abs, gradient=10047.0)
            found["depth"].append(Came(came, m.time_boot_ms * 1e-3, np.atleast_1d(depth)))
        else:
            v = codec.body_vector(*m.position_delta) / (m.time_delta_usec * 1e-6)
            found["dvl"].append(Came(came, came, v))
    epoch = min(each.arrival - each.stamp for each in found["imu"])
    local = {
        name: [one._replace(arrival=one.arrival - epoch) for one in each]
        for name, each in found.items()
    }
    local["dvl"] = [one._replace(stamp=one.arrival - 0.01) for one in local["dvl"]]
    # each SIM_STATE is sent after an attitude
    n = min(len(truth), len(local["attitude"]))
    times, first = np.unique([one.stamp for one in local["attitude"][:n]], return_index=True)
    rows = np.array(truth)[first]
    return Dive(local, times, Rotation.from_quat(rows[:, :4], scalar_first=True), rows[:, 4:])


class Port:
    """A sensor's readings as the vehicle's interface shows them: the newest, at most at a rate."""

    def __init__(self, came: list[Came], period: float, size: int):
        self._left = iter(came)
        self._next = next(self._left, None)
        self._period = period - 1 / RATE
        self.shown = np.zeros(size + 2)

    def until(self, now: float) -> np.ndarray:
        while self._next is not None and self._next.arrival <= now:
            stamp, values = self._next.stamp - START, self._next.values
            changed = not np.array_equal(values, self.shown[:-2])
            if stamp > 0 and changed and stamp >= self.shown[-1] + self._period:
                self.shown = np.r_[values, 1.0, stamp]
            self._next = next(self._left, None)
        return self.shown


def as_shown(hangs: tuple[tuple[float, float], ...], latency: float) -> Readings:
    """What a filter gets in each period if the link hangs: messages come after its end."""

    def held(one: Came) -> Came:
        return one._replace(
            arrival=next((b for a, b in hangs if a <= one.arrival < b), one.arrival)
        )

    came = {name: [held(one) for one in each] for name, each in dive().readings.items()}
    yaw = [
        one._replace(
            values=np.array([codec.yaw_ned_to_enu(codec.euler_from_attitude(one.values)[2])])
        )
        for one in came["attitude"]
    ]
    ports = [
        Port(each, 1 / sensor.rate, sensor.value_size)
        for sensor, each in zip(AIDS, (came["dvl"], came["depth"], yaw), strict=True)
    ]
    dither, inertial = np.random.default_rng(0), iter(came["imu"])
    samples, following = InertialSamples(HELD / RATE, (LOW_PASS, LOW_PASS)), next(inertial)
    rows: tuple[list, ...] = ([], [], [], [])
    for now in START + np.arange(round((END - START) * RATE)) / RATE:
        while following.arrival <= now:
            noise = RESOLUTION * dither.uniform(-0.5, 0.5, 6)
            samples.add(following.stamp, following.values + noise)
            following = next(inertial)
        rows[0].append(samples.at(now - latency))
        for row, port in zip(rows[1:], ports, strict=True):
            row.append(port.until(now))
    first, *others = (jnp.asarray(np.array(each)) for each in rows)
    return Readings(first, tuple(others))


@pytest.mark.parametrize("hangs", [(), HANGS], ids=["as recorded", "link hangs"])
def test_estimate_and_covariance_hold_along_a_real_dive(hangs):
    latency = DELAY + 1 / RATE + LOW_PASS
    config = EkfConfig(imu_latency=latency, latency_std=0.05, timing_std=1 / RATE / 3**0.5)
    core, readings = DelayedFilter(imu(), AIDS, config), as_shown(hangs, latency)

    def step(state: FilterState, given: tuple) -> tuple:
        state = core.step(state, *given)
        X, V, P = core.present(state, core.period + latency)
        shown = X, V, P[3:9, 3:9], core.health(state, P, given[1]), state.nominal.sensors
        return state, shown

    R, v = dive().at(np.array([START]))
    z = -np.interp(
        START, *zip(*[(o.stamp, o.values[0]) for o in dive().readings["depth"]], strict=True)
    )
    X_WB = np.r_[R.as_quat(scalar_first=True)[0], 0, 0, z]
    start = core.init(jnp.asarray(X_WB), jnp.asarray(np.r_[v[0], 0, 0, 0]))
    numbers = jnp.arange(float(len(readings.imu)))
    found = jax.jit(lambda s, r: jax.lax.scan(step, s, (r, numbers)))(start, readings)[1]
    X, V, P, health, sensors = map(np.asarray, found)

    R, v = dive().at(START + (np.arange(len(X)) + 1) / RATE)
    turn = Rotation.from_quat(X[:, :4], scalar_first=True).inv() * R
    errors = np.c_[turn.as_rotvec(), v - V[:, :3]]
    bound = chi2.ppf(chi2.cdf(9, 1), 3)
    for part in (slice(0, 3), slice(3, 6)):
        e, S = errors[:, part], P[:, part, part]
        nees = np.einsum("ki,kij,kj->k", e, np.linalg.inv(S), e)
        assert np.mean(nees < bound) > 0.98
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 0.05
    assert np.mean(health[:, 0] > 1) < 0.005  # lost only in the longest gaps
    assert health[:, 1:].mean(axis=0).min() > 0.9
    # ArduSub averages the pressure and sends it once in 0.1 s
    assert sensors[-1, len(AIDS) + 1] == pytest.approx(0.06, abs=0.03)
