"""From the states of the inner steps to what instruments show at the samples."""

import numpy as np

from .effect import Signals
from .plant import Plant
from .rotations import exponential, product, to_body, to_world

LEAD = 0.2
"""The simulation begins so many s before the first sample, so that late signals have a past."""


def _at(history: np.ndarray, position: np.ndarray, rows: slice, runs: np.ndarray) -> np.ndarray:
    """Rows of the history (steps, size, B) at real-valued steps (N, k) of some runs."""
    top = history.shape[0] - 1
    position = np.clip(position, 0, top)
    i = np.minimum(np.floor(position).astype(int), max(top - 1, 0))
    s = (position - i)[:, None]
    part = history[:, rows]
    low = part[i, :, runs].transpose(0, 2, 1)
    if not s.any():
        return low
    high = part[np.minimum(i + 1, top), :, runs].transpose(0, 2, 1)
    return np.where(s == 0, low, (1 - s) * low + s * high)


def instruments_show(
    history: np.ndarray, at: np.ndarray, h: float, plant: Plant, runs: np.ndarray | None = None
) -> Signals:
    """What noiseless instruments of runs (k,) show at inner steps `at` (N, k)."""
    run = np.arange(history.shape[2]) if runs is None else runs

    def late(name: str, rows: slice) -> np.ndarray:
        return _at(history, at - plant.shifts.get(name, 0.0) / h, rows, run)

    pose = late("pose", slice(0, 7))
    v, w = late("linear", slice(7, 10)), late("angular", slice(10, 13))
    q = pose[:, 3:7] / np.sqrt(np.sum(pose[:, 3:7] ** 2, axis=1, keepdims=True))

    def turn(a: np.ndarray) -> np.ndarray:
        return np.moveaxis(a, 1, 0)

    signals = Signals(at * h - LEAD, turn(pose[:, :3]), turn(q), turn(v), turn(w))
    for effect in plant.effects:
        signals = effect.measure(signals)
    return signals


def _noisy(
    signals: Signals, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    e = np.moveaxis(errors, 1, 0)
    q = product(signals.q, exponential(e[3:6])) if e[3:6].any() else signals.q
    return signals.p + e[:3], q, signals.v + e[6:9], signals.w + e[9:]


def observe(
    history: np.ndarray, h: float, i: int, runs: np.ndarray, errors: np.ndarray, plant: Plant
) -> tuple[np.ndarray, np.ndarray]:
    """What the controllers of some runs see at inner step i: pose (7, k), twist (6, k)."""
    at = np.full((1, runs.size), i, float)
    signals = instruments_show(history[: i + 1], at, h, plant, runs)
    p, q, v, w = _noisy(signals, errors[None])
    return np.concatenate([q, p])[:, 0], np.concatenate([v, w])[:, 0]


def record(
    history: np.ndarray,
    at: np.ndarray,
    h: float,
    errors: np.ndarray,
    plant: Plant,
    dead_reckoned: bool,
    rate_filter: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    signals = instruments_show(history, at.astype(float), h, plant)
    p, q, v, w = _noisy(signals, errors)
    if not (dead_reckoned or rate_filter):
        X, V = np.concatenate([q, p]), np.concatenate([v, w])
        return np.moveaxis(X, 0, 1), np.moveaxis(V, 0, 1)
    every = np.arange(history.shape[0], dtype=float)[:, None] + np.zeros(at.shape[1])
    fine = instruments_show(history, every, h, plant)
    if rate_filter:
        w = w - signals.w + low_pass(fine.w, rate_filter, h)[:, at, np.arange(at.shape[1])]
    if dead_reckoned:
        speed = to_world(fine.q, fine.v)
        path = np.zeros_like(speed)
        path[:, 1:] = np.cumsum(0.5 * h * (speed[:, 1:] + speed[:, :-1]), axis=1)
        path = path[:, at, np.arange(at.shape[1])]
        walk = np.zeros_like(p)
        dt = np.diff(at, axis=0) * h
        error = to_world(signals.q, v - signals.v)
        walk[:, 1:] = np.cumsum(dt * error[:, :-1], axis=1)
        p = history[at[0], :3, np.arange(at.shape[1])].T[:, None] + path - path[:, :1] + walk
    X, V = np.concatenate([q, p]), np.concatenate([v, w])
    return np.moveaxis(X, 0, 1), np.moveaxis(V, 0, 1)


def low_pass(x: np.ndarray, cutoff: float, h: float) -> np.ndarray:
    """Butterworth's of second order by the bilinear transform, on x (k, N, B) each h s."""
    c = np.tan(np.pi * cutoff * h)
    a0 = 1 + np.sqrt(2) * c + c * c
    b, a1, a2 = c * c / a0, 2 * (c * c - 1) / a0, (1 - np.sqrt(2) * c + c * c) / a0
    y = x.copy()  # at rest in the first value
    for n in range(2, x.shape[1]):
        came = x[:, n] + 2 * x[:, n - 1] + x[:, n - 2]
        y[:, n] = b * came - a1 * y[:, n - 1] - a2 * y[:, n - 2]
    return y


def specific_force(history: np.ndarray, samples: np.ndarray, h: float) -> np.ndarray:
    """What an accelerometer at Bo shows at samples (N, B): the mean over a step, (N, 3, B).

    The change of the velocity in W over the step, less gravity, seen from the body at its middle.
    """
    half = max(int(np.median(np.diff(samples, axis=0))) // 2, 1)
    lead, last = round(LEAD / h), len(history) - 1
    at = samples + lead
    before, after = np.maximum(at - half, 0), np.minimum(at + half, last)
    run = np.arange(history.shape[2])

    def state(i: np.ndarray) -> np.ndarray:
        return np.moveaxis(history[i, :13, run], -1, 0)

    first, middle, end = state(before), state(at), state(after)
    v_W = [to_world(y[3:7], y[7:10]) for y in (first, end)]
    a_W = (v_W[1] - v_W[0]) / ((after - before) * h)
    a_W[2] += 9.80665
    return np.moveaxis(to_body(middle[3:7], a_W), 0, 1)
