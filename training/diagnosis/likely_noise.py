"""The noise of records and process that makes blocks of one-step errors most likely.

r_n = e_(n+1) - A e_n + w_n is a moving average of first order. Its blocks of `_BLOCK` neighbours,
each axis less its mean over the block (slow errors of the model are not noise), are normal with a
covariance that is linear in the variances of records and process: Σ = Σ_i θ_i G_i. Fisher's scoring
in log θ finds the most likely ones (Anderson 1973, "Asymptotically efficient estimation of
covariance matrices with linear structure"). Moments of neighbours alone tell little of a process
that is smaller than the records' noise: here the whole block tells.
"""

import numpy as np
import scipy.linalg
from jaxtyping import Float

from .transition import Transition

_BLOCK, _LEAST = 12, 8
"""Samples of a block, and blocks at least."""
_ROUNDS, _TRIES, _ENOUGH = 30, 8, 1e-4
"""Of scoring; halvings of a step; gain of log likelihood a block at which it ends."""
_STEP = 1.5  # of log θ at most
_CLEAR = 10.0
"""Times what the process makes of a pose within a step its record's variance must be to be heard.
Exact poses would tell of the process by how a simulation was stepped."""


def most_likely(
    error: Float[np.ndarray, "N 12 R"],
    weight: Float[np.ndarray, "N R"],
    transition: Transition,
    units: Float[np.ndarray, "6 12 12"],
    start: Float[np.ndarray, "18"],
    least: Float[np.ndarray, "18"],
) -> Float[np.ndarray, "18"]:
    """Variances of the twelve records and the six b²; `start` where data are too few.

    A process that is hidden by the records' noise counts with its standard error: a filter that
    believes in none at all is deaf, and its innovations are correlated.

    Args:
        error: of one-step predictions.
        weight: zero where a piece has no sample.
        transition: of a step.
        units: covariance of a step's process for b² = 1 of each axis.
        start: first guess.
        least: lower bounds.
    """
    blocks = _blocks(error, weight)
    if len(blocks) < _LEAST:
        return start
    made = np.diagonal(units, axis1=1, axis2=2)[:, :6].T @ start[12:]
    heard = np.concatenate([start[:6] > _CLEAR * made, np.ones(12, bool)])
    basis = scipy.linalg.null_space(np.ones((1, _BLOCK)))
    y = np.einsum("kna,nm->kma", blocks[:, :, heard[:12]], basis).reshape(len(blocks), -1)
    S = y.T @ y / len(y)
    scale = 1 / np.sqrt(np.diag(S))
    G = _structures(transition, units, basis, heard[:12]) * scale[:, None] * scale
    S = S * scale[:, None] * scale
    low = np.log(least)
    x = np.maximum(np.log(start), low)
    loss, inverse = _loss(x, G, S)
    damping = 1e-3
    for _ in range(_ROUNDS):
        IG = inverse @ G * np.exp(x)[:, None, None]
        slope = (np.trace(IG, axis1=1, axis2=2) - np.einsum("iab,ba->i", IG, inverse @ S)) / 2
        fisher = np.einsum("iab,jba->ij", IG, IG, optimize=True) / 2
        free = heard & ((x > low + 1e-9) | (slope < 0))
        for _ in range(_TRIES):
            H = fisher[np.ix_(free, free)]
            H = H + np.diag(damping * np.diag(H) + 1e-9)
            step = np.zeros(len(x))
            step[free] = np.clip(-np.linalg.solve(H, slope[free]), -_STEP, _STEP)
            tried = np.maximum(x + step, low)
            less, other = _loss(tried, G, S)
            if less <= loss:
                break
            damping = 10 * max(damping, 1e-3)
        else:
            break
        gain, x, loss, inverse = loss - less, tried, less, other
        damping = max(damping / 10, 1e-6)
        if gain < _ENOUGH:
            break
    found, IG = np.exp(x), inverse @ G
    fisher = np.einsum("iab,jba->ij", IG, IG, optimize=True) / 2 * len(y) / 2
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(fisher, hermitian=True)), 0.0))
    return np.concatenate([found[:12], np.maximum(found[12:], errors[12:])])


def _blocks(error: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "K n 12"]:
    """Blocks of neighbours without a gap, each half over the next."""
    found = []
    for n in range(0, len(error) - _BLOCK + 1, _BLOCK // 2):
        whole = np.all(weight[n : n + _BLOCK] > 0, axis=0)
        found.append(error[n : n + _BLOCK, :, whole].transpose(2, 0, 1))
    return np.concatenate(found).astype(float) if found else np.zeros((0, _BLOCK, 12))


def _structures(
    transition: Transition, units: np.ndarray, basis: np.ndarray, heard: np.ndarray
) -> Float[np.ndarray, "18 d d"]:
    """Covariance of a block's axes that are heard for each variance of one."""
    rows = np.ix_(heard, heard)
    same, next_ = basis.T @ basis, basis.T @ np.eye(_BLOCK, k=-1) @ basis
    found = []
    for i in range(12):
        one = np.zeros((12, 12))
        one[i, i] = 1.0
        late = np.kron(next_, (-transition.mean @ one)[rows])
        found.append(np.kron(same, (one + transition.of(one))[rows]) + late + late.T)
    return np.stack([*found, *(np.kron(same, unit[rows]) for unit in units)])


def _loss(x: np.ndarray, G: np.ndarray, S: np.ndarray) -> tuple[float, np.ndarray]:
    """Negative log likelihood a block, up to a constant, and Σ⁻¹."""
    covariance = np.tensordot(np.exp(x), G, 1)
    try:
        L = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return np.inf, covariance
    inverse = np.linalg.inv(covariance)
    return float(np.log(np.diag(L)).sum() + np.sum(inverse * S) / 2), inverse
