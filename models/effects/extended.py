"""A base model with effects; it is a `Dynamics` itself."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..dynamics import Dynamics, Memory
from ..integrate import over_substeps
from ..rigid_body import FossenDynamics
from ..thrusters import Thrusters
from .base import Effect
from .deterministic_step import advance
from .inertia import times
from .on_motion import EffectsOnMotion
from .recent import Recent

Random = tuple[Array, ...]
"""One array (s, *batch) for each effect with a random state, in the model's order."""
FOR_EVER = 1e9
"""A step (s) after which `step_random_state` draws from the stationary law."""


def core(dynamics: Dynamics) -> Dynamics:
    """The base of a model with effects; other models are returned as they are."""
    return dynamics.base if isinstance(dynamics, Extended) else dynamics


def with_core(dynamics: Dynamics, base: Dynamics) -> Dynamics:
    """The model with another `core`: another base below the same effects, or `base` itself."""
    return dynamics.with_base(base) if isinstance(dynamics, Extended) else base


class Extended(EffectsOnMotion):
    """`base` with `effects`, driven by thruster forces.

    As a `Dynamics` it takes a wrench and allocates it to the thrusters with the least effort; lag
    and delay act in `integrate.rollout`. Random states (waves, coloured noise) act where thruster
    forces are commanded: in `rollout`, and in the plant of a diagram.
    """

    @classmethod
    def create(
        cls, base: Dynamics, effects: tuple[Effect, ...], thrusters: Thrusters
    ) -> "Extended":
        """Effects in any order; they apply in the order of their kinds.

        Raises:
            UserError: one acts on a thruster that the vehicle doesn't have.
        """
        t = thrusters
        bare = cls(base, (), t.positions, t.directions, t.inverse)  # pyright: ignore[reportCallIssue]
        return bare.with_effects(effects)

    def with_effects(self, effects: tuple[Effect, ...]) -> "Extended":
        """The same base and thrusters with other effects."""
        fitted = [effect.for_thrusters(self.positions.shape[1]) for effect in effects]
        ordered = tuple(sorted(fitted, key=lambda effect: effect.order))
        return dataclasses.replace(self, effects=ordered)

    def with_base(self, base: Dynamics) -> "Extended":
        """The same effects and thrusters on another base."""
        return dataclasses.replace(self, base=base)

    def with_constants_in_base(self) -> "Extended":
        """The same motion by a Fossen base with other constants and by the effects that are more.

        Effects that refer to the base's mass or drag (the Munk moment, proximity) refer to the
        changed ones then.
        """
        base, rest = self.base, []
        if not isinstance(base, FossenDynamics):
            return self
        for effect in self.effects:
            found = effect.in_constants(base, self.plant)
            base = base if found is None else found
            rest += [effect] if found is None else []
        return self.with_base(base).with_effects(tuple(rest))

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

    # ---------------------------------------------------------------------------- memories

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

    def for_steps_of(self, dt: float) -> "Extended":
        """The same model, its effects with enough memory for steps of `dt` s."""
        return self.with_effects(tuple(e.for_steps_of(dt) for e in self.effects))

    def remember(self, command: Float[Array, "n *batch"]) -> Memory:
        """Steady-state memories under a constant command."""
        return tuple(e.initial(command) for e in self.effects if e.memory_size)

    def actuate(
        self,
        memory: Memory,
        command: Float[Array, "n *#batch"],
        dt: Any,
        substeps: int,
        rise: Float[Array, "n *#batch"] | None = None,
    ) -> tuple[Memory, Float[Array, "n *#batch S"]]:
        """Memories after `dt` s, and mean forces over its substeps.

        The command is held, or the mean of one that changes by `rise` over the step.
        """
        h = jnp.asarray(dt, command.dtype)
        level = over_substeps(command, rise, substeps)
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
