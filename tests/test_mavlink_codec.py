"""Conversions to and from ArduPilot's frames and units: against definitions, and there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from spinndrift.models import frames
from spinndrift.systems.mavlink import codec

RNG = np.random.default_rng(0)
P = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # NED components to ENU components
Q = np.diag([1.0, -1, -1])  # FRD to FLU


def quaternions(n=50):
    q = RNG.normal(size=(4, n))
    return q / np.linalg.norm(q, axis=0)


def matrix(q):
    return Rotation.from_quat(q.T, scalar_first=True).as_matrix()


def same_rotation(a, b):
    np.testing.assert_allclose(matrix(a), matrix(b), atol=1e-12)


def test_axis_swaps_are_their_definitions_and_their_own_inverses():
    v, V, q = RNG.normal(size=(3, 9)), RNG.normal(size=(6, 9)), quaternions(9)
    np.testing.assert_array_equal(frames.ned_to_enu(v), P @ v)
    np.testing.assert_array_equal(frames.frd_to_flu(v), Q @ v)
    np.testing.assert_array_equal(frames.twist_frd_to_flu(V)[3:], Q @ V[3:])
    np.testing.assert_allclose(
        matrix(frames.quaternion_to_flu_enu(q)), P @ matrix(q) @ Q, atol=1e-12
    )
    X = np.concatenate([q, v])
    for swap, x in (
        (frames.ned_to_enu, v),
        (frames.frd_to_flu, v),
        (frames.twist_frd_to_flu, V),
        (frames.quaternion_to_flu_enu, q),
        (frames.pose_to_enu, X),
    ):
        np.testing.assert_allclose(swap(swap(x)), x, atol=1e-15)
    same_rotation(codec.quaternion_to_frd_ned(codec.attitude(*q)), q)


@pytest.mark.parametrize(
    ("yaw_ned_deg", "forward"),
    [(0, [0, 1, 0]), (90, [1, 0, 0]), (180, [0, -1, 0]), (270, [-1, 0, 0])],
)
def test_heading_north_is_the_y_axis_and_east_the_x_axis(yaw_ned_deg, forward):
    q = codec.attitude_from_euler(0, 0, yaw_ned_deg, degrees=True)
    np.testing.assert_allclose(matrix(q) @ [1, 0, 0], forward, atol=1e-12)
    np.testing.assert_allclose(matrix(q) @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    yaw = codec.yaw_ned_to_enu(np.deg2rad(yaw_ned_deg))
    np.testing.assert_allclose([np.cos(yaw), np.sin(yaw), 0], forward, atol=1e-12)


def test_signs_of_roll_and_pitch():
    right_down = matrix(codec.attitude_from_euler(0.3, 0, 0)) @ [0, 1, 0]  # left axis of the body
    assert right_down[2] > 0.29
    nose_up = matrix(codec.attitude_from_euler(0, 0.3, 0)) @ [1, 0, 0]
    assert nose_up[2] > 0.29


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.booleans())
def test_euler_angles_there_and_back(roll, pitch, yaw, degrees):
    rpy = np.array([roll, pitch, yaw])
    given_ = np.rad2deg(rpy) if degrees else rpy
    q = codec.attitude_from_euler(*given_, degrees=degrees)
    np.testing.assert_allclose(codec.euler_from_attitude(q, degrees=degrees), given_, atol=1e-6)
    x, y, z = (Rotation.from_rotvec(turn) for turn in np.diag(rpy))
    ned = (z * y * x).as_matrix()
    np.testing.assert_allclose(matrix(q), P @ ned @ Q, atol=1e-9)


def test_imu_at_rest_and_back():
    f = codec.imu_specific_force(0, 0, -1000)  # RAW_IMU of a level vehicle at rest
    np.testing.assert_allclose(f, [0, 0, codec.G], rtol=0.6e-3)
    omega = codec.imu_angular_rate(1000, 1000, 1000)
    np.testing.assert_allclose(omega, [1, -1, -1], rtol=0.6e-3)
    gyro, acc = codec.imu_fields(omega, f)
    np.testing.assert_array_equal(np.trunc(gyro), [1000, 1000, 1000])
    np.testing.assert_array_equal(np.trunc(acc), [0, 0, -1000])


def test_truncated_rates_are_right_on_average():
    turn = np.random.default_rng(0).uniform(-20, 20, (3, 30_000))
    found = codec.imu_angular_rate(*np.trunc(turn)) * 1e3
    error = np.abs(found) - np.abs(turn)
    whole = np.abs(turn) > 1
    assert np.abs(error[whole]).max() <= 0.5 + 1e-9
    assert abs(error[whole].mean()) < 4 * np.sqrt(1 / 12 / whole.sum())


def test_pressure_is_depth_and_back():
    depth = np.linspace(0, 30, 7)
    for gradient in (codec.pascal_per_metre(), codec.pascal_per_metre(density=1025.0)):
        hPa = codec.pressure_from_depth(depth, gradient=gradient)
        np.testing.assert_allclose(
            codec.depth_from_pressure(hPa, gradient=gradient), depth, atol=1e-12
        )
    assert codec.depth_from_pressure(1013.25 + 980) == pytest.approx(10.0)
    assert codec.pascal_per_metre(1.024) == pytest.approx(1.024 * 9800)
    assert codec.height_from_relative_alt(-1500) == pytest.approx(-1.5)
    assert codec.climb_from_vz(25) == pytest.approx(-0.25)


def test_voltages_know_what_unknown_means():
    np.testing.assert_array_equal(codec.volts([12600, 65535, 0]), [12.6, np.nan, np.nan])
    cells = np.full((10, 2), 65535.0)
    cells[:4, 0] = 4000
    np.testing.assert_array_equal(codec.pack_voltage(cells), [16.0, np.nan])


def test_thruster_direction_mirrors_and_no_pulse_is_stopped():
    us = np.array([1100.0, 1500, 1750])
    np.testing.assert_array_equal(codec.thruster_pwm(us, -1), [1900, 1500, 1250])
    np.testing.assert_array_equal(codec.thruster_pwm(codec.thruster_pwm(us, -1), -1), us)
    assert codec.thruster_pwm(0) == 1500


def test_filter_delay_is_the_group_delay_of_a_butterworth():
    cutoff, slow = 2 * np.pi * 20.0, 2 * np.pi * 0.01
    response = cutoff**2 / ((1j * slow) ** 2 + np.sqrt(2) * cutoff * 1j * slow + cutoff**2)
    assert codec.filter_delay(20.0) == pytest.approx(-np.angle(response) / slow, rel=1e-6)


axis = st.floats(-0.45, 0.45)


@given(axis, axis, axis, axis, axis, axis)
def test_manual_control_there_and_back(surge, sway, heave, roll, pitch, yaw):
    fields = codec.manual_control_fields(surge, sway, heave, roll, pitch, yaw, gain=0.5)
    back = codec.manual_control_demand(**fields, gain=0.5)
    np.testing.assert_allclose(back, [surge, sway, heave, roll, pitch, yaw], atol=2e-3)


def test_manual_control_is_neutral_at_zero_clipped_and_never_not_a_number():
    assert codec.manual_control_fields() == {"x": 0, "y": 0, "z": 500, "r": 0, "s": 0, "t": 0}
    full = codec.manual_control_fields(surge=9.0, heave=-9.0, roll=9.0, pitch=9.0)
    assert (full["x"], full["z"], full["t"], full["s"]) == (1000, 0, 400, -400)
    with pytest.raises(ValueError, match="finite"):
        codec.manual_control_fields(yaw=float("nan"))


def test_names_of_modes():
    assert codec.mode_name(19) == "MANUAL"
    assert codec.mode_name(99) == "MODE_99"
    assert codec.stick(1900) == 1.0
