"""Static errors of the thruster curve: dead zone, exponent, reverse, single and common gains."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..se3 import AXES
from ..thruster_curves import RESTING
from .base import ByThruster, Effect, Parameter, Plant

REFERENCE = 10.0
"""Reference force F_0 (N), at which the exponent has no influence."""
START = 0.3
"""Dead zone and offset (N) that a fit of all coefficients starts from: at zero their responses are
one-sided."""


class ThrusterDeadZone(ByThruster):
    """f = sign(u) max(|u| - w, 0): the first w newtons commanded of a thruster are lost."""

    name: ClassVar[str] = "thruster_dead_zone"
    family: ClassVar = "actuation"
    parameters: ClassVar = (
        Parameter("width", "N", (0.2, 0.6, 1.5, 3.0), 0.0, 15.0, refit=3.0, start=START),
    )
    order: ClassVar[int] = 10
    refits: ClassVar = ("all",)
    refit_needs: ClassVar = frozenset({"thrust"})
    source: ClassVar[str] = "0.3 to 2.5 N: 25 to 40 µs of a T200 around 1500 µs"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        width = self.each(0, force)
        return force - jnp.clip(force, -width, width)


class ThrustCurve(ByThruster):
    """f = (1 + g) F_0 sign(u) |u / F_0|^(1 + e) with F_0 = 10 N: another exponent of the curve.

    The gain g is estimated with the exponent because the force at which the two curves cross is
    not known.
    """

    name: ClassVar[str] = "thrust_curve"
    family: ClassVar = "actuation"
    parameters: ClassVar = (
        Parameter("exponent", "1", (0.04, -0.04, 0.12, -0.12), -0.5, 1.0, refit=0.3),
        Parameter("gain", "1", (0.05,), -0.7, 0.7),
    )
    simpler: ClassVar = ("thrust_scale", "thruster_gain")
    essential: ClassVar = ("exponent",)
    order: ClassVar[int] = 11
    refits: ClassVar = ("all",)
    refit_needs: ClassVar = frozenset({"thrust"})
    source: ClassVar[str] = "5 to 15 % between bollard tests"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        exponent, gain = self.each(0, force), self.each(1, force)
        size = jnp.maximum(jnp.abs(force) / REFERENCE, 1e-6)
        return force * (1 + gain) * jnp.exp(exponent * jnp.log(size))


class ThrustAsymmetry(ByThruster):
    """f = (1 + a) u for u < 0: reverse thrust differs from the modelled."""

    name: ClassVar[str] = "thrust_asymmetry"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("reverse_gain", "1", (-0.05,), -0.6, 1.5, refit=0.5),)
    order: ClassVar[int] = 12
    refits: ClassVar = ("all",)
    refit_needs: ClassVar = frozenset({"thrust"})
    source: ClassVar[str] = "reverse ≈ 0.78 of forward: Blue Robotics T200 data, 2019"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        return force + self.each(0, force) * jnp.minimum(force, 0)


class ThrusterGain(ByThruster):
    """f_i = (1 + g_i) u_i: one thruster is weak (g < 0), dead (-1) or reversed (-2)."""

    name: ClassVar[str] = "thruster_gain"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("gain", "1", (-0.05,), -2.3, 3.0),)
    common: ClassVar = ()
    order: ClassVar[int] = 13
    source: ClassVar[str] = "5 to 100 %: worn, fouled or wrongly wired propellers"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        return force * (1 + self.column(force))


class ThrustScale(Effect):
    """f = (1 + s) u for all thrusters alike."""

    name: ClassVar[str] = "thrust_scale"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("scale", "1", (0.03,), -0.8, 1000.0),)
    order: ClassVar[int] = 10
    refits: ClassVar = ("scales",)
    source: ClassVar[str] = "bollard thrust of equal thrusters scatters by 10 to 20 %"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        return force * (1 + self.part(0, force)[None])


KNOTS = (1.0, 2.0, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0)
"""Forces (N), forward and reverse, between which `ThrustTable` is linear."""


class ThrustTable(Effect):
    """f = u + c(u), c = c_k F_k at the knots ± F_k, linear between, proportional to u beyond.

    It fits the errors of the curve that exponent, dead zone and reverse gain do not.
    """

    name: ClassVar[str] = "thrust_table"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("correction", "1", (0.05,), -0.9, 3.0, 0.1),)
    places: ClassVar = tuple(f"{sign}{knot:g} N" for sign in "+-" for knot in KNOTS)
    order: ClassVar[int] = 13
    refits: ClassVar = ("all",)
    refit_only: ClassVar[bool] = True
    refit_needs: ClassVar = frozenset({"thrust"})
    source: ClassVar[str] = "curves of one thruster differ with maker's rig, battery and software"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        count = len(KNOTS)
        for first, sign in ((0, 1), (count, -1)):
            size = sign * force
            change = jnp.zeros_like(force)
            before, reached = 0.0, jnp.zeros_like(force[:1])
            for k, knot in enumerate(KNOTS):
                here = knot * self.part(first + k, force)[None]
                part = (jnp.clip(size, before, knot) - before) / (knot - before)
                change = change + part * (here - reached)
                before, reached = knot, here
            force = force + sign * change * jnp.maximum(size / KNOTS[-1], 1)
        return force


class ThrustOffset(Effect):
    """f = u + o sign(u) min(|u| / ε, 1)²: a dead band that is narrower than modelled.

    Thrust is larger by o beyond the modelled band. Within it, where u only encodes the pulse (ε is
    `thruster_curves.RESTING`), it grows with the square of u.
    """

    name: ClassVar[str] = "thrust_offset"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("force", "N", (0.05,), 0.0, 3.0, 1.0, start=START),)
    order: ClassVar[int] = 10
    refits: ClassVar = ("all",)
    refit_only: ClassVar[bool] = True
    refit_needs: ClassVar = frozenset({"pwm"})
    replaces: ClassVar = ("thruster_dead_zone",)
    source: ClassVar[str] = "dead bands of 25 to 40 µs around 1500 µs: speed controllers differ"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        share = jnp.minimum(jnp.abs(force) / RESTING, 1)
        return force + self.part(0, force)[None] * jnp.sign(force) * share**2


class AxisThrust(Effect):
    """F_i = (1 + s_i) F_i: all thrusters together give more along an axis than modelled.

    It stands for positions, angles and losses that differ from the vehicle file, and for a
    command whose gains are unknown.
    """

    name: ClassVar[str] = "axis_thrust"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("scale", "1", (0.05,), -3.0, 20.0, 0.3),)
    places: ClassVar = AXES
    order: ClassVar[int] = 15
    refits: ClassVar = ("command", "all")
    refit_only: ClassVar[bool] = True
    source: ClassVar[str] = "thrusters 30 to 45° from the axis; moment arms differ by 10 to 100 %"

    def together(self, F_Bo_B: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        return F_Bo_B * (1 + self.column(F_Bo_B))


LEVERS = (
    ("pitch_from_surge", 4, 0),
    ("roll_from_sway", 3, 1),
    ("yaw_from_surge", 5, 0),
    ("yaw_from_sway", 5, 1),
    ("roll_from_heave", 3, 2),
    ("pitch_from_heave", 4, 2),
)
"""(place, axis of the moment, axis of the force)."""


class ThrustLever(Effect):
    """M_i += l F_j: error l (m) of the lever arm about axis i of thrust along axis j."""

    name: ClassVar[str] = "thrust_lever"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("lever", "m", (0.005,), -1.0, 1.0, 0.05),)
    places: ClassVar = tuple(name for name, _, _ in LEVERS)
    order: ClassVar[int] = 16
    refits: ClassVar = ("all",)
    refit_only: ClassVar[bool] = True
    source: ClassVar[str] = "positions of thrusters, and of Bo, are known to some cm"

    def together(self, F_Bo_B: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        for k, (_, i, j) in enumerate(LEVERS):
            F_Bo_B = F_Bo_B.at[i].add(self.part(k, F_Bo_B) * F_Bo_B[j])
        return F_Bo_B
