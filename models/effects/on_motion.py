"""How effects act on the equation of motion of a base model: inertia, wrench, thrust, diffusion."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..dynamics import Coefficients, Dynamics, Flow
from ..spd import ConstantSpd, Spd
from .base import Effect, Plant
from .inertia import Inertia, times


class EffectsOnMotion(Dynamics):
    """`base` with the part of its `effects` that depends on the state alone, without memory."""

    base: Dynamics
    effects: tuple[Effect, ...]
    positions: Float[Array, "3 n"]
    directions: Float[Array, "3 n"]
    inverse: Float[Array, "n 6"]

    @property
    def rigid_inertia(self) -> Float[Array, "6 6"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.rigid_inertia

    @property
    def displaced_mass(self) -> Float[Array, ""]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.displaced_mass

    @property
    def p_BoCb_B(self) -> Float[Array, "3"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.p_BoCb_B

    @property
    def stochastic(self) -> bool:
        return self.base.stochastic

    def coefficients(self, V_WB_B: Float[Array, "6 *#batch"]) -> Coefficients:
        c = self.base.coefficients(V_WB_B)
        return c._replace(
            mass=self._mass(c.mass), diffusion=self.scaled_diffusion(V_WB_B, c.diffusion)
        )

    def mass_and_diffusion(self, V_WB_B: Float[Array, "6 *#batch"]) -> tuple[Spd, Array]:
        mass, b = self.base.mass_and_diffusion(V_WB_B)
        return self._mass(mass), self.scaled_diffusion(V_WB_B, b)

    @property
    def brownian_size(self) -> int:
        return self.base.brownian_size

    def lasting_push(
        self, w: Float[Array, "T 6 *batch"], dt: float | Float[Array, ""]
    ) -> Float[Array, "T 6 *batch"]:
        return self.base.lasting_push(w, dt)

    def correlate(
        self, V_WB_B: Float[Array, "6 *#batch"], dW: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        return self.base.correlate(V_WB_B, dW)

    def potential(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "*#batch"]:
        """Potential of the base alone: effects need not have one."""
        return self.base.potential(X_WB)

    def potential_wrench(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "6 *#batch"]:
        """Potential wrench of the base alone."""
        return self.base.potential_wrench(X_WB)

    def balance(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        F_Bo_B: Float[Array, "6 *#batch"],
        flow: Flow | None = None,
        coefficients: Coefficients | None = None,
    ) -> tuple[Spd, Float[Array, "6 *#batch"]]:
        level = None
        if self._any("thrust"):
            level = self.thrust(jnp.tensordot(self.inverse, F_Bo_B, 1), V_WB_B)
            F_Bo_B = self.allocate(level)
        F_Bo_B = self.together(F_Bo_B)
        V_own, turning = self.through_water(X_WB, V_WB_B)
        own = None if coefficients is None else coefficients._replace(mass=self._base_mass(V_own))
        mass, wrench = self.base.balance(X_WB, V_own, F_Bo_B, flow, own)
        V_CB = V_own
        if flow is not None:
            v_c = se3.rotate_inverse(X_WB, flow.v_WC_W)
            V_CB = V_own - jnp.concatenate([v_c, jnp.zeros_like(v_c)])
        extra = self.extra_inertia()
        wrench = wrench + self.extra_wrench(X_WB, V_CB, extra)
        mass = self._mass(mass, extra)
        if turning is not None:
            wrench = wrench + mass.matvec(turning)
        return mass, wrench

    @property
    def plant(self) -> Plant:
        """Constants of the vehicle that effects may refer to."""
        zero = jnp.zeros(6, self.positions.dtype)
        mass = self.base.coefficients(zero).mass.matrix()
        weight = getattr(self.base, "weight", self.base.displaced_mass * 9.80665)
        rigid = self.base.rigid_inertia[0, 0]
        drag = self.base.drag_wrench
        weight = jnp.asarray(weight)
        buoyant = self.base.p_BoCb_B
        return Plant(self.positions, self.directions, mass, weight, rigid, drag, buoyant)

    def _any(self, hook: str) -> bool:
        return any(effect.acts(hook) for effect in self.effects)

    def extra_inertia(self) -> Float[Array, "6 6 *batch"] | None:
        """What effects add to the mass matrix (kg, kg·m, kg·m²); None without such effects."""
        if not self._any("inertia"):
            return None
        plant = self.plant
        parts = [effect.inertia(plant) for effect in self.effects if effect.acts("inertia")]
        return sum(parts[1:], parts[0])

    def _base_mass(self, V: Array) -> Spd:
        return self.base.mass_and_diffusion(V)[0]

    def _mass(self, mass: Spd, extra: Array | None = None) -> Spd:
        extra = self.extra_inertia() if extra is None else extra
        return mass if extra is None else ConstantSpd(mass.matrix() + extra)

    def scaled_diffusion(
        self, V: Float[Array, "6 *#batch"], b: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        """The diffusion that replaces b, with the effects on it."""
        for effect in self.effects:
            if effect.acts("diffusion"):
                V, b = se3.align(V, b)
                b = effect.diffusion(V, b)
        return b

    def inertia(self) -> Inertia:
        """The mass matrix with effects, for a base of constant mass; batched as their values.

        Raises:
            ValueError: the base's mass depends on its velocity.
        """
        mass = self._base_mass(jnp.zeros(6, self.positions.dtype))
        if not isinstance(mass, ConstantSpd):
            raise ValueError("effects with batches of values need a base of constant mass")
        extra = self.extra_inertia()
        if extra is None:
            return Inertia(mass.dense, mass.inverse)
        M, _ = se3.align(mass.dense, extra)
        M = M + extra
        batch = M.shape[2:]
        flat = jnp.moveaxis(M.reshape(6, 6, -1), -1, 0)
        inverse = jnp.moveaxis(jnp.linalg.inv(flat), 0, -1).reshape(6, 6, *batch)
        return Inertia(M, inverse)

    def allocate(self, level: Float[Array, "n *batch"]) -> Float[Array, "6 *batch"]:
        """The wrench of thruster forces."""
        lever = jnp.cross(self.positions, self.directions, axis=0)
        return jnp.tensordot(jnp.concatenate([self.directions, lever]), level, 1)

    def together(self, F_Bo_B: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        """The wrench of all thrusters (N, N·m) with the effects on it, from that allocated."""
        for effect in self.effects:
            if effect.acts("together"):
                F_Bo_B = effect.together(F_Bo_B)
        return F_Bo_B

    def through_water(
        self, X: Float[Array, "7 *#batch"], V: Float[Array, "6 *#batch"]
    ) -> tuple[Float[Array, "6 *#batch"], Float[Array, "6 *#batch"] | None]:
        """Velocity relative to the effects' steady flow, and that flow's rate in B as B rotates.

        For a uniform steady flow the equations hold unchanged in the relative velocity (Fossen
        2011, property 8.1: Galilean invariance).
        """
        if not self._any("flow"):
            return V, None
        flows = [effect.flow(X) for effect in self.effects if effect.acts("flow")]
        v_c = se3.rotate_inverse(X, sum(flows[1:], flows[0]))
        zero = jnp.zeros_like(v_c)
        turning = jnp.concatenate([-se3.cross(jnp.broadcast_to(V[3:], v_c.shape), v_c), zero])
        return V - jnp.concatenate([v_c, zero]), turning

    def extra_wrench(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        extra: Float[Array, "6 6 *#batch"] | None = None,
    ) -> Float[Array, "6 *#batch"]:
        """Wrench of the effects, other than thrust."""
        total = jnp.zeros_like(V_CB_B)
        if extra is not None:
            total = total + se3.coad_apply(V_CB_B, times(extra, V_CB_B))
        plant = self.plant
        for effect in self.effects:
            if effect.acts("wrench"):
                total = total + effect.wrench(X_WB, V_CB_B, plant)
        return total

    def thrust(
        self,
        level: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"] | None = None,
    ) -> Float[Array, "n *#batch"]:
        """Static actuation effects on thruster forces (N); `voltage` relative to the nominal."""
        relative = jnp.ones_like(level[:1]) if voltage is None else voltage
        plant = self.plant
        for effect in self.effects:
            if effect.acts("thrust"):
                level = effect.thrust(level, V_CB_B, relative, plant)
        return level

    def drift(
        self,
        inertia: Inertia,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        level: Float[Array, "n *#batch"],
        voltage: Float[Array, "1 *#batch"] | None = None,
        push: Float[Array, "6 *#batch"] | None = None,
    ) -> Float[Array, "6 *#batch"]:
        """dV/dt under thruster forces (memory effects applied) and a random wrench `push`."""
        V_r, turning = self.through_water(X_WB, V_WB_B)
        F = self.push(level, X_WB, V_WB_B, voltage)
        F = F if push is None else F + push
        _, wrench = self.base.balance(X_WB, V_r, F)
        wrench = wrench + self.extra_wrench(X_WB, V_r, self.extra_inertia())
        acceleration = times(inertia.inverse, wrench)
        return acceleration if turning is None else acceleration + turning

    def push(
        self,
        level: Float[Array, "n *#batch"],
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"] | None = None,
    ) -> Float[Array, "6 *#batch"]:
        """The thrusters' wrench on the body, from forces with memory effects applied."""
        V_r, _ = self.through_water(X_WB, V_WB_B)
        return self.together(self.allocate(self.thrust(level, V_r, voltage)))
