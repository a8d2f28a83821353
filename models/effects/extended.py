"""A base model with effects; it is a `Dynamics` itself."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..dynamics import Coefficients, Dynamics, Flow, Memory
from ..spd import ConstantSpd, Spd
from ..thrusters import Thrusters
from .base import Effect, Plant
from .deterministic_step import advance
from .inertia import Inertia, times
from .recent import Recent

Random = tuple[Array, ...]
"""One array (s, *batch) for each effect with a random state, in the model's order."""
FOR_EVER = 1e9
"""A step (s) after which `step_random_state` draws from the stationary law."""


def core(dynamics: Dynamics) -> Dynamics:
    """The base of a model with effects; other models are returned as they are."""
    return dynamics.base if isinstance(dynamics, Extended) else dynamics


class Extended(Dynamics):
    """`base` with `effects`, driven by thruster forces.

    As a `Dynamics` it takes a wrench and allocates it to the thrusters with the least effort; lag
    and delay act in `integrate.rollout`. Random states (waves, coloured noise) act where thruster
    forces are commanded: in `rollout`, and in the plant of a diagram.
    """

    base: Dynamics
    effects: tuple[Effect, ...]
    positions: Float[Array, "3 n"]
    directions: Float[Array, "3 n"]
    inverse: Float[Array, "n 6"]

    @classmethod
    def create(
        cls, base: Dynamics, effects: tuple[Effect, ...], thrusters: Thrusters
    ) -> "Extended":
        """Effects in any order; they apply in the order of their kinds."""
        ordered = tuple(sorted(effects, key=lambda effect: effect.order))
        t = thrusters
        return cls(base, ordered, t.positions, t.directions, t.inverse)  # pyright: ignore[reportCallIssue]

    def with_effects(self, effects: tuple[Effect, ...]) -> "Extended":
        """The same base and thrusters with other effects."""
        ordered = tuple(sorted(effects, key=lambda effect: effect.order))
        return dataclasses.replace(self, effects=ordered)

    def with_base(self, base: Dynamics) -> "Extended":
        """The same effects and thrusters on another base."""
        return dataclasses.replace(self, base=base)

    def trainable(self) -> "Extended":
        """The same tree with True at the base's trainable leaves; effects are not trained."""
        own = getattr(self.base, "trainable", None)
        spec = jax.tree.map(eqx.is_inexact_array, self.base) if own is None else own()
        fixed = jax.tree.map(lambda _: False, self)
        return eqx.tree_at(lambda m: m.base, fixed, spec)

    @property
    def memory_duration(self) -> float:
        """Memory duration (s), to about 1 %."""
        return max((effect.memory_duration for effect in self.effects), default=0.0)

    @property
    def reads(self) -> bool:
        """Whether any effect makes the recorded state differ from the true one."""
        return self._any("measure")

    # ------------------------------------------------------------------ interface of `Dynamics`

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
        V_own, turning = self._through_water(X_WB, V_WB_B)
        own = None if coefficients is None else coefficients._replace(mass=self._base_mass(V_own))
        mass, wrench = self.base.balance(X_WB, V_own, F_Bo_B, flow, own)
        V_CB = V_own
        if flow is not None:
            v_c = se3.rotate_inverse(X_WB, flow.v_WC_W)
            V_CB = V_own - jnp.concatenate([v_c, jnp.zeros_like(v_c)])
        extra = self._extra_inertia()
        wrench = wrench + self.extra_wrench(X_WB, V_CB, extra)
        mass = self._mass(mass, extra)
        if turning is not None:
            wrench = wrench + mass.matvec(turning)
        return mass, wrench

    # --------------------------------------------------------------------------- the pieces

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

    @property
    def remembers(self) -> bool:
        return any(effect.memory_size for effect in self.effects)

    def commanded(self, F_Bo_B: Float[Array, "6 *batch"]) -> Memory:
        return self.remember(jnp.tensordot(self.inverse, F_Bo_B, 1))

    def arriving(
        self,
        memory: Memory,
        F_Bo_B: Float[Array, "6 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dt: Any,
        substeps: int,
    ) -> tuple[Memory, Float[Array, "6 *batch S"]]:
        level = jnp.tensordot(self.inverse, F_Bo_B, 1)
        memory, levels = self.actuate(memory, level, dt, substeps)
        memory, felt = self.feel(memory, V_WB_B, dt)
        F = self.allocate(levels)
        return memory, F if felt is None else F + felt[..., None]

    def _any(self, hook: str) -> bool:
        return any(effect.acts(hook) for effect in self.effects)

    def _extra_inertia(self) -> Array | None:
        if not self._any("inertia"):
            return None
        plant = self.plant
        parts = [effect.inertia(plant) for effect in self.effects if effect.acts("inertia")]
        return sum(parts[1:], parts[0])

    def _base_mass(self, V: Array) -> Spd:
        return self.base.mass_and_diffusion(V)[0]

    def _mass(self, mass: Spd, extra: Array | None = None) -> Spd:
        extra = self._extra_inertia() if extra is None else extra
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
        extra = self._extra_inertia()
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

    def _through_water(self, X: Array, V: Array) -> tuple[Array, Array | None]:
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
        V_r, turning = self._through_water(X_WB, V_WB_B)
        F = self.push(level, X_WB, V_WB_B, voltage)
        F = F if push is None else F + push
        _, wrench = self.base.balance(X_WB, V_r, F)
        wrench = wrench + self.extra_wrench(X_WB, V_r, self._extra_inertia())
        acceleration = times(inertia.inverse, wrench)
        return acceleration if turning is None else acceleration + turning

    # ---------------------------------------------------------------------------- memories

    def for_steps_of(self, dt: float) -> "Extended":
        """The same model, its effects with enough memory for steps of `dt` s."""
        return self.with_effects(tuple(e.for_steps_of(dt) for e in self.effects))

    def remember(self, command: Float[Array, "n *batch"]) -> Memory:
        """Steady-state memories under a constant command."""
        return tuple(e.initial(command) for e in self.effects if e.memory_size)

    def actuate(
        self, memory: Memory, command: Float[Array, "n *#batch"], dt: Any, substeps: int
    ) -> tuple[Memory, Float[Array, "n *#batch S"]]:
        """Memories after a held command of `dt` s, and mean forces over its substeps."""
        h = jnp.asarray(dt, command.dtype)
        level = jnp.broadcast_to(command[..., None], (*command.shape, substeps))
        kept, i = [], 0
        for effect in self.effects:
            if effect.memory_size:
                new, level = effect.actuate(memory[i], level, h)
                kept.append(new)
                i += 1
        return tuple(kept), level

    def feel(
        self, memory: Memory, V_WB_B: Float[Array, "6 *#batch"], dt: Any
    ) -> tuple[Memory, Float[Array, "6 *#batch"] | None]:
        """Memories after a step at a velocity, and the resulting wrench, if any."""
        kept, total, i = [], None, 0
        for effect in self.effects:
            if not effect.memory_size:
                continue
            new = memory[i]
            if effect.acts("feel"):
                new, push = effect.feel(new, V_WB_B, dt)
                total = push if total is None else total + push
            kept.append(new)
            i += 1
        return tuple(kept), total

    # ------------------------------------------------------------------------ step by step

    @property
    def body(self) -> "Extended":
        """The same without effects on the actuation: its input is the thrusters' wrench."""
        hooks = ("actuate", "thrust", "together")
        rest = (e for e in self.effects if not any(e.acts(hook) for hook in hooks))
        return self.with_effects(tuple(rest))

    def simulation_state(self, command: Float[Array, "n *batch"]) -> tuple[Memory, Random]:
        """Initial memories, steady state under a constant `command` (N), and random states."""
        batch = command.shape[1:]
        return self.remember(command), tuple(
            jnp.zeros((e.pushes, *batch), command.dtype) for e in self.effects if e.pushes
        )

    def push(
        self,
        level: Float[Array, "n *#batch"],
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"] | None = None,
    ) -> Float[Array, "6 *#batch"]:
        """The thrusters' wrench on the body, from forces with memory effects applied."""
        V_r, _ = self._through_water(X_WB, V_WB_B)
        return self.together(self.allocate(self.thrust(level, V_r, voltage)))

    def observe(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        """Recorded pose and twist without noise; `recent` is the twist's history."""
        for effect in self.effects:
            if effect.acts("measure"):
                X_WB, V_WB_B = effect.measure(X_WB, V_WB_B, recent)
        return X_WB, V_WB_B

    def infer(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        """True pose and twist from the recorded ones: the inverse of `observe`."""
        for effect in reversed(self.effects):
            if effect.acts("measure"):
                X_WB, V_WB_B = effect.unmeasure(X_WB, V_WB_B, recent)
        return X_WB, V_WB_B

    # -------------------------------------------------------------------------- simulation

    @property
    def noise_size(self) -> int:
        """Number of unit Gaussians per step of `rollout`: six for b dW, then the effects'."""
        return 6 + sum(effect.noise_size for effect in self.effects)

    def rollout(
        self,
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        command: Float[Array, "T n *batch"],
        dt: float,
        w: Float[Array, "T k *batch"] | None = None,
        voltage: Float[Array, "T *batch"] | None = None,
    ) -> tuple[Float[Array, "T 7 *batch"], Float[Array, "T 6 *batch"]]:
        """States at dt, 2 dt, … under thruster commands (N), each held for a step.

        `w` holds `noise_size` unit Gaussians per step. Those of the first step draw random states
        from their stationary law; without `w` the motion is noise-free. Values of the effects must
        have no batch axes, or ones that broadcast against the state's.
        """
        inertia = self.inertia()
        memory, state = self.simulation_state(command[0])

        def body(carry: Any, given: Any) -> Any:
            memory, state, X, V = carry
            u, noise, volts, since = given
            push = None
            if noise is not None:
                state, push = self.step_random_state(state, X, V, noise, since)
            memory, X, V, _ = advance(self, inertia, memory, X, V, u, dt, 1, volts, push)
            if noise is not None:
                h = jnp.asarray(dt, V.dtype)
                b = self.scaled_diffusion(V, self.base.mass_and_diffusion(V)[1])
                b, dW = se3.align(b, self.correlate(V, jnp.sqrt(h) * noise[:6]))
                V = V + times(inertia.inverse, b * dW)
            return (memory, state, X, V), (X, V)

        volts = None if voltage is None else voltage[:, None]
        since = jnp.full(len(command), dt, V_WB_B.dtype).at[0].set(FOR_EVER)
        start = (memory, state, X_WB, V_WB_B)
        return jax.lax.scan(body, start, (command, w, volts, since))[1]

    def step_random_state(
        self,
        state: Random,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        w: Float[Array, "k *#batch"],
        dt: float | Float[Array, ""],
    ) -> tuple[Random, Float[Array, "6 *#batch"]]:
        """Random states after a step, and their wrench, including drag of the moving water.

        `w` holds `noise_size` unit Gaussians, the first six of which are reserved for b dW.
        """
        h = jnp.asarray(dt, V_WB_B.dtype)
        moved, push, at, i = [], jnp.zeros_like(V_WB_B), 6, 0
        water = None
        for effect in self.effects:
            if not effect.pushes:
                continue
            new = effect.advance(state[i], w[at : at + effect.noise_size], h)
            moved.append(new)
            at, i = at + effect.noise_size, i + 1
            push = push + effect.push(new, X_WB)
            if effect.acts("drift_of_water"):
                v = effect.drift_of_water(new, X_WB)
                water = v if water is None else water + v
        if water is not None:
            v_c = se3.rotate_inverse(X_WB, water)
            V_r = V_WB_B - jnp.concatenate([v_c, jnp.zeros_like(v_c)])
            push = push + self.base.drag_wrench(V_r) - self.base.drag_wrench(V_WB_B)
        return tuple(moved), push
