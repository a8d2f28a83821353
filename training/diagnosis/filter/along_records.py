"""Motion of a model along recorded runs, which predictions, forecasts and simulations share.

Actuators settle under the commands before a run (`AlongRecords.init`). The motion starts at a
record, and again at later ones (`restart`); it advances by recorded steps under recorded commands
(`step`, `scan`); it is seen as instruments record it (`observe`). Positions that a recorder has
dead-reckoned are seen as integrals of the velocity and attitude that instruments show.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ....models import se3
from ....models.dynamics import Memory
from ....models.effects.deterministic_step import advance
from ....models.effects.extended import Extended, Random
from ....models.effects.inertia import Inertia
from ....models.effects.recent import Recent
from ..data.arrays import Data
from .varying import Modulated, at_sample

Out = TypeVar("Out")
SUBSTEPS, LONGEST = 2, 0.0125
"""Fewest substeps of a step, and their greatest length (s): drag is stiff in fast turns."""


def substeps(longest: float) -> int:
    """Substeps of predictions over steps of up to `longest` s."""
    return max(SUBSTEPS, math.ceil(longest / LONGEST - 1e-6))


class Records(NamedTuple):
    """The arrays of `Data` that compiled programs take; equal steps are one column, (N, 1)."""

    X: Float[Array, "M 7 *R"]
    V: Float[Array, "M 6 *R"]
    u: Float[Array, "N n *R"]
    voltage: Float[Array, "N *R"]
    step: Float[Array, "N *_"]
    past: Float[Array, "P n *R"]
    past_step: Float[Array, "P *_"]
    rise: Float[Array, "N n *R"] | None = None

    @classmethod
    def of(cls, data: Data, pieces: Int[np.ndarray, " K"] | slice = slice(None)) -> "Records":
        """Those of some pieces, by default of all."""
        now = (a[..., pieces] for a in (data.X, data.V, data.u, data.voltage))
        steps = data.own_steps(pieces), data.past_steps(pieces)
        arrays = (*now, steps[0], data.past[..., pieces], steps[1])
        rise = None if data.rise is None else jnp.asarray(data.rise[..., pieces])
        X, V, u, voltage, step, past, past_step = (jnp.asarray(a) for a in arrays)
        return cls(X, V, u, voltage, step, past, past_step, rise)

    def in_lanes(self) -> "Records":
        """The same with an axis for lanes, which are simulated side by side, before the pieces."""
        return jax.tree.map(lambda a: a[..., None, :], self)


class Step(NamedTuple):
    """One recorded step of all pieces.

    Attributes:
        number: of the step, from 0.
        X, V: recorded at its start.
        X_next, V_next: recorded at its end.
        command: thruster forces (N).
        before: those of the step before.
        voltage: relative to the nominal one.
        length: of the step (s).
        rise: change of the command over the step (N), which is then the mean; None if it is held.
    """

    number: Int[Array, ""]
    X: Float[Array, "7 *R"]
    V: Float[Array, "6 *R"]
    X_next: Float[Array, "7 *R"]
    V_next: Float[Array, "6 *R"]
    command: Float[Array, "n *R"]
    before: Float[Array, "n *R"]
    voltage: Float[Array, "1 *R"]
    length: Float[Array, "1 *_"]
    rise: Float[Array, "n *R"] | None = None


class State(NamedTuple):
    """State of a model: actuators, pose, twist, its history, random states of effects.

    `position_error` is that of a dead-reckoned position (m, in W).
    """

    memory: Memory
    X: Float[Array, "7 *b"]
    V: Float[Array, "6 *b"]
    recent: Recent
    position_error: Float[Array, "3 *b"]
    random: Random = ()


class AlongRecords(eqx.Module):
    """A model as it moves along records, in `substeps` of each recorded step.

    Attributes:
        changes: of its effects in parts of the records, for `at`.
        reckoned: axes of W whose position is dead-reckoned (`Data.reckoned`).
    """

    model: Extended
    inertia: Inertia
    substeps: int = eqx.field(static=True)
    changes: tuple[Modulated, ...] = ()
    reckoned: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        model: Extended,
        substeps: int,
        changes: tuple[Modulated, ...] = (),
        reckoned: tuple[int, ...] = (),
    ) -> "AlongRecords":
        return cls(model, model.inertia(), substeps, changes, reckoned if model.reads else ())

    def at(self, number: Int[Array, ""] | int) -> "AlongRecords":
        """With the effects as they are at a sample."""
        if not self.changes:
            return self
        return replace(self, model=at_sample(self.model, self.changes, number))

    def init(self, records: Records, lanes: int | None = None) -> State:
        """At the first record, with settled actuators and under constant acceleration.

        With `lanes` the records are those of `in_lanes`.
        """
        pieces = records.V.shape[-1]
        batch = (pieces,) if lanes is None else (lanes, pieces)

        def spread(a: Array) -> Array:
            return jnp.broadcast_to(a, (*a.shape[: a.ndim - len(batch)], *batch))

        past, X, V = (spread(a) for a in (records.past, records.X[0], records.V[0]))
        memory = settle(self.model, past, records.past_step[:, None])
        step = records.step[:1]
        level = self.model.actuate(memory, past[-1], step, 1)[1][..., 0]
        rate = self.model.drift(self.inertia, X, V, level, records.voltage[:1])
        return State(memory, X, V, Recent.steady(rate, step), jnp.zeros_like(V[:3]))

    def restart(self, state: State, X: Array, V: Array, when: Array | None = None) -> State:
        """At a record of pose and twist (`when` true): what instruments read without noise.

        What delayed instruments do not show yet happened under earlier commands.
        """
        X_true, V_true = self.model.infer(X, V, state.recent)
        fresh = X_true, V_true, X[4:] - X_true[4:]
        if when is not None:
            old = state.X, state.V, state.position_error
            fresh = tuple(jnp.where(when, a, b) for a, b in zip(fresh, old, strict=True))
        return state._replace(X=fresh[0], V=fresh[1], position_error=fresh[2])

    def step(self, state: State, given: Step, push: Float[Array, "6 *b"] | None = None) -> State:
        """After a recorded step, under a wrench `push` in addition."""
        memory, X, V, rates = advance(
            self.model, self.inertia, state.memory, state.X, state.V, given.command, given.length,
            self.substeps, given.voltage, push, given.rise,
        )  # fmt: skip
        recent = state.recent.after(Recent.over(state.V, V, rates, given.length))
        end = state._replace(memory=memory, X=X, V=V, recent=recent)
        if not self.reckoned:
            return end
        gained = given.length / 2 * (self._velocity_error(state) + self._velocity_error(end))
        return end._replace(position_error=state.position_error + gained)

    def observe(self, state: State) -> tuple[Float[Array, "7 *b"], Float[Array, "6 *b"]]:
        """Pose and twist as they are recorded, without noise."""
        X, V = self.model.observe(state.X, state.V, state.recent)
        if not self.reckoned:
            return X, V
        return with_position(X, state.X[4:] + state.position_error, self.reckoned), V

    def _velocity_error(self, state: State) -> Float[Array, "3 *b"]:
        """Recorded velocity in W by the recorded attitude, less the true one (m/s)."""
        X, V = self.model.observe(state.X, state.V, state.recent)
        return se3.rotate(X, V[:3]) - se3.rotate(state.X, state.V[:3])


def with_position(
    X: Float[Array, "7 *b"], p: Float[Array, "3 *b"], axes: tuple[int, ...]
) -> Float[Array, "7 *b"]:
    """The pose with another position along some axes of W."""
    rows = [4 + i for i in axes]
    return X.at[jnp.array(rows)].set(p[jnp.array(axes)])


def scan(step: Callable[[State, Step], tuple[State, Out]], state: State, records: Records) -> Out:
    """Results of all recorded steps, stacked."""
    X, V, u, voltage, length, past, _, rise = records
    before = jnp.concatenate([past[-1:], u[:-1]])
    ends = X[:-1], V[:-1], X[1:], V[1:]
    steps = Step(jnp.arange(len(u)), *ends, u, before, voltage[:, None], length[:, None], rise)
    return jax.lax.scan(step, state, steps)[1]


def settle(model: Extended, past: Float[Array, "P n *batch"], step: Array) -> Memory:
    """Actuator states after commands, each held for a `step` (s); steady under the first before."""
    memory = model.remember(past[0])
    if not memory:
        return ()

    def after(memory: Memory, given: tuple[Array, Array]) -> tuple[Memory, None]:
        return model.actuate(memory, *given, 1)[0], None

    shapes = jax.eval_shape(lambda m: after(m, (past[0], step[0]))[0], memory)
    memory = tuple(jnp.broadcast_to(m, s.shape) for m, s in zip(memory, shapes, strict=True))
    return jax.lax.scan(after, memory, (past, step))[0]
