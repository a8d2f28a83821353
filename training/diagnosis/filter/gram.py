"""Inner products of whitened innovations and sensitivities, by cluster."""

import numpy as np
import scipy.optimize
from jaxtyping import Float, Int


def gram(z: Float[np.ndarray, "m K R"]) -> Float[np.ndarray, "R m m"]:
    """Σ over samples and axes of z_i z_j for each piece."""
    m, _, R = z.shape
    found = np.empty((R, m, m))
    for first in range(0, R, 16):
        Z = np.ascontiguousarray(np.moveaxis(z[:, :, first : first + 16], 2, 0))
        found[first : first + 16] = Z @ Z.transpose(0, 2, 1)
    return found


def pooled(
    G: Float[np.ndarray, "R m m"], group: Int[np.ndarray, " R"]
) -> Float[np.ndarray, "g m m"]:
    """Sums over pieces of the same group, groups in ascending order."""
    labels, index = np.unique(group, return_inverse=True)
    total = np.zeros((len(labels), *G.shape[1:]))
    np.add.at(total, index, G)
    return total


def least_within(
    values: Float[np.ndarray, " k"],
    vectors: Float[np.ndarray, "k k"],
    gradient: Float[np.ndarray, " k"],
    low: Float[np.ndarray, " k"],
    high: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """The minimiser of ½ xᵀH x + gᵀx in a box, with H by its eigenvalues (positive) and vectors.

    Where a bound is active, the other components are optimal given it.
    """
    turned = vectors.T @ gradient
    free = -vectors @ (turned / values)
    if np.all((low <= free) & (free <= high)):
        return free
    roots = np.sqrt(values)
    # a box must have some width
    bounds = (low - 1e-12, high + 1e-12)
    found = scipy.optimize.lsq_linear(roots[:, None] * vectors.T, -turned / roots, bounds).x
    return np.clip(found, low, high)
