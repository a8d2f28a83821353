"""A thruster's output that stands still in the record while the motion shows that it did not.

A mixer drives several thrusters for the same axes, so the others tell what a column would have
been. It stood still only in the record if the motion fits what they tell much better. Where the
others leave an axis open that only this thruster and its partner drive (heave and roll of two
vertical ones), it is taken as not commanded. Its partner alone would then drive both axes: the
column did not stand still if one of them never answers.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...thruster_curves import NEUTRAL
from ...vehicles.vehicle import Vehicle
from ..outputs import in_words
from ..store import Recording
from .columns import columns_of
from .finding import Finding
from .held_outputs import VARIES, seconds, stands
from .hypotheses import CAUSAL, EVIDENCE, LEAST_COUNT, MAIN, PLAUSIBLE, Driven, driven_by, named
from .response import responses

_TELLS, _LEARNED = 0.9, 200
"""Share of a column's variance that others explain if they tell it, and samples for that."""


@dataclass(frozen=True)
class _Told:
    """The recording with a column as the others tell it, where that is, and the axis left open."""

    recording: Recording
    place: str
    open_axis: int | None


@dataclass(frozen=True)
class _Judged:
    """What the commands as they are explain of a scenario.

    Attributes:
        every: responses of all axes.
        own: of the axes that are judged by shares.
        nats: evidence of these.
        shares: of the motion, of these.
    """

    every: Driven
    own: Driven
    nats: float
    shares: dict[int, float]


def held_column(
    recording: Recording, vehicle: Vehicle | None, data: Driven
) -> tuple[float, list[Finding]]:
    """A thruster's column that stands still, whose thrust the motion shows; nats beyond chance.

    Each scenario is judged by itself: in another one thrusters may be driven in another way.
    """
    best: tuple[float, list[Finding]] = (0.0, [])
    if vehicle is None:
        return best
    for name in recording.scenarios:
        own = recording.select(name)
        now = None
        for k, _ in enumerate(data.columns):
            for told in _told_by_others(own, vehicle, data.weights, k):
                now = now or _judged(own, vehicle, data)
                worth = (
                    _gain(told.recording, vehicle, now)
                    if told.open_axis is None
                    else _unanswered(told, vehicle, now, k)
                )
                if worth > best[0]:
                    best = worth, [_column_finding(data, k, told.place)]
    return best


def _judged(recording: Recording, vehicle: Vehicle, data: Driven) -> _Judged:
    every = _driven(recording, vehicle)
    axes = {i: r for i, r in every.axes.items() if i in data.axes and r.count >= LEAST_COUNT}
    own = replace(data, axes=axes)
    nats, shares, _ = own.best(data.weights[..., None], PLAUSIBLE)
    kept = {i: float(share[0]) for i, share in shares.items()}
    return _Judged(every, own, float(np.sum(nats)), kept)


def _driven(recording: Recording, vehicle: Vehicle) -> Driven:
    columns = columns_of(recording, vehicle)
    assert columns is not None
    found = responses(recording, columns[0], recording.command_period)
    return driven_by(found, columns[1], columns[2], vehicle)


def _gain(changed: Recording, vehicle: Vehicle, now: _Judged) -> float:
    """Nats beyond `EVIDENCE` by which changed commands explain a scenario better; 0 if unclear."""
    if not now.own.axes:
        return 0.0
    axes = _driven(changed, vehicle).axes
    own = {i: replace(axes[i], count=r.count) for i, r in now.own.axes.items()}
    tried = replace(now.own, axes=own)
    nats, shares, _ = tried.best(tried.weights[..., None], CAUSAL, strict=True)
    clear = any(named(now.shares[i], float(shares[i][0]), r.count) for i, r in own.items())
    return float(nats[0]) - now.nats - EVIDENCE if clear else 0.0


def _unanswered(told: _Told, vehicle: Vehicle, now: _Judged, k: int) -> float:
    """Nats beyond `EVIDENCE` that a column that stood still would have given on the open axis.

    They count only if the motion of that axis does not follow its command, and that of the others
    which the thruster drives follows the changed ones.
    """
    axis = told.open_axis
    if axis not in now.every.axes or not now.every.unanswered(axis):
        return 0.0
    changed = _driven(told.recording, vehicle)
    others = np.flatnonzero(_mixer(changed.weights)[k])
    if not all(i in changed.axes and changed.answered(i) for i in others.tolist() if i != axis):
        return 0.0
    return now.every.expected(axis) - now.every.nats(axis) - EVIDENCE


def _told_by_others(
    recording: Recording, vehicle: Vehicle, weights: np.ndarray, k: int
) -> Iterator[_Told]:
    """What the others tell of column k where it stands still."""
    name, dt, mask = recording.thrust_from, recording.dt, recording.mask
    raw = recording.dataset[name]
    values = raw.to_numpy()
    held = np.zeros(mask.shape, bool)
    for j, r in np.argwhere(recording.lengths > 1).tolist():
        n = int(recording.lengths[j, r])
        held[j, r, :n] = stands(values[j, r, :n, [k]].T, dt)
    if not held.any():
        return
    signs = np.asarray(vehicle.thrusters().motor_directions) if name == "pwm" else 1.0
    neutral = NEUTRAL if name == "pwm" else 0.0
    sent = np.nan_to_num(values, nan=neutral) - neutral
    sent = sent * signs
    others = np.arange(sent.shape[-1]) != k
    x, y = sent[..., others], sent[..., k]
    where = [
        f"{recording.scenarios[j]}, {seconds(recording, j, r, held[j, r])}"
        for j, r in np.argwhere(held.any(axis=-1)).tolist()
    ]
    place = where[0] if len(where) == 1 else f"{len(where)} stretches, first {where[0]}"
    low, high = sent[mask].min(), sent[mask].max()
    for factors, open_axis in _factors(x[mask & ~held], y[mask & ~held], weights, k):
        expected = np.clip(x @ factors, low, high)
        if np.std(expected[held]) < VARIES * float(np.max(np.std(x[mask], axis=0))):
            continue
        told = sent.copy()
        told[..., k] = np.where(held, expected, sent[..., k])
        changed = np.where(mask[..., None], neutral + told * signs, np.nan)
        dataset = recording.dataset.assign({name: (raw.dims, changed, raw.attrs)})
        yield _Told(Recording(dataset), place, open_axis)


def _factors(
    x: np.ndarray, y: np.ndarray, weights: np.ndarray, k: int
) -> list[tuple[np.ndarray, int | None]]:
    """Linear factors of the others that give column k: learned where it moves, or by geometry.

    With them the axis that is taken as not commanded, where the others leave one open.
    """
    if len(y) >= _LEARNED and np.std(y) > 0:
        factors = np.linalg.lstsq(x, y, rcond=1e-6)[0]
        left = float(np.mean((y - x @ factors) ** 2))
        return [(factors, None)] if left < (1 - _TELLS) * float(np.var(y)) else []
    mixer = _mixer(weights)
    factors = _solved(mixer, k)
    if factors is not None:
        return [(factors, None)]
    found = []
    for axis in np.flatnonzero(mixer[k]).tolist():
        factors = _solved(np.delete(mixer, axis, axis=1), k)
        if factors is not None and np.any(factors):
            found.append((factors, axis))
    return found


def _mixer(weights: np.ndarray) -> np.ndarray:
    """Signs with which a mixer drives the thrusters (m) of each axis (6): those of their levers."""
    arms = weights / np.maximum(np.abs(weights).max(axis=1, keepdims=True), 1e-9)
    return np.where(np.abs(arms) > MAIN, np.sign(arms), 0.0).T


def _solved(mixer: np.ndarray, k: int) -> np.ndarray | None:
    """Factors of the other thrusters that give row k whatever the axes' commands; None if none."""
    rest = np.delete(mixer, k, axis=0)
    factors = mixer[k] @ np.linalg.pinv(rest, rcond=1e-6)
    return factors if np.allclose(factors @ rest, mixer[k], atol=1e-6) else None


def _column_finding(data: Driven, k: int, place: str) -> Finding:
    name = in_words(k + 1, data.outputs)
    return Finding(
        "output-held",
        f"column {data.columns[k]}; {place}",
        f"the output of {name} stands still at one value, while the other thrusters and the motion "
        "say that it was driven",
        f"record the output that drives it, or leave out the stretch in which {data.columns[k]} "
        "stands still",
    )
