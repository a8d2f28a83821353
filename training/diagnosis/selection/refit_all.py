"""A belief that is wrong in most of its numbers, brought near the data before anything is named.

Where every coefficient is off, names that are tried one by one explain each other's errors. With
`--refit all` the coefficients of a grey box are fitted together first: added mass, drag, buoyancy
and restoring moment, the thrusters' curve, what they push along each axis and their levers. Motion
alone tells all of these in proportion to each other. The scale is that of the rigid body's mass and
inertia, which one can weigh and compute; added mass and drag are not negative, and thrust lies as
near to the belief as that allows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ....models.effects.base import AXES
from ....models.effects.library import COEFFICIENTS
from ..filter.gram import least_within
from ..filter.noise import Filter
from ..filter.problem import Bench, Look
from .hypotheses import known_within

WRENCH = ("axis_thrust", "thrust_lever", "centre_of_buoyancy")
CURVE = ("thrust_table", "voltage_exponent")
PULSES = ("thrust_offset",)
OF_ALL = {
    "thrust_curve": ("exponent", 0.3),
    "thrust_asymmetry": ("reverse_gain", 0.5),
    "thruster_dead_zone": ("width", 3.0),
}
"""Parameters of effects in all thrusters alike, and how far they are known beforehand."""
_ROUNDS, _TRIES = 40, 8
_ENOUGH = 1.0
"""Nats a round from which a fit goes on."""
_START = 0.3
"""Dead zone and offset (N) to start from: at none their responses are one-sided."""
_COMMON = 13
"""Samples by which a piece's covariance is drawn to that of all: as many as give it an inverse."""
_DRAG, _BUOYANCY, _DELAY = 3.0, 20.0, 0.01
"""How far drag (in multiples of itself), net buoyancy (N) and the commands' delay (s) are known
beforehand."""


@dataclass(frozen=True)
class Coefficient:
    """A number of θ with what is known of it: standard deviation about the belief, and range."""

    row: int
    spread: float
    low: float
    high: float


def with_coefficients(bench: Bench) -> Bench:
    """The bench with the effects that only such a fit has, and bounds that physics sets."""
    level, of_pulses = bench.data.command != "F_Bo_B", bench.data.command == "pwm"
    for name, kind in COEFFICIENTS.items():
        if (name in CURVE and not level) or (name in PULSES and not of_pulses):
            continue
        if name == "voltage_exponent" and not bench.data.has_voltage:
            continue
        bench = bench.with_effect(kind.neutral())
    return bench.within({c.row: (c.low, c.high) for c in coefficients(bench)})


def coefficients(bench: Bench) -> list[Coefficient]:
    """All that is fitted."""
    library, found = bench.library, []
    level, of_pulses = bench.data.command != "F_Bo_B", bench.data.command == "pwm"
    rigid = np.diag(np.asarray(bench.model.rigid_inertia))
    for i, (cause, where, p) in enumerate(library.entries):
        old, start = bench.believes(cause, where), bench.believed[i]
        spread, low, high = p.spread, p.low, p.high
        if cause in ("linear_drag", "quadratic_drag"):
            both = [bench.believes(name, where) for name in ("linear_drag", "quadratic_drag")]
            spread, low = _DRAG * max(*both, 1e-3), -old
        elif cause == "added_mass":
            spread, low = max(old, 0.1 * float(rigid[AXES.index(where)])), -old
        elif (cause, where) == ("net_buoyancy", "all"):
            spread = _BUOYANCY
        elif (cause, where) == ("actuation_delay", "all") and level:
            spread = _DELAY
        elif cause in OF_ALL and level and where == "all" and p.name == OF_ALL[cause][0]:
            if cause == "thruster_dead_zone" and of_pulses:
                continue  # an offset says more
            spread = OF_ALL[cause][1]
        elif cause not in (*WRENCH, *CURVE, *PULSES):
            continue
        found.append(Coefficient(i, spread, start + min(low, 0.0), start + high))
    return found


def identify(
    bench: Bench,
    progress: Callable[[float], None] = lambda fraction: None,
    start: Float[np.ndarray, " p"] | None = None,
    also: Sequence[int] = (),
) -> Float[np.ndarray, " p"]:
    """θ with all coefficients where data and prior have them (Levenberg 1944).

    Steps are damped in units of what is known beforehand, so that they are short along valleys that
    data leave flat, which are curved, and whole across them.

    From the belief, or from `start`; with the parameters `also` of causes free beside them. Every
    step is weighed by the covariances that the one-step errors of pose and of twist have at it, in
    each piece its own: that asks for no noise levels that a wrong model makes too large, and an
    estimator's slow errors do less harm where the vehicle rests than where drag multiplies them.
    """
    chosen = [*coefficients(bench), *_beside(bench, also)]
    rows = [c.row for c in chosen]
    spread = np.array([c.spread for c in chosen])
    low, high = np.array([c.low for c in chosen]), np.array([c.high for c in chosen])
    centre = bench.believed[rows]
    if start is None:
        theta = bench.believed.copy()
        for c in chosen:
            if bench.library.entries[c.row].cause in ("thruster_dead_zone", "thrust_offset"):
                theta[c.row] += _START
    else:
        theta = start.copy()
        theta[rows] = np.clip(theta[rows], low, high)

    def loss(theta: np.ndarray, common: np.ndarray) -> float:
        away = (theta[rows] - centre) / spread
        C, counts = _by_piece(bench, bench.errors(theta), common)
        if not np.isfinite(C).all():
            return np.inf
        return float(counts @ np.linalg.slogdet(C)[1] + away @ away) / 2

    damping = 0.0
    for n in range(_ROUNDS):
        progress(n / _ROUNDS)
        common = bench.covariance(bench.errors(theta), apart=True)
        best = loss(theta, common)
        seen = bench.look(theta, rows, one_step(bench, theta))
        gradient, H = _quadratic(seen, rows)
        gradient = (gradient + (theta[rows] - centre) / spread**2) * spread
        # products of responses are rounded; with the prior no eigenvalue is below 1
        values, vectors = np.linalg.eigh(H * np.outer(spread, spread) + np.eye(len(rows)))
        values = np.maximum(values, 1.0)
        for _ in range(_TRIES):
            within = (low - theta[rows]) / spread, (high - theta[rows]) / spread
            step = least_within(values + damping, vectors, gradient, *within)
            moved = theta.copy()
            moved[rows] = np.clip(theta[rows] + step * spread, low, high)
            new = loss(moved, common)
            if new < best:
                break
            damping = max(10 * damping, 1.0)
        else:
            break
        won, theta, best = best - new, moved, new
        damping = damping / 10 if damping > 0.1 else 0.0
        if won < _ENOUGH:
            break
    return theta


def _beside(bench: Bench, rows: Sequence[int]) -> list[Coefficient]:
    """Parameters of causes as coefficients: known no better than a name's prior has them."""
    low, high = bench.limits(rows)
    return [
        Coefficient(i, known_within(bench.library.entries[i].parameter), a, b)
        for i, a, b in zip(rows, low.tolist(), high.tolist(), strict=True)
    ]


def one_step(bench: Bench, theta: Float[np.ndarray, " p"]) -> Filter:
    """The filter that believes every record: innovations are one-step errors, whitened."""
    error = bench.errors(theta)
    C, _ = _by_piece(bench, error, bench.covariance(error, apart=True))
    whiten = np.moveaxis(np.linalg.inv(np.linalg.cholesky(C)), 0, -1)
    whiten = np.repeat(whiten[None], len(bench.data.u), axis=0)
    log_det = np.broadcast_to(np.linalg.slogdet(C)[1] / 2, bench.data.weight.shape)
    return Filter(np.zeros_like(whiten), whiten, log_det)


def _by_piece(
    bench: Bench, error: Float[np.ndarray, "N 12 R"], common: Float[np.ndarray, "12 12"]
) -> tuple[Float[np.ndarray, "R 12 12"], Float[np.ndarray, " R"]]:
    """Covariance of each piece's one-step errors, and of how many samples it is one.

    It is the most likely under an inverse Wishart prior with the mean that all have in `common`.
    """
    C = np.einsum("nir,njr->rij", error, error)
    C[:, :6, 6:], C[:, 6:, :6] = 0.0, 0.0
    counts = bench.data.weight.sum(axis=0) + _COMMON
    return (C + _COMMON * common) / counts[:, None, None], counts


def _quadratic(seen: Look, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss–Newton Hessian of ½ |z|² by the parameters."""
    columns = [seen.evidence.column(i) for i in rows]
    total = seen.evidence.total
    return total[columns, 0], total[np.ix_(columns, columns)]
