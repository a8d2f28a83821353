"""The path integral planner in a diagram."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from .jit import VectorFunction, value_or_zeros
from .mppi_core import MppiPlanner, MppiState
from .plan import Plan
from .plan_samples import SampleLayout

FIGURES = (
    "cost",
    "collision_probability",
    "clearance",
    "effective_samples",
    "temperature",
    "valid",
)
"""What the output port `figures` holds, in this order."""


def key_from_gaussians(w: Float[Array, "4"]) -> UInt32[Array, "2"]:
    """A threefry key from the bits of four unit Gaussians (float64, so some 200 random bits)."""
    bits = jax.lax.bitcast_convert_type(w, jnp.uint32).reshape(2, 4)
    return bits[:, 0] ^ bits[:, 1] ^ bits[:, 2] ^ bits[:, 3]


class Mppi(LeafSystem):
    """Plans every `config.period` with `systems.mppi_core.MppiPlanner`.

    `plan` is laid out by `layout` and `samples` by `samples`; both hold zeros before the first
    call, and `plan` whenever no finite plan was found (a state estimate of NaN, say), which the
    tracking controller takes for "no plan". `F_bias_Bo_W` is an observed wrench with the axes of
    W, zero if not connected. `noise` is drawn anew for every call.

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
        """The planner brings model, limits, obstacles, goal and settings."""
        super().__init__()
        config = planner.config
        self.planner = planner
        self.layout = config.layout
        self.samples = SampleLayout(
            config.horizon, config.dt, min(config.shown_paths, config.sequences)
        )
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._bias = self.DeclareVectorInputPort("F_bias_Bo_W", 6)
        self._noise = self.DeclareVectorInputPort("noise", 4, RandomDistribution.kGaussian)
        first = eqx.filter_jit(MppiPlanner.init)(planner)
        start: Any = np.asarray(first.F_Bo_B, float).ravel()
        self._nominal = self.DeclareDiscreteState(start)
        self._plan = self.DeclareDiscreteState(self.layout.size)
        self._samples = self.DeclareDiscreteState(self.samples.size)
        self._figures = self.DeclareDiscreteState(len(FIGURES))
        self.DeclareStateOutputPort("plan", self._plan)
        self.DeclareStateOutputPort("samples", self._samples)
        self.DeclareStateOutputPort("figures", self._figures)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)
        sizes = [start.size, self.layout.size, self.samples.size, len(FIGURES)]
        self._step = VectorFunction(self._call, [1, start.size, 7, 6, 6, 4], sizes)

    def _call(self, t: Array, nominal: Array, X: Array, V: Array, bias: Array, noise: Array):
        planner = self.planner
        single = planner.V_goal.dtype
        state = MppiState(nominal.reshape(-1, 6).astype(single))
        state, out = planner.step(state, key_from_gaussians(noise), X, V, bias)
        wide = jax.tree.map(lambda a: a.astype(t.dtype), out)
        vector = self.layout.pack(Plan(t[0], wide.X_WB, wide.V_WB_B, wide.F_Bo_B))
        samples = self.samples.pack(t[0], wide.paths, wide.path_weights)
        return (
            state.F_Bo_B.ravel().astype(t.dtype),
            jnp.where(out.valid, vector, 0),
            jnp.where(out.valid, samples, 0),
            jnp.stack([getattr(wide, name) for name in FIGURES]),
        )

    def _update(self, context: Context, state: DiscreteValues) -> None:
        nominal, plan, samples, figures = self._step(
            np.array([context.get_time()]),
            context.get_discrete_state(self._nominal).value(),
            self._X.Eval(context),
            self._V.Eval(context),
            value_or_zeros(self._bias, context),
            self._noise.Eval(context),
        )
        state.set_value(self._nominal, nominal)
        state.set_value(self._plan, plan)
        state.set_value(self._samples, samples)
        state.set_value(self._figures, figures)
