"""Commands over steps by sampled outputs: means, rises, and those that are held."""

import numpy as np

from spinndrift.systems.logs.commanded import over_steps
from spinndrift.systems.logs.signals import Series, Signals

STEP = 0.05
T = np.arange(1.0, 9.0, STEP)


def log(x, period=0.0025, **given):
    t = np.arange(0.0, 10.0, period)
    outputs = Series(t, np.atleast_2d(x(t)), "SERVO_OUTPUT_RAW")
    some = Series(t, np.zeros((3, t.size)), "some")
    return Signals(attitude=some, rates=some, outputs=outputs, **given)


def test_means_and_rises_are_those_of_the_signal():
    signals = log(lambda t: 1500 + 100 * np.sin(3 * t))
    command, beside = over_steps(signals, T, STEP)
    half = 3 * STEP / 2
    mean = 1500 + 100 * np.sin(3 * (T + STEP / 2)) * np.sin(half) / half
    np.testing.assert_allclose(command[:, 0], mean, atol=0.01)
    np.testing.assert_allclose(
        beside["pwm_rise"][:, 0], 300 * STEP * np.cos(3 * (T + STEP / 2)), atol=0.05
    )


def test_held_commands_and_forces_are_means_alone():
    forces = log(np.sin, command="thruster_force")
    command, beside = over_steps(forces, T, STEP)
    np.testing.assert_allclose(command[:, 0], np.sin(T + STEP / 2), atol=2e-4)
    assert not beside
    held = log(lambda t: np.floor(t / STEP + 1e-9), held=True)
    command, beside = over_steps(held, T, STEP)
    np.testing.assert_allclose(command[:, 0], np.rint(T / STEP), atol=1e-6)
    assert not beside
