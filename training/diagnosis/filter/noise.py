"""Diffusion and measurement noise, from the autocovariances of one-step prediction errors.

With y = x + e, r_n = e_(n+1) - A e_n + w_n has the covariances C_0 = Q + R + A R Aᵀ, C_1 = -A R and
zero at longer lags. A slow model error adds about the same to C_1 and C_2, so C_1 - C_2 gives the
first guess, from which the maximum of the likelihood is sought (`likely_noise`).

States that an autopilot has estimated have slow errors, but none that is independent from sample to
sample: R is then estimated as zero on most axes of the twist, or of all. All one-step errors are
then taken as process noise, with slip of the pose against the twist, and their correlation in time
is kept: it lowers the effective number of samples.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int

from ..data.arrays import all_equal
from .likely_noise import most_likely
from .transition import Transition

FLOOR = np.array([1e-4] * 3 + [1e-5] * 3 + [1e-4] * 3 + [1e-5] * 3)
"""Least standard deviation of a record: m, rad, m/s, rad/s."""
_SMOOTH, _SMOOTH_OF_ALL, _NEAR, _ALIKE = 4, 8, 3.0, 0.1
"""States count as estimated where `_SMOOTH` axes of the twist have no independent error, or
`_SMOOTH_OF_ALL` of pose and twist have errors within `_NEAR` times `FLOOR`, if neighbouring
one-step errors of these axes correlate by more than `_ALIKE`. Those of exact states, and of states
with dominant white noise, do not."""
_INDEPENDENT = -0.15
"""Correlation of neighbouring kinematic errors below which a pose has independent errors (−0.5 for
them alone), and does not slip."""
_OVER = 4.0
"""Time (s) over which slip is measured: an estimator's errors last for seconds."""
_DRIFTS = 3e-4
"""Slip of an attitude (rad/√s) above which the poses are an estimator's. Exact states have a tenth
of it, by the integration of their rates; the angle random walk of a gyro is 1e-4 at most."""
_LONGEST = 0.98
"""Upper limit of the correlation of neighbouring errors."""
_DEAF = 10.0
"""Standard deviation (m, rad) given to a pose that was not measured, so that it has no weight."""
_BELOW = 0.1
"""Share of `FLOOR` that bounds the most likely noise from below: a floor of the order of the
process noise of a pose over one step would be subtracted from the process."""
_MUCH = 0.03
"""Share of an innovation's variance due to the spread of Jacobians above which each piece has a
filter of its own."""
_NODES = 8
"""Nodes of interpolation between uneven steps."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the records (12,) and diffusion b (6,) in N√s, N·m√s.

    Attributes:
        record: m, rad, m/s, rad/s.
        diffusion: b.
        slip: of the pose against the integrated twist, in m/√s and rad/√s.
        memory: number of samples with the information of one independent sample (12,).
        error: standard error of b; half of b where data are too few, zero for estimated states.
        estimated: whether the records are states that a filter has estimated.
        silent: poses without any one-step error (12,), such as those that were not measured.
    """

    record: Float[np.ndarray, "12"]
    diffusion: Float[np.ndarray, "6"]
    slip: Float[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))
    memory: Float[np.ndarray, "12"] = field(default_factory=lambda: np.ones(12))
    error: Float[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))
    estimated: bool = False
    silent: Bool[np.ndarray, "12"] = field(default_factory=lambda: np.zeros(12, bool))

    @property
    def trusted(self) -> Float[np.ndarray, "12"]:
        """Standard deviations of the records that the filter uses."""
        return np.where(self.silent, _DEAF, self.record)

    def with_diffusion(self, values: Mapping[int, float]) -> "Noise":
        """The same with another b of some axes."""
        b = self.diffusion.copy()
        b[list(values)] = list(values.values())
        return replace(self, diffusion=b)


@dataclass(frozen=True)
class Filter:
    """Gains and whitening of the first N innovations, by piece, or the same for all (R = 1).

    Attributes:
        keep: I - K_n before step n (N, 12, 12, R).
        whiten: L_n⁻¹ with L Lᵀ the innovations' covariance after step n (N, 12, 12, R).
        log_det: ½ log det of that covariance (N, R).
        memory: by which the whitened squares are divided already (`Noise.memory`) (12,).
    """

    keep: Float[np.ndarray, "N 12 12 R"]
    whiten: Float[np.ndarray, "N 12 12 R"]
    log_det: Float[np.ndarray, "N R"]
    memory: Float[np.ndarray, "12"] = field(default_factory=lambda: np.ones(12))

    def of(self, pieces: Int[np.ndarray, " K"]) -> "Filter":
        """The filter of some pieces."""
        if self.keep.shape[-1] == 1:
            return self
        parts = (a[..., pieces] for a in (self.keep, self.whiten, self.log_det))
        return Filter(*parts, memory=self.memory)


def process_covariance(
    A: Float[np.ndarray, "12 12"],
    mass_inverse: Float[np.ndarray, "6 6"],
    diffusion: Float[np.ndarray, "6"],
    dt: float,
    slip: Float[np.ndarray, "6"] | None = None,
    late: Float[np.ndarray, "6"] | None = None,
) -> Float[np.ndarray, "12 12"]:
    """Q = ∫ exp(J s) B Bᵀ exp(J s)ᵀ ds over a step, by three Gauss points, plus that of the slip.

    Poses may be recorded `late` against twists (s): see `transition`.
    """
    J = np.real(scipy.linalg.logm(A)) / dt
    push = mass_inverse * diffusion
    B = np.concatenate([np.zeros((6, 6)) if late is None else -late[:, None] * push, push])
    Q = np.zeros((12, 12))
    for x, w in zip(*np.polynomial.legendre.leggauss(3), strict=True):
        E = scipy.linalg.expm(J * dt * (1 + x) / 2) @ B
        Q += w * dt / 2 * E @ E.T
    if slip is not None:
        Q[:6, :6] += np.diag(slip**2 * dt)
    return Q


def unit_processes(
    transition: Transition, mass_inverse: Float[np.ndarray, "6 6"], dt: float
) -> Float[np.ndarray, "6 12 12"]:
    """Covariance of a step's process for b = 1 of each axis alone."""
    A, late = transition.mean, transition.late
    return np.stack([process_covariance(A, mass_inverse, b, dt, None, late) for b in np.eye(6)])


def estimate(
    error: Float[np.ndarray, "N 12 R"],
    weight: Float[np.ndarray, "N R"],
    transition: Transition,
    mass: Float[np.ndarray, "6 6"],
    dt: float,
    held: Mapping[int, float] | None = None,
    estimated: bool | None = None,
) -> Noise:
    """Maximum likelihood noise of records and process, from a first guess by moments.

    The diffusion b of some axes may be `held`. Whether the records are states that a filter has
    `estimated` is decided from the errors unless it is given.
    """
    held = {} if held is None else held
    silent = np.zeros(12, bool)
    silent[:6] = np.max(np.abs(error[:, :6] * weight[:, None]), axis=(0, 2)) == 0
    C = []
    for lag in range(3):
        w = weight[lag:] * weight[: len(weight) - lag]
        a, b = error[lag:] * w[:, None], error[: len(error) - lag]
        C.append(np.einsum("nir,njr->ij", a, b) / max(w.sum(), 1.0))
    A, inverse = transition.mean, np.linalg.inv(mass)
    R = np.diag(-np.linalg.solve(A, C[1] - C[2]))
    variance = np.maximum(R, FLOOR**2)
    units = unit_processes(transition, inverse, dt)
    unit = np.diag(units.sum(axis=0))[6:]
    alike = np.diag(C[1]) > _ALIKE * np.diag(C[0])
    none, near = (alike & ((times * FLOOR) ** 2 >= R) for times in (1.0, _NEAR))
    if estimated is None:
        estimated = bool(np.sum(none[6:]) >= _SMOOTH or np.sum(near) >= _SMOOTH_OF_ALL)
    if estimated:
        of_estimates = _of_estimates(C[0], C[1], variance, transition, inverse, unit, dt)
        return replace(of_estimates.with_diffusion(held), silent=silent)
    C0 = C[0] - (C[2] + C[2].T) / 2
    Q = C0 - np.diag(variance) - transition.of(np.diag(variance))
    least = 1e-8 * np.diag(C[0])[6:] / unit
    wrench = np.maximum(np.diag(Q)[6:] / unit, 1e4 * least)
    start = np.concatenate([variance, wrench])
    bounds = np.concatenate([(_BELOW * FLOOR) ** 2, np.maximum(least, 1e-300)])
    start, fixed = np.maximum(start, bounds), np.zeros(6, bool)
    for i, b in held.items():
        start[12 + i], fixed[i] = b**2, True
    found, errors = most_likely(error, weight, transition, units, start, bounds, fixed)
    b = np.sqrt(found[12:])
    record = np.maximum(np.sqrt(found[:12]), FLOOR)
    slip = slip_of(error, weight, dt)
    if not (np.any(record[6:] > _NEAR * FLOOR[6:]) or np.any(slip[3:] > _DRIFTS)):
        slip = np.zeros(6)  # exact states
    return Noise(record, b, slip, error=errors / (2 * b), silent=silent)


def slip_of(
    error: Float[np.ndarray, "N 12 R"], weight: Float[np.ndarray, "N R"], dt: float
) -> Float[np.ndarray, "6"]:
    """Slip of each pose against the integrated twist (m/√s, rad/√s), 0 with independent errors.

    A pose's one-step error less dt/2 times that of its velocity is that of kinematics alone: no
    force is in it. An attitude that an estimator has filtered drifts against the rates, and a
    position that it has dead-reckoned follows the velocity's own errors. Slip is the variance, a
    second, of the sum over a step or, if larger, over some seconds: it covers errors that last.
    """
    k = (error[:, :6] - dt / 2 * error[:, 6:]) * weight[:, None]
    square = np.maximum((k**2).sum(axis=(0, 2)), 1e-300)
    independent = (k[1:] * k[:-1]).sum(axis=(0, 2)) < _INDEPENDENT * square
    length = max(1, min(round(_OVER / dt), len(k)))
    whole = len(k) // length * length
    sums = k[:whole].reshape(-1, length, *k.shape[1:]).sum(axis=1)
    there = weight[:whole].sum() * dt
    slip = np.sqrt(
        np.maximum((sums**2).sum(axis=(0, 2)) / max(there, dt), square / (weight.sum() * dt))
    )
    return np.where(independent, 0.0, slip)


def _of_estimates(
    C0: np.ndarray,
    C1: np.ndarray,
    variance: np.ndarray,
    transition: Transition,
    inverse: np.ndarray,
    unit: np.ndarray,
    dt: float,
) -> Noise:
    """Noise of states that were estimated: all of it process noise, with its correlation."""
    square = np.maximum(np.diag(C0)[6:] / unit, 1e-300)
    A = transition.mean
    own = process_covariance(A, inverse, np.sqrt(square), dt, None, transition.late)
    left = np.diag(C0 - np.diag(variance) - A * variance @ A.T - own)[:6]
    correlation = np.clip(np.diag(C1) / np.maximum(np.diag(C0), 1e-300), 0.0, _LONGEST)
    return Noise(
        record=np.sqrt(variance),
        diffusion=np.sqrt(square),
        slip=np.sqrt(np.maximum(left, 0.0) / dt),
        memory=(1 + correlation) / (1 - correlation),
        estimated=True,
    )


def make_filter(
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    dt: float,
    step: Float[np.ndarray, "N R"],
    jacobian: Float[np.ndarray, "N 12 12 R"] | None = None,
) -> Filter:
    """The Kalman filter that starts from the first record: gains of every step.

    The transition is that of a step of `dt` s. Where all steps are equal, all pieces share one
    filter, unless the spread of Jacobians adds much to the innovations: then each has its own.
    """
    process = _process(noise, transition, mass_inverse, dt, step)
    if all_equal(step, dt):
        found, P = _filter(noise, process, step[:, :1], dt, transition)
        share = np.diag(transition.added(P)) / (np.diag(transition.of(P)) + noise.trusted**2)
        if jacobian is None or np.max(share[~noise.silent]) < _MUCH:
            return found
    return _filter(noise, process, step, dt, transition, jacobian)[0]


def judging_filter(
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    dt: float,
    step: Float[np.ndarray, "N R"],
    jacobian: Float[np.ndarray, "N 12 12 R"],
) -> Filter:
    """`make_filter` with correlated innovations weighted down by `Noise.memory`."""
    kalman = make_filter(noise, transition, mass_inverse, dt, step, jacobian)
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
) -> tuple[Filter, Float[np.ndarray, "12 12"]]:
    """A filter for each column of `step`, and the first one's last covariance."""
    R, eye = np.diag(noise.trusted**2), np.eye(12)
    count = step.shape[1]
    P = np.repeat(R[None], count, 0)
    gap = np.zeros_like(P)  # I - K: the filter starts at the first record
    keep, whiten = np.zeros((2, len(step), count, 12, 12))
    log_det = np.zeros(step.shape)
    for n in range(len(step)):
        keep[n] = gap
        A, prior = process(step[n])
        if jacobian is None:
            prior = prior + (step[n] / dt)[:, None, None] ** 2 * transition.added(P)
        else:
            own = np.moveaxis(jacobian[n], -1, 0).astype(float)
            A = np.where(np.isfinite(own), own, A)  # a piece without samples has none
        prior = A @ P @ A.swapaxes(1, 2) + prior
        L = np.linalg.cholesky(prior + R)
        whiten[n] = np.linalg.inv(L)
        log_det[n] = np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
        K = np.linalg.solve(prior + R, prior).swapaxes(1, 2)
        gap = eye - K
        # Joseph's form stays positive where exact records meet a long step (Bucy and Joseph 1968)
        P = gap @ prior @ gap.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
    return Filter(np.moveaxis(keep, 1, -1), np.moveaxis(whiten, 1, -1), log_det), P[0]


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
    error: Float[np.ndarray, "N 12 R"], jacobian: Float[np.ndarray, "N 12 12 R"], kalman: Filter
) -> Float[np.ndarray, "N 12 R"]:
    """Whitened innovations of one-step errors."""
    nu, found = np.zeros(error.shape[1:]), np.empty(error.shape)
    for n in range(len(error)):
        kept = np.einsum("ijr,jr->ir", kalman.keep[n], nu)
        nu = error[n] + np.einsum("ijr,jr->ir", jacobian[n], kept)
        found[n] = np.einsum("ijr,jr->ir", kalman.whiten[n], nu)
    return found


def score_of(
    error: Float[np.ndarray, "N 12 R"],
    jacobian: Float[np.ndarray, "N 12 12 R"],
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    dt: float,
    step: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
) -> Float[np.ndarray, " R"]:
    """Log density of the innovations by piece (nats)."""
    kalman = make_filter(noise, transition, mass_inverse, dt, step, jacobian)
    z = filtered(error, jacobian, kalman) * weight[:, None]
    found = -(z**2).sum(axis=(0, 1)) / 2 - (kalman.log_det * weight).sum(axis=0)
    return found - 6 * np.log(2 * np.pi) * weight.sum(axis=0)
