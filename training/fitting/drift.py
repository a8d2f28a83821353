"""A first fit of the drift: the networks' output biases by nonlinear least squares.

A preset may be wrong by factors: kernels are then insensitive, and the gradients with respect to
masses and drags differ by orders of magnitude. With its networks' weights fixed a SPINN is a
vehicle with constant M, D and D^f: some 70 numbers, which a trust region method (Moré 1978,
SciPy's) fits in a few steps to the noise-free motion over short pieces. What the data do not
excite (an axis that never moves) is kept near the preset by a weak prior. The fit is meant for
measured states; for exact ones `likelihood` is much more efficient.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ...models.dynamics import Dynamics
from ..config import DriftConfig
from ..data.windows import Windows
from ..losses.base import Batch
from ..losses.matching import SquaredError
from ..predict import predict_drift
from .constants import constants, without_networks
from .fit import Progress

Model = TypeVar("Model", bound=Dynamics)

_PASSES = 2


def fit_drift(
    config: DriftConfig,
    model: Model,
    windows: Windows,
    substeps: int,
    progress: Progress | None = None,
) -> Model:
    """The model with the biases that fit the motion of short pieces best.

    Raises:
        UserError: the model's motion diverges in most of the pieces.
    """
    if config.iterations == 0:
        return model
    steps = int(np.clip(round(config.length_s / windows.dt), 1, windows.steps))
    small = without_networks(model)
    pieces = _telling(windows.subdivide(steps), small, config.pieces, substeps)
    start, unravel = ravel_pytree(constants(model))
    residuals = _residuals(config, unravel, start, substeps, pieces.dt)

    # the first pass scales errors by the preset's, the second one by those that remain
    values = np.asarray(start, float)
    for n in range(_PASSES):
        if progress is not None:
            progress(n, _PASSES, float("nan"))
        current = eqx.tree_at(constants, small, unravel(jnp.asarray(values, start.dtype)))
        given = small, Batch.of(pieces), SquaredError.build("typical", substeps, current, pieces)
        found = _solved(residuals, given, values, start.dtype, config.iterations)
        if not np.all(np.isfinite(found)):
            break
        values = found
    return eqx.tree_at(constants, model, unravel(jnp.asarray(values, start.dtype)))


def _solved(
    residuals: Callable[[Array, Any], tuple[Array, Array]],
    given: Any,
    values: Float[np.ndarray, " p"],
    dtype: Any,
    steps: int,
) -> Float[np.ndarray, " p"]:
    """The least-squares solution after at most `steps` evaluations from `values`."""
    known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if x.tobytes() not in known:
            known.clear()
            errors, jacobian = (
                np.asarray(a, float) for a in residuals(jnp.asarray(x, dtype), given)
            )
            # entries of diverged motions are not finite
            known[x.tobytes()] = errors, np.where(np.isfinite(jacobian), jacobian, 0.0)
        return known[x.tobytes()]

    def slopes(x: np.ndarray) -> np.ndarray:
        return both(x)[1]

    jac: Any = slopes  # SciPy's stubs only allow names of schemes
    return scipy.optimize.least_squares(
        lambda x: both(x)[0], values, jac, xtol=1e-3, ftol=1e-4, max_nfev=steps
    ).x


def _telling(pieces: Windows, model: Dynamics, count: int, substeps: int) -> Windows:
    """Half of `count` evenly spread over all, half where the model predicts the largest changes.

    A change of velocity separates masses from drags, and a recording may have few of them. The
    largest predicted changes on each axis are chosen: they depend on states and commands, not on
    the noise within the piece, so that the choice does not bias the fit.
    """
    if len(pieces) <= count:
        return pieces
    batch = Batch.of(pieces)
    _, V = eqx.filter_jit(predict_drift)(
        model, batch.X[0], batch.V[0], batch.F, pieces.dt, substeps=substeps,
        commands=batch.commands, rise=batch.rise,
    )  # fmt: skip
    change = np.nan_to_num(np.abs(np.asarray(V[-1]) - pieces.V[0]), nan=0.0, posinf=0.0)
    largest = np.argsort(-change, axis=1, kind="stable")[:, : max(1, count // 12)]
    even = np.linspace(0, len(pieces) - 1, max(1, count - largest.size)).round().astype(int)
    return pieces.take(np.unique(np.concatenate([largest.ravel(), even])))


def _residuals(
    config: DriftConfig,
    unravel: Callable[[Array], Any],
    start: Float[Array, " p"],
    substeps: int,
    dt: float,
) -> Callable[[Array, Any], tuple[Array, Array]]:
    """A compiled function of constants and (model, pieces, units): residuals and Jacobian."""

    def residuals(values: Array, given: Any) -> Array:
        model, batch, unit = given
        model = eqx.tree_at(constants, model, unravel(values))
        X, V = predict_drift(
            model, batch.X[0], batch.V[0], batch.F, dt, substeps=substeps,
            commands=batch.commands, rise=batch.rise,
        )  # fmt: skip
        errors = jnp.stack(unit.by_axis(X[:, :, None], V[:, :, None], batch))
        errors = errors[:, :, 1::4]  # neighbouring times are nearly redundant
        # a large step of the solver may diverge: a large finite error makes it step back
        errors = jnp.where(jnp.isfinite(errors), jnp.clip(errors, -1e3, 1e3), 1e3)
        change = (values - start) / jnp.maximum(1, jnp.abs(start))
        return jnp.concatenate([errors.ravel() / errors.size**0.5, config.prior**0.5 * change])

    @eqx.filter_jit
    def both(values: Array, given: Any) -> tuple[Array, Array]:
        errors, push = jax.linearize(lambda x: residuals(x, given), values)
        return errors, jax.vmap(push, out_axes=1)(jnp.eye(len(values), dtype=values.dtype))

    return both
