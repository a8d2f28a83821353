"""Positions and velocities that are all given in another unit of length.

They fit each other, and neither angles nor rates tell of it. The answer to the commands does: in
lengths that are 1/k of a metre, speeds are k times too large, so that in

    F = m v̇ + d v + e |v| v

the fitted m is 1/k and e is 1/k² of the vehicle's, while those of rotation are right. Thrust that
is off by a factor changes all of them alike, and another vehicle has other numbers, but not in such
a ratio. The logarithms of the ratios of fitted to believed numbers are taken as normal; what is
uncertain of the hull, of each axis and of thrust makes their covariance.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls
from scipy.stats import chi2

from ...vehicles.vehicle import Vehicle
from ..conventions import LENGTHS
from .finding import Finding
from .hypotheses import EVIDENCE, MOST, PLAUSIBLE, Driven
from .response import AxisResponse

_MASS, _DRAG, _THRUST = 0.35, 0.7, 1.0
"""Standard deviations of logarithms: believed inertia with its added mass, which is known to a
half; drag, known to a factor of 2; thrust, whose curve and voltage may be another motor's."""
_COMMON = 0.5
"""Part of the variance of inertias and drags that is common to all axes of a kind: the hull's."""
_KNOWN = 0.5
"""Standard error of a logarithm above which a number is not taken."""
_MENTIONED = 6.0
"""Nats from which a unit is mentioned, below `EVIDENCE`."""
_NEAR = 3.0
"""Nats by which a second unit may be less likely and is named beside the first."""
_FITS = 1e-3
"""Probability of numbers so far from those of a unit, below which it explains nothing."""


def length_findings(data: Driven, vehicle: Vehicle | None) -> list[Finding]:
    """A unit of length in which the vehicle's numbers fit, and in metres do not."""
    if vehicle is None:
        return []
    y, rows = _ratios(data, vehicle)
    linear = np.array([axis < 3 for axis, _, _ in rows], bool)
    if not linear.any():
        return []
    order = np.array([power for _, power, _ in rows], float)
    cov = _covariance(rows)
    squares: dict[str, float] = {}
    for unit, size in {"": 1.0, **LENGTHS}.items():
        off = y - linear * order * np.log(size)
        squares[unit] = float(off @ np.linalg.solve(cov, off))
    usual = squares.pop("")
    best = min(squares, key=lambda unit: squares[unit])
    nats = 0.5 * (usual - squares[best])
    if nats < _MENTIONED or chi2.sf(squares[best], len(y)) < _FITS:
        return []
    units = " or ".join(u for u in squares if 0.5 * (squares[u] - squares[best]) < _NEAR)
    return [_severe(units) if nats > EVIDENCE else _doubtful(units)]


def _severe(units: str) -> Finding:
    return Finding(
        "length-unit",
        "x,y,z and u,v,w",
        f"all positions and velocities look like {units}: the commands make the vehicle's mass and "
        "drag too small by this factor and its square, and those of rotation not",
        "give m and m/s",
    )


def _doubtful(units: str) -> Finding:
    return Finding(
        "length-doubtful",
        "x,y,z and u,v,w",
        f"positions and velocities may be in {units}, or the vehicle is far lighter and has less "
        "drag than its file says: the commands do not tell which",
        "check their unit, and mass and drag in the vehicle's file",
    )


def _ratios(data: Driven, vehicle: Vehicle) -> tuple[np.ndarray, list[tuple[int, int, float]]]:
    """Logarithms of fitted over believed numbers, with axis, power of the length, and variance."""
    y, rows = [], []
    for i, r in data.axes.items():
        believed = data.mass[i], vehicle.quadratic_damping[i]
        found, errors = fitted(r, data.weights[i])
        for power, n in ((1, 0), (2, 2)):
            if believed[power - 1] > 0 and found[n] > 0 and errors[n] < _KNOWN * found[n]:
                y.append(np.log(found[n] / believed[power - 1]))
                rows.append((i, power, float((errors[n] / found[n]) ** 2)))
    return np.array(y), rows


def fitted(
    r: AxisResponse, weights: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """m, d, e of an axis and their standard errors at the most likely lag; zeros without answer."""
    shares = r.fit(weights, PLAUSIBLE)[0]
    lag, share = PLAUSIBLE[int(np.argmax(shares))], float(np.max(shares))
    if share < MOST:
        return np.zeros(3), np.full(3, np.inf)
    size = np.sqrt(np.maximum(np.diag(r.RR), 1e-300))
    RR = r.RR / np.outer(size, size) + 1e-9 * np.eye(3)
    L = np.linalg.cholesky(RR)
    theta = nnls(L.T, np.linalg.solve(L, r.RC[lag] @ weights / size))[0]
    left = float(weights @ r.CC[lag] @ weights) * (1 - share) / r.count
    return theta / size, np.sqrt(left * np.diag(np.linalg.inv(RR))) / size


def _covariance(rows: list[tuple[int, int, float]]) -> np.ndarray:
    belief: Mapping[int, float] = {1: _MASS**2, 2: _DRAG**2}
    cov = np.full((len(rows), len(rows)), _THRUST**2)
    for a, (i, power, variance) in enumerate(rows):
        cov[a, a] += variance + (1 - _COMMON) * belief[power]
        for b, (j, other, _) in enumerate(rows):
            if power == other and (i < 3) == (j < 3):
                cov[a, b] += _COMMON * belief[power]
    return cov
