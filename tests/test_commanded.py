"""Commands over steps by sampled outputs: behind the filter of the rates, within their limits."""

import numpy as np
import pytest
import scipy.signal

from spinndrift.systems.logs.commanded import filtered, over_steps
from spinndrift.systems.logs.signals import Series, Signals
from spinndrift.systems.mavlink.codec import filter_delay

CUTOFF = 20.0
STEP = 0.05
T = np.arange(1.0, 9.0, STEP)


def log(x, period=0.0025, **given):
    t = np.arange(0.0, 10.0, period)
    outputs = Series(t, np.atleast_2d(x(t)), "SERVO_OUTPUT_RAW")
    some = Series(t, np.zeros((3, t.size)), "some")
    return Signals(attitude=some, rates=some, outputs=outputs, **given)


@pytest.mark.parametrize("hertz", [1.0, 8.0, 20.0])
def test_a_filtered_wave_has_the_filters_gain_and_what_its_delay_leaves(hertz):
    one = log(lambda t: 1500 + 100 * np.sin(2 * np.pi * hertz * t)).outputs
    found = filtered(one, CUTOFF)
    b, a = scipy.signal.butter(2, 2 * np.pi * CUTOFF, analog=True)
    gain = scipy.signal.freqs(b, a, [2 * np.pi * hertz])[1][0]
    shifted = gain * np.exp(2j * np.pi * hertz * filter_delay(CUTOFF))
    t = found.t[(found.t > 2) & (found.t < 8)]
    wave = np.exp(2j * np.pi * hertz * t)
    x = found.x[0, (found.t > 2) & (found.t < 8)] - 1500
    fitted = np.linalg.lstsq(np.stack([wave.real, wave.imag], 1), x, rcond=None)[0]
    assert fitted[1] + 1j * fitted[0] == pytest.approx(100 * shifted, abs=3.0)


def test_a_step_stays_within_the_limits_of_the_outputs_and_keeps_its_time():
    one = log(lambda t: np.where(t < 5.0, 1500.0, 1900.0)).outputs
    found = filtered(one, CUTOFF)
    assert found.x.max() == 1900.0
    assert found.x.min() == 1500.0
    area = np.trapezoid(found.x[0] - 1500.0, found.t) / 400.0
    assert found.t[-1] - area == pytest.approx(5.0, abs=2e-3)


def test_outputs_on_two_sides_of_a_gap_are_filtered_apart():
    one = log(lambda t: np.where(t < 5.0, 1400.0, 1700.0)).outputs
    kept = (one.t < 4.0) | (one.t > 6.0)
    found = filtered(Series(one.t[kept], one.x[:, kept], one.source), CUTOFF)
    assert set(np.round(found.x[0], 6)) == {1400.0, 1700.0}
    assert not ((found.t > 4.0) & (found.t < 5.9)).any()


def test_outputs_of_no_known_filter_are_as_they_were():
    signals = log(lambda t: 1500 + 100 * np.sin(3 * t))
    assert filtered(signals.outputs, 0.0) is signals.outputs
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
