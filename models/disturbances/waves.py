"""Wind waves: a JONSWAP sea of many linear components."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from ..config.checks import require
from ..dynamics import Flow
from ..randomness import Scalar, column
from .base import Disturbance
from .linear_waves import orbital_factors, wave_number

_LOWEST, _HIGHEST = 0.4, 6.0  # band of the components over the peak frequency


def jonswap(
    omega: np.ndarray, significant_height: float, peak_period: float, peak_enhancement: float
) -> np.ndarray:
    """Spectral density S(ω) of the elevation (m²·s) (Hasselmann et al. 1973; DNV-RP-C205, 3.5.5).

    S = (1 − 0.287 ln γ) (5/16) Hs² ωp⁴ ω⁻⁵ exp(−(5/4)(ωp/ω)⁴) γ^r,
    r = exp(−(ω − ωp)² / (2 σ² ωp²)), σ = 0.07 up to ωp and 0.09 above.
    """
    peak = 2 * math.pi / peak_period
    width = np.where(omega <= peak, 0.07, 0.09) * peak
    r = np.exp(-0.5 * ((omega - peak) / width) ** 2)
    norm = (1 - 0.287 * math.log(peak_enhancement)) * (5 / 16) * significant_height**2 * peak**4
    return norm * omega**-5.0 * np.exp(-1.25 * (peak / omega) ** 4) * peak_enhancement**r


class _Components(NamedTuple):
    omega: np.ndarray  # (rad/s)
    wave_number: np.ndarray  # (rad/m)
    amplitude: np.ndarray  # of the elevation (m)
    directions: np.ndarray  # quantiles of the directional law (rad), relative to the mean


@lru_cache(maxsize=64)
def _components(sea: "JonswapWaves") -> _Components:
    peak = 2 * math.pi / sea.peak_period
    edges = np.geomspace(_LOWEST * peak, _HIGHEST * peak, sea.components + 1)
    fine = edges[:-1, None] * (edges[1:] / edges[:-1])[:, None] ** ((np.arange(32) + 0.5) / 32)
    energy = jonswap(fine, sea.significant_height, sea.peak_period, sea.peak_enhancement) * fine
    total = energy.sum(axis=1)
    omega = (energy * fine).sum(axis=1) / total
    variance = total / total.sum() * sea.significant_height**2 / 16
    k = wave_number(omega, sea.water_depth, sea.gravity, xp=np)
    theta = np.linspace(-math.pi, math.pi, 721)
    cumulative = np.cumsum(np.cos(theta / 2) ** (2 * sea.spreading))
    quantiles = np.interp((np.arange(257) + 0.5) / 257, cumulative / cumulative[-1], theta)
    return _Components(omega, k, np.sqrt(2 * variance), quantiles)


@dataclass(frozen=True)
class JonswapWaves(Disturbance):
    """Orbital motion under a random sea, η = Σ a_i cos(k_i·x − ω_i t + φ_i), of linear theory.

    Each component has the energy of its bin and the frequency of the bin's energy centroid. Bins
    widen geometrically, so no two frequency differences are equal and the sea does not repeat.
    Velocity and acceleration are those at a fixed point of the water, consistent to the first
    order of the theory. The state holds the random phases, then with spreading the directions
    relative to the mean.

    Attributes:
        significant_height: Hs = 4 √m₀ (m).
        peak_period: Tp (s); the spectrum is valid for 3.6 < Tp/√Hs < 5 (DNV-RP-C205).
        peak_enhancement: γ; 1 is a Pierson–Moskowitz sea.
        direction: mean direction the waves travel to (rad), counter-clockwise from W's x axis.
        spreading: s of the directional law cos²ˢ(θ/2) (Longuet-Higgins et al. 1963); 0 for
            long-crested waves.
        water_depth: h (m); the bed lies at z = −h.
        components: number of components.
        gravity: (m/s²).
    """

    significant_height: float = 0.25
    peak_period: float = 2.5
    peak_enhancement: float = 3.3
    direction: float = 0.0
    spreading: float = 0.0
    water_depth: float = 10.0
    components: int = 48
    gravity: float = 9.80665

    def __post_init__(self) -> None:
        """Check signs and the number of components."""
        super().__post_init__()
        for field in ("peak_period", "water_depth", "gravity"):
            require(getattr(self, field) > 0, self, field, "give a number above zero")
        for field in ("significant_height", "spreading"):
            require(getattr(self, field) >= 0, self, field, "give zero or more")
        require(1 <= self.peak_enhancement <= 10, self, "peak_enhancement", "give 1 to 10")
        require(40 <= self.components <= 1000, self, "components", "give 40 to 1000")

    @property
    def state_size(self) -> int:
        """A phase, and with spreading a direction, for each component."""
        return self.components * (2 if self.spreading > 0 else 1)

    @property
    def initial_noise_size(self) -> int:
        """One for each state."""
        return self.state_size

    def initial(self, w: Float[Array, "w *batch"]) -> Float[Array, "s *batch"]:
        """Draw uniform phases, and directions from the directional law."""
        n = self.components
        phases = 2 * math.pi * ndtr(w[:n])
        if self.spreading == 0:
            return phases
        table = jnp.asarray(_components(self).directions, w.dtype)
        places = jnp.linspace(0.5 / table.size, 1 - 0.5 / table.size, table.size, dtype=w.dtype)
        return jnp.concatenate([phases, jnp.interp(ndtr(w[n:]), places, table)])

    def _argument(
        self, state: Array, p_W: Array, t: Scalar
    ) -> tuple[Array, Float[Array, "n *batch"], Float[Array, "n *batch"]]:
        """Phase k·x − ωt + φ of every component, and the cosine and sine of its direction."""
        sea, n = _components(self), self.components
        spread = state[n:] if self.spreading > 0 else jnp.zeros_like(state[:1])
        heading = self.direction + spread
        c, s = jnp.cos(heading), jnp.sin(heading)
        along = c * p_W[:1] + s * p_W[1:2]
        time = jnp.asarray(t, state.dtype)
        k, omega = column(sea.wave_number, state), column(sea.omega, state)
        return k * along - omega * time + state[:n], c, s

    def elevation(
        self, state: Float[Array, "s *batch"], p_W: Float[Array, "3 *batch"], t: Scalar
    ) -> Float[Array, "*batch"]:
        """Elevation of the surface above its mean (m) at the horizontal position of p_W."""
        amplitude = column(_components(self).amplitude, state)
        return jnp.sum(amplitude * jnp.cos(self._argument(state, p_W, t)[0]), axis=0)

    def flow(
        self, state: Float[Array, "s *batch"], X_WB: Float[Array, "7 *batch"], t: Scalar
    ) -> Flow:
        """Sum the orbital velocities and accelerations of all components at Bo."""
        sea = _components(self)
        p_W = X_WB[4:]
        argument, c, s = self._argument(state, p_W, t)
        k, omega = column(sea.wave_number, state), column(sea.omega, state)
        horizontal, vertical = orbital_factors(k, p_W[2:], self.water_depth)
        speed = column(sea.amplitude * sea.omega, state)
        cosine, sine = jnp.cos(argument), jnp.sin(argument)
        u, u_dot = speed * horizontal * cosine, speed * omega * horizontal * sine
        w, w_dot = speed * vertical * sine, -speed * omega * vertical * cosine
        v_WC_W = [jnp.sum(part, axis=0) for part in (u * c, u * s, w)]
        a_WC_W = [jnp.sum(part, axis=0) for part in (u_dot * c, u_dot * s, w_dot)]
        return Flow(jnp.stack(v_WC_W), jnp.stack(a_WC_W))
