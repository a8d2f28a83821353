"""Vertical cylinders in the water (pylons, piles) and the vehicle's distance to them.

Planning uses a set of spheres that covers the hull, which is cheap and conservative; collision
checks of a run use the box itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.checks import check_numbers, require

_GOLDEN = 0.6180339887498949
_SECTIONS = 60  # golden sections: 0.618⁶⁰ of the axis' length is below rounding in float64


@dataclass(frozen=True)
class Pylon:
    """A vertical cylinder; lengths in m, W z-up with the still surface at 0.

    Attributes:
        x: of the axis in W (m).
        y: of the axis in W (m).
        diameter: (m).
        bottom: z of the lower end (m).
        top: z of the upper end (m).
        name: its name in reports.
    """

    x: float
    y: float
    diameter: float = 0.3
    bottom: float = -10.0
    top: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(self.diameter > 0, self, "diameter", "give a length above zero")
        require(self.top > self.bottom, self, "top", "give a height above `bottom`")


class Cylinders(eqx.Module):
    """Any number of vertical cylinders as arrays."""

    p_WO_xy: Float[Array, "2 n"]
    radius: Float[Array, " n"]
    bottom: Float[Array, " n"]
    top: Float[Array, " n"]

    @classmethod
    def create(cls, pylons: Sequence[Pylon], dtype: jnp.dtype | type = float) -> "Cylinders":
        """Arrays of a list of pylons, which may be empty."""
        rows = np.array([[p.x, p.y, p.diameter / 2, p.bottom, p.top] for p in pylons])
        x, y, radius, bottom, top = jnp.asarray(rows.reshape(-1, 5).T, dtype)
        return cls(jnp.stack([x, y]), radius, bottom, top)

    def point_distance(self, p_W: Float[Array, "3 *batch"]) -> Float[Array, "n *batch"]:
        """Signed distance (m) of points to each cylinder's surface, negative inside; exact."""
        shape = (-1,) + (1,) * (p_W.ndim - 1)
        dx = p_W[0][None] - self.p_WO_xy[0].reshape(shape)
        dy = p_W[1][None] - self.p_WO_xy[1].reshape(shape)
        side = jnp.sqrt(dx * dx + dy * dy) - self.radius.reshape(shape)
        middle = ((self.top + self.bottom) / 2).reshape(shape)
        half = ((self.top - self.bottom) / 2).reshape(shape)
        end = jnp.abs(p_W[2][None] - middle) - half
        outside = jnp.sqrt(jnp.maximum(side, 0) ** 2 + jnp.maximum(end, 0) ** 2)
        return outside + jnp.minimum(jnp.maximum(side, end), 0)


class SphereHull(eqx.Module):
    """A hull covered by equal spheres whose centres are fixed in B."""

    p_BoS_B: Float[Array, "3 s"]
    radius: Float[Array, ""]

    @classmethod
    def cover(
        cls,
        size: tuple[float, float, float],
        count: tuple[int, int] = (2, 2),
        dtype: jnp.dtype | type = float,
    ) -> "SphereHull":
        """Spheres that together contain a horizontal slice of the box of length, width, height.

        The slice through the middle is cut into `count` rectangles and each is circumscribed.
        Against upright cylinders a level box is as wide as its slice; a tilt of φ adds at most
        (height/2) sin φ, which belongs in the planner's margin.

        Raises:
            ValueError: a length or a count is not positive.
        """
        if min(size) <= 0 or min(count) < 1:
            raise ValueError(f"hull size {size} and count {count} must be positive")
        step = np.array(size[:2]) / count
        x = (np.arange(count[0]) - (count[0] - 1) / 2) * step[0]
        y = (np.arange(count[1]) - (count[1] - 1) / 2) * step[1]
        xs, ys = (a.ravel() for a in np.meshgrid(x, y))
        centres = np.stack([xs, ys, np.zeros_like(xs)])
        return cls(jnp.asarray(centres, dtype), jnp.asarray(np.hypot(*step) / 2, dtype))

    def clearance(
        self, X_WB: Float[Array, "7 *batch"], cylinders: Cylinders
    ) -> Float[Array, " *batch"]:
        """Least distance (m) of the spheres to any cylinder; +inf if there is none."""
        if cylinders.radius.shape[0] == 0:
            return jnp.full_like(X_WB[0], jnp.inf)
        spheres = self.p_BoS_B.reshape(self.p_BoS_B.shape + (1,) * (X_WB.ndim - 1))
        least = None
        for i in range(self.p_BoS_B.shape[1]):
            distance = jnp.min(cylinders.point_distance(se3.act(X_WB, spheres[:, i])), axis=0)
            least = distance if least is None else jnp.minimum(least, distance)
        assert least is not None
        return least - self.radius


class BoxHull(eqx.Module):
    """The vehicle as a box about Bo, aligned with B."""

    half_size: Float[Array, "3"]

    @classmethod
    def create(cls, size: tuple[float, float, float], dtype: jnp.dtype | type = float) -> "BoxHull":
        """Box of a length, width and height (m).

        Raises:
            ValueError: a length is not positive.
        """
        if min(size) <= 0:
            raise ValueError(f"hull size {size} must be positive")
        return cls(jnp.asarray(size, dtype) / 2)

    def clearance(
        self, X_WB: Float[Array, "7 *batch"], cylinders: Cylinders
    ) -> Float[Array, " *batch"]:
        """Signed distance (m) of the box to the nearest cylinder; +inf if there is none.

        The least signed distance of the box to a point of the cylinder's axis, less its radius.
        The distance to a convex body is convex along a line, so golden sections find it. It is
        exact beside the cylinder; beyond its ends it treats them as hemispheres (conservative).
        """
        if cylinders.radius.shape[0] == 0:
            return jnp.full_like(X_WB[0], jnp.inf)
        n = cylinders.radius.shape[0]
        shape = (n,) + (1,) * (X_WB.ndim - 1)
        X = jnp.broadcast_to(X_WB[:, None], (7, n, *X_WB.shape[1:]))
        xy = [jnp.broadcast_to(c.reshape(shape), X.shape[1:]) for c in cylinders.p_WO_xy]
        low = jnp.broadcast_to(cylinders.bottom.reshape(shape), X.shape[1:])
        high = jnp.broadcast_to(cylinders.top.reshape(shape), X.shape[1:])
        half = self.half_size.reshape((3,) + (1,) * (X.ndim - 1))

        def distance(z: Array) -> Array:
            q = jnp.abs(se3.rotate_inverse(X, jnp.stack([*xy, z]) - X[4:])) - half
            outside = jnp.sqrt(jnp.sum(jnp.maximum(q, 0) ** 2, axis=0))
            return outside + jnp.minimum(jnp.max(q, axis=0), 0)

        def section(_: Any, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            a, b = bracket
            width = _GOLDEN * (b - a)
            right = distance(b - width) > distance(a + width)
            return jnp.where(right, b - width, a), jnp.where(right, b, a + width)

        low, high = jax.lax.fori_loop(0, _SECTIONS, section, (low, high))
        return jnp.min(distance((low + high) / 2) - cylinders.radius.reshape(shape), axis=0)
