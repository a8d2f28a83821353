"""Dependence of thrust on the battery's voltage and on the load of all thrusters together."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import Effect, Parameter, Plant

FULL_LOAD = 40.0**1.5
"""|f|^1.5 of a thruster at 40 N: its share of the reference load of `LoadDroop`."""


class VoltageSag(Effect):
    """f = u (V / V_nominal)^k with the recorded voltage V; k is 1 to 2 at given PWM."""

    name: ClassVar[str] = "voltage_sag"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("exponent", "1", (0.3,), 0.0, 4.0),)
    order: ClassVar[int] = 15
    needs: ClassVar = frozenset({"voltage"})
    source: ClassVar[str] = "T200: thrust falls by 30 % from 16 to 12 V (Blue Robotics, 2019)"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        return force * jnp.exp(self.part(0, force)[None] * jnp.log(voltage))


class VoltageExponent(VoltageSag):
    """The same with either sign: the modelled curve may depend on the voltage too much."""

    name: ClassVar[str] = "voltage_exponent"
    parameters: ClassVar = (Parameter("exponent", "1", (0.3,), -4.0, 4.0, 1.0),)
    refits: ClassVar = ("all",)
    refit_only: ClassVar[bool] = True
    refit_needs: ClassVar = frozenset({"voltage", "thrust"})


class LoadDroop(Effect):
    """f = u (1 - c Σ|u|^1.5 / L): thrust lost to the common load; L is that of all at 40 N.

    Current grows as |u|^1.5 (momentum theory), and the pack's voltage falls in proportion to it.
    """

    name: ClassVar[str] = "load_droop"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("loss", "1", (0.15,), 0.0, 4.0),)
    order: ClassVar[int] = 16
    source: ClassVar[str] = "20 to 50 mΩ of pack and wiring: 10 to 40 % at full load"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        size = jnp.abs(force)
        load = jnp.sum(size * jnp.sqrt(size), axis=0, keepdims=True) / (len(force) * FULL_LOAD)
        return force * (1 - self.part(0, force)[None] * load)
