"""A reference for the tracking controller from a given path, without a planner."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.integrate import cast
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import set_groups, value_or_zeros
from .paths import Motion, Path
from .plan import Plan, PlanLayout


def feedforward(
    dynamics: Dynamics, motion: Motion, F_bias_Bo_W: Float[Array, "6"]
) -> Float[Array, "6 n"]:
    """The wrench that makes a model follow a motion in still water: inverse dynamics.

    F = M ξ̇ − ad*_ξ(M ξ) + D ξ + D^f |ξ|ξ − F_V(g) − F_bias (see `models.dynamics`).
    """
    X, V = motion.X_WB, motion.V_WB_B
    c = dynamics.coefficients(V)
    F = c.mass.matvec(motion.A_WB_B) - se3.coad_apply(V, c.mass.matvec(V))
    F = F - dynamics.drag_wrench(V, c) - dynamics.potential_wrench(X)
    parts = [se3.rotate_inverse(X, part) for part in (F_bias_Bo_W[:3], F_bias_Bo_W[3:])]
    return F - jnp.concatenate(parts)


def _planned(
    path: Path, model: Dynamics | None, layout: PlanLayout, t: Array, bias: Array
) -> Array:
    """The path's motion from t on, as a plan."""
    motion = path.motion(t + layout.dt * jnp.arange(layout.horizon + 1, dtype=t.dtype))
    if model is None:
        X = motion.X_WB
        F = -jnp.concatenate([se3.rotate_inverse(X, bias[:3]), se3.rotate_inverse(X, bias[3:])])
    else:
        F = feedforward(model, motion, bias)
    return layout.pack(Plan(t[0], motion.X_WB, motion.V_WB_B, F[:, :-1]))


class Reference(LeafSystem):
    """Outputs a path's next states every `period`, in the same `plan` vector as a planner's.

    The wrenches are the model's inverse dynamics along the path less the observed bias
    `F_bias_Bo_W` (axes of W, zero if not connected); without a model they only counter the bias.

    .. pydrake_system::

        name: Reference
        input_ports:
        - F_bias_Bo_W
        output_ports:
        - plan

    """

    def __init__(
        self,
        path: Path,
        dynamics: Dynamics | None = None,
        layout: PlanLayout | None = None,
        period: float = 0.2,
    ):
        """`layout` is 1 s at 20 Hz unless given.

        Raises:
            ValueError: `period` is not positive, or a plan ends before the next one comes.
        """
        super().__init__()
        self.layout = PlanLayout(20, 0.05) if layout is None else layout
        length = self.layout.horizon * self.layout.dt
        if not 0 < period <= length:
            raise ValueError(
                f"period is {period} s: give one above 0 and up to the plan's {length} s"
            )
        self.path, self.period = path, period
        self._bias = self.DeclareVectorInputPort("F_bias_Bo_W", 6)
        self._plan = self.DeclareDiscreteState(self.layout.size)
        self.DeclareStateOutputPort("plan", self._plan)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        model = None if dynamics is None else cast(dynamics, jnp.float64)
        self._call = partial(_planned, path, model, self.layout)
        self._step = VectorFunction(self._call, [1, 6], [self.layout.size])

    def pure(self) -> Pure:
        """The update as a pure function."""

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            del state
            return {0: self._call(t[None], inputs.get("F_bias_Bo_W", jnp.zeros(6)))}

        return Pure((Event(self.period, update),), {"plan": shown(0)})

    def _update(self, context: Context, state: DiscreteValues) -> None:
        bias = value_or_zeros(self._bias, context)
        set_groups(state, [self._plan], self._step(np.array([context.get_time()]), bias))
