"""Maximum-likelihood drift and diffusion for exactly known states: a fit to innovations.

By the Markov property the likelihood of a trajectory is the product of its steps' (`innovations`).
Least squares weighted by P⁻¹, with P and b updated between passes, reaches the Cramér–Rao bound of
the constants. Squared errors of long noise-free motions are far from it, as they accumulate the
process noise. With measurement noise the reverse holds: it dominates the one-step innovations. The
fit is therefore accepted only if its innovations are uncorrelated (`Fitted.white`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ...models.spinn import Spinn
from ..config import DriftConfig
from ..data.windows import Windows
from ..least_squares import Damping, LocalModel, marquardt, minimise
from .constants import constants, without_networks
from .one_step_errors import Steps, correlation, innovations, likely_diffusion, whitened, whitening

Model = TypeVar("Model", bound=Spinn)

_FEW = 4000  # steps of the first passes, enough for approximate constants
_CHUNK = 4096  # steps whose derivatives fit into a processor's cache
_GAIN = 0.1
"""Least gain in log-likelihood of an iteration; one standard error of a parameter is 0.5."""
_DAMPING = Damping(after_failure=0.0, least=0.0, factor=5.0)


@dataclass(frozen=True)
class Fitted:
    """Result of the fit to innovations.

    Attributes:
        values: the constants (`training.fitting.constants`), flat.
        diffusion: maximum-likelihood b given them (N√s, N·m√s).
        information: Fisher information of the values, including the prior's.
        correlation: correlation of neighbouring innovations by axis.
    """

    values: Float[np.ndarray, " p"]
    diffusion: Float[np.ndarray, "6"]
    information: Float[np.ndarray, "p p"]
    correlation: Float[np.ndarray, "6"]

    def white(self, bound: float) -> bool:
        """Whether the correlation is known and within ± `bound` on every axis."""
        return bool((np.abs(self.correlation) <= bound).all())

    def apply(self, model: Model) -> Model:
        """The model with these constants."""
        flat, unravel = ravel_pytree(constants(model))
        return eqx.tree_at(constants, model, unravel(jnp.asarray(self.values, flat.dtype)))


def fit_innovations(
    config: DriftConfig, model: Spinn, windows: Windows, substeps: int
) -> Fitted | None:
    """Maximum-likelihood constants and b, starting from `model`, subject to `config.innovations`.

    None if that is `never` or there are no iterations, if it is `auto` and the innovations are
    correlated, or if the result is not finite.
    """
    if config.innovations == "never" or config.iterations == 0:
        return None
    few, every = (Steps.of(windows, n) for n in (min(_FEW, config.most_steps), config.most_steps))
    if len(every) == 0:
        return None
    fit = _Fit.of(config, model, substeps)
    # the first pass has the preset's weights; the last one needs weights that are nearly right
    first = fit.from_here(fit.start, None, few)
    found = None if first is None else fit.from_here(first.values, first.diffusion, few)
    if found is not None and len(every) > len(few) and _may_stay(config, found):
        found = fit.from_here(found.values, found.diffusion, every)
    return found if found is not None and _may_stay(config, found) else None


def _may_stay(config: DriftConfig, found: Fitted) -> bool:
    return config.innovations == "always" or found.white(config.white)


class _Fit(eqx.Module):
    """Constants of all passes."""

    small: Spinn
    start: np.ndarray
    unravel: Callable[[Array], Any]
    precision: float
    iterations: int
    substeps: int

    @classmethod
    def of(cls, config: DriftConfig, model: Spinn, substeps: int) -> "_Fit":
        flat, unravel = ravel_pytree(constants(model))
        return cls(
            without_networks(model),
            np.asarray(flat, np.float64),
            unravel,
            config.prior_sd**-2 if config.prior_sd > 0 else 0.0,
            config.iterations,
            substeps,
        )

    def model(self, values: Float[np.ndarray, " p"]) -> Spinn:
        dtype = self.small.matrix_heads.bias.dtype
        return _with(self.small, self.unravel, jnp.asarray(values, dtype))

    def from_here(
        self, values: Float[np.ndarray, " p"], b: Float[np.ndarray, "6"] | None, steps: Steps
    ) -> Fitted | None:
        """One pass: weights from `values`, then the constants by least squares, then b."""
        b = likely_diffusion(self.model(values), steps, self.substeps, b)
        if not np.isfinite(b).all():
            return None
        whiten = self.whitening(values, steps, b)

        def cost(values: Float[np.ndarray, " p"]) -> float:
            errors, change = self.whitened(values, steps, whiten), values - self.start
            return float(errors.ravel() @ errors.ravel() + self.precision * change @ change) / 2

        def gram(values: Float[np.ndarray, " p"]) -> tuple[np.ndarray, np.ndarray]:
            flat = jnp.asarray(values, steps.V.dtype)
            parts = _gram(self.small, self.unravel, flat, steps, whiten, self.substeps)
            H, g = (np.asarray(a, np.float64) for a in parts)
            g = g + self.precision * (values - self.start)
            return H + self.precision * np.eye(len(g)), g

        def local(values: Float[np.ndarray, " p"]) -> LocalModel:
            H, g = gram(values)
            return LocalModel(cost(values), cost, lambda damping: values + marquardt(H, g, damping))

        values = minimise(values, local, self.iterations, _GAIN, _DAMPING)
        information, _ = gram(values)
        b = likely_diffusion(self.model(values), steps, self.substeps, b)
        errors = self.whitened(values, steps, self.whitening(values, steps, b))
        if not (np.isfinite(values).all() and np.isfinite(b).all()):
            return None
        return Fitted(values, b, information, correlation(steps, errors))

    def whitening(
        self, values: Float[np.ndarray, " p"], steps: Steps, b: Float[np.ndarray, "6"]
    ) -> Float[Array, "6 6 N"]:
        b_array = jnp.asarray(b, steps.V.dtype)
        return whitening(self.model(values), steps, b_array, self.substeps)[0]

    def whitened(
        self, values: Float[np.ndarray, " p"], steps: Steps, whiten: Float[Array, "6 6 N"]
    ) -> Float[np.ndarray, "6 N"]:
        errors = whitened(self.model(values), steps, whiten, self.substeps)
        return np.asarray(errors, np.float64)


def _with(small: Spinn, unravel: Callable[[Array], Any], values: Array) -> Spinn:
    return eqx.tree_at(constants, small, unravel(values))


@eqx.filter_jit
def _gram(
    small: Spinn,
    unravel: Callable[[Array], Any],
    values: Float[Array, " p"],
    steps: Steps,
    whiten: Float[Array, "6 6 N"],
    substeps: int,
) -> tuple[Float[Array, "p p"], Float[Array, " p"]]:
    """JᵀJ and Jᵀr of the whitened innovations r, chunk by chunk."""
    count = -(-len(steps) // _CHUNK)
    short = -len(steps) % count

    def chunks(a: Array, mode: str = "edge") -> Array:
        a = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, short)], mode=mode)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], count, -1), -2, 0)

    def part(inputs: tuple[Steps, Array]) -> tuple[Array, Array]:
        steps, whiten = inputs

        def errors(v: Array) -> Array:
            r = innovations(_with(small, unravel, v), steps, substeps)
            return jnp.einsum("ijn,jn->in", whiten, r).ravel()

        r, push = jax.linearize(errors, values)
        J = jax.lax.map(push, jnp.eye(values.size, dtype=values.dtype))
        return J @ J.T, J @ r

    # the padding of the last chunk has zero weight
    H, g = jax.lax.map(part, (jax.tree.map(chunks, steps), chunks(whiten, "constant")))
    return jnp.sum(H, axis=0), jnp.sum(g, axis=0)
