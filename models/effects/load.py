"""Buoyancy, centres of gravity and buoyancy, and payload."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import se3
from ..dynamics import Dynamics
from ..rigid_body import FossenDynamics
from ..se3 import XYZ
from .base import Effect, Parameter, Plant, force_only


def up_in_body(X_WB: Float[Array, "7 *batch"]) -> Float[Array, "3 *batch"]:
    """W's z axis expressed in B."""
    w, x, y, z = jnp.unstack(X_WB[:4])
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


class NetBuoyancy(Effect):
    """A constant upward force ΔB (N), at Bo or at the centre of buoyancy.

    The second is the effect of another displaced volume on Fossen's restoring forces (2011,
    eq. 4.6), which adds the moment p_BoCb × ΔB.
    """

    name: ClassVar[str] = "net_buoyancy"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("force", "N", (0.5,), -60.0, 60.0, refit=20.0),)
    places: ClassVar = ("all", "centre_of_buoyancy")
    at_rest: ClassVar[bool] = True
    refits: ClassVar = ("linear", "command", "all")
    source: ClassVar[str] = "0.2 to 4 N: trim, foam, water density"

    @classmethod
    def believed(cls, base: Dynamics, place: str) -> float:
        return float(base.buoyancy - base.weight) if isinstance(base, FossenDynamics) else 0.0

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        up = up_in_body(X_WB)
        at_Bo, at_Cb = (self.part(i, V_CB_B)[None] * up for i in range(2))
        r = plant.p_BoCb_B.reshape(3, *(1,) * (at_Cb.ndim - 1))
        return force_only(at_Bo + at_Cb) + _hung(r, at_Cb)

    def in_constants(self, base: FossenDynamics, plant: Plant) -> FossenDynamics:
        at_Bo, at_Cb = np.asarray(self.values, float)
        moment = np.asarray(base.p_BoCb_B, float) * float(base.buoyancy)
        moment = moment + np.asarray(plant.p_BoCb_B, float) * at_Cb
        buoyancy = float(base.buoyancy) + at_Bo + at_Cb
        return base.with_constants(buoyancy=buoyancy, p_BoCb_B=moment / buoyancy)


class CentreOfGravity(Effect):
    """The centre of gravity moved by r along an axis of B: moment r × weight, and inertia.

    The mass matrix about Bo couples translation and rotation by m S(r) (Fossen 2011, eq. 3.44); its
    second-order term in r is neglected.
    """

    name: ClassVar[str] = "centre_of_gravity"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("shift", "m", (0.001,), -0.1, 0.1),)
    places: ClassVar = XYZ
    at_rest: ClassVar[bool] = True
    source: ClassVar[str] = "mm to cm: batteries, tools, ballast"

    def inertia(self, plant: Plant) -> Float[Array, "6 6 *batch"]:
        return _coupled(plant.rigid_mass * self.values)

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return _hung(self.column(V_CB_B), -plant.weight * up_in_body(X_WB))


class CentreOfBuoyancy(Effect):
    """The centre of buoyancy moved by r along an axis of B: a moment r × weight, no inertia."""

    name: ClassVar[str] = "centre_of_buoyancy"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("shift", "m", (0.001,), -0.5, 0.5, 0.05),)
    places: ClassVar = XYZ
    refits: ClassVar = ("all",)
    refit_only: ClassVar[bool] = True
    source: ClassVar[str] = "0.01 to 0.1 m above Bo in published sets"

    @classmethod
    def believed(cls, base: Dynamics, place: str) -> float:
        fossen = isinstance(base, FossenDynamics)
        return float(base.p_BoCb_B[XYZ.index(place)]) if fossen else 0.0

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return _hung(self.column(V_CB_B), plant.weight * up_in_body(X_WB))

    def in_constants(self, base: FossenDynamics, plant: Plant) -> FossenDynamics:
        shift = np.asarray(self.values, float) * float(plant.weight) / float(base.buoyancy)
        return base.with_constants(p_BoCb_B=np.asarray(base.p_BoCb_B, float) + shift)


class Payload(Effect):
    """A load at (x, y, z): mass m, weight in water w, and their moments about Bo.

    The mass includes the water that moves with it. Data determine the moments w x and w y; x and y
    follow from them and the weight, z is the height. m acts at that point: coupling m S(r) and
    inertia -m S(r)²; its own rotational inertia is neglected.
    """

    name: ClassVar[str] = "payload"
    family: ClassVar = "body"
    parameters: ClassVar = (
        Parameter("mass", "kg", (0.5,), 0.0, 30.0),
        Parameter("weight", "N", (0.5,), 0.0, 100.0),
        Parameter("moment_x", "N·m", (0.05,), -30.0, 30.0),
        Parameter("moment_y", "N·m", (0.05,), -30.0, 30.0),
        Parameter("height", "m", (0.05,), -1.0, 1.0),
    )
    simpler: ClassVar = ("net_buoyancy", "centre_of_gravity")
    essential: ClassVar = ("mass", "weight")
    source: ClassVar[str] = "0.1 to 3 kg"

    def inertia(self, plant: Plant) -> Float[Array, "6 6 *batch"]:
        m, w, a, b, z = self.values
        square = w * w + _LIGHT**2
        r = jnp.stack([a * w / square, b * w / square, z])
        S = _skew(r)
        turning = -jnp.einsum("ij...,jk...->ik...", S, S)
        eye = jnp.eye(3, dtype=m.dtype).reshape((3, 3) + (1,) * m.ndim)
        upper = jnp.concatenate([jnp.broadcast_to(eye, S.shape), -S], axis=1)
        return m[None, None] * jnp.concatenate([upper, jnp.concatenate([S, turning], axis=1)])

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        up = up_in_body(X_WB)
        w, a, b, z = (self.part(i, V_CB_B) for i in range(1, 5))
        moment = _hung(jnp.stack(jnp.broadcast_arrays(a, b, w * z)), -up)
        force = jnp.broadcast_to(-w[None] * up, moment[:3].shape)
        return jnp.concatenate([force, moment[3:]])


_LIGHT = 0.05
"""Weight (N) below which its moments do not determine a load's position."""


def _skew(r: Float[Array, "3 *batch"]) -> Float[Array, "3 3 *batch"]:
    x, y, z = jnp.unstack(r)
    o = jnp.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _coupled(moment: Float[Array, "3 *batch"]) -> Float[Array, "6 6 *batch"]:
    """Mass matrix of a first moment m r: it couples translation and rotation."""
    S = _skew(moment)
    zero = jnp.zeros_like(S)
    upper, lower = jnp.concatenate([zero, -S], axis=1), jnp.concatenate([S, zero], axis=1)
    return jnp.concatenate([upper, lower])


def _hung(r: Float[Array, "3 *#batch"], force: Float[Array, "3 *#batch"]) -> Array:
    """The moment r × force as a wrench without force."""
    r, force = jnp.broadcast_arrays(r, force)
    moment = se3.cross(r, force)
    return jnp.concatenate([jnp.zeros_like(moment), moment])
