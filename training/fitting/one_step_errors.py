"""Innovations: one-step prediction errors of a model, and their covariance.

Given the state at t_n, the twist at t_(n+1) of a diffusion is Gaussian to first order in its noise,

    r_n = ξ_(n+1) - m(x_n) ~ N(0, P_n),   P ← A P Aᵀ + h G diag(b²) Gᵀ,   A = I + h ∂a/∂ξ,  G = M⁻¹,

over the integrator's steps of h from P = 0, where a is the drift and m the motion without noise
(local linearisation: Särkkä and Solin 2019, chapter 9). Innovations of different steps are
independent if states are known exactly and the law is Markov; measurement noise and forces with
memory correlate neighbours.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, DTypeLike, Float

from ...models.dynamics import Dynamics
from ...models.integrate import over_substeps
from ..data.windows import Windows

_PART = 20  # consecutive steps that are kept together when steps are left out


class Steps(eqx.Module):
    """N distinct steps of one sample each, in the order of their runs.

    Attributes:
        X: poses at the start.
        V: twists at the start.
        F: mean wrenches.
        V_next: twists at the end; the poses there carry no further information.
        follows: whether a step's end is the next one's start.
        dt: length of each (s).
        rise: change of the wrenches over them; None if they are held.
    """

    X: Float[Array, "7 N"]
    V: Float[Array, "6 N"]
    F: Float[Array, "6 N"]
    V_next: Float[Array, "6 N"]
    follows: Bool[Array, " N"]
    dt: float = eqx.field(static=True)
    rise: Float[Array, "6 N"] | None = None

    @classmethod
    def of(cls, windows: Windows, most: int) -> "Steps":
        """The finite steps of windows that may overlap, thinned evenly to about `most`."""
        pieces = windows.subdivide(1)
        time = np.round(pieces.start / pieces.dt).astype(int)
        key = np.stack([pieces.scenario, pieces.run, time])
        chosen = np.unique(key, axis=1, return_index=True)[1]
        numbers = np.concatenate([*pieces.X, *pieces.V, *pieces.F])
        chosen = chosen[np.isfinite(numbers[:, chosen]).all(axis=0)]
        if len(chosen) > most:
            parts = np.array_split(chosen, max(1, len(chosen) // _PART))
            kept = np.linspace(0, len(parts) - 1, max(1, most // _PART)).round().astype(int)
            chosen = np.concatenate([parts[i] for i in np.unique(kept)])
        key, pieces = key[:, chosen], pieces.take(chosen)
        after = (np.diff(key, axis=1) == np.array([[0], [0], [1]])).all(axis=0)
        return cls(
            X=jnp.asarray(pieces.X[0]),
            V=jnp.asarray(pieces.V[0]),
            F=jnp.asarray(pieces.F[0]),
            V_next=jnp.asarray(pieces.V[1]),
            follows=jnp.asarray(np.append(after, np.zeros(min(1, len(chosen)), bool))),
            dt=pieces.dt,
            rise=None if pieces.rise is None else jnp.asarray(pieces.rise[0]),
        )

    def __len__(self) -> int:
        return self.V.shape[1]


def correlation(steps: Steps, errors: Float[np.ndarray, "6 N"]) -> Float[np.ndarray, "6"]:
    """Correlation of neighbouring errors by axis, NaN without neighbours."""
    pairs = np.flatnonzero(np.asarray(steps.follows))
    if not len(pairs):
        return np.full(6, np.nan)
    product = np.mean(errors[:, pairs] * errors[:, pairs + 1], axis=1)
    return product / np.mean(errors * errors, axis=1)


def innovations(model: Dynamics, steps: Steps, substeps: int) -> Float[Array, "6 N"]:
    """r: the twists at the steps' ends minus those of the motion without noise."""
    return steps.V_next - _motion(model, steps, substeps)[0]


@eqx.filter_jit
def whitened(
    model: Dynamics, steps: Steps, whiten: Float[Array, "6 6 N"], substeps: int
) -> Float[Array, "6 N"]:
    """The innovations whitened by `whitening`."""
    return jnp.einsum("ijn,jn->in", whiten, innovations(model, steps, substeps))


@eqx.filter_jit
def whitening(
    model: Dynamics, steps: Steps, b: Float[Array, "6"], substeps: int
) -> tuple[Float[Array, "6 6 N"], Float[Array, "6"]]:
    """L⁻¹ where P = L Lᵀ, and the factor on b² of a fixed-point iteration to maximum likelihood.

    With S_i = ∂P/∂b_i² the maximum-likelihood b makes Σ rᵀ P⁻¹ S_i P⁻¹ r over the steps equal to
    Σ tr(P⁻¹ S_i); the factor is the ratio of the two.
    """
    r, S = _spread(model, steps, substeps)
    L = jnp.linalg.cholesky(jnp.moveaxis(jnp.tensordot(b * b, S, 1), 2, 0))
    eye = jnp.broadcast_to(jnp.eye(6, dtype=r.dtype), L.shape)
    inverse = jax.lax.linalg.triangular_solve(L, eye, left_side=True, lower=True)
    weight = jnp.einsum("nki,nkj->nij", inverse, inverse)
    y = jnp.einsum("nij,jn->in", weight, r)
    found = jnp.einsum("in,jn,kijn->k", y, y, S)
    expected = jnp.einsum("nij,kijn->k", weight, S)
    return jnp.moveaxis(inverse, 0, 2), found / expected


def mass_at_rest(model: Dynamics, dtype: DTypeLike) -> Float[np.ndarray, "6 6"]:
    """M at ξ = 0 (kg, kg·m, kg·m²)."""
    return np.asarray(_mass(model, jnp.zeros(6, dtype)), np.float64)


@eqx.filter_jit
def _mass(model: Dynamics, V: Float[Array, "6"]) -> Float[Array, "6 6"]:
    return model.coefficients(V).mass.matrix()


def likely_diffusion(
    model: Dynamics, steps: Steps, substeps: int, b: Float[np.ndarray, "6"] | None = None
) -> Float[np.ndarray, "6"]:
    """Maximum-likelihood diffusion b (N√s, N·m√s) for this drift, starting from `b` if given."""
    if b is None:
        wrench = mass_at_rest(model, steps.V.dtype) @ np.asarray(
            innovations(model, steps, substeps)
        )
        b = np.sqrt(np.mean(wrench**2, axis=1) / steps.dt)
    found = np.asarray(b, np.float64)
    for _ in range(4):
        factor = whitening(model, steps, jnp.asarray(found, steps.V.dtype), substeps)[1]
        found = found * np.sqrt(np.clip(np.asarray(factor, np.float64), 1 / 16, 16.0))
    return found


def _motion(
    model: Dynamics, steps: Steps, substeps: int
) -> tuple[Float[Array, "6 N"], list[tuple[Array, Array]]]:
    """The twists at the steps' ends without noise, and the states at the start of each substep."""
    X, V, path = steps.X, steps.V, []
    h = jnp.asarray(steps.dt / substeps, V.dtype)
    F = over_substeps(steps.F, steps.rise, substeps)
    for s in range(substeps):
        path.append((X, V))
        X, V = model.displace(X, V * h), V + h * model.acceleration(X, V, F[..., s])
    return V, path


def _spread(
    model: Dynamics, steps: Steps, substeps: int
) -> tuple[Float[Array, "6 N"], Float[Array, "6 6 6 N"]]:
    """Innovations, and their covariances S_i for noise of b_i = 1 on one axis alone."""
    V_end, path = _motion(model, steps, substeps)
    h = jnp.asarray(steps.dt / substeps, V_end.dtype)
    eye = jnp.broadcast_to(jnp.eye(6, dtype=V_end.dtype)[:, :, None], (6, 6, len(steps)))
    columns: list[Array] = []  # response to unit noise in each of the substeps so far
    F = over_substeps(steps.F, steps.rise, substeps)
    for s, (X, V) in enumerate(path):
        mass = model.coefficients(V).mass
        _, push = jax.linearize(lambda v, X=X, s=s: model.acceleration(X, v, F[..., s]), V)
        A = eye + h * jax.vmap(push, in_axes=1, out_axes=1)(eye)
        columns = [jnp.einsum("ijn,jkn->ikn", A, G) for G in columns]
        columns.append(jnp.stack([mass.solve(eye[:, i]) for i in range(6)], axis=1))
    G = jnp.stack(columns)
    return steps.V_next - V_end, h * jnp.einsum("sikn,sjkn->kijn", G, G)
