"""Velocity between slow samples follows an accelerometer that tells of it, and no other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spinndrift.systems.logs.between import velocity_at
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
