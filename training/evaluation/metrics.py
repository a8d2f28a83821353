"""Metrics of the agreement between samples of a predicted law and an observation.

All take predicted samples (T, C, P, W) and observations (T, C, W) of W windows at T times.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..losses.geodesic import relative_log
from ..losses.scores import partners, shifts

GROUPS: dict[str, slice] = {
    "position": slice(0, 3),
    "rotation": slice(3, 6),
    "linear_velocity": slice(6, 9),
    "angular_velocity": slice(9, 12),
    "geodesic": slice(0, 6),
    "velocity": slice(6, 12),
}
"""Components of each norm of the error; `geodesic` is ‖log(g⁻¹ĝ)‖, m and rad alike (paper)."""
BANDS = (0.5, 0.9)


@jax.jit
def displacement(
    X: Float[Array, "T 7 P W"],
    V: Float[Array, "T 6 P W"],
    X_ref: Float[Array, "T 7 Q W"],
    V_ref: Float[Array, "T 6 Q W"],
) -> Float[Array, "12 T P W"]:
    """log(g_ref⁻¹ g) and ξ - ξ_ref, component first."""
    pose = relative_log(jnp.moveaxis(X_ref, 1, 0), jnp.moveaxis(X, 1, 0))
    return jnp.concatenate([jnp.stack(pose), jnp.moveaxis(V - V_ref, 1, 0)])


def norms(e: Float[Array, "12 *batch"]) -> dict[str, Float[Array, "*batch"]]:
    """The norm of each group of components."""
    return {name: jnp.sqrt(jnp.sum(e[part] ** 2, axis=0)) for name, part in GROUPS.items()}


def order_statistics(samples: int, band: float) -> tuple[int, int]:
    """Zero-based ranks lo, hi of the order statistics that cover exactly `band` of the next draw.

    Among P + 1 exchangeable values each rank is equally likely, so [x_(r), x_(P+1-r)] holds the
    last one with probability (P + 1 - 2r) / (P + 1) (David and Nagaraja 2003, section 7.2).

    Raises:
        ValueError: no pair of ranks has exactly this coverage.
    """
    r = (samples + 1) * (1 - band) / 2
    if abs(r - round(r)) > 1e-9 or round(r) < 1:
        raise ValueError(
            f"samples: {samples} can't give a band of exactly {band:g}; take 19, 39, 59, …"
        )
    return round(r) - 1, samples - round(r)


def coverage(
    X: Float[Array, "T 7 P W"],
    V: Float[Array, "T 6 P W"],
    X_seen: Float[Array, "T 7 W"],
    V_seen: Float[Array, "T 6 W"],
    X_ref: Float[Array, "T 7 1 W"],
    V_ref: Float[Array, "T 6 1 W"],
    bands: tuple[float, ...] = BANDS,
) -> Float[np.ndarray, "bands 12 T W"]:
    """Whether each observed component lies in the central band of the samples (1) or not (0).

    Components are displacements from a reference motion, such as the noise-free one. For a true
    law the mean is exactly the band's probability for any P.
    """
    e = np.sort(np.asarray(displacement(X, V, X_ref, V_ref)), axis=2)
    y = np.asarray(displacement(X_seen[:, :, None], V_seen[:, :, None], X_ref, V_ref))[:, :, 0]
    inside = []
    for band in bands:
        lo, hi = order_statistics(e.shape[2], band)
        inside.append((e[:, :, lo] <= y) & (y <= e[:, :, hi]))
    return np.stack(inside).astype(float)


def energy_score(
    X: Float[Array, "T 7 P W"],
    V: Float[Array, "T 6 P W"],
    X_seen: Float[Array, "T 7 W"],
    V_seen: Float[Array, "T 6 W"],
) -> tuple[Float[Array, "T W"], Float[Array, "T W"]]:
    """Unbiased energy scores E‖x - y‖ - ½ E‖x - x'‖ of poses (geodesic norm) and of velocities.

    Smaller is better (Gneiting and Raftery 2007, eq. 22, sign turned).
    """
    weight = np.asarray([w for _, w in shifts(X.shape[2], None)])
    scores = []
    for difference, a, y in (
        (relative_log, jnp.moveaxis(X, 1, 0), jnp.moveaxis(X_seen, 1, 0)),
        (_subtract, jnp.moveaxis(V, 1, 0), jnp.moveaxis(V_seen, 1, 0)),
    ):
        cross = jnp.mean(_norm(difference(a, y[:, :, None])), axis=1)
        own = jnp.mean(_norm(difference(a[:, :, None], partners(a, None))), axis=2)
        own = jnp.tensordot(jnp.asarray(weight, own.dtype), jnp.moveaxis(own, 1, 0), 1)
        scores.append(cross - own / 2)
    return scores[0], scores[1]


def _subtract(a: Array, b: Array) -> list[Array]:
    return list(jnp.unstack(b - a))


def _norm(components: list[Array]) -> Array:
    return jnp.sqrt(jnp.sum(jnp.stack(components) ** 2, axis=0))
