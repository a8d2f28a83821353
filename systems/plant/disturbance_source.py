"""Disturbances as a system: a wrench on the body and the motion of the water around it."""

import numpy as np
from jax import numpy as jnp
from jaxtyping import Array
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ...models import se3
from ...models.disturbances import Disturbance
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import group, set_groups, value_or_none, value_or_zeros


class DisturbanceSource(LeafSystem):
    """Holds the state of a `Disturbance` and outputs its wrench and flow.

    The update at time t computes the outputs that readers use on [t + period, t + 2 period): state
    and outputs are those of t + period, at the pose extrapolated with the present twist. At
    initialisation `initial_noise` gives the random start (phases, first values), `noise` the first
    advance; later updates read `noise` alone. `flow_W` is the velocity (m/s) and acceleration
    (m/s²) of the water at Bo, in W. Unconnected inputs count as zero, an unconnected pose as the
    identity.

    .. pydrake_system::

        name: DisturbanceSource
        input_ports:
        - X_WB
        - V_WB_B
        - noise
        - initial_noise
        output_ports:
        - F_disturbance_Bo_B
        - flow_W

    """

    def __init__(self, disturbance: Disturbance, period: float = 0.01):
        """Advance `disturbance` every `period` seconds.

        Raises:
            ValueError: `period` is not positive.
        """
        super().__init__()
        if not (np.isfinite(period) and period > 0):
            raise ValueError(f"period is {period}: give a time above 0 s")
        gaussian = RandomDistribution.kGaussian
        sizes = disturbance.noise_size, disturbance.initial_noise_size
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._noise = self.DeclareVectorInputPort("noise", sizes[0], gaussian)
        self._initial_noise = self.DeclareVectorInputPort("initial_noise", sizes[1], gaussian)
        self._state = self.DeclareDiscreteState(disturbance.state_size)
        self._wrench = self.DeclareDiscreteState(6)
        self._water = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("F_disturbance_Bo_B", self._wrench)
        self.DeclareStateOutputPort("flow_W", self._water)
        self.DeclareInitializationDiscreteUpdateEvent(self._initialise)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

        def advance(
            X: Array, V: Array, when: Array, noise: Array, state: Array
        ) -> tuple[Array, Array, Array]:
            X, t = se3.retract(X, V * when[1]), when[0] + when[1]
            state = disturbance.advance(state, X, V, t, period, noise)
            flow = disturbance.flow(state, X, t)
            wrench = disturbance.wrench(state, X, V, t, flow)
            return state, wrench, jnp.concatenate([flow.v_WC_W, flow.a_WC_W])

        size = disturbance.state_size
        self._period = period
        self._function = advance
        self._start = VectorFunction(disturbance.initial, [sizes[1]], [size])
        self._advance = VectorFunction(advance, [7, 6, 2, sizes[0], size], [size, 6, 6])

    def pure(self) -> Pure:
        """The update as a pure function."""

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            X = inputs.get("X_WB", se3.identity(t.dtype))
            V = inputs.get("V_WB_B", jnp.zeros(6))
            noise = inputs.get("noise", jnp.zeros(self._noise.size()))
            when = jnp.stack([t, jnp.full_like(t, self._period)])
            return dict(enumerate(self._function(X, V, when, noise, state[0])))

        outputs = {"F_disturbance_Bo_B": shown(1), "flow_W": shown(2)}
        return Pure((Event(self._period, update),), outputs, ("noise",))

    def _initialise(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._start.flat(value_or_zeros(self._initial_noise, context))
        self._move(context, discrete_state, state, 0.0)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        self._move(context, discrete_state, group(context, 0), self._period)

    def _move(
        self, context: Context, discrete_state: DiscreteValues, state: np.ndarray, ahead: float
    ) -> None:
        """Advance the state over the period that begins `ahead` (s) from now; set the outputs."""
        X = value_or_none(self._X, context)
        if X is None:
            X = np.array([1.0, 0, 0, 0, 0, 0, 0])
        V = value_or_zeros(self._V, context)
        when = np.array([context.get_time(), ahead])
        result = self._advance.flat(X, V, when, value_or_zeros(self._noise, context), state)
        set_groups(discrete_state, range(3), (result[:-12], result[-12:-6], result[-6:]))
