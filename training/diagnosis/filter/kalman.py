"""Kalman filters of one-step errors: gains, whitened innovations, their density."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from jaxtyping import Float, Int

from ..data.arrays import all_equal
from ..data.lost import known_errors
from .noise import Noise, process_covariance
from .transition import Latent, Transition

_MUCH = 0.03
"""Share of an innovation's variance due to the spread of Jacobians above which each piece has a
filter of its own."""
_NODES = 8
"""Nodes of interpolation between uneven steps."""


@dataclass(frozen=True)
class Filter:
    """Gains and whitening of the first N innovations, by piece, or the same for all (R = 1).

    Attributes:
        keep: I - K_n before step n (N, 12, 12, R).
        whiten: L_n⁻¹ with L Lᵀ the innovations' covariance after step n (N, 12, 12, R).
        log_det: ½ log det of that covariance (N, R).
        memory: by which the whitened squares are divided already (`Noise.memory`) (12,).
        state: standard deviations of the filtered state, root mean square over the steps (12,).
    """

    keep: Float[np.ndarray, "N 12 12 R"]
    whiten: Float[np.ndarray, "N 12 12 R"]
    log_det: Float[np.ndarray, "N R"]
    memory: Float[np.ndarray, "12"] = field(default_factory=lambda: np.ones(12))
    state: Float[np.ndarray, "12"] = field(default_factory=lambda: np.zeros(12))

    def of(self, pieces: Int[np.ndarray, " K"]) -> "Filter":
        """The filter of some pieces."""
        if self.keep.shape[-1] == 1:
            return self
        parts = (a[..., pieces] for a in (self.keep, self.whiten, self.log_det))
        return Filter(*parts, memory=self.memory, state=self.state)


def make_filter(
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    dt: float,
    step: Float[np.ndarray, "N R"],
    jacobian: Float[np.ndarray, "N 12 12 R"] | None = None,
    latent: Latent | None = None,
    spread: Float[np.ndarray, "M 6 R"] | None = None,
) -> Filter:
    """The Kalman filter that starts from the first record: gains of every step.

    The transition is that of a step of `dt` s. Where all steps are equal, all pieces share one
    filter, unless the spread of Jacobians adds much to the innovations, or velocities were lost
    (`spread`, `Data.spread`): then each has its own.
    """
    process = _process(noise, transition, mass_inverse, dt, step)
    if all_equal(step, dt) and spread is None:
        found, P = _filter(noise, process, step[:, :1], dt, transition)
        share = np.diag(transition.added(P)) / (np.diag(transition.of(P)) + noise.trusted**2)
        if jacobian is None or np.max(share[~noise.silent]) < _MUCH:
            return found
    return _filter(noise, process, step, dt, transition, jacobian, latent, spread)[0]


def judging_filter(
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    dt: float,
    step: Float[np.ndarray, "N R"],
    jacobian: Float[np.ndarray, "N 12 12 R"],
    latent: Latent | None = None,
    spread: Float[np.ndarray, "M 6 R"] | None = None,
) -> Filter:
    """`make_filter` with correlated innovations weighted down by `Noise.memory`."""
    kalman = make_filter(noise, transition, mass_inverse, dt, step, jacobian, latent, spread)
    less = kalman.whiten / np.sqrt(noise.memory)[:, None, None]
    return replace(kalman, whiten=less, memory=noise.memory)


Process = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Ā and Q (R, 12, 12) of steps (R,) in s."""


def _filter(
    noise: Noise,
    process: Process,
    step: Float[np.ndarray, "N R"],
    dt: float,
    transition: Transition,
    jacobian: Float[np.ndarray, "N 12 12 R"] | None = None,
    latent: Latent | None = None,
    spread: Float[np.ndarray, "M 6 R"] | None = None,
) -> tuple[Filter, Float[np.ndarray, "12 12"]]:
    """A filter for each column of `step`, and the first one's last covariance.

    With `Transition.latent` an innovation is that of the state after a step less `carried` times
    the state before it.
    """
    records, eye = np.repeat(np.diag(noise.trusted**2)[None], step.shape[1], 0), np.eye(12)
    R = records if spread is None else _with_lost(records, spread[0])
    first = R if noise.first is None else R - records + np.diag(noise.first**2)
    P = first.copy()
    latent = transition.latent if latent is None else latent
    variance = np.zeros(12)
    gap = np.zeros_like(P)  # I - K: the filter starts at the first record
    keep, whiten = np.zeros((2, len(step), step.shape[1], 12, 12))
    log_det = np.zeros(step.shape)
    for n in range(len(step)):
        keep[n] = gap
        variance += np.diagonal(P, axis1=1, axis2=2).mean(axis=0) / len(step)
        A, prior = process(step[n])
        if jacobian is None:
            prior = prior + (step[n] / dt)[:, None, None] ** 2 * transition.added(P)
        else:
            own = np.moveaxis(jacobian[n], -1, 0).astype(float)
            A = np.where(np.isfinite(own), own, A)  # a piece without samples has none
        if spread is not None:
            R = _with_lost(records, spread[n + 1])
        own_noise = prior
        prior = A @ P @ A.swapaxes(1, 2) + prior
        S, cross, M = prior + R, prior, A
        if latent is not None and latent.carried is not None:
            before = latent.carried
            M = A - (before if before.ndim == 2 else np.moveaxis(before[n], -1, 0))
            S = M @ P @ M.swapaxes(1, 2) + own_noise + R
            cross = (A @ P @ M.swapaxes(1, 2) + own_noise).swapaxes(1, 2)
        L = np.linalg.cholesky(S)
        whiten[n] = np.linalg.inv(L)
        log_det[n] = np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
        K = np.linalg.solve(S, cross).swapaxes(1, 2)
        gap = eye - K
        # Joseph's form stays positive where exact records meet a long step (Bucy and Joseph 1968)
        if M is A:
            P = gap @ prior @ gap.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
        else:
            left = A - K @ M
            P = left @ P @ left.swapaxes(1, 2) + gap @ own_noise @ gap.swapaxes(1, 2)
            P = P + K @ R @ K.swapaxes(1, 2)
    moved = np.moveaxis(keep, 1, -1), np.moveaxis(whiten, 1, -1)
    return Filter(*moved, log_det, state=np.sqrt(variance)), P[0]


def _with_lost(
    records: Float[np.ndarray, "R 12 12"], spread: Float[np.ndarray, "6 R"]
) -> Float[np.ndarray, "R 12 12"]:
    """Covariances of the records of a sample, with those of velocities that were lost there."""
    found = records.copy()
    axes = np.arange(6, 12)
    found[:, axes, axes] += spread.T**2
    return found


def _process(
    noise: Noise, transition: Transition, mass_inverse: np.ndarray, dt: float, step: np.ndarray
) -> Process:
    """Ā and Q of any steps among these, interpolated between Chebyshev nodes."""

    def of_step(A: np.ndarray, h: float) -> np.ndarray:
        late = transition.late
        return process_covariance(A, mass_inverse, noise.diffusion, h, noise.slip, late)

    A = transition.mean
    if all_equal(step, dt):
        alone = A[None], of_step(A, dt)[None]
        return lambda h: alone
    J = np.real(scipy.linalg.logm(A)) / dt
    low, high = float(step.min()), float(step.max())
    at = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    nodes = (low + high) / 2 + (high - low) / 2 * at
    each = [scipy.linalg.expm(J * h) for h in nodes]
    values = np.stack([each, [of_step(a, h) for a, h in zip(each, nodes, strict=True)]], axis=1)
    inverse = np.linalg.inv(np.polynomial.chebyshev.chebvander(at, _NODES - 1))
    series = np.tensordot(inverse, values, 1)

    def of_steps(h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = (2 * h - low - high) / (high - low)
        both = np.tensordot(np.polynomial.chebyshev.chebvander(x, _NODES - 1), series, 1)
        return both[:, 0], both[:, 1]

    return of_steps


def filtered(
    error: Float[np.ndarray, "N 12 R"],
    jacobian: Float[np.ndarray, "N 12 12 R"],
    kalman: Filter,
    latent: Latent | None = None,
) -> Float[np.ndarray, "N 12 R"]:
    """Whitened innovations of one-step errors."""
    return with_states(error, jacobian, kalman, latent)[0]


def with_states(
    error: Float[np.ndarray, "N 12 R"],
    jacobian: Float[np.ndarray, "N 12 12 R"],
    kalman: Filter,
    latent: Latent | None = None,
) -> tuple[Float[np.ndarray, "N 12 R"], Float[np.ndarray, "N 12 R"]]:
    """Whitened innovations, and records less filtered states before every step."""
    nu, moved = np.zeros(error.shape[1:]), np.zeros(error.shape[1:])
    found, states = np.empty(error.shape), np.empty(error.shape)
    for n in range(len(error)):
        kept = np.einsum("ijr,jr->ir", kalman.keep[n], nu) + moved
        nu = error[n] + np.einsum("ijr,jr->ir", jacobian[n], kept)
        if latent is not None and latent.carried is not None:
            before = np.einsum("ijr,jr->ir", latent.carried[n], kept)
            nu = nu - before
            moved = before - latent.instead[:, None] * error[n]
        found[n], states[n] = np.einsum("ijr,jr->ir", kalman.whiten[n], nu), kept
    return found, states


def score_of(
    error: Float[np.ndarray, "N 12 R"],
    jacobian: Float[np.ndarray, "N 12 12 R"],
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    dt: float,
    step: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
    latent: Latent | None = None,
    spread: Float[np.ndarray, "M 6 R"] | None = None,
) -> Float[np.ndarray, " R"]:
    """Log density of the innovations by piece (nats), of those without a lost velocity in them."""
    kalman = make_filter(noise, transition, mass_inverse, dt, step, jacobian, latent, spread)
    z = filtered(error, jacobian, kalman, latent)
    if spread is None:
        return log_density(z, kalman, weight)
    known = known_errors(spread)
    of_lost = (np.log(np.einsum("niir->nir", kalman.whiten)) * (1 - known)).sum(axis=1)
    return log_density(z * known, replace(kalman, log_det=kalman.log_det + of_lost), weight)


def log_density(
    z: Float[np.ndarray, "N 12 R"], kalman: Filter, weight: Float[np.ndarray, "N R"]
) -> Float[np.ndarray, " R"]:
    """Log density by piece (nats) of whitened innovations."""
    z = z * weight[:, None]
    found = -(z**2).sum(axis=(0, 1)) / 2 - (kalman.log_det * weight).sum(axis=0)
    return found - 6 * np.log(2 * np.pi) * weight.sum(axis=0)
