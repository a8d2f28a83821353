"""Inner products of whitened innovations and responses, by cluster."""

import numpy as np
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
