"""What a step makes of errors: the mean of the Jacobians along the records, and their spread.

Where instruments are noisy against the process, the noise enters the next error through Jacobians
that change from sample to sample (Munk's moment turns an error of the velocity into pitch, with the
speed's sign): E[A P Aᵀ] is more than its mean makes of P.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_SAMPLES = 4000
"""Of so many samples the spread is taken, evenly."""


class Transition(NamedTuple):
    """Mean of A, and E[(A - Ā)_ij (A - Ā)_kl]."""

    mean: Float[np.ndarray, "12 12"]
    spread: Float[np.ndarray, "12 12 12 12"]

    @classmethod
    def along(
        cls, jacobian: Float[np.ndarray, "N 12 12 R"], weight: Float[np.ndarray, "N R"]
    ) -> "Transition":
        """That of all steps that exist.

        Raises:
            FloatingPointError: a Jacobian is not finite.
        """
        mean = np.einsum("nijr,nr->ij", jacobian, weight) / weight.sum()
        if not np.isfinite(mean).all():
            raise FloatingPointError("slopes of predictions overflow")
        n, r = np.nonzero(weight)
        some = slice(None, None, max(1, -(-len(n) // _SAMPLES)))
        off = (jacobian[n[some], :, :, r[some]] - mean).reshape(-1, 144)
        share = weight[n[some], r[some]] / weight[n[some], r[some]].sum()
        return cls(mean, np.einsum("sa,s,sb->ab", off, share, off, optimize=True).reshape([12] * 4))

    @classmethod
    def constant(cls, A: Float[np.ndarray, "12 12"]) -> "Transition":
        """The same A at all steps."""
        return cls(A, np.zeros([12] * 4))

    def added(self, P: Float[np.ndarray, "*b 12 12"]) -> Float[np.ndarray, "*b 12 12"]:
        """What the spread adds to Ā P Āᵀ."""
        return np.einsum("ijkl,...jl->...ik", self.spread, P, optimize=True)

    def of(self, P: Float[np.ndarray, "*b 12 12"]) -> Float[np.ndarray, "*b 12 12"]:
        """E[A P Aᵀ]."""
        return self.mean @ P @ self.mean.T + self.added(P)
