"""Attitude and velocity between slow samples follow sensors that tell of them, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spinndrift.models.recordings.resample import slerp
from spinndrift.systems.logs.between import attitude_at, velocity_at
from spinndrift.systems.logs.load import own_rate, usual_rate
from spinndrift.systems.logs.signals import Series, Signals

GRAVITY = 9.80665
FREQUENCIES = np.array([1.3, 0.9, 1.1])  # Hz
SIZES = np.array([0.3, 0.2, 0.4])  # m/s
WANTED = np.arange(3.0, 17.0, 0.02)


def velocity(t):
    return SIZES[:, None] * np.sin(2 * np.pi * FREQUENCIES[:, None] * t)


def log(period=0.1, bias=(0.0, 0.0, 0.0), noise=0.0):
    """A tilted and turning vehicle with velocities each `period` (s) and forces at 60 Hz."""
    t = np.arange(0.0, 20.0, 1 / 60)
    R = Rotation.from_euler("ZYX", np.stack([0.2 * t, 0.3 * np.sin(t), 0.4 * np.cos(t)], axis=1))
    omega = 2 * np.pi * FREQUENCIES[:, None]
    a = SIZES[:, None] * omega * np.cos(omega * t) + np.array([[0.0], [0.0], [GRAVITY]])
    f = R.inv().apply(a.T).T + np.asarray(bias)[:, None]
    f = f + noise * np.random.default_rng(0).normal(size=f.shape)
    q = R.as_quat(scalar_first=True).T
    slow = np.arange(0.013, 20.0, period)
    some = Series(t, np.zeros((3, t.size)), "some")
    return Signals(
        attitude=Series(t, q, "ATTITUDE"),
        rates=some,
        outputs=some,
        velocity=Series(slow, velocity(slow), "LOCAL_POSITION_NED"),
        specific_force=Series(t, f, "RAW_IMU"),
    )


def turning(t):
    """Attitudes q_WB that turn by up to 3 rad/s about all axes at times t (s)."""
    angles = np.stack([0.4 * t, 0.35 * np.sin(5 * t), 0.5 * np.sin(6 * t + 1)], axis=1)
    return Rotation.from_euler("ZYX", angles)


def turned(period=0.1, bias=(0.0, 0.0, 0.0), fast=0.01):
    """Attitudes of `turning` each `period` (s) and body rates each `fast` s."""
    t, h = np.arange(0.0, 20.0, fast), 1e-4
    omega = (turning(t - h).inv() * turning(t + h)).as_rotvec().T / (2 * h)
    slow = np.arange(0.013, 20.0, period)
    q = turning(slow).as_quat(scalar_first=True).T
    rates = Series(t, omega + np.asarray(bias)[:, None], "RAW_IMU")
    return Signals(attitude=Series(slow, q, "ATTITUDE"), rates=rates, outputs=rates)


def angles_off(q, t=WANTED):
    right = turning(t)
    return (right.inv() * Rotation.from_quat(q.T, scalar_first=True)).magnitude()


def geodesics(signals, t=WANTED):
    return slerp(t, signals.attitude.t, signals.attitude.x)


def test_a_turn_between_samples_is_that_of_the_gyro():
    exact = turned()
    line = np.sqrt(np.mean(angles_off(geodesics(exact)) ** 2))
    assert line > 0.01
    assert angles_off(attitude_at(exact, WANTED)).max() < 1e-3
    biased = turned(bias=(0.02, -0.03, 0.01))
    assert angles_off(attitude_at(biased, WANTED)).max() < 2e-3
    inside = exact.attitude.t[5:-5]
    assert angles_off(attitude_at(biased, inside), inside).max() < 1e-9


def test_coning_between_samples_is_turned_in_the_right_order():
    """A quarter of a second between attitudes, in which the axes of the turn change."""
    exact = turned(period=0.25, fast=0.002)
    assert angles_off(geodesics(exact)).max() > 0.1
    assert angles_off(attitude_at(exact, WANTED)).max() < 0.01


@pytest.mark.parametrize("wrong", ["sign", "axes", "slow", "silent"])
def test_a_gyro_that_does_not_tell_of_the_turn_is_not_followed(wrong):
    signals = turned(fast=0.08 if wrong == "slow" else 0.01)
    rates = signals.rates
    given = {
        "sign": replace(rates, x=-rates.x),
        "axes": replace(rates, x=np.roll(rates.x, 1, axis=0)),
        "slow": rates,
        "silent": replace(rates, x=0 * rates.x),
    }[wrong]
    found = attitude_at(replace(signals, rates=given), WANTED)
    np.testing.assert_allclose(found, geodesics(signals), atol=1e-12)


def test_a_pause_of_the_gyro_is_crossed_on_the_geodesic():
    signals = turned()
    paused = (signals.rates.t > 8.0) & (signals.rates.t < 8.5)
    rates = replace(signals.rates, t=signals.rates.t[~paused], x=signals.rates.x[:, ~paused])
    found = attitude_at(replace(signals, rates=rates), WANTED)
    there = (WANTED > 8.1) & (WANTED < 8.4)
    np.testing.assert_allclose(found[:, there], geodesics(signals)[:, there], atol=1e-12)
    away = (WANTED < 7.8) | (WANTED > 8.7)
    assert angles_off(found)[away].max() < 1e-3


def test_attitudes_that_a_gyro_tells_of_count_at_its_rate():
    assert own_rate(turned()) == 50
    assert own_rate(turned(fast=0.04)) == usual_rate(turned(fast=0.04)) == 25
    lone = turned(fast=0.04)
    assert own_rate(replace(lone, rates=replace(lone.rates, x=-lone.rates.x))) == 10


def velocities(signals) -> Series:
    assert signals.velocity is not None
    return signals.velocity


def forces(signals) -> Series:
    assert signals.specific_force is not None
    return signals.specific_force


def lines(signals, t=WANTED):
    v = velocities(signals)
    return np.stack([np.interp(t, v.t, x) for x in v.x])


def off(found, t=WANTED):
    return np.sqrt(np.mean((found - velocity(t)) ** 2, axis=1))


def test_motion_between_samples_is_that_of_the_accelerometer():
    signals = log(bias=(0.2, -0.1, 0.3), noise=0.05)
    assert (off(velocity_at(signals, WANTED)) < 0.2 * off(lines(signals))).all()
    v = velocities(signals)
    inside = v.t[5:-5]
    np.testing.assert_allclose(velocity_at(signals, inside), v.x[:, 5:-5], atol=1e-12)


@pytest.mark.parametrize("wrong", ["sign", "axes", "other motion"])
def test_an_accelerometer_that_does_not_tell_of_the_motion_is_not_followed(wrong):
    signals = log()
    force = forces(signals)
    x = {
        "sign": -force.x,
        "axes": np.roll(force.x, 1, axis=0),
        "other motion": np.roll(force.x, 37, axis=1) + 4 * np.sin(9 * force.t),
    }[wrong]
    found = velocity_at(replace(signals, specific_force=replace(force, x=x)), WANTED)
    np.testing.assert_allclose(found, lines(signals), atol=1e-12)


def test_pauses_and_ends_of_the_accelerometer_are_lines():
    signals = log()
    force = forces(signals)
    kept: np.ndarray = (force.t > 6.0) & ~((force.t > 9.0) & (force.t < 11.0))
    short = replace(signals, specific_force=replace(force, t=force.t[kept], x=force.x[:, kept]))
    found, plain = velocity_at(short, WANTED), lines(signals)
    straight = np.max(np.abs(found - plain), axis=0) < 1e-12
    assert straight[(WANTED < 5.9) | ((WANTED > 9.1) & (WANTED < 10.9))].all()
    there = ((WANTED > 6.2) & (WANTED < 8.8)) | (WANTED > 11.2)
    assert not straight[there].all()
    assert (off(found[:, there], WANTED[there]) < 0.1 * off(plain[:, there], WANTED[there])).all()


def test_components_that_are_unknown_stay_so_and_the_others_are_found():
    signals = log()
    v = velocities(signals)
    x = v.x.copy()
    x[:2] = np.nan
    found = velocity_at(replace(signals, velocity=replace(v, x=x)), WANTED)
    assert np.isnan(found[:2]).all()
    assert off(found)[2] < 0.1 * off(lines(signals))[2]


@pytest.mark.parametrize("missing", ["no accelerometer", "few velocities"])
def test_without_enough_samples_it_is_the_line(missing):
    signals = log()
    if missing == "no accelerometer":
        signals = replace(signals, specific_force=None)
    else:
        v = velocities(signals)
        signals = replace(signals, velocity=replace(v, t=v.t[:4], x=v.x[:, :4]))
    np.testing.assert_allclose(velocity_at(signals, WANTED), lines(signals), atol=1e-12)


def test_a_value_that_stands_still_is_kept():
    """Of a lost stream: between two equal samples, which rounding makes too, motion goes on."""
    signals = log(bias=(0.2, -0.1, 0.3))
    v = velocities(signals)
    x = v.x.copy()
    lost = (v.t > 8) & (v.t < 11)
    x[:2, lost] = 0.0
    twice = int(np.searchsorted(v.t, 5.0))
    x[2, twice + 1] = x[2, twice]
    signals = replace(signals, velocity=replace(v, x=x))
    found, straight = velocity_at(signals, WANTED), lines(signals)
    here = (v.t[lost][0] <= WANTED) & (v.t[lost][-1] >= WANTED)
    assert np.all(found[:2, here] == 0)
    around = (WANTED > 7) & ~here & (WANTED < 12)
    assert np.abs(found[:2, around] - straight[:2, around]).max() > 0.02
    assert np.abs(found[2, here] - straight[2, here]).max() > 0.02
    pair = (v.t[twice] < WANTED) & (v.t[twice + 1] > WANTED)
    assert np.all(found[2, pair] != straight[2, pair])
