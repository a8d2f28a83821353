"""Conventions that poses and twists are mistaken for: units, signs, order and frames of their axes.

A reading changes poses and twists to what they should have been. Every order and sign of three axes
is tried by sums of products: with displacements d and integrals i over windows, the residual of
d = k P i is |d|² - 2 k tr(Pᵀ Σ d iᵀ) + k² |i|² for a signed permutation P.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .resample import rotations

Arrays = tuple[np.ndarray, np.ndarray]

LENGTHS = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "feet": 0.3048}
"""Units that lengths are given in by mistake, in m."""
SPEEDS = {"mm/s": 1e-3, "cm/s": 1e-2, "ft/s": 0.3048, "knots": 0.514444, "km/h": 1 / 3.6}
_DEGREE = np.pi / 180
_NEAR = 2.0
"""A simpler reading is taken if it leaves at most twice of what the best one leaves."""
MOST = 0.7
"""Share of the motion that a reading must explain in each half of the record."""
_ROUNDING = 1e-3
"""Share of the squared motion below which readings fit equally well."""


def _flip(x: np.ndarray, rows: tuple[int, ...]) -> np.ndarray:
    sign = np.ones((x.shape[0], 1))
    sign[list(rows)] = -1
    return x * sign


def _world(X: np.ndarray, V: np.ndarray, part: slice) -> Arrays:
    turned = V.copy()
    turned[part] = rotations(X[:4]).inv().apply(V[part].T).T
    return X, turned


def _mirrored(X: np.ndarray, V: np.ndarray, row: int) -> Arrays:
    """Velocities with the other sign along one of the world's axes."""
    R = rotations(X[:4])
    turned = V.copy()
    turned[:3] = R.inv().apply(_flip(R.apply(V[:3].T).T, (row,)).T).T
    return X, turned


Reading = tuple[str, Callable[[np.ndarray, np.ndarray], Arrays]]


def _speed(unit: str, size: float) -> Reading:
    return f"u,v,w look like {unit}; give m/s", lambda X, V: (X, V * size)


def _length(unit: str, size: float) -> Reading:
    return f"x,y,z look like {unit}; give m", lambda X, V: (X, V / size)


LINEAR: list[Reading] = [
    (
        "u,v,w look like velocities along the world's axes; rotate them into the body",
        lambda X, V: _world(X, V, slice(0, 3)),
    ),
    *(_speed(unit, size) for unit, size in SPEEDS.items()),
    *(_length(unit, size) for unit, size in LENGTHS.items()),
    (
        "u,v,w look like forward-right-down while x,y,z and the quaternion do not; "
        "give all in one convention",
        lambda X, V: (X, _flip(V, (1, 2))),
    ),
    ("u seems to have the wrong sign; give forward as positive", lambda X, V: (X, _flip(V, (0,)))),
    ("v seems to have the wrong sign; give left as positive", lambda X, V: (X, _flip(V, (1,)))),
    (
        "the velocity along the world's x has the wrong sign; give all in one convention",
        lambda X, V: _mirrored(X, V, 0),
    ),
    (
        "the velocity along the world's y has the wrong sign; give all in one convention",
        lambda X, V: _mirrored(X, V, 1),
    ),
    (
        "z seems to have the wrong sign against w; give all in one convention",
        lambda X, V: (_flip(X, (6,)), V),
    ),
    (
        "x,y,z look like north-east-down while the quaternion does not; give all in one convention",
        lambda X, V: (np.concatenate([X[:4], X[[5]], X[[4]], -X[[6]]]), V),
    ),
]
ANGULAR: list[Reading] = [
    (
        "the columns of u,v,w and p,q,r look exchanged; give linear velocities first",
        lambda X, V: (X, V[[3, 4, 5, 0, 1, 2]]),
    ),
    ("p,q,r look like deg/s; give rad/s", lambda X, V: (X, V * _DEGREE)),
    ("p,q,r look like mrad/s; give rad/s", lambda X, V: (X, V * 1e-3)),
    (
        "p,q,r are 57.3 times too small, as if converted from degrees twice; give rad/s",
        lambda X, V: (X, V / _DEGREE),
    ),
    ("p seems to have the wrong sign", lambda X, V: (X, _flip(V, (3,)))),
    ("q seems to have the wrong sign", lambda X, V: (X, _flip(V, (4,)))),
    ("r seems to have the wrong sign", lambda X, V: (X, _flip(V, (5,)))),
    (
        "the quaternion's columns look like x,y,z,w; give w first",
        lambda X, V: (np.concatenate([X[[3, 0, 1, 2]], X[4:]]), V),
    ),
    (
        "p,q,r look like rates about the world's axes; rotate them into the body",
        lambda X, V: _world(X, V, slice(3, 6)),
    ),
    (
        "the quaternion looks like world-to-body; give body-to-world (its conjugate)",
        lambda X, V: (_flip(X, (1, 2, 3)), V),
    ),
    (
        "p,q,r look like forward-right-down while the quaternion does not; "
        "give all in one convention",
        lambda X, V: (X, _flip(V, (4, 5))),
    ),
]


@dataclass(frozen=True)
class Explained:
    """A reading in words, and the share of the squared motion that it explains."""

    reading: str
    share: float


@dataclass(frozen=True)
class Axes:
    """Names of the three axes that may be in another order, and how their motion is expressed.

    Attributes:
        names: of the axes.
        moved: displacements over windows (3, n).
        integrals: of the velocities over them, in the same axes (3, n).
        before: a reading without which the axes are not those of the integrals; empty for none.
        units: factors of the integrals that are tried, by their words.
        right: what is right, in words.
        least: root mean square of a displacement that is more than noise.
    """

    names: tuple[str, str, str]
    moved: Float[np.ndarray, "3 n"]
    integrals: Float[np.ndarray, "3 n"]
    before: str = ""
    units: Sequence[tuple[str, float]] = (("", 1.0),)
    right: str = "give all in one convention"
    least: float = 0.02


def exchanged(groups: Sequence[Axes], least: float, even: bool = False) -> Explained | None:
    """The simplest order and signs of axes that explain at least a share of the motion.

    The simplest is that with the fewest changes, of those that leave nearly as little as the best.
    With `even` each axis that moves counts alike, else by its motion.
    """
    found = [one for axes in groups for one in _throughout(axes, even)]
    fits = [(cost, one) for cost, one in found if cost and one.share > least]
    if not fits:
        return None
    left = min(1 - one.share for _, one in fits)
    near = [(cost, one) for cost, one in fits if 1 - one.share <= _NEAR * left + _ROUNDING]
    return min(near, key=lambda pair: (pair[0], -pair[1].share))[1]


def _throughout(axes: Axes, even: bool) -> Iterator[tuple[int, Explained]]:
    """Changes and fits that explain most of the motion in both halves: conventions stay."""
    whole, *halves = (
        list(
            _orders(
                replace(axes, moved=axes.moved[:, part], integrals=axes.integrals[:, part]), even
            )
        )
        for part in _parts(axes.moved.shape[1])
    )
    for n, one in enumerate(whole):
        if all(half[n][1].share > MOST for half in halves if half):
            yield one


def _parts(count: int) -> tuple[slice, slice, slice]:
    """All windows, and their halves."""
    return slice(None), slice(0, count // 2), slice(count // 2, None)


def as_given(axes: Axes) -> float:
    """Share that the axes explain as they are, each alike."""
    return max((one.share for cost, one in _orders(axes, True) if not cost), default=np.nan)


def _orders(axes: Axes, even: bool) -> Iterator[tuple[int, Explained]]:
    """Changes and fit of every order, signs and unit of some axes."""
    known = np.isfinite(axes.moved).all(axis=0) & np.isfinite(axes.integrals).all(axis=0)
    d, i = axes.moved[:, known], axes.integrals[:, known]
    sizes, own, G = np.sum(d**2, axis=1), np.sum(i**2, axis=1), d @ i.T
    weights = 1 / np.maximum(sizes, d.shape[1] * axes.least**2 + 1e-12) if even else np.ones(3)
    whole = float(weights @ sizes)
    if whole <= 0:
        return
    for order in itertools.permutations(range(3)):
        own_ordered, products = own[list(order)], G[range(3), order]
        for signs in itertools.product((1, -1), repeat=3):
            told = _in_words(axes.names, order, signs)
            for unit, k in axes.units:
                left = weights @ (sizes - 2 * k * np.array(signs) * products + k**2 * own_ordered)
                said = [part for part in (axes.before, *told, unit) if part]
                text = f"{', and '.join(said)}; {axes.right}"
                yield len(said), Explained(text, 1 - float(left) / whole)


def quaternions() -> Iterator[Reading]:
    """Every other order and sign of the quaternion's qx, qy, qz, the simplest first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            told = _in_words(("qx", "qy", "qz"), order, signs)
            if told:
                found.append((len(told), told, np.array(signs)[:, None], list(order)))
    for _, told, signs, order in sorted(found, key=lambda one: one[0]):
        text = f"{', and '.join(told)}; give the quaternion body-to-world in the axes of the rest"
        yield text, _turned_axes(signs, order)


def _turned_axes(signs: np.ndarray, order: list[int]) -> Callable[[np.ndarray, np.ndarray], Arrays]:
    return lambda X, V: (np.concatenate([X[:1], signs * X[1:4][order], X[4:]]), V)


def _in_words(names: Sequence[str], order: Sequence[int], signs: Sequence[int]) -> list[str]:
    """What is changed: the row of a displacement is the integral of the axis `order[row]`."""
    moved = [row for row, column in enumerate(order) if row != column]
    told = []
    if len(moved) == 2:
        told.append(f"{names[moved[0]]} and {names[moved[1]]} look exchanged")
    elif moved:
        found = ",".join(names[order.index(n)] for n in range(3))
        told.append(f"{','.join(names)} look like {found}")
    turned = [names[column] for row, column in enumerate(order) if signs[row] < 0]
    if turned:
        told.append(f"{', '.join(turned)} {'have' if len(turned) > 1 else 'has'} the other sign")
    return told


def along_axis(
    axis: int, moved: Float[np.ndarray, " n"], integral: Float[np.ndarray, " n"]
) -> tuple[Explained, float] | None:
    """The best unit or sign of the motion along one axis of the world; the share as it is given."""
    known = np.isfinite(moved) & np.isfinite(integral)
    d, i = moved[known], integral[known]
    size = float(np.sum(d**2))
    if size <= 0:
        return None
    name = "xyz"[axis]
    tried = {f"{name} looks like {u} against u,v,w; give m": 1 / k for u, k in LENGTHS.items()}
    tried |= {
        f"the velocity along the world's {name} looks like {unit}; give m/s": k
        for unit, k in SPEEDS.items()
    }
    signs = f"{name} and the velocity along it have opposite signs; give all in one convention"
    tried[signs] = -1.0
    best = max(tried, key=lambda how: _share(d, tried[how] * i))
    worst = min(_share(d[part], tried[best] * i[part]) for part in _parts(d.size))
    share = _share(d, tried[best] * i) if worst > MOST else -np.inf
    return Explained(best, share), _share(d, i)


def _share(d: Float[np.ndarray, " n"], i: Float[np.ndarray, " n"]) -> float:
    """Share of the squared displacements that integrals explain; 1 without displacements."""
    return 1 - float(np.sum((d - i) ** 2)) / max(float(np.sum(d**2)), 1e-12) if d.size else 1.0
