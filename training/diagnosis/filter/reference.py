"""The trajectory about which errors are linear, where velocities were not measured."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ....models import se3
from ....models.effects.extended import Extended
from ....models.effects.library import Library
from ....models.recordings.kinematics import dead_reckoned
from ....models.se3 import XYZ
from ..data.arrays import Data
from .innovations import predict

_SETTLED, _MOST = 0.02, 8
"""Change of a start (m/s) below which it is settled; most simulations for that."""
_LEVEL = 0.3
"""Least cosine of the tilt at which the climb determines w."""


def with_latent(
    data: Data, model: Extended, library: Library, theta: Float[np.ndarray, " p"]
) -> Data:
    """The data with latent velocities simulated under θ, from run to run of pieces.

    A piece starts where the one before it ends; the first piece of a run starts at rest. A climb
    that was measured in W gives w, and velocities give coordinates that were not measured.
    """
    latent = data.latent
    if not latent:
        return data
    follows = np.flatnonzero(data.run[1:] == data.run[:-1]) + 1
    last = data.weight.sum(axis=0).astype(int)
    for _ in range(_MOST):
        p = predict(model, library, theta, data)
        V = data.V.copy()
        V[:-1, latent] = np.asarray(p.start[1])[:, latent]
        for r, n in enumerate(last):
            V[n:, latent, r] = np.asarray(p.V)[max(n - 1, 0), latent, r]
        if not np.isfinite(V).all():
            break
        start = V[0, latent].copy()
        start[:, follows] = V[last[follows - 1], :, follows - 1][:, latent].T
        change = np.abs(start - V[0, latent]).max(initial=0.0)
        V[0, latent] = start
        data = _completed(replace(data, V=V))
        if change < _SETTLED:
            break
    return data


def _completed(data: Data) -> Data:
    """The data with w from the climb, and positions dead-reckoned."""
    X, V = data.X.copy(), data.V.copy()
    if data.climb is not None:
        poses = jnp.moveaxis(jnp.asarray(X), 1, 0)
        up = np.asarray(se3.rotate_inverse(poses, jnp.zeros_like(poses[4:]).at[2].set(1.0)))
        steep = np.where(np.abs(up[2]) > _LEVEL, up[2], np.inf)
        w = (data.climb - up[0] * V[:, 0] - up[1] * V[:, 1]) / steep
        V[:, 2] = np.where(np.isfinite(steep), w, V[:, 2])
    lost = [XYZ.index(c) for c in data.unmeasured if c in XYZ]
    rows = [4 + i for i in lost]
    times = data.times
    for r in range(X.shape[2]):
        n = int(data.weight[:, r].sum())
        poses = X[: n + 1, :, r].copy()
        poses[:, rows] = np.nan
        found = dead_reckoned(times[: n + 1, r], poses, V[: n + 1, :, r])
        if r and data.run[r] == data.run[r - 1]:
            before = int(data.weight[:, r - 1].sum())
            found[:, rows] += X[before, rows, r - 1]
        X[: n + 1, :, r] = found
        X[n + 1 :, :, r] = found[-1]
    return replace(data, X=X, V=V)
