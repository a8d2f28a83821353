"""How much a model's noise grows with speed, by the errors of its forecasts.

Errors of drag and thrust grow with motion: a vehicle at rest strays less than one that turns fast,
and a constant b has bands too wide for the one and too narrow for the other, so that their shares
are neither 50 nor 90 %. On each axis the scale of b² is a sum of a constant and of squares of the
twist's components (`models.growth`). The spread of forecasts by each term alone is that of motions
drawn from the model; variances add up, as noise is small. The terms' sizes minimise the continuous
ranked probability score of what was observed (Gneiting and Raftery 2007), each component and
horizon in units of its typical error. Terms are used where windows that their sizes were not fitted
to are predicted better than by a constant b, by more than two standard errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import scipy.optimize
import scipy.stats
from jaxtyping import Float

from ...models.dynamics import Dynamics
from ...models.effects.extended import core, with_core
from ...models.growth import Growth
from ...models.rigid_body import FossenDynamics
from ...models.spinn import Spinn
from ..data.windows import Windows
from .start import diffusion_scale, with_diffusion

Model = TypeVar("Model", bound=Dynamics)

TERMS = 7
"""A constant, and the squares of the six components of the twist."""
_LEAST = 1e-4
"""Smallest size of the constant term, so that no motion is certain."""
_SLOWEST = 0.01
"""Speed (m/s, rad/s) below which a component of the twist is at rest."""
_CERTAIN = 1e-3
"""Standard deviation, relative to the typical error, of what is certain."""
_FEWEST = 4
"""Windows of a set below which an axis tells nothing."""


def can_grow(model: Dynamics) -> bool:
    """Whether the noise is a constant model's, or a SPINN's on the group with a network for b."""
    own = core(model)
    if isinstance(own, Spinn):
        c = own.config
        return c.stochastic and c.coordinates == "group" and c.diffusion == "network"
    return isinstance(own, FossenDynamics)


@dataclass(frozen=True)
class Twists:
    """Root mean square and largest size of each component of the twist (m/s, rad/s)."""

    typical: Float[np.ndarray, "6"]
    fastest: Float[np.ndarray, "6"]

    @classmethod
    def of(cls, sets: Sequence[Windows]) -> "Twists":
        """Those in windows, each set counting alike."""
        sizes = [np.abs(np.asarray(one.V, float)) for one in sets]
        typical = np.sqrt(np.mean([np.mean(V**2, axis=(0, 2)) for V in sizes], axis=0))
        fastest = np.max([V.max(axis=(0, 2)) for V in sizes], axis=0)
        return cls(np.maximum(typical, _SLOWEST), np.maximum(fastest, _SLOWEST))


def with_growth(model: Model, size: Float[np.ndarray, "6 7"], twists: Twists) -> Model:
    """The model with other terms of b².

    Args:
        model: one that `can_grow`.
        size: terms of b_i² at the typical twist, in units of the model's constant term; the first
            one of each axis, the constant term, is not zero.
        twists: those that were seen.
    """
    own = core(model)
    rate = size[:, 1:] / size[:, :1] / twists.typical**2
    growth = Growth.create(rate, twists.fastest, own.rigid_inertia.dtype)
    changed: Any = None
    if isinstance(own, Spinn):
        scales = replace(own.scales, growth=growth)
        changed = replace(own, config=replace(own.config, growing=True), scales=scales)
    elif isinstance(own, FossenDynamics):
        changed = own.with_constants(growth=growth)
    changed = with_core(model, changed)
    return with_diffusion(changed, diffusion_scale(model) * np.sqrt(size[:, 0]))


@dataclass(frozen=True)
class Spread:
    """Displacements from the noise-free motion in a set of windows.

    Attributes:
        start: variance by what was not known of the first twist.
        terms: variance by each term of b² alone.
        observed: what was observed; NaN where nothing was.
    """

    start: Float[np.ndarray, "12 T W"]
    terms: Float[np.ndarray, "7 12 T W"]
    observed: Float[np.ndarray, "12 T W"]


def sizes(sets: Sequence[Spread]) -> Float[np.ndarray, "6 7"]:
    """By how much each term of each axis' b² has to grow: 1 and zeros where b is constant.

    Fitted to all sets, each of which counts alike; whether terms are used is decided by sets that
    their sizes were not fitted to (of a single set, its halves).
    """
    found = np.eye(1, TERMS).repeat(6, axis=0)
    for axis in range(6):
        parts = [part for one in sets if (part := _Axis.of(one, axis)) is not None]
        if not parts:
            continue
        halves = parts if len(parts) > 1 else parts[0].halves()
        constant = _left_out(halves, [0])
        tried = [list(range(TERMS)), [0, 1 + axis]]  # with all speeds, with the axis' own
        gains = [constant - _left_out(halves, used) for used in tried]
        gain, used = max(zip(gains, tried, strict=True), key=lambda one: one[0].mean())
        if gain.mean() > 2 * gain.std() / np.sqrt(gain.size):
            found[axis] = _fitted(parts, used)
    return found


@dataclass(frozen=True)
class _Axis:
    """Pose and twist of one axis in the windows where both are finite."""

    start: Float[np.ndarray, "2 T W"]
    terms: Float[np.ndarray, "7 2 T W"]
    observed: Float[np.ndarray, "2 T W"]
    unit: Float[np.ndarray, "2 T 1"]

    @classmethod
    def of(cls, spread: Spread, axis: int) -> "_Axis | None":
        own = [axis, axis + 6]
        start, terms, observed = spread.start[own], spread.terms[:, own], spread.observed[own]
        known = np.isfinite(start + terms.sum(axis=0)).all(axis=(0, 1))
        known &= np.isfinite(observed).all(axis=(0, 1))
        if known.sum() < _FEWEST:
            return None
        start, terms, observed = start[..., known], terms[..., known], observed[..., known]
        unit = np.maximum(np.median(np.abs(observed), axis=-1, keepdims=True), 1e-12)
        # noise reaches the pose a step late: what is certain there has no score
        return cls(start + (_CERTAIN * unit) ** 2, terms, observed, unit)

    def halves(self) -> "list[_Axis]":
        """The first and the second half of the windows."""
        middle = self.observed.shape[-1] // 2
        return [
            replace(
                self,
                start=self.start[..., part],
                terms=self.terms[..., part],
                observed=self.observed[..., part],
            )
            for part in (slice(None, middle), slice(middle, None))
        ]

    def scores(self, size: Float[np.ndarray, "7"]) -> Float[np.ndarray, " W"]:
        """Mean score of each window."""
        std = np.sqrt(self.start + np.tensordot(size, self.terms, 1))
        return np.mean(crps(std, self.observed) / self.unit, axis=(0, 1))

    def slope(self, size: Float[np.ndarray, "7"]) -> Float[np.ndarray, "7"]:
        """Derivative of the mean score by the sizes."""
        std = np.sqrt(self.start + np.tensordot(size, self.terms, 1))
        z = self.observed / std
        by_std = (2 * scipy.stats.norm.pdf(z) - 1 / np.sqrt(np.pi)) / self.unit
        return np.mean(by_std / (2 * std) * self.terms, axis=(1, 2, 3))


def crps(
    std: Float[np.ndarray, "*shape"], error: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Continuous ranked probability score of N(0, std²) (Gneiting and Raftery 2007, eq. 21)."""
    z = error / std
    cdf, pdf = scipy.stats.norm.cdf(z), scipy.stats.norm.pdf(z)
    return std * (z * (2 * cdf - 1) + 2 * pdf - 1 / np.sqrt(np.pi))


def _left_out(parts: Sequence[_Axis], used: list[int]) -> Float[np.ndarray, " W"]:
    """Scores of all windows, those of each part with sizes fitted to the other parts."""
    return np.concatenate(
        [
            part.scores(_fitted([other for other in parts if other is not part], used))
            for part in parts
        ]
    )


def _fitted(parts: Sequence[_Axis], used: list[int]) -> Float[np.ndarray, "7"]:
    """Sizes of the `used` terms with the least mean score; the other ones are zero."""

    def full(x: np.ndarray) -> np.ndarray:
        size = np.zeros(TERMS)
        size[used] = x
        return size

    def score(x: np.ndarray) -> tuple[float, np.ndarray]:
        size = full(x)
        slope = np.mean([part.slope(size)[used] for part in parts], axis=0)
        return float(np.mean([part.scores(size).mean() for part in parts])), slope

    start = np.full(len(used), 1 / len(used))
    bounds = [(_LEAST, None)] + [(0, None)] * (len(used) - 1)
    found: Any = scipy.optimize.minimize(score, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return full(found.x)
