"""Whether the axes that a topic map says fit the motion: velocities to positions, gravity to down.

The displacement over half a second is the integral of the velocity in the world, and at low
acceleration the specific force points up. Both hold in one choice of axes alone, as soon as the
vehicle moves and turns.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ....models.recordings.checks.finding import Finding
from ....models.recordings.resample import linear, rotations, slerp
from ..signals import Series
from .adjust import is_upside_down
from .quantities import Quantities
from .topics import Frames, Topic

_WINDOW_S, _LEAST_M, _FEWEST = 0.5, 0.05, 10
"""Displacements are compared over such windows if their rms is as large, and there are as many;
turns likewise."""
_MATTERS, _BETTER = 0.02, 0.1
"""Axes are wrong if they leave such a share of the squared displacement, and others this part of
it: noise and delays leave more than a tenth in any axes."""
_LEAST_RAD = 0.05
_GRAVITY, _UPRIGHT = (5.0, 15.0), 0.5
_FRAMES: tuple[Frames, ...] = ("ENU/FLU", "ENU/FRD", "NED/FRD", "NED/FLU")


def velocity_axes(
    taken: Quantities, attitude: Series, position: Series | None
) -> tuple[Topic, float] | None:
    """The velocity's topic with other axes that fit the positions, if the given ones don't.

    The second result is the share of the squared displacement that the given ones leave. None if
    the given ones fit, or the motion does not tell.
    """
    given = taken.topic("velocity")
    if given is None or position is None:
        return None
    left = _left(taken, given, attitude, position)
    if left is None or left < _MATTERS:
        return None
    others = list(_others(given))
    if not np.isfinite(position.x[:2]).any():  # the climb alone tells z of the given axes
        others = [one for one in others if one.expressed == given.expressed]
    found = {one: _left(taken, one, attitude, position) for one in others}
    fits = {
        one: share for one, share in found.items() if share is not None and share < _BETTER * left
    }
    return (min(fits, key=lambda one: fits[one]), left) if fits else None


def _others(given: Topic) -> Iterator[Topic]:
    """The topic with each other choice of axes; the usual mix-up of a world's axes first."""
    for expressed, frame in itertools.product(("world", "body"), _FRAMES):
        one = replace(given, expressed=expressed, frame=frame)
        if one != given:
            yield one


def _left(taken: Quantities, topic: Topic, attitude: Series, position: Series) -> float | None:
    """Share of the squared displacement that the integral of the velocity leaves."""
    velocity = taken.velocity(attitude, topic)
    if velocity is None:
        return None
    first = max(position.t[0], velocity.t[0])
    last = min(position.t[-1], velocity.t[-1])
    t = position.t[(position.t >= first) & (position.t <= last)]
    _, index = np.unique(np.floor((t - first) / _WINDOW_S), return_index=True)
    edges = t[index]
    if edges.size <= _FEWEST:
        return None
    moved = np.diff(linear(edges, position.t, position.x), axis=1)
    moved = moved[seen := np.isfinite(position.x).any(axis=1)]
    steps = 0.5 * (velocity.x[:, 1:] + velocity.x[:, :-1]) * np.diff(velocity.t)
    way = np.concatenate([np.zeros((3, 1)), np.cumsum(np.nan_to_num(steps), axis=1)], axis=1)
    off = moved - np.diff(linear(edges, velocity.t, way[seen]), axis=1)
    known = np.isfinite(moved).all(axis=0) & np.isfinite(off).all(axis=0)
    known &= np.diff(edges) < 2 * _WINDOW_S  # no pause
    total = float(np.mean(np.sum(moved[:, known] ** 2, axis=0))) if known.any() else 0.0
    if np.count_nonzero(known) < _FEWEST or total < _LEAST_M**2:
        return None
    return float(np.mean(np.sum(off[:, known] ** 2, axis=0))) / total


def rates_findings(taken: Quantities, attitude: Series) -> list[Finding]:
    """A finding where the rates' axes or unit contradict the turns of the attitude."""
    given, now = taken.topic("rates"), taken.rates(attitude)
    if given is None or now is None:
        return []
    left = _left_of_turns(now, attitude)
    if left is None or left < _MATTERS:
        return []
    others: dict[str, Series | None] = {
        f"`frame: {one.frame}` and `expressed: {one.expressed}`": taken.rates(attitude, one)
        for one in _others(given)
    }
    own = "an entry of its own for the rates with `scale: 0.0174533` (degrees)"
    others[own] = replace(now, x=np.deg2rad(now.x))
    for written, rates in others.items():
        share = None if rates is None else _left_of_turns(rates, attitude)
        if share is not None and share < _BETTER * left:
            return [
                Finding(
                    "wrong-frame",
                    given.topic,
                    f"its rates leave {100 * left:.0f} % of the turns of {attitude.source}, and "
                    f"{100 * share:.0f} % in other axes or another unit",
                    f"write {written} in the topic map",
                )
            ]
    return []


def _left_of_turns(rates: Series, attitude: Series) -> float | None:
    """Share of the squared turns over half a second that the integral of the rates leaves."""
    first, last = max(attitude.t[0], rates.t[0]), min(attitude.t[-1], rates.t[-1])
    t = attitude.t[(attitude.t >= first) & (attitude.t <= last)]
    _, index = np.unique(np.floor((t - first) / _WINDOW_S), return_index=True)
    edges = t[index]
    if edges.size <= _FEWEST:
        return None
    R = rotations(slerp(edges, attitude.t, attitude.x))
    turned = (R[:-1].inv() * R[1:]).as_rotvec().T
    steps = 0.5 * (rates.x[:, 1:] + rates.x[:, :-1]) * np.diff(rates.t)
    way = np.concatenate([np.zeros((3, 1)), np.cumsum(steps, axis=1)], axis=1)
    off = turned - np.diff(linear(edges, rates.t, way), axis=1)
    known = np.diff(edges) < 2 * _WINDOW_S  # no pause
    total = float(np.mean(np.sum(turned[:, known] ** 2, axis=0))) if known.any() else 0.0
    if np.count_nonzero(known) < _FEWEST or total < _LEAST_RAD**2:
        return None
    return float(np.mean(np.sum(off[:, known] ** 2, axis=0))) / total


def axes_findings(
    taken: Quantities, attitude: Series, position: Series | None, force: Series | None
) -> list[Finding]:
    """A finding where the axes of the map contradict the motion."""
    found = []
    other = velocity_axes(taken, attitude, position)
    given = taken.topic("velocity")
    if other is not None and given is not None:
        one, left = other
        found.append(
            Finding(
                "wrong-frame",
                given.topic,
                f"its velocities in {given.frame}, expressed in the {given.expressed}, leave "
                f"{100 * left:.0f} % of the displacements; in {one.frame}, expressed in the "
                f"{one.expressed}, they fit",
                f"write `frame: {one.frame}` and `expressed: {one.expressed}` in the topic map",
            )
        )
    found += rates_findings(taken, attitude)
    one = taken.topic("attitude")
    if one is not None and is_upside_down(one, taken.columns[one.topic]):
        found.append(
            Finding(
                "wrong-frame",
                one.topic,
                f"by axes {one.frame} the vehicle is upside down most of the time",
                "correct `frame` or `rpy` in the topic map",
            )
        )
    if force is not None and (felt := _felt(attitude, force)) is not None:
        size = float(np.linalg.norm(felt))
        if _GRAVITY[0] < size < _GRAVITY[1] and felt[2] < _UPRIGHT * size:
            found.append(
                Finding(
                    "wrong-frame",
                    f"{force.source}, {attitude.source}",
                    "the specific force does not point up in the world, as gravity demands, but "
                    f"along ({', '.join(f'{x:.1f}' for x in felt)}) m/s²",
                    "correct `frame` in the topic map: of both where all is NED/FRD, else of one",
                )
            )
    return found


def _felt(attitude: Series, force: Series) -> Float[np.ndarray, "3"] | None:
    """Median specific force in W (m/s²)."""
    inside = (force.t >= attitude.t[0]) & (force.t <= attitude.t[-1])
    x = force.x[:, inside]
    if not x.size or not np.isfinite(x).all():
        return None
    q = slerp(force.t[inside], attitude.t, attitude.x)
    return np.median(rotations(q).apply(x.T), axis=0)
