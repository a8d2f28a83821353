"""Static errors of the thrusters' curve: dead zone, exponent, reverse, single and common gains."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import ALL_OR_ONE, THRUSTERS, Effect, Parameter, Plant

REFERENCE = 10.0
"""Force (N) at which a changed exponent changes nothing."""


class ThrusterDeadZone(Effect):
    """f = sign(u) max(|u| - w, 0): the first w newtons asked of a thruster are lost."""

    name: ClassVar[str] = "thruster_dead_zone"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("width", "N", (0.2, 0.6, 1.5, 3.0), 0.0, 15.0),)
    places: ClassVar = ALL_OR_ONE
    order: ClassVar[int] = 10
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


class ThrustCurve(Effect):
    """f = (1 + g) F_0 sign(u) |u / F_0|^(1 + e) with F_0 = 10 N: another exponent of the curve.

    The gain g goes with the exponent because the force at which old and new curve meet is not
    known.
    """

    name: ClassVar[str] = "thrust_curve"
    family: ClassVar = "actuation"
    parameters: ClassVar = (
        Parameter("exponent", "1", (0.04, -0.04, 0.12, -0.12), -0.5, 1.0),
        Parameter("gain", "1", (0.05,), -0.7, 0.7),
    )
    places: ClassVar = ALL_OR_ONE
    simpler: ClassVar = ("thrust_scale", "thruster_gain")
    order: ClassVar[int] = 11
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


class ThrustAsymmetry(Effect):
    """f = (1 + a) u for u < 0: reverse thrust differs from what is believed."""

    name: ClassVar[str] = "thrust_asymmetry"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("reverse_gain", "1", (-0.05,), -0.6, 1.5),)
    places: ClassVar = ALL_OR_ONE
    order: ClassVar[int] = 12
    source: ClassVar[str] = "reverse ≈ 0.78 of forward: Blue Robotics T200 data, 2019"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        return force + self.each(0, force) * jnp.minimum(force, 0)


class ThrusterGain(Effect):
    """f_i = (1 + g_i) u_i: one thruster is weak (g < 0), dead (-1) or turns backwards (-2)."""

    name: ClassVar[str] = "thruster_gain"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("gain", "1", (-0.05,), -2.3, 3.0),)
    places: ClassVar = THRUSTERS
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
    parameters: ClassVar = (Parameter("scale", "1", (0.03,), -0.8, 4.0),)
    order: ClassVar[int] = 14
    source: ClassVar[str] = "bollard thrust of equal thrusters scatters by 10 to 20 %"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        return force * (1 + self.part(0, force)[None])
