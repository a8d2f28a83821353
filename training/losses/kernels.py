"""Kernels on pairs of states at two times, for the kernel scores of finite dimensional matching.

Each kernel is k(z, z') = exp(-½ (d₁² + d₂²)), d_k² the squared distance of the two states at time
t_k in axes scaled by the bandwidths γ_k (Palmer et al., velocity, chordal and geodesic kernel).
With several `scales` s it is the mean of exp(-½ (d₁² + d₂²) / s²), which is characteristic if each
one is, and has a useful gradient while the laws are still far apart.

With the profile `energy` it is -√(d₁² + d₂²) instead, whose kernel score is the energy score
(Székely and Rizzo 2013; Gneiting and Raftery 2007, eq. 22): it needs no scale except the axes'
relative ones, and is proper for twists and chordal poses. The geodesic distance of rotations is not
of negative type, so with it the score is proper only for laws within about a radian.
"""

import abc
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from .geodesic import relative_log

Profile = Literal["gaussian", "energy"]

_NEAR = 1e-12  # added to d², so that the energy profile has a gradient where samples coincide


def _subtract(a: Array, b: Array) -> list[Array]:
    return [y - x for x, y in zip(jnp.unstack(a), jnp.unstack(b), strict=True)]


class Kernel(eqx.Module):
    """A product kernel over two times; `bandwidths` (components, N) has one column per time."""

    bandwidths: Float[Array, "C N"]
    scales: tuple[float, ...] = eqx.field(static=True, default=(1.0,))
    profile: Profile = eqx.field(static=True, default="gaussian")
    floors: ClassVar[tuple[float, ...]]
    """Least bandwidth of each axis: below sensor resolution (m, rad, m/s, rad/s, or 1)."""

    @staticmethod
    @abc.abstractmethod
    def difference(a: Float[Array, "S *a"], b: Float[Array, "S *b"]) -> list[Array]:
        """The components of the displacement from a to b that the bandwidths scale."""

    def squared(
        self, a: Float[Array, "S *a"], b: Float[Array, "S *b"], bandwidth: Float[Array, "C *g"]
    ) -> Float[Array, "*c"]:
        """d²: the squared distance at one time in units of the bandwidth; all of equal rank."""
        inverse = jnp.unstack(1 / bandwidth)
        total = jnp.zeros((), a.dtype)
        for e, scale in zip(self.difference(a, b), inverse, strict=True):
            e = e * scale
            total = e * e if total.ndim == 0 else total + e * e
        return total

    def value(self, d2: Float[Array, "*c"]) -> Float[Array, "*c"]:
        """The kernel as a function of d₁² + d₂²."""
        if self.profile == "energy":
            return -jnp.sqrt(d2 + _NEAR)
        total = jnp.zeros_like(d2)
        for s in self.scales:
            total = total + jnp.exp(d2 * (-0.5 / (s * s)))
        return total / len(self.scales)


class VelocityKernel(Kernel):
    """ARD Gaussian kernel on body twists, characteristic on R⁶ × R⁶."""

    floors: ClassVar[tuple[float, ...]] = (2e-3,) * 6

    @staticmethod
    def difference(a: Float[Array, "6 *a"], b: Float[Array, "6 *b"]) -> list[Array]:
        return _subtract(a, b)


class ChordalKernel(Kernel):
    """ARD Gaussian kernel on poses embedded in R¹² (rotation matrix by rows, position)."""

    floors: ClassVar[tuple[float, ...]] = (2e-3,) * 12

    @staticmethod
    def difference(a: Float[Array, "7 *a"], b: Float[Array, "7 *b"]) -> list[Array]:
        return _subtract(se3.chordal(a), se3.chordal(b))


class GeodesicKernel(Kernel):
    """Gaussian of log(g⁻¹ g') with one bandwidth per axis; locally characteristic if narrow."""

    floors: ClassVar[tuple[float, ...]] = (2e-3,) * 6

    @staticmethod
    def difference(a: Float[Array, "7 *a"], b: Float[Array, "7 *b"]) -> list[Array]:
        return relative_log(a, b)


KERNELS: dict[str, type[Kernel]] = {
    "velocity": VelocityKernel,
    "chordal": ChordalKernel,
    "geodesic": GeodesicKernel,
}
"""Kernels by name; the last two are for poses."""


def bandwidths_from_differences(
    kernel: type[Kernel],
    differences: Float[np.ndarray, "N C M"],
    lag: int,
    *,
    quantile: float = 0.5,
    factor: float = 1.0,
) -> Float[np.ndarray, "C N"]:
    """Bandwidths from M typical displacements at each of N times, by the median heuristic.

    1. Axis and time: s_i(t) = the `quantile` of |displacement_i(t)| over all M, divided by 0.6745
       (so that the median of a Gaussian gives its standard deviation), at least the axis' floor.
    2. Both times together: γ_i(t) = factor · c s_i(t), where c² is the median over M and over
       neighbouring times of Σ_k Σ_i (displacement_i(t_k) / s_i(t_k))², t_1 = t, t_2 = t + lag: a
       typical pair then has d₁² + d₂² = 1 for any number of axes (Garreau et al. 2017, for
       the median rule). c is the same for all times.
    """
    e = np.abs(np.asarray(differences, np.float64))
    floor = np.asarray(kernel.floors)[None, :]
    s = np.maximum(np.quantile(e, quantile, axis=2) / 0.6745, floor)
    whitened = np.sum((e / s[..., None]) ** 2, axis=1)
    lag = min(lag, whitened.shape[0] - 1)
    both = whitened[: whitened.shape[0] - lag] + whitened[lag:]
    c = float(np.sqrt(max(np.median(both), 1e-12)))
    return factor * max(c, 1.0) * s.T
