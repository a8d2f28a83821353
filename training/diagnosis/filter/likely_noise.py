"""Maximum likelihood noise of records and process, from blocks of one-step errors.

r_n = e_(n+1) - A e_n + w_n is a moving average of first order. Its blocks of `_BLOCK` neighbours,
each axis less its mean over the block (slow errors of the model are not noise), are normal with a
covariance that is linear in the variances of records and process: Σ = Σ_i θ_i G_i. Fisher's scoring
in log θ finds the most likely ones (Anderson 1973, "Asymptotically efficient estimation of
covariance matrices with linear structure"). Lag-one moments alone have little information on a
process that is smaller than the records' noise; whole blocks have more.

Slow disturbances add Σ_j σ_j² φ_j^|n - m| g_j g_jᵀ, with g_j the error that a constant one makes:
linear in their variances too. Longer blocks thus separate a white level from coloured noise.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from ...least_squares import LocalModel, marquardt, minimise
from .transition import Transition

_BLOCK, _LEAST = 12, 8
"""Samples of a block, and blocks at least."""
_ENOUGH_BLOCKS = 40
"""Blocks at least where an axis with lost velocities is used: they overlap by half, so that they
have about 220 degrees of freedom, which give a variance to a tenth."""
_LONGER = 24
"""Samples of a block where slow disturbances are separated from a white level."""
_TIMES = (0.3, 1.0, 4.0)
"""Time constants (s) of slow disturbances, as a mixture."""
_ROUNDS, _ENOUGH = 60, 1e-4
"""Rounds of scoring; gain of log likelihood a block at which scoring ends."""
_STEP = 1.5  # largest step of log θ
_DEEP = 14.0
"""How far below its start log θ may go where slow disturbances are fitted."""
_CLEAR = 10.0
"""Ratio of a pose's measurement variance to its process variance over a step, above which the pose
is used. Exact poses would show a simulation's integration scheme instead of the process."""


class Likelihood(NamedTuple):
    """Likelihood of blocks y: S, the mean of y yᵀ, has the expectation Σ_i exp(x_i) G_i."""

    S: Float[np.ndarray, "d d"]
    G: Float[np.ndarray, "k d d"]

    def loss(self, x: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, "d d"]]:
        """Negative log likelihood a block, up to a constant, and Σ⁻¹."""
        covariance = np.tensordot(np.exp(x), self.G, 1)
        try:
            L = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return np.inf, covariance
        inverse = np.linalg.inv(covariance)
        return float(np.log(np.diag(L)).sum() + np.sum(inverse * self.S) / 2), inverse

    def fisher(
        self, x: Float[np.ndarray, " k"], inverse: Float[np.ndarray, "d d"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Gradient of the loss in x, and the Fisher information."""
        IG = inverse @ self.G * np.exp(x)[:, None, None]
        slope = np.trace(IG, axis1=1, axis2=2) - np.einsum("iab,ba->i", IG, inverse @ self.S)
        return slope / 2, np.einsum("iab,jba->ij", IG, IG, optimize=True) / 2

    def likeliest(
        self,
        x: Float[np.ndarray, " k"],
        low: Float[np.ndarray, " k"],
        moved: Bool[np.ndarray, " k"],
    ) -> Float[np.ndarray, " k"]:
        """Fisher scoring from x over the entries `moved`, bounded below by `low`."""
        x = np.where(moved, np.maximum(x, low), x)

        def local(x: np.ndarray) -> LocalModel:
            loss, inverse = self.loss(x)
            slope, fisher = self.fisher(x, inverse)
            free = moved & ((x > low + 1e-9) | (slope < 0))

            def stepped(damping: float) -> np.ndarray:
                step = np.zeros(len(x))
                full = marquardt(fisher[np.ix_(free, free)], slope[free], damping)
                step[free] = np.clip(full, -_STEP, _STEP)
                return np.where(moved, np.maximum(x + step, low), x)

            return LocalModel(loss, lambda x: self.loss(x)[0], stepped)

        return minimise(x, local, _ROUNDS, _ENOUGH)


def most_likely(
    error: Float[np.ndarray, "N 12 R"],
    weight: Float[np.ndarray, "N R"],
    transition: Transition,
    units: Float[np.ndarray, "6 12 12"],
    start: Float[np.ndarray, "18"],
    least: Float[np.ndarray, "18"],
    held: Bool[np.ndarray, "6"] | None = None,
    apart: Bool[np.ndarray, "6"] | None = None,
) -> tuple[Float[np.ndarray, "18"], Float[np.ndarray, "6"]]:
    """Variances of the twelve records and the six b², and standard errors of the six.

    Where data are too few it returns `start`, with standard errors equal to b².

    A b² below its standard error is replaced by that error: a filter without process noise has no
    gain, and its innovations are correlated.

    Args:
        error: of one-step predictions.
        weight: zero where a piece has no sample.
        transition: of a step.
        units: covariance of a step's process for b² = 1 of each axis.
        start: first guess.
        least: lower bounds.
        held: axes whose b² stays as in `start`.
        apart: axes whose errors are not used, and whose variances stay as in `start`.
    """
    blocks = _blocks(error, weight, _BLOCK)
    if len(blocks) < _LEAST:
        return start, start[12:]
    apart = np.zeros(6, bool) if apart is None else apart
    used = _used_axes(blocks, units, start) & ~np.tile(apart, 2)
    model = _likelihood(blocks, transition, units, used)
    held = apart if held is None else held | apart
    moved = np.concatenate([used, ~held])
    x = model.likeliest(np.log(start), np.log(least), moved)
    found = np.exp(x)
    loss, inverse = model.loss(x)
    if not np.isfinite(loss):  # predictions that nearly diverge
        return start, start[12:]
    curvature = model.fisher(x, inverse)[1][np.ix_(moved, moved)] * len(blocks) / 2
    size = np.sqrt(np.diag(curvature))  # poses and forces differ in scale
    covariance = np.linalg.pinv(curvature / np.outer(size, size), hermitian=True)
    relative = np.zeros(len(found))
    relative[moved] = np.sqrt(np.maximum(np.diag(covariance), 0.0)) / size
    errors = (relative * found)[12:]
    wrench = np.where(held, found[12:], np.maximum(found[12:], errors))
    return np.concatenate([found[:12], wrench]), errors


def fit_with_slow_noise(
    error: Float[np.ndarray, "N 12 R"],
    weight: Float[np.ndarray, "N R"],
    transition: Transition,
    units: Float[np.ndarray, "6 12 12"],
    push: Float[np.ndarray, "6 12"],
    dt: float,
    start: Float[np.ndarray, "18"],
    believed: Float[np.ndarray, "6"],
    axes: list[int],
) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
    """White b fitted with slow disturbances, and the nats that a believed b loses, of some axes.

    Args:
        error, weight, transition, units: as in `most_likely`.
        push: one-step error under a constant unit wrench, by axis.
        dt: step (s).
        start: variances to start from.
        believed: b.
        axes: whose loss is computed; it is zero elsewhere, and where data are too few.
    """
    blocks, lost = _blocks(error, weight, _LONGER), np.zeros(6)
    if len(blocks) < _LEAST:
        return np.sqrt(start[12:]), lost
    used = _used_axes(blocks, units, start)
    model = _likelihood(blocks, transition, units, used, (push, dt))
    often = np.repeat(start[12:], len(_TIMES)) / dt / 10
    x = np.log(np.concatenate([start, often]))
    low, moved = x - _DEEP, np.concatenate([used, np.ones(len(x) - 12, bool)])
    x = model.likeliest(x, low, moved)
    best = model.loss(x)[0]
    for i in axes:
        other, free = x.copy(), moved.copy()
        other[12 + i], free[12 + i] = 2 * np.log(believed[i]), False
        other = model.likeliest(other, low, free)
        lost[i] = (model.loss(other)[0] - best) * len(blocks) / 2
    return np.exp(x[12:18] / 2), lost


def likely_beside_lost(
    error: Float[np.ndarray, "N 12 R"],
    weight: Float[np.ndarray, "N R"],
    known: Float[np.ndarray, "N 12 R"],
    *given: Any,
) -> tuple[Float[np.ndarray, "18"], Float[np.ndarray, "6"]]:
    """`most_likely` of errors of which not all are known, with its further arguments.

    Axes with the fewest known errors are set apart until the others have enough blocks without a
    lost velocity. Each of those is then fitted alone, to its own blocks.
    """
    there, apart = known[:, 6:], np.zeros(6, bool)
    share = (there * weight[:, None]).sum(axis=(0, 2))
    clean = weight * there.min(axis=1)
    for i in np.argsort(share)[:-1]:
        if len(_blocks(error, clean, _BLOCK)) >= _ENOUGH_BLOCKS:
            break
        apart[i] = True
        clean = weight * there[:, ~apart].min(axis=1)
    found, errors = (a.copy() for a in most_likely(error, clean, *given, apart=apart))
    for i in np.flatnonzero(apart):
        alone = np.arange(6) != i
        own, its = most_likely(error, weight * there[:, i], *given, apart=alone)
        found[[6 + i, 12 + i]], errors[i] = own[[6 + i, 12 + i]], its[i]
    return found, errors


def _blocks(error: np.ndarray, weight: np.ndarray, length: int) -> Float[np.ndarray, "K n 12"]:
    """Blocks of consecutive samples without a gap, overlapping by half."""
    found = []
    for n in range(0, len(error) - length + 1, length // 2):
        whole = np.all(weight[n : n + length] > 0, axis=0)
        found.append(error[n : n + length, :, whole].transpose(2, 0, 1))
    return np.concatenate(found).astype(float) if found else np.zeros((0, length, 12))


def _used_axes(
    blocks: Float[np.ndarray, "K n 12"],
    units: Float[np.ndarray, "6 12 12"],
    start: Float[np.ndarray, "18"],
) -> Bool[np.ndarray, "12"]:
    """Axes that are used: twists, and poses with clearly more measurement than process noise."""
    made = np.diagonal(units, axis1=1, axis2=2)[:, :6].T @ start[12:]
    used = np.concatenate([start[:6] > _CLEAR * made, np.ones(6, bool)])
    return used & np.any(blocks != blocks[:, :1], axis=(0, 1))


def _likelihood(
    blocks: Float[np.ndarray, "K n 12"],
    transition: Transition,
    units: Float[np.ndarray, "6 12 12"],
    used: Bool[np.ndarray, "12"],
    pushes: tuple[np.ndarray, float] | None = None,
) -> Likelihood:
    """Likelihood of the `heard` axes: records, white processes, optionally slow disturbances."""
    n = blocks.shape[1]
    basis = scipy.linalg.null_space(np.ones((1, n)))
    y = np.einsum("kna,nm->kma", blocks[:, :, used], basis).reshape(len(blocks), -1)
    rows = np.ix_(used, used)
    same, next_ = basis.T @ basis, basis.T @ np.eye(n, k=-1) @ basis
    G = []
    for i in range(12):
        one = np.zeros((12, 12))
        one[i, i] = 1.0
        late = np.kron(next_, (-transition.mean @ one)[rows])
        G.append(np.kron(same, (one + transition.of(one))[rows]) + late + late.T)
    G += [np.kron(same, unit[rows]) for unit in units]
    if pushes is not None:
        push, dt = pushes
        apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) * dt
        lasting = [basis.T @ np.exp(-apart / time) @ basis for time in _TIMES]
        G += [np.kron(k, np.outer(g, g)[rows]) for g in push for k in lasting]
    S = y.T @ y / len(y)
    scale = 1 / np.sqrt(np.diag(S))
    return Likelihood(S * scale[:, None] * scale, np.stack(G) * scale[:, None] * scale)
