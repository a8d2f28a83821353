"""Commands behind the low-pass that the recorded body rates went through.

An autopilot logs its rates behind a filter (INS_GYRO_FILTER). Behind one filter, what commands do
is what filtered commands do (Ljung 1999, section 14.4), so the pulses are filtered likewise: forces
are those of a believed curve, whose dead band would hide small ones behind their neighbours. An
import has already moved the rates back by the filter's delay, so that of the pulses is left out.
"""

from typing import Any

import numpy as np
import scipy.signal
from jaxtyping import Float

from ...models.recordings.commands import rises_of, thrusters_of
from ...models.recordings.origin import LOW_PASS
from ...models.recordings.schema import PWM_RISE
from ...models.recordings.store import Recording

_PARTS = 20.0
"""Samples in a period of the filter's cutoff, within which steps are resolved."""


def with_rises(
    recording: Recording, vehicle: Any
) -> tuple[Recording, Float[np.ndarray, "J K N n"] | None]:
    """The recording and rises of forces (N) over its steps; None where commands are held.

    Where there are rises, forces are those of pulses behind the filter of the body rates. `vehicle`
    is as in `Recording.wrench`.
    """
    if not {"pwm", PWM_RISE} <= set(recording.dataset):
        return recording, None
    thrusters = thrusters_of(recording.dataset, vehicle, "pwm")
    if rises_of(recording.dataset, thrusters) is None:
        return recording, None
    recording = with_filtered_pulses(recording)
    return recording, rises_of(recording.dataset, thrusters)


def wrench_rise(
    recording: Recording, vehicle: Any, rise: Float[np.ndarray, "J K N n"] | None
) -> Float[np.ndarray, "J K N 6"] | None:
    """Changes of the wrench over each step, from those of the forces that it is made from."""
    if rise is None or "F_Bo_B" in recording.dataset:
        return None
    return rise @ np.asarray(thrusters_of(recording.dataset, vehicle, "pwm").allocation).T


def with_filtered_pulses(recording: Recording) -> Recording:
    """A recording of pulses with their rises, behind the filter of its rates where it tells one.

    The filter overshoots; the range of each output in a run is kept.
    """
    dataset = recording.dataset
    cutoff = float(dataset.attrs.get(LOW_PASS, 0.0))
    if not cutoff:
        return recording
    pwm, rise = (dataset[name].to_numpy().copy() for name in ("pwm", PWM_RISE))
    for j, k in np.argwhere(recording.lengths > 0).tolist():
        own = j, k, slice(int(recording.lengths[j, k]))
        low, high = pwm[own].min(axis=0), pwm[own].max(axis=0)
        mean, rise[own] = behind_filter(pwm[own], np.nan_to_num(rise[own]), recording.dt, cutoff)
        pwm[own] = np.clip(mean, low, high)
    new = {"pwm": pwm, PWM_RISE: rise}
    return Recording(dataset.assign({n: dataset[n].copy(data=x) for n, x in new.items()}))


def behind_filter(
    u: Float[np.ndarray, "N n"], rise: Float[np.ndarray, "N n"], dt: float, cutoff: float
) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]]:
    """Means and rises of commands over their steps, behind the filter and without its delay.

    The filter is a Butterworth of second order, as ArduPilot's (LowPassFilter2p).

    Args:
        u: mean of each step.
        rise: change over it.
        dt: length of the steps (s).
        cutoff: of the filter (Hz).
    """
    parts = max(int(np.ceil(dt * _PARTS * cutoff)), 2)
    step = dt / parts
    delay = step / (np.sqrt(2.0) * np.tan(np.pi * cutoff * step))  # s, of the sampled filter
    along = (np.arange(parts) + 0.5) / parts - 0.5
    fine = (u[:, None] + rise[:, None] * along[:, None]).reshape(-1, u.shape[1])
    fine = np.concatenate([fine, np.repeat(fine[-1:], int(delay / step) + 2, axis=0)])
    sections = np.asarray(scipy.signal.butter(2, cutoff, fs=1 / step, output="sos"))
    start = scipy.signal.sosfilt_zi(sections)[:, :, None] * fine[0]
    y = scipy.signal.sosfilt(sections, fine, axis=0, zi=start)[0]
    whole = int(delay / step)
    share, size = delay / step - whole, len(u) * parts
    y = (1 - share) * y[whole : whole + size] + share * y[whole + 1 : whole + 1 + size]
    y = y.reshape(len(u), parts, -1)
    return y.mean(axis=1), np.einsum("npk,p->nk", y, along) / np.sum(along**2)
