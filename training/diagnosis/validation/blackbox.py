"""Black-box model to compare with: ridge regression of a model's errors on random features.

The error of the twist after one step, divided by the step, is regressed on
φ(s) = [1, s, cos(Ω s + c)] with s the standardised state, command and command before, and Gaussian
Ω of two length scales: an approximate Gaussian process (Rahimi and Recht 2007, algorithm 1). The
ridge is chosen by cross-validation among the folds of the fit.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ..data.arrays import Data
from ..filter.innovations import Predictions

_WIDTHS = (3.0, 8.0)
_RIDGES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)


class BlackBox(eqx.Module):
    """Acceleration error of a model: weights on D features by piece, or one set for all."""

    centre: Float[Array, " s"]
    scale: Float[Array, " s"]
    frequencies: Float[Array, "d s"]
    phases: Float[Array, " d"]
    weights: Float[Array, "D 6 #R"]

    def features(
        self, X: Float[Array, "7 *b"], V: Float[Array, "6 *b"], u: Array, before: Array
    ) -> Float[Array, "D *b"]:
        """φ of poses, twists, commands and the commands a step before."""
        s = inputs(X, V, u, before)
        shape = (-1,) + (1,) * (s.ndim - 1)
        s = (s - self.centre.reshape(shape)) / self.scale.reshape(shape)
        waves = jnp.cos(jnp.tensordot(self.frequencies, s, 1) + self.phases.reshape(shape))
        return jnp.concatenate([jnp.ones_like(s[:1]), s, waves])

    def acceleration(
        self, X: Float[Array, "7 S R"], V: Float[Array, "6 S R"], u: Array, before: Array
    ) -> Float[Array, "6 S R"]:
        """Correction to dV/dt (m/s², rad/s²)."""
        phi = self.features(X, V, u, before)
        weights = jnp.broadcast_to(self.weights, (*self.weights.shape[:2], phi.shape[-1]))
        return jnp.einsum("dsr,dir->isr", phi, weights)


def inputs(
    X: Float[Array, "7 *b"], V: Float[Array, "6 *b"], u: Float[Array, "n *#b"], before: Array
) -> Float[Array, "s *b"]:
    """Position, sine and cosine of heading, up in B, twist, commands."""
    e = jnp.zeros_like(X[4:])
    north, up = e.at[0].set(1), e.at[2].set(1)
    ahead = se3.rotate(X, north)[:2]
    parts = [X[4:], ahead, se3.rotate_inverse(X, up), V, u, before]
    batch = jnp.broadcast_shapes(*(p.shape[1:] for p in parts))
    return jnp.concatenate([jnp.broadcast_to(p, (p.shape[0], *batch)) for p in parts])


def arguments(data: Data) -> tuple[Array, Array, Array, Array]:
    """Poses, twists, commands and the commands a step before, at every step: (·, N, R)."""
    u = data.u.swapaxes(0, 1)
    before = np.concatenate([data.past[-1][:, None], u[:, :-1]], axis=1)
    X, V = data.X[:-1].swapaxes(0, 1), data.V[:-1].swapaxes(0, 1)
    return jnp.asarray(X), jnp.asarray(V), jnp.asarray(u), jnp.asarray(before)


def train(
    predictions: Predictions,
    data: Data,
    rng: np.random.Generator,
    count: int = 240,
    whole: bool = False,
) -> BlackBox:
    """Fit to the errors of one-step predictions, for every piece without its fold.

    With a single fold, or `whole`, it is fitted to all.
    """
    arrays = arguments(data)
    s = np.asarray(inputs(*arrays))  # (s, N, R)
    exists = data.clean > 0
    centre, scale = s[:, exists].mean(axis=1), s[:, exists].std(axis=1) + 1e-6
    widths = np.repeat(_WIDTHS, count // len(_WIDTHS))
    box = BlackBox(
        jnp.asarray(centre),
        jnp.asarray(scale),
        jnp.asarray(rng.standard_normal((len(widths), len(s))) / widths[:, None]),
        jnp.asarray(rng.uniform(0, 2 * np.pi, len(widths))),
        jnp.zeros((1 + len(s) + len(widths), 6, 1)),
    )
    phi = np.asarray(box.features(*arrays)) * data.clean  # (D, N, R)
    target = np.asarray(predictions.error)[:, 6:].swapaxes(0, 1) / data.step * data.clean
    labels = np.unique(data.fold)
    H, g, square = [], [], []
    for label in labels:
        own = data.fold == label
        P, y = phi[:, :, own].reshape(len(phi), -1), target[:, :, own].reshape(6, -1)
        H.append(P @ P.T)
        g.append(P @ y.T)
        square.append((y**2).sum(axis=1))
    if whole:
        weights = _ridge(H, g, list(range(len(labels))))[..., None]
        return eqx.tree_at(lambda b: b.weights, box, jnp.asarray(weights))
    weights = np.zeros((len(phi), 6, len(data.fold)))
    for k, label in enumerate(labels):
        rest = [i for i in range(len(labels)) if i != k] or [k]
        weights[:, :, data.fold == label] = _ridge(H, g, rest)[..., None]
    return eqx.tree_at(lambda b: b.weights, box, jnp.asarray(weights))


def _ridge(H: list[np.ndarray], g: list[np.ndarray], kept: list[int]) -> np.ndarray:
    """Weights (D, 6) from the folds kept, the ridge of each axis by two-fold cross-validation."""
    size = np.diag(sum(H[i] for i in kept)).mean()
    eye = np.eye(len(H[0]))
    halves = [kept[0::2], kept[1::2]] if len(kept) > 1 else [kept, kept]
    losses = np.zeros((len(_RIDGES), 6))
    for fitted, judged in (halves, halves[::-1]):
        A, b = sum(H[i] for i in fitted), sum(g[i] for i in fitted)
        A2, b2 = sum(H[i] for i in judged), sum(g[i] for i in judged)
        for k, ridge in enumerate(_RIDGES):
            w = np.linalg.solve(A + ridge * 1e-2 * size * eye, b)
            losses[k] += np.einsum("di,de,ei->i", w, A2, w) - 2 * np.einsum("di,di->i", w, b2)
    A, b = sum(H[i] for i in kept), sum(g[i] for i in kept)
    best = np.argmin(losses, axis=0)
    found = np.zeros_like(b)
    for k in np.unique(best):
        w = np.linalg.solve(A + _RIDGES[k] * 1e-2 * size * eye, b)
        # where no ridge predicts the other half better than zero, weights stay zero
        use = (best == k) & (losses[k] < 0)
        found[:, use] = w[:, use]
    return found
