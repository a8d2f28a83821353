"""Tether: drag, weight and pull of the line between the vehicle and its anchor."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector3, require
from ..dynamics import Flow
from ..randomness import Scalar, column
from .base import Disturbance

_POINTS = (0.125, 0.375, 0.625, 0.875)  # quadrature points of the line, from anchor to vehicle
_SURFACE = 0.05  # half width of the transition between dry and wet at the surface (m)
_TINY = 1e-6


@dataclass(frozen=True)
class Tether(Disturbance):
    """A quasi-static line of two straight halves, deflected by its load between anchor and vehicle.

    A line of length L whose ends are D apart is modelled as two halves that meet at the distance
    s = ½ √(L² − D²) from the middle of the chord, in the direction of the transverse load. Every
    wet segment carries its weight in water and the drag of the flow relative to it,
    f = ½ ρ d (C_n |u_n| u_n + π C_t |u_t| u_t) per metre, normal and tangential; its own velocity
    grows linearly from zero at the anchor to the vehicle's. Each segment's load is shared by the
    two ends by the lever rule. Balance at the joint requires a tension Q D / (8 s) along the chord,
    Q being the transverse load: the statics of two hinged links under a uniform load, and the
    parabolic cable's value (Irvine 1981, eq. 2.4). As D approaches L the slack L − D fades smoothly
    within `taut_range`; beyond it acts a spring, damped while it lengthens. The force is continuous
    in pose, velocity and flow.

    The flow passed to `wrench` holds all along the line; `Combined` provides it.

    Attributes:
        anchor: p_WA_W, the anchor in the world (m); above z = 0 the line is dry.
        attachment: p_BoT_B, the attachment in the body (m), aft and on top.
        length: L (m).
        diameter: d (m).
        weight: weight in water per metre (N/m); negative floats. The default is that of a line of
            0.043 kg/m and 7.6 mm, neutral in fresh water, when it is in sea water.
        normal_drag: C_n (von Benzon et al. 2022).
        tangential_drag: C_t (von Benzon et al. 2022).
        water_density: ρ (kg/m³).
        taut_range: distance over which the line becomes taut (m).
        stiffness: tension per metre beyond L (N/m); far below the material's, to allow for sag and
            to keep the integration stable.
        damping: tension per speed of lengthening when taut (N·s/m).
    """

    anchor: Vector3 = (0.0, 0.0, 0.0)
    attachment: Vector3 = (-0.2, 0.0, 0.12)
    length: float = 20.0
    diameter: float = 0.0076
    weight: float = -0.03
    normal_drag: float = 1.2
    tangential_drag: float = 0.01
    water_density: float = 1025.0
    taut_range: float = 0.2
    stiffness: float = 100.0
    damping: float = 30.0

    def __post_init__(self) -> None:
        """Check signs."""
        super().__post_init__()
        for field in ("length", "diameter", "water_density", "taut_range"):
            require(getattr(self, field) > 0, self, field, "give a number above zero")
        for field in ("normal_drag", "tangential_drag", "stiffness", "damping"):
            require(getattr(self, field) >= 0, self, field, "give zero or more")
        require(self.taut_range <= self.length / 4, self, "taut_range", "give at most length / 4")

    @property
    def state_size(self) -> int:
        """Zero: the line is quasi-static."""
        return 0

    def _load(self, u_W: Array, tangent_W: Array, z: Array) -> Array:
        """Drag and weight per metre in W for relative flow u_W at height z."""
        u_t = _dot(u_W, tangent_W) * tangent_W
        u_n = u_W - u_t
        half = 0.5 * self.water_density * self.diameter
        drag = half * self.normal_drag * _length(u_n) * u_n
        drag = drag + half * math.pi * self.tangential_drag * _length(u_t) * u_t
        wet = jax.nn.sigmoid(-z / (_SURFACE / 2))
        down = column((0.0, 0.0, -self.weight), u_W)
        return wet * (drag + down)

    def wrench(
        self,
        state: Float[Array, "0 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        flow: Flow | None = None,
    ) -> Float[Array, "6 *batch"]:
        """Return the force of the line's end at the attachment, as a wrench about Bo."""
        del state, t
        r = column(self.attachment, X_WB) + jnp.zeros_like(V_WB_B[:3])
        anchor = column(self.anchor, X_WB)
        end = se3.act(X_WB, r)
        v_end = se3.rotate(X_WB, V_WB_B[:3] + se3.cross(V_WB_B[3:], r))
        water = jnp.zeros_like(end) if flow is None else flow.v_WC_W

        chord = end - anchor
        distance = _length(chord)
        along = chord / distance

        def across(force: Array) -> Array:
            return force - _dot(force, along) * along

        stretch = distance - self.length
        slack = self.taut_range * (0.5 + jax.nn.softplus(-stretch / self.taut_range))
        sag = 0.5 * jnp.sqrt(slack * (self.length + distance))

        straight = sum(
            (self._load(water - s * v_end, along, (anchor + s * chord)[2:]) for s in _POINTS),
            start=jnp.zeros_like(end),
        )
        push = across(straight)
        side = push / jnp.sqrt(_dot(push, push) + _TINY)
        middle = anchor + chord / 2 + sag * side

        piece = self.length / len(_POINTS)
        total, at_end = jnp.zeros_like(end), jnp.zeros_like(end)
        for s in _POINTS:
            first = s < 0.5
            span = middle - anchor if first else end - middle
            point = anchor + 2 * s * span if first else middle + (2 * s - 1) * span
            load = piece * self._load(water - s * v_end, span / _length(span), point[2:])
            total, at_end = total + load, at_end + s * load

        tension = _length(across(total)) * distance / (8 * sag)
        lengthening = jnp.maximum(_dot(v_end, along), 0)
        tension = tension + self.stiffness * self.taut_range * jax.nn.softplus(
            stretch / self.taut_range
        )
        tension = tension + self.damping * lengthening * jax.nn.sigmoid(stretch / self.taut_range)
        f_B = se3.rotate_inverse(X_WB, at_end - tension * along)
        return jnp.concatenate([f_B, se3.cross(r, f_B)])


def _dot(a: Float[Array, "3 *batch"], b: Float[Array, "3 *batch"]) -> Float[Array, "1 *batch"]:
    return jnp.sum(a * b, axis=0, keepdims=True)


def _length(v: Float[Array, "3 *batch"]) -> Float[Array, "1 *batch"]:
    """Euclidean length with a finite derivative at zero."""
    return jnp.sqrt(_dot(v, v) + _TINY * _TINY)
