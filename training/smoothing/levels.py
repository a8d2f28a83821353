"""What is believed before the data, and levels of all noise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .states import BIAS, FADING, LEVER, SCALES, SIZE


@dataclass(frozen=True)
class Belief:
    """What is believed before the data: standard deviations.

    Attributes:
        scales: of the logarithms of M, D, D^f, of the restoring force (in % of the displacement)
            and of the righting lever (relative).
        cov: their covariance instead, if given.
        bias: of the accelerometer (m/s²), with the tilt of an autopilot's attitude: 1° is 0.17.
        walk: of the bias (m/s²/√s).
        lever: place of the accelerometer from Bo (m).
    """

    scales: Float[np.ndarray, "22"]
    cov: Float[np.ndarray, "22 22"] | None = None
    bias: float = 0.15
    walk: float = 5e-3
    lever: float = 0.1

    @classmethod
    def of_preset(cls) -> "Belief":
        """Coefficients known to a factor of about e^0.7 = 2, masses to e^0.4 = 1.5."""
        return cls(np.array([0.4] * 6 + [0.7] * 12 + [1.0] + [0.1, 0.1, 0.7]))

    @classmethod
    def exact(cls) -> "Belief":
        """A model that is judged as it is: its coefficients are not adapted to the data."""
        return cls(np.full(22, 1e-3))

    def covariance(self) -> Float[np.ndarray, "46 46"]:
        """Of the start's components that are not pose and twist; push from its own law."""
        P = np.zeros((SIZE, SIZE))
        P[BIAS, BIAS] = np.eye(3) * self.bias**2
        P[LEVER, LEVER] = np.eye(3) * self.lever**2
        P[SCALES, SCALES] = np.diag(self.scales**2) if self.cov is None else self.cov
        return P


@dataclass(frozen=True)
class Levels:
    """Levels of all noise.

    Attributes:
        white: b (N√s, N·m√s).
        push: stationary standard deviation of the push (N, N·m).
        measured: standard deviations of `MEASURED`.
    """

    white: Float[np.ndarray, "6"]
    push: Float[np.ndarray, "6"]
    measured: Float[np.ndarray, "16"]

    @property
    def diffusion(self) -> Float[np.ndarray, "6"]:
        """Of white noise, b, with the effect of both over times longer than the push's."""
        return np.sqrt(self.white**2 + 2 * FADING * self.push**2)
