"""The path integral planner in a diagram."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import accumulate, pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ..compiled.jit import Lowered, compiled, require_double, shared, together
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import group, set_groups, value, value_or_zeros
from .mppi_core import Draw, MppiPlanner, MppiState
from .plan import Plan
from .plan_samples import SampleLayout
from .rollouts import Rolled, Situation

FIGURES = (
    "cost",
    "collision_probability",
    "clearance",
    "effective_samples",
    "temperature",
    "valid",
)
"""Components of the output port `figures`, in this order."""


def key_from_gaussians(w: Float[Array, "4"]) -> UInt32[Array, "2"]:
    """A threefry key from the bits of four unit Gaussians (float64, so some 200 random bits)."""
    bits = jax.lax.bitcast_convert_type(w, jnp.uint32).reshape(2, 4)
    return bits[:, 0] ^ bits[:, 1] ^ bits[:, 2] ^ bits[:, 3]


@dataclass(frozen=True, eq=False)
class _Steps:
    """What a call computes, as functions of vectors: draw, roll out every part, choose."""

    planner: MppiPlanner
    samples: SampleLayout

    def draw(self, t: Array, nominal: Array, X: Array, V: Array, bias: Array, noise: Array) -> Draw:
        state = MppiState(nominal.reshape(-1, 6))
        return self.planner.draw(state, key_from_gaussians(noise), X, V, bias, t)

    def roll(self, part: Array, at: Situation) -> Rolled:
        return self.planner.roll(part, at)

    def choose(self, t: Array, draw: Draw, rolled: Sequence[Rolled]) -> Array:
        state, out = self.planner.choose(draw, rolled)
        wide = jax.tree.map(lambda a: a.astype(t.dtype), out)
        layout = self.planner.config.layout
        plan = layout.pack(Plan(t[0], wide.X_WB, wide.V_WB_B, wide.F_Bo_B))
        samples = self.samples.pack(t[0], wide.paths, wide.path_weights)
        plan, samples = jnp.where(out.valid, plan, 0), jnp.where(out.valid, samples, 0)
        figures = jnp.stack([getattr(wide, name) for name in FIGURES])
        return jnp.concatenate([state.F_Bo_B.ravel().astype(t.dtype), plan, samples, figures])


class _Programs:
    """The compiled steps; `roll` has one program for each part (equal parts share it)."""

    def __init__(self, steps: _Steps):
        vector = {n: jax.ShapeDtypeStruct((n,), np.float64) for n in (1, 4, 6, 7)}
        nominal = jax.ShapeDtypeStruct((6 * steps.planner.config.horizon,), np.float64)
        of_draw = vector[1], nominal, vector[7], vector[6], vector[6], vector[4]
        draw = Lowered(steps.draw, *of_draw)
        parts, at = draw.result.parts, draw.result.at
        roll = {part.shape: Lowered(steps.roll, part, at) for part in parts}
        rolled = [roll[part.shape].result for part in parts]
        choose = Lowered(steps.choose, vector[1], draw.result, rolled)
        self.draw, self.choose, *rolling = compiled(draw, choose, *roll.values())
        by_shape = dict(zip(roll, rolling, strict=True))
        self.roll = [by_shape[part.shape] for part in parts]


class Mppi(LeafSystem):
    """Plans every `config.period` with `systems.planning.mppi_core.MppiPlanner`.

    `plan` is laid out by `layout` and `samples` by `samples`; both hold zeros before the first
    call, and `plan` whenever no finite plan was found (a state estimate of NaN, say), which the
    tracking controller reads as "no plan". `F_bias_Bo_W` is an observed wrench with the axes of
    W, zero if not connected. `noise` is redrawn for every call.

    .. pydrake_system::

        name: Mppi
        input_ports:
        - X_WB
        - V_WB_B
        - F_bias_Bo_W
        - noise
        output_ports:
        - plan
        - samples
        - figures

    """

    def __init__(self, planner: MppiPlanner):
        """The planner contains model, limits, task and settings.

        Raises:
            ValueError: if JAX runs in single precision.
        """
        super().__init__()
        require_double()
        config = planner.config
        self.planner = planner
        self.layout = config.layout
        self.samples = SampleLayout(
            config.horizon, config.dt, min(config.shown_paths, config.sequences)
        )
        self._steps = _Steps(planner, self.samples)
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._bias = self.DeclareVectorInputPort("F_bias_Bo_W", 6)
        self._noise = self.DeclareVectorInputPort("noise", 4, RandomDistribution.kGaussian)
        start: Any = self.first_nominal()
        self._nominal = self.DeclareDiscreteState(start)
        self._plan = self.DeclareDiscreteState(self.layout.size)
        self._samples = self.DeclareDiscreteState(self.samples.size)
        self._figures = self.DeclareDiscreteState(len(FIGURES))
        self.DeclareStateOutputPort("plan", self._plan)
        self.DeclareStateOutputPort("samples", self._samples)
        self.DeclareStateOutputPort("figures", self._figures)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)
        sizes = [start.size, self.layout.size, self.samples.size, len(FIGURES)]
        ends = [0, *accumulate(sizes)]
        self._slices = [slice(a, b) for a, b in pairwise(ends)]

    def first_nominal(self) -> Float[np.ndarray, " n"]:
        """The nominal wrenches of the first call."""
        first = eqx.filter_jit(MppiPlanner.init)(self.planner)
        return np.asarray(first.F_Bo_B, float).ravel()

    @cached_property
    def _programs(self) -> _Programs:
        """The compiled steps, shared by equal planners."""
        return shared(partial(_Programs, self._steps))

    def plan(
        self,
        t: float,
        nominal: Float[np.ndarray, " n"],
        X_WB: Float[np.ndarray, "7"],
        V_WB_B: Float[np.ndarray, "6"],
        F_bias_Bo_W: Float[np.ndarray, "6"],
        noise: Float[np.ndarray, "4"],
    ) -> list[Float[np.ndarray, "_"]]:
        """One call at time t (s): the next `nominal`, and the values of the three ports.

        `nominal` holds the wrenches (horizon × 6) planned by the previous call, from its time on.
        """
        programs = self._programs
        now = np.array([t])
        drawn = programs.draw.call(now, nominal, X_WB, V_WB_B, F_bias_Bo_W, noise)
        rolled = together(programs.roll, [(part, drawn.at) for part in drawn.parts])
        flat = np.asarray(programs.choose.call(now, drawn, rolled))
        return [flat[part] for part in self._slices]

    def pure(self) -> Pure:
        """The update as a pure function; all sequences are rolled out in one thread."""

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            now = t[None]
            bias = inputs.get("F_bias_Bo_W", jnp.zeros(6))
            X, V, noise = (inputs[name] for name in ("X_WB", "V_WB_B", "noise"))
            draw = self._steps.draw(now, state[0], X, V, bias, noise)
            rolled = [self._steps.roll(part, draw.at) for part in draw.parts]
            flat = self._steps.choose(now, draw, rolled)
            return {group: flat[part] for group, part in enumerate(self._slices)}

        outputs = {name: shown(1 + i) for i, name in enumerate(("plan", "samples", "figures"))}
        return Pure((Event(self.planner.config.period, update),), outputs, ("noise",))

    def _update(self, context: Context, state: DiscreteValues) -> None:
        values = self.plan(
            context.get_time(),
            group(context, self._nominal),
            value(self._X, context),
            value(self._V, context),
            value_or_zeros(self._bias, context),
            value(self._noise, context),
        )
        set_groups(state, (self._nominal, self._plan, self._samples, self._figures), values)
