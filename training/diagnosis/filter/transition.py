"""Transition of errors over a step: mean and spread of the Jacobians along the records.

Where measurement noise is large against the process, it enters the next error through Jacobians
that change from sample to sample (Munk's moment turns an error of the velocity into pitch, with the
speed's sign): E[A P Aᵀ] is larger than Ā P Āᵀ.

A disturbance reaches a delayed pose later than the twist: its effect on records X - δ V and V is
T = [[1, -δ], [0, 1]] times its effect on X and V. (Disturbances within δ before a sample, of the
order of δ^3/2, enter the next step; they are small against the pose's own noise.)
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_SAMPLES = 4000
"""Number of evenly spaced samples that the spread is computed from."""


@dataclass(frozen=True)
class Latent:
    """What a filter knows of velocities that were not measured.

    A velocity's place in the errors has the accelerometer's instead, where there is one: over a
    step it measures the change of the velocity, so its innovation is that of the state after the
    step less `carried` times the state before. The accelerometer's bias has the place of the
    position on the axis.

    Attributes:
        levels: assumed diffusion b of the axes, by index.
        felt: axes with an accelerometer.
        carried: how the state before a step enters the innovations, (N, 12, 12, R) or its mean.
    """

    levels: Mapping[int, float]
    felt: tuple[int, ...] = ()
    carried: Float[np.ndarray, "..."] | None = None

    @property
    def silent(self) -> list[int]:
        """Axes without any instrument."""
        return [i for i in self.levels if i not in self.felt]

    @property
    def instead(self) -> Float[np.ndarray, "12"]:
        """1 for errors of an accelerometer, 0 for others."""
        found = np.zeros(12)
        found[[6 + i for i in self.felt]] = 1.0
        return found

    def mean(self, weight: Float[np.ndarray, "N R"]) -> "Latent":
        """The same with the mean over all steps that exist."""
        if self.carried is None:
            return self
        mean = np.einsum("nijr,nr->ij", self.carried, weight) / weight.sum()
        return Latent(self.levels, self.felt, mean)

    def of(self, pieces: np.ndarray) -> "Latent":
        """That of some pieces."""
        some = None if self.carried is None else self.carried[..., pieces]
        return Latent(self.levels, self.felt, some)


class Transition(NamedTuple):
    """Transition of errors over a step.

    Attributes:
        mean: Ā.
        spread: E[(A - Ā)_ij (A - Ā)_kl].
        late: delay of recorded poses against twists, by axis (s).
        latent: of velocities that were not measured, with the mean of `carried`.
    """

    mean: Float[np.ndarray, "12 12"]
    spread: Float[np.ndarray, "12 12 12 12"]
    late: Float[np.ndarray, "6"] = np.zeros(6)
    latent: Latent | None = None

    @classmethod
    def along(
        cls,
        jacobian: Float[np.ndarray, "N 12 12 R"],
        weight: Float[np.ndarray, "N R"],
        late: Float[np.ndarray, "6"],
        latent: Latent | None = None,
    ) -> "Transition":
        """The transition over all steps that exist.

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
        spread = np.einsum("sa,s,sb->ab", off, share, off, optimize=True).reshape([12] * 4)
        return cls(mean, spread, late, None if latent is None else latent.mean(weight))

    @classmethod
    def constant(cls, A: Float[np.ndarray, "12 12"]) -> "Transition":
        """The same A at all steps, without delays between instruments."""
        return cls(A, np.zeros([12] * 4))

    def added(self, P: Float[np.ndarray, "*b 12 12"]) -> Float[np.ndarray, "*b 12 12"]:
        """The term that the spread adds to Ā P Āᵀ."""
        return np.einsum("ijkl,...jl->...ik", self.spread, P, optimize=True)

    def of(self, P: Float[np.ndarray, "*b 12 12"]) -> Float[np.ndarray, "*b 12 12"]:
        """E[A P Aᵀ]."""
        return self.mean @ P @ self.mean.T + self.added(P)
