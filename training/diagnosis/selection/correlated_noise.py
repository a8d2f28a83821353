"""Correlated noise: generalised least squares where innovations are not white.

Slow disturbances, a current that differs from run to run, and swell make innovations correlated.
Causes that only change the mean then seem to explain them, for the state depends on past
disturbances too. Innovations and sensitivities are therefore whitened first: a slow disturbance is
predicted from past innovations (an ARMA(1, 1), as in `laws.colour`), and amplitudes drawn anew for
each piece are integrated out (Woodbury 1950), with the variance of their law.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ..filter.gram import gram


@dataclass(frozen=True)
class CorrelatedNoise:
    """Correlated noise with known parameters.

    Attributes:
        slow: of axes with slow disturbances, by index: ρ, κ, and the regression coefficients of
            the twelve innovations on the predicted disturbance.
        scale: standard deviations of the innovations without the slow disturbances.
        drawn: whitened sensitivities to the amplitudes drawn for each piece (k, N·12, R).
        precision: of each of these amplitudes (k,).
    """

    slow: dict[int, tuple[float, float, Float[np.ndarray, "12"]]] = field(default_factory=dict)
    scale: Float[np.ndarray, "12"] = field(default_factory=lambda: np.ones(12))
    amplitudes: Float[np.ndarray, "k N12 R"] | None = None
    precision: Float[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0))

    def products(self, z: Float[np.ndarray, "m N12 R"]) -> Float[np.ndarray, "R m m"]:
        """Inner products of innovations and sensitivities by piece, after whitening."""
        if self.amplitudes is not None:
            z = np.concatenate([z, self.amplitudes])
        G = gram(self._without_slow(z))
        if self.amplitudes is None:
            return G
        m = len(z) - len(self.amplitudes)
        own, cross = G[:, :m, :m], G[:, m:, :m]
        inner = G[:, m:, m:] + np.diag(self.precision)
        return own - cross.swapaxes(1, 2) @ np.linalg.solve(inner, cross)

    @classmethod
    def from_slow(
        cls, z: Float[np.ndarray, "N 12 R"], numbers: dict[int, tuple[float, float]]
    ) -> "CorrelatedNoise":
        """Slow disturbances with ρ and κ by axis; the rest is estimated from innovations `z`."""
        slow, left = {}, z.copy()
        for axis, (rho, kappa) in numbers.items():
            m = _slow_prediction(z[None, :, 6 + axis], rho, kappa)[0]
            share = np.einsum("njr,nr->j", z, m) / max(float((m**2).sum()), 1e-300)
            share[6 + axis] = 1.0
            slow[axis] = rho, kappa, share
            left -= share[:, None] * m[:, None]
        before, after = (np.sqrt((e**2).sum(axis=(0, 2))) for e in (z, left))
        count = np.sqrt(np.maximum((z != 0).sum(axis=(0, 2)), 1))
        scale = np.where(before > 0, np.maximum(after / count, 1.0), 1.0)
        return cls(slow, scale)

    def _without_slow(self, z: np.ndarray) -> np.ndarray:
        if not self.slow:
            return z
        before = z.reshape(len(z), -1, 12, z.shape[2])
        found = before / self.scale[:, None].astype(z.dtype)
        for axis, (rho, kappa, share) in self.slow.items():
            m = _slow_prediction(before[:, :, 6 + axis], rho, kappa)
            for j in np.flatnonzero(share):
                found[:, :, j] -= float(share[j] / self.scale[j]) * m
        return found.reshape(z.shape)


def _slow_prediction(
    z: Float[np.ndarray, "m N R"], rho: float, kappa: float
) -> Float[np.ndarray, "m N R"]:
    """Prediction of the slow disturbance before each step."""
    m = np.zeros_like(z)
    for n in range(z.shape[1] - 1):
        m[:, n + 1] = rho * (m[:, n] + kappa * (z[:, n] - m[:, n]))
    return m
