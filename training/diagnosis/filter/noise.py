"""Diffusion and measurement noise, from the autocovariances of one-step prediction errors.

With y = x + e, r_n = e_(n+1) - A e_n + w_n has the covariances C_0 = Q + R + A R Aᵀ, C_1 = -A R and
zero at longer lags. A slow model error adds about the same to C_1 and C_2, so C_1 - C_2 gives the
first guess, from which the maximum of the likelihood is sought (`likely_noise`).

States that an autopilot has estimated have slow errors, but none that is independent from sample to
sample: R is then estimated as zero on most axes of the twist, or of all. All one-step errors are
then taken as process noise, with slip of the pose against the twist, and their correlation in time
is kept: it lowers the effective number of samples.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from ..data.reckoned import INDEPENDENT, OVER
from .likely_noise import likely_beside_lost, most_likely
from .transition import Transition

FLOOR = np.array([1e-4] * 3 + [1e-5] * 3 + [1e-4] * 3 + [1e-5] * 3)
"""Least standard deviation of a record: m, rad, m/s, rad/s."""
_SMOOTH, _SMOOTH_OF_ALL, _NEAR, _ALIKE = 4, 8, 3.0, 0.1
"""States count as estimated where `_SMOOTH` axes of the twist have no independent error, or
`_SMOOTH_OF_ALL` of pose and twist have errors within `_NEAR` times `FLOOR`, if neighbouring
one-step errors of these axes correlate by more than `_ALIKE`. Those of exact states, and of states
with dominant white noise, do not."""
_DRIFTS = 3e-4
"""Slip of an attitude (rad/√s) above which the poses are an estimator's. Exact states have a tenth
of it, by the integration of their rates; the angle random walk of a gyro is 1e-4 at most."""
_LONGEST = 0.98
"""Upper limit of the correlation of neighbouring errors."""
_DEAF = np.array([10.0] * 6 + [1e4] * 6)
"""Standard deviation (m, rad, m/s, rad/s) given to what was not measured, so that it has no weight:
velocities act on other errors, so theirs must have none at all."""
_READING, _MOST_OF_IT = 0.05, 0.5
"""Noise of an accelerometer beside turning thrusters (m/s²), and the share of the variance of its
one-step errors that it has at most. A white force looks like it, so no datum tells the two apart;
innovations hardly depend on the share."""
_FORGETS = 10.0
"""Time (s) after which drag has at the latest ended a velocity's error."""
_BIAS, _WANDERS = 0.1, 10.0
"""Bias of an accelerometer against the attitude (m/s²), and time (s) in which it wanders: half a
degree of tilt, as an autopilot's attitude errs without a velocity."""
_BELOW = 0.1
"""Share of `FLOOR` that bounds the most likely noise from below: a floor of the order of the
process noise of a pose over one step would be subtracted from the process."""


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
        silent: records without any one-step error (12,), such as those that were not measured.
        first: standard deviations of the errors at the first sample, where they are not `trusted`.
    """

    record: Float[np.ndarray, "12"]
    diffusion: Float[np.ndarray, "6"]
    slip: Float[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))
    memory: Float[np.ndarray, "12"] = field(default_factory=lambda: np.ones(12))
    error: Float[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))
    estimated: bool = False
    silent: Bool[np.ndarray, "12"] = field(default_factory=lambda: np.zeros(12, bool))
    first: Float[np.ndarray, "12"] | None = None

    @property
    def trusted(self) -> Float[np.ndarray, "12"]:
        """Standard deviations of the records that the filter uses."""
        return np.where(self.silent, _DEAF, self.record)

    def with_diffusion(self, values: Mapping[int, float]) -> "Noise":
        """The same with another b of some axes."""
        b = self.diffusion.copy()
        b[list(values)] = list(values.values())
        return replace(self, diffusion=b)


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
    known: Float[np.ndarray, "N 12 R"] | None = None,
) -> Noise:
    """Maximum likelihood noise of records and process, from a first guess by moments.

    The diffusion b of some axes may be `held`. Whether the records are states that a filter has
    `estimated` is decided from the errors unless it is given. Errors with lost velocities in them
    are left out (`known`, `Data.known`).
    """
    held, latent = {} if held is None else held, transition.latent
    silent = np.zeros(12, bool)
    silent[:6] = np.max(np.abs(error[:, :6] * weight[:, None]), axis=(0, 2)) == 0
    if latent is not None:
        silent[[6 + i for i in latent.silent]] = True
        held = {i: latent.levels[i] for i in latent.silent} | dict(held)
    C = [_autocovariance(error, weight, lag, known) for lag in range(3)]
    A, inverse = transition.mean, np.linalg.inv(mass)
    R = np.diag(-np.linalg.solve(A, C[1] - C[2]))
    variance = np.maximum(R, FLOOR**2)
    units = unit_processes(transition, inverse, dt)
    unit = np.diag(units.sum(axis=0))[6:]
    alike = np.diag(C[1]) > _ALIKE * np.diag(C[0])
    if latent is not None:
        alike[[6 + i for i in latent.felt]] = False
    none, near = (alike & ((times * FLOOR) ** 2 >= R) for times in (1.0, _NEAR))
    if estimated is None:
        of = 1.0 if latent is None else 1 - len(latent.levels) / 6  # share of twists measured
        estimated = bool(np.sum(none[6:]) >= _SMOOTH * of or np.sum(near) >= _SMOOTH_OF_ALL * of)
    if estimated:
        of_estimates = _of_estimates(C[0], C[1], variance, transition, inverse, unit, dt)
        found = replace(of_estimates.with_diffusion(held), silent=silent)
        return _with_latent(found, transition, inverse, unit, dt, C)
    C0 = C[0] - (C[2] + C[2].T) / 2
    Q = C0 - np.diag(variance) - transition.of(np.diag(variance))
    least = 1e-8 * np.diag(C[0])[6:] / unit
    wrench = np.maximum(np.diag(Q)[6:] / unit, 1e4 * least)
    start = np.concatenate([variance, wrench])
    bounds = np.concatenate([(_BELOW * FLOOR) ** 2, np.maximum(least, 1e-300)])
    start, fixed = np.maximum(start, bounds), np.zeros(6, bool)
    for i, b in held.items():
        start[12 + i], fixed[i] = b**2, True
    given = transition, units, start, bounds, fixed
    if known is None:
        found, errors = most_likely(error, weight, *given)
    else:
        found, errors = likely_beside_lost(error, weight, known, *given)
    b = np.sqrt(found[12:])
    record = np.maximum(np.sqrt(found[:12]), FLOOR)
    slip = slip_of(error if known is None else error * known, weight, dt)
    if not (np.any(record[6:] > _NEAR * FLOOR[6:]) or np.any(slip[3:] > _DRIFTS)):
        slip = np.zeros(6)  # exact states
    noise = Noise(record, b, slip, error=errors / (2 * b), silent=silent)
    return _with_latent(noise, transition, inverse, unit, dt, C)


def _autocovariance(
    error: Float[np.ndarray, "N 12 R"],
    weight: Float[np.ndarray, "N R"],
    lag: int,
    known: Float[np.ndarray, "N 12 R"] | None,
) -> Float[np.ndarray, "12 12"]:
    """Mean of r_(n+lag) r_nᵀ, element by element over the errors that are known."""
    w = weight[lag:] * weight[: len(weight) - lag]
    a, b = error[lag:] * w[:, None], error[: len(error) - lag]
    if known is None:
        return np.einsum("nir,njr->ij", a, b) / max(w.sum(), 1.0)
    after, before = known[lag:] * w[:, None], known[: len(known) - lag]
    count = np.einsum("nir,njr->ij", after, before)
    return np.einsum("nir,njr->ij", a * known[lag:], b * before) / np.maximum(count, 1.0)


def _with_latent(
    noise: Noise,
    transition: Transition,
    mass_inverse: Float[np.ndarray, "6 6"],
    unit: Float[np.ndarray, "6"],
    dt: float,
    C: list[np.ndarray],
) -> Noise:
    """The noise with that of accelerometers, their biases and the start of latent velocities.

    Such a velocity starts as uncertain as the assumed diffusion keeps it against drag. Steps share
    readings, so their errors are correlated, and the diffusion is that of their sum: by C, the
    autocovariances of the errors. Those of an estimator's states count for fewer instead.
    """
    latent = transition.latent
    if latent is None:
        return noise
    record, b, slip = noise.record.copy(), noise.diffusion.copy(), noise.slip.copy()
    memory = noise.memory.copy()
    slip[:3] = 0.0
    first = np.where(noise.silent, _DEAF, record)
    levels = np.zeros(6)
    for i, level in latent.levels.items():
        levels[i] = level
    made = np.diag(process_covariance(transition.mean, mass_inverse, levels, dt))
    for i in latent.levels:
        lost = 1 - min(transition.mean[6 + i, 6 + i], 1 - dt / _FORGETS) ** 2
        first[6 + i] = np.sqrt(made[6 + i] / lost)
    for i in latent.felt:
        before, after, later = (max(c[6 + i, 6 + i], 0.0) for c in C)
        if noise.estimated:
            alike = min(after / max(before, 1e-300), _LONGEST)
            memory[6 + i] = (1 + alike) / (1 - alike)
        else:
            shared = (after - later) / max(before - later, 1e-300)
            b[i] *= np.sqrt(1 + 2 * np.clip(shared, 0.0, 1.0))
        one_step = unit[i] * b[i] ** 2
        share = min((_READING * dt) ** 2 / max(one_step, 1e-300), _MOST_OF_IT)
        record[6 + i] = np.sqrt(share * one_step)
        b[i] *= np.sqrt(1 - share)
        first[i], slip[i] = _BIAS, _BIAS * np.sqrt(2 / _WANDERS)
    return replace(noise, record=record, diffusion=b, slip=slip, first=first, memory=memory)


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
    independent = (k[1:] * k[:-1]).sum(axis=(0, 2)) < INDEPENDENT * square
    length = max(1, min(round(OVER / dt), len(k)))
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
