"""Rival methods on the same cases: their terms and their share of the gain.

Each learns the belief's error in dν/dt from the same one-step errors, and is judged by the same
forecasts as the extended model. None of them names causes; sparse ones are reported by their terms.

- `stlsq`: sequentially thresholded least squares (Brunton, Proctor and Kutz 2016) on the smoothed
  derivative of the summed errors, which is SINDy of a discrepancy (Kaheman et al. 2019);
- `weak`: the same regression in weak form (Messenger and Bortz 2021), both by pysindy;
- `features`: ridge on random features, an approximate Gaussian process (`training`'s black box).

Sparse regressions choose among constants, ν, |ν|ν, products of ν, the up direction, heading,
position, thruster forces with those of the step before, their sizes, and their products with the
axial flow speed, standardised. The threshold is the best one on held-out scenarios.
"""

import functools
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.errors import UserError
from ...models.se3 import TWIST, WRENCH
from ...training.diagnosis.data.arrays import Data
from ...training.diagnosis.filter.innovations import predict
from ...training.diagnosis.filter.problem import DiagnosisProblem
from ...training.diagnosis.validation.blackbox import arguments, train
from ...training.diagnosis.validation.forecast import Learned
from .cases import Case
from .judging import believed, share_of_gain

THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0)
"""Shares of the residual's standard deviation, on standardised features; the last keeps none."""
_SMOOTH = 11
"""Window (samples) of the smoothing filter before differentiation (pysindy's default)."""
_TESTED, _HALF = 60, 0.5
"""Test functions per run, and half of their width (s)."""


@dataclass(frozen=True)
class Rival:
    """The result of one rival on a case.

    Attributes:
        gain: share of the true model's gain, as for the extended model; empty without an oracle.
        terms: of a sparse regression, by axis, largest first; None for others.
    """

    gain: dict[str, float] = field(default_factory=dict)
    terms: dict[str, list[str]] | None = None

    @property
    def count(self) -> int | None:
        """Number of terms."""
        return None if self.terms is None else sum(len(t) for t in self.terms.values())

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        return {**asdict(self), "count": self.count}


# ------------------------------------------------------------------------------------ features


class Sparse(eqx.Module):
    """Acceleration that is linear in `terms`, with weights (D, 6)."""

    directions: Float[Array, "3 n"]
    weights: Float[Array, "D 6"]

    def acceleration(
        self, X: Float[Array, "7 *b"], V: Float[Array, "6 *b"], u: Array, before: Array
    ) -> Float[Array, "6 *b"]:
        """The addition to dV/dt (m/s², rad/s²)."""
        return jnp.tensordot(self.weights.T, terms(self.directions, X, V, u, before), 1)


_PAIRS = [(i, j) for i in range(6) for j in range(i + 1, 6)]


def terms(
    directions: Float[Array, "3 n"],
    X: Float[Array, "7 *b"],
    V: Float[Array, "6 *b"],
    u: Float[Array, "n *b"],
    before: Float[Array, "n *b"],
) -> Float[Array, "D *b"]:
    """The candidates, in the order of `labels`."""
    e = jnp.zeros_like(X[4:])
    up, ahead = se3.rotate_inverse(X, e.at[2].set(1)), se3.rotate(X, e.at[0].set(1))[:2]
    products = jnp.stack([V[i] * V[j] for i, j in _PAIRS])
    axial = jnp.tensordot(directions.T, V[:3], 1)
    parts = (jnp.ones_like(V[:1]), V, jnp.abs(V) * V, products, up, ahead, X[4:], u, before,
             jnp.abs(u), axial * u)  # fmt: skip
    return jnp.concatenate(parts)


def labels(thrusters: int) -> list[str]:
    """The names of the candidates."""
    numbers = range(1, thrusters + 1)
    found = ["1", *TWIST, *(f"|{v}|{v}" for v in TWIST)]
    found += [f"{TWIST[i]} {TWIST[j]}" for i, j in _PAIRS]
    found += ["up_x", "up_y", "up_z", "cos yaw", "sin yaw", "x", "y", "z"]
    for form in ("f{}", "f{} before", "|f{}|", "f{} axial speed"):
        found += [form.format(i) for i in numbers]
    return found


# ------------------------------------------------------------------------------------ regressions


def pysindy() -> Any:
    """The pysindy library, an optional dependency of this comparison.

    Raises:
        UserError: it isn't installed.
    """
    try:
        import pysindy as library
    except ImportError as error:
        raise UserError(
            "--rivals: pysindy is not installed; pip install 'spinndrift[rivals]' brings it (in a "
            "checkout pip install -e '.[rivals]')"
        ) from error
    return library


System = tuple[Float[np.ndarray, "n D"], Float[np.ndarray, "n 6"]]
"""Rows of candidates and of regression targets, of one run."""


def _derivatives(phi: np.ndarray, y: np.ndarray, t: np.ndarray, _: int) -> System:
    method = pysindy().SmoothedFiniteDifference(smoother_kws={"window_length": _SMOOTH})
    return phi[:-1], method(y, t)[:-1]


def _weak(phi: np.ndarray, y: np.ndarray, t: np.ndarray, number: int) -> System:
    """Integrals against the same test functions on both sides of the equation."""
    sindy = pysindy()
    library = sindy.WeakPDELibrary(
        function_library=sindy.PolynomialLibrary(degree=1, include_bias=False),
        spatiotemporal_grid=t,
        K=_TESTED,
        H_xt=[min(_HALF, (t[-1] - t[0]) / 4)],
    )
    state = np.random.get_state()  # noqa: NPY002  pysindy draws its test functions from it
    np.random.seed(number)  # noqa: NPY002
    library.fit([phi])
    np.random.set_state(state)  # noqa: NPY002
    return np.asarray(library.transform([phi])[0]), np.asarray(library.convert_u_dot_integral(y))


_FORMS: dict[str, Callable[..., System]] = {"stlsq": _derivatives, "weak": _weak}


def sparse(
    form: str, errors: Float[np.ndarray, "N 12 R"], data: Data, directions: np.ndarray
) -> Sparse:
    """Regression of the belief's error on the candidates, its threshold by cross-validation."""
    phi = np.asarray(terms(jnp.asarray(directions), *arguments(data)))  # (D, N, R)
    exists = data.weight > 0
    centre, scale = phi[:, exists].mean(axis=1), phi[:, exists].std(axis=1)
    constant = scale < 1e-9
    centre, scale = np.where(constant, 0.0, centre), np.where(constant, 1.0, scale)
    systems = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on unlabelled axes and empty models
        for r in range(len(data.fold)):
            n = int(data.weight[:, r].sum())
            if n <= _SMOOTH:
                continue
            y = np.concatenate([np.zeros((1, 6)), np.cumsum(errors[:n, 6:, r], axis=0)])
            own = (phi[:, :n, r].T - centre) / scale
            own = np.concatenate([own, own[-1:]])  # held until the last record
            systems.append((data.fold[r], *_FORMS[form](own, y, data.times[: n + 1, r], r)))
        weights = _chosen(systems, centre, scale)
    return Sparse(jnp.asarray(directions), jnp.asarray(weights))


def _chosen(systems: list[tuple], centre: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Weights (D, 6) on unstandardised candidates, each axis with its own best threshold."""
    if not systems:
        return np.zeros((len(scale), 6))
    folds = np.concatenate([np.full(len(P), f) for f, P, _ in systems])
    P, y = (np.concatenate([s[i] for s in systems]) for i in (1, 2))
    unit = y.std(axis=0) + 1e-12
    halves = [folds % 2 == 0, folds % 2 == 1] if len(np.unique(folds)) > 1 else []
    losses = np.zeros((len(THRESHOLDS), 6))
    for fitted in halves:
        for k, threshold in enumerate(THRESHOLDS):
            w = _stlsq(P[fitted], y[fitted] / unit, threshold)
            losses[k] += np.mean((P[~fitted] @ w - y[~fitted] / unit) ** 2, axis=0)
    best = np.argmin(losses, axis=0) if halves else np.full(6, THRESHOLDS.index(0.1))
    weights = np.zeros((P.shape[1], 6))
    for k in np.unique(best):
        own = best == k
        weights[:, own] = _stlsq(P, y / unit, THRESHOLDS[k])[:, own]
    weights = weights * unit / scale[:, None]
    weights[0] -= centre[1:] @ weights[1:]  # the constant is the first
    return weights


def _stlsq(P: np.ndarray, y: np.ndarray, threshold: float) -> np.ndarray:
    """STLSQ on R of P = Q R: least squares and ridge depend on PᵀP and Pᵀy alone."""
    Q, P = np.linalg.qr(P)
    y = Q.T @ y / np.sqrt(len(Q))
    P = P / np.sqrt(len(Q))
    return pysindy().STLSQ(threshold=threshold, alpha=1e-3).fit(P, y).coef_.T


# ---------------------------------------------------------------------------------------- judging


def compete(case: Case) -> dict[str, Rival]:
    """All rivals on one case.

    Raises:
        UserError: the data can't be read, or pysindy is not installed.
    """
    pysindy()
    recording = case.read()
    vehicle, base = believed(case.truth, recording)
    problem = DiagnosisProblem.of(recording, vehicle, base)
    predictions = predict(problem.model, problem.library, problem.believed, problem.data)
    errors = np.asarray(predictions.error) * problem.data.weight[:, None]
    directions = np.asarray(vehicle.thrusters().directions)
    judged = functools.partial(_judged, case, problem)
    found = {}
    for form in _FORMS:
        model = sparse(form, errors, problem.data, directions)
        found[form] = Rival(judged(model), _equations(model))
    box = train(predictions, problem.data, np.random.default_rng(0), whole=True)
    return found | {"features": Rival(judged(box))}


def _judged(case: Case, problem: DiagnosisProblem, rest: Learned) -> dict[str, float]:
    if not (case.has_oracle and case.truth.causes):
        return {}
    model = problem.model.with_effects(())
    return share_of_gain(case, problem.vehicle, (model, None), (model, rest))


def _equations(model: Sparse) -> dict[str, list[str]]:
    names = labels(model.directions.shape[1])
    weights = np.asarray(model.weights)
    found = {}
    for i, axis in enumerate(WRENCH):
        order = np.argsort(-np.abs(weights[:, i]))
        found[axis] = [names[k] for k in order if weights[k, i] != 0 and k > 0]
    return found
