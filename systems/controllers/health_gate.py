"""A gate between estimator and controller that withholds the estimate while it is lost."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from ..compiled.pure import Inputs, Output, Pure
from ..drake import put, value, value_or_none

LOST = 2.0
"""State of a filter's health from which on its estimate is unusable."""


class HealthGate(LeafSystem):
    """Passes the estimate through while the filter's `health` is good or degraded; NaN when lost.

    Its readers then treat the state as unknown: planners make no plan and restart afterwards,
    observers keep their estimate, and impedance control commands a zero wrench. A pose that is
    unknown can't be held, and feedback of a wrong state is worse than none: drag brings the vehicle
    to rest, its righting moment keeps it level, and net buoyancy raises it slowly. `health` that
    isn't connected counts as good, one that isn't finite as lost.

    .. pydrake_system::

        name: HealthGate
        input_ports:
        - X_WB
        - V_WB_B
        - health
        output_ports:
        - X_WB
        - V_WB_B

    """

    def __init__(self, size: int = 5):
        """`size` is the length of the filter's health."""
        super().__init__()
        sizes = {"X_WB": 7, "V_WB_B": 6}
        ports = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
        self._health = self.DeclareVectorInputPort("health", size)
        for name, port in ports.items():

            def pass_on(context: Context, output: BasicVector, port=port) -> None:
                health = value_or_none(self._health, context)
                seen = value(port, context)
                known = health is None or health[0] < LOST
                put(output, seen if known else np.full(seen.size, np.nan))

            needs = {port.ticket(), self._health.ticket()}
            self.DeclareVectorOutputPort(name, sizes[name], pass_on, needs)

    def pure(self) -> Pure:
        """The outputs as pure functions."""

        def passed(name: str) -> Output:
            def output(state: object, inputs: Inputs) -> Float[Array, "_"]:
                del state
                if "health" not in inputs:
                    return inputs[name]
                return jnp.where(inputs["health"][0] < LOST, inputs[name], jnp.nan)

            return output

        return Pure((), {name: passed(name) for name in ("X_WB", "V_WB_B")})
