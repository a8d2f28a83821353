"""Observes the steady wrench that is not in the model: a current, a tether, ballast."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.integrate import cast
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import group, set_groups, value


class ObserverState(eqx.Module):
    """Bias, and the observer's inputs at its last call; `seen` is 0 before the first."""

    F_bias_Bo_W: Float[Array, "6"]
    X_WB: Float[Array, "7"]
    V_WB_B: Float[Array, "6"]
    F_Bo_B: Float[Array, "6"]
    seen: Float[Array, ""]


class MomentumObserver(eqx.Module):
    """Low-pass filtered difference between the observed motion and the model's.

    Over one period the model without disturbance accelerates by a(X, ξ, F); the disturbance wrench
    is M(ξ) ((ξ⁺ − ξ)/dt − a), a discrete form of the generalised-momentum observer (De Luca and
    Mattone 2003). Expressed in W, the wrench of a current or a tether changes slowly even while the
    vehicle turns; a first-order low-pass of `time_constant` removes noise and waves. `limit`
    (N, N·m) bounds the norms of its force and of its moment.
    """

    dynamics: Dynamics
    time_constant: float = eqx.field(static=True)
    limit: tuple[float, float] = eqx.field(static=True)

    def __init__(
        self,
        dynamics: Dynamics,
        time_constant: float = 1.5,
        limit: tuple[float, float] = (60.0, 5.0),
        dtype: jnp.dtype | type = float,
    ):
        """Model and filter.

        Raises:
            ValueError: the time constant or a limit is not positive.
        """
        if not (time_constant > 0 and min(limit) > 0):
            raise ValueError(f"time constant {time_constant} and limits {limit} must be positive")
        self.dynamics = cast(dynamics, dtype)
        self.time_constant, self.limit = time_constant, limit

    def init(self, dtype: jnp.dtype | type = float) -> ObserverState:
        """The state before the first call: zero bias."""
        zero = jnp.zeros(6, dtype)
        return ObserverState(zero, se3.identity(dtype), zero, zero, jnp.zeros((), dtype))

    def step(
        self,
        state: ObserverState,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        F_Bo_B: Float[Array, "6"],
        dt: float,
    ) -> ObserverState:
        """Take in the state and the wrench that acts from now on; `dt` (s) since the last call."""
        X, V = state.X_WB, state.V_WB_B
        c = self.dynamics.coefficients(V)
        expected = self.dynamics.acceleration(X, V, state.F_Bo_B, None, c)
        rest = c.mass.matvec((V_WB_B - V) / dt - expected)
        rest = jnp.concatenate([se3.rotate(X, rest[:3]), se3.rotate(X, rest[3:])])
        gain = state.seen * (1 - np.exp(-dt / self.time_constant).item())
        bias = state.F_bias_Bo_W + gain * (rest - state.F_bias_Bo_W)
        parts = []
        for part, limit in zip((bias[:3], bias[3:]), self.limit, strict=True):
            norm = jnp.sqrt(jnp.sum(part * part) + jnp.finfo(part.dtype).tiny)
            parts.append(part * jnp.minimum(1, limit / norm))
        bias = jnp.concatenate(parts)
        bias = jnp.where(jnp.all(jnp.isfinite(bias)), bias, state.F_bias_Bo_W)
        finite = jnp.all(jnp.isfinite(jnp.concatenate([X_WB, V_WB_B, F_Bo_B])))
        seen = finite.astype(bias.dtype)
        keep = lambda a, b: jnp.where(finite, a, b)  # noqa: E731
        return ObserverState(bias, keep(X_WB, X), keep(V_WB_B, V), keep(F_Bo_B, state.F_Bo_B), seen)


def _observed(
    observer: MomentumObserver,
    period: float,
    bias: Array,
    memory: Array,
    X: Array,
    V: Array,
    F: Array,
) -> tuple[Array, Array]:
    state = ObserverState(bias, memory[:7], memory[7:13], memory[13:19], memory[19])
    new = observer.step(state, X, V, F, period)
    memory = jnp.concatenate([new.X_WB, new.V_WB_B, new.F_Bo_B, new.seen.reshape(1)])
    return new.F_bias_Bo_W, memory


class DisturbanceObserver(LeafSystem):
    """Runs a `MomentumObserver` every `period` on the estimated state and the commanded wrench.

    .. pydrake_system::

        name: DisturbanceObserver
        input_ports:
        - X_WB
        - V_WB_B
        - F_Bo_B
        output_ports:
        - F_bias_Bo_W

    """

    def __init__(self, observer: MomentumObserver, period: float = 0.05):
        """`period` is that of the state estimates."""
        super().__init__()
        if not period > 0:
            raise ValueError(f"period is {period}: give a time above 0 s")
        self.observer, self.period = observer, period
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._F = self.DeclareVectorInputPort("F_Bo_B", 6)
        self._bias = self.DeclareDiscreteState(6)
        start: Any = np.zeros(20)
        start[0] = 1.0
        self._memory = self.DeclareDiscreteState(start)
        self.DeclareStateOutputPort("F_bias_Bo_W", self._bias)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self._call = partial(_observed, observer, period)
        self._step = VectorFunction(self._call, [6, 20, 7, 6, 6], [6, 20])

    def pure(self) -> Pure:
        """The update as a pure function."""

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            del t
            given = [inputs[name] for name in ("X_WB", "V_WB_B", "F_Bo_B")]
            return dict(enumerate(self._call(*state, *given)))

        return Pure((Event(self.period, update),), {"F_bias_Bo_W": shown(0)})

    def _update(self, context: Context, state: DiscreteValues) -> None:
        groups = (self._bias, self._memory)
        held = [group(context, index) for index in groups]
        seen = [value(port, context) for port in (self._X, self._V, self._F)]
        set_groups(state, groups, self._step(*held, *seen))
