"""Multi-step fits, for records whose one-step errors come mostly from their preprocessing.

`spinndrift diagnose` fits to innovations, the better statistic where records are raw: white noise,
original time steps. States that were smoothed, averaged in bins or resampled have correlated
one-step errors, and drag fitted to them absorbs the smoothing. Here the model forecasts windows
from the record at their start, without noise, and all errors along the window are minimised,

    min_θ Σ_windows Σ_k ρ(|e_k(θ)|² / s²),   e_k = (X̂_k, V̂_k) ⊖ (X_k, V_k),

with s a robust size of each component under the believed model and ρ(x) = 2 (√(1 + x) - 1)
(Charbonnier et al. 1997), which limits the weight of outliers of motion capture. Standard errors of
θ are robust against dependence within blocks (sandwich). The price: process noise in the window
biases drag slightly, and lags and delays below a few steps are less well resolved.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.library import Library
from spinndrift.training.diagnosis.data.arrays import Data
from spinndrift.training.diagnosis.filter.along_records import Records, substeps
from spinndrift.training.diagnosis.filter.innovations import difference
from spinndrift.training.diagnosis.filter.problem import DiagnosisProblem, mass
from spinndrift.training.diagnosis.validation.forecast import states
from spinndrift.training.least_squares import LocalModel, marquardt, minimise

_ENOUGH = 1e-3
"""Relative gain of a step below which a fit has ended."""


@dataclass(frozen=True)
class Windows:
    """K windows of M steps, component first: record at the start, commands, and what followed.

    Attributes:
        X, V: records 0 … M (M + 1, 7, K), (M + 1, 6, K).
        u: thruster forces (M, n, K).
        past: commands of the steps before, oldest first (P, n, K); they set actuator states.
        past_step: how long each was held (s) (P, K).
        voltage: relative (M, K).
        step: from record k to k + 1 (s) (M, K).
        block: index of the stretch of time (K,), within which windows depend on each other.
        scenario: index of the scenario (K,).
    """

    X: Float[np.ndarray, "M1 7 K"]
    V: Float[np.ndarray, "M1 6 K"]
    u: Float[np.ndarray, "M n K"]
    past: Float[np.ndarray, "P n K"]
    past_step: Float[np.ndarray, "P K"]
    voltage: Float[np.ndarray, "M K"]
    step: Float[np.ndarray, "M K"]
    block: Int[np.ndarray, " K"]
    scenario: Int[np.ndarray, " K"]

    @property
    def count(self) -> int:
        """Substeps of a step."""
        return substeps(float(self.step.max()))


@dataclass(frozen=True)
class MultiStepFit:
    """Values of all parameters, standard errors of those fitted (`rows`), loss on the windows."""

    theta: Float[np.ndarray, " p"]
    rows: tuple[int, ...]
    errors: Float[np.ndarray, " k"]
    loss: float


def windows(data: Data, horizon: float, every: float, block: float = 10.0) -> Windows:
    """Windows of `horizon` s that start `every` s, in blocks of `block` s."""
    M, step = max(1, round(horizon / data.dt)), max(1, round(every / data.dt))
    parts: dict[str, list[np.ndarray]] = {
        k: [] for k in ("X", "V", "u", "past", "past_step", "voltage", "step")
    }
    blocks, scenarios = [], []
    for r in range(len(data.run)):
        length, behind = int(data.weight[:, r].sum()), len(data.past)
        u = np.concatenate([data.past[..., r], data.u[..., r]])
        held = np.concatenate([data.past_step[:, r], data.step[:, r]])
        for n in range(0, length - M + 1, step):
            parts["X"].append(data.X[n : n + M + 1, :, r])
            parts["V"].append(data.V[n : n + M + 1, :, r])
            parts["u"].append(data.u[n : n + M, :, r])
            parts["past"].append(u[n : n + behind])
            parts["past_step"].append(held[n : n + behind])
            parts["voltage"].append(data.voltage[n : n + M, r])
            parts["step"].append(data.step[n : n + M, r])
            blocks.append((r, int(n * data.dt / block)))
            scenarios.append(int(data.scenario[r]))
    labels = np.unique(np.array(blocks, int).reshape(-1, 2), axis=0, return_inverse=True)[1]
    stacked = {k: np.stack(v, axis=-1) for k, v in parts.items()}
    return Windows(**stacked, block=labels.ravel(), scenario=np.array(scenarios))


def _errors(model: Extended, records: Records, count: int) -> Float[Array, "M 12 K"]:
    X, V = (jnp.moveaxis(a, 1, 0) for a in states(model, records, len(records.u), count))
    X1, V1 = (jnp.moveaxis(a[1:], 1, 0) for a in (records.X, records.V))
    return jnp.moveaxis(difference(X1, V1, X, V), 0, 1)


@eqx.filter_jit
def _apart(model: Extended, effects: tuple, records: Records, count: int) -> Float[Array, "M 12 K"]:
    return _errors(model.with_effects(effects), records, count)


@eqx.filter_jit
def _slopes(
    model: Extended, library: Library, theta: Array, rows: Array, records: Records, count: int
) -> tuple[Array, Array]:
    def errors(values: Array) -> Array:
        effects = library.filled(theta.at[rows].set(values))
        return _errors(model.with_effects(effects), records, count)

    values = theta[rows]
    e, push = jax.linearize(errors, values)
    return e, jax.vmap(push)(jnp.eye(len(values), dtype=values.dtype))


def _records(w: Windows) -> Records:
    arrays = (w.X, w.V, w.u, w.voltage, w.step, w.past, w.past_step)
    return Records(*(jnp.asarray(a) for a in arrays))


def small(
    problem: DiagnosisProblem, rows: Sequence[int], theta: np.ndarray
) -> tuple[Library, list[int]]:
    """The library of the effects in use, and its parameters' indices in the problem's library."""
    used = {problem.library.entries[i].cause for i in rows}
    used |= {problem.library.entries[i].cause for i in np.flatnonzero(theta)}
    library = Library([e for e in problem.library.effects if e.name in used])
    index = {(e.cause, e.where, e.parameter.name): i for i, e in enumerate(problem.library.entries)}
    return library, [index[e.cause, e.where, e.parameter.name] for e in library.entries]


def forecast_errors(
    problem: DiagnosisProblem, theta: Float[np.ndarray, " p"], w: Windows
) -> Float[np.ndarray, "M 12 K"]:
    """Forecast minus record: pose in the recorded body frame (m, rad), then twist."""
    library, at = small(problem, (), theta)
    effects = library.filled(theta[at])
    return np.asarray(_apart(problem.model, effects, _records(w), w.count))


def fit_forecasts(
    problem: DiagnosisProblem,
    w: Windows,
    rows: Sequence[int],
    kept: Bool[np.ndarray, " K"] | None = None,
    rounds: int = 12,
) -> MultiStepFit:
    """Gauss–Newton with damping (Levenberg 1944; Marquardt 1963) on the parameters chosen.

    Only windows `kept` are fitted to (all by default). Drag stays passive: neither the linear nor
    the quadratic coefficient of an axis becomes negative.
    """
    theta, rows = problem.believed.copy(), list(rows)
    kept = np.ones(len(w.block), bool) if kept is None else kept
    belief = forecast_errors(problem, theta, w)[..., kept]
    size = np.maximum(1.4826 * np.median(np.abs(belief), axis=(0, 2)), 1e-4)
    if not rows:
        return MultiStepFit(theta, (), np.zeros(0), _loss(belief, size))
    library, at = small(problem, rows, theta)
    own = [at.index(i) for i in rows]
    entries = [library.entries[i].parameter for i in own]
    low, high = problem.limits(rows)
    probe = np.array([abs(p.probes[0]) for p in entries])
    records = _records(w)
    # where a response has no slope at zero (lag, delay), start at the first probe
    start = theta[at]
    flat = np.array([len(p.probes) > 2 and min(p.probes) > 0 for p in entries]) & (start[own] == 0)
    start[own] = np.clip(np.where(flat, probe, start[own]), low, high)

    def loss(values: np.ndarray) -> float:
        if not _is_body(problem, library, values):
            return np.inf
        e = _apart(problem.model, library.filled(values), records, w.count)
        return _log(_loss(np.asarray(e)[..., kept], size))

    def errors(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e, J = _slopes(library=library, model=problem.model, theta=jnp.asarray(values),
                       rows=jnp.asarray(own), records=records, count=w.count)  # fmt: skip
        return np.asarray(e)[..., kept], np.asarray(J)[..., kept]

    def local(values: np.ndarray) -> LocalModel:
        e, J = errors(values)
        H, g = _normal(e, J, size, probe)

        def stepped(damping: float) -> np.ndarray:
            trial = values.copy()
            trial[own] = np.clip(values[own] + marquardt(H, g, damping) * probe, low, high)
            return trial

        return LocalModel(_log(_loss(e, size)), loss, stepped)

    theta[at] = found = minimise(start, local, rounds, _ENOUGH)
    e, J = errors(found)
    spread = _spread(e, J, size, probe, w.block[kept])
    return MultiStepFit(theta, tuple(rows), spread, _loss(e, size))


def _log(loss: float) -> float:
    return float(np.log(max(loss, 1e-300)))


def _is_body(problem: DiagnosisProblem, library: Library, values: np.ndarray) -> bool:
    return bool(np.linalg.eigvalsh(mass(problem.model, library, values))[0] > 0)


def _loss(e: np.ndarray, size: np.ndarray) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # too long a step diverges
        x = np.sum((e / size[:, None]) ** 2, axis=1) / e.shape[1]
    return float(np.mean(2 * (np.sqrt(1 + x) - 1))) if np.isfinite(x).all() else np.inf


def _weighted(e: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scaled = e / size[:, None]
    return scaled, 1 / np.sqrt(1 + np.sum(scaled**2, axis=1) / e.shape[1])


def _normal(
    e: np.ndarray, J: np.ndarray, size: np.ndarray, probe: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    scaled, weight = _weighted(e, size)
    J = J / size[:, None] * probe[:, None, None, None]
    H = np.einsum("amik,mk,bmik->ab", J, weight, J, optimize=True)
    return H, np.einsum("amik,mk,mik->a", J, weight, scaled, optimize=True)


def _spread(
    e: np.ndarray, J: np.ndarray, size: np.ndarray, probe: np.ndarray, block: np.ndarray
) -> Float[np.ndarray, " k"]:
    """Standard errors, clustered by block (Liang and Zeger 1986)."""
    H, _ = _normal(e, J, size, probe)
    scaled, weight = _weighted(e, size)
    g = np.einsum(
        "amik,mk,mik->ak", J / size[:, None] * probe[:, None, None, None], weight, scaled,
        optimize=True,
    )  # fmt: skip
    total = np.zeros((block.max() + 1, len(H)))
    np.add.at(total, block, g.T)
    inverse = np.linalg.pinv(H, rcond=1e-10)
    return np.sqrt(np.maximum(np.diag(inverse @ (total.T @ total) @ inverse), 0)) * probe


GROUPS = {
    "position": slice(0, 3), "rotation": slice(3, 6), "velocity": slice(6, 9), "rate": slice(9, 12),
}  # fmt: skip
"""Position (m), rotation (rad), velocity (m/s) and rate (rad/s) of errors."""


def rmse(
    e: Float[np.ndarray, "M 12 K"],
    block: Int[np.ndarray, " K"],
    rng: np.random.Generator,
    than: Float[np.ndarray, "M 12 K"] | None = None,
    draws: int = 2000,
) -> dict[str, tuple[float, float, float]]:
    """RMSE at the windows' end, or its ratio to that of `than`, with 95 % intervals.

    Intervals are from a block bootstrap (Künsch 1989), with the same blocks for both.
    """
    labels, index = np.unique(block, return_inverse=True)
    drawn = rng.integers(len(labels), size=(draws, len(labels)))
    found = {}
    for name, part in GROUPS.items():
        top = np.sum(e[-1, part] ** 2, axis=0)
        bottom = np.ones_like(top) if than is None else np.sum(than[-1, part] ** 2, axis=0)
        a, b = (np.bincount(index, x, len(labels)) for x in (top, bottom))
        sampled = np.sqrt(a[drawn].sum(axis=1) / b[drawn].sum(axis=1))
        low, high = np.percentile(sampled, (2.5, 97.5))
        found[name] = float(np.sqrt(a.sum() / b.sum())), float(low), float(high)
    return found
