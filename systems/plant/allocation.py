"""From a wrench to pulse widths."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from ...models import integrate
from ...models.thrusters import Thrusters
from ..compiled.jit import VectorFunction
from ..compiled.pure import Inputs, Pure, State
from ..drake import put, value


class ThrustAllocation(LeafSystem):
    """Pulse widths (µs) and thruster forces (N) for a commanded wrench, without delay.

    A wrench beyond the thrusters' limits is scaled down and keeps its direction. The inverse of the
    thrust curve at the battery's expected voltage skips the dead band. Wrenches that are not finite
    are rejected.

    .. pydrake_system::

        name: ThrustAllocation
        input_ports:
        - F_Bo_B
        output_ports:
        - pwm
        - thruster_force

    """

    def __init__(self, thrusters: Thrusters, voltage: float | None = None):
        """Allocate for a battery voltage (V), the thrusters' nominal one if left out.

        Raises:
            ValueError: the voltage is not positive.
        """
        super().__init__()
        if voltage is not None and not (np.isfinite(voltage) and voltage > 0):
            raise ValueError(f"voltage is {voltage}: give the battery's voltage in V")
        model = integrate.cast(thrusters, jnp.float64)
        count = model.positions.shape[1]

        def allocate(F_Bo_B: Array) -> tuple[Array, Array]:
            force = model.allocate(F_Bo_B, voltage)
            return model.pwm(force, voltage), force

        self._function = allocate
        self._allocate = VectorFunction(allocate, [6], [count, count])
        self._F = self.DeclareVectorInputPort("F_Bo_B", 6)
        once = {self._F.ticket()}  # depends on the wrench, not on time
        self.DeclareVectorOutputPort("pwm", count, self._put_pwm, once)
        self.DeclareVectorOutputPort("thruster_force", count, self._put_forces, once)

    def pure(self) -> Pure:
        """Both outputs as pure functions."""

        def output(index: int):
            def put(state: State, inputs: Inputs) -> Array:
                del state
                return self._function(inputs["F_Bo_B"])[index]

            return put

        return Pure((), {"pwm": output(0), "thruster_force": output(1)})

    def _both(self, context: Context) -> np.ndarray:
        F = value(self._F, context)
        if not np.isfinite(F).all():
            raise FloatingPointError(
                f"{self.get_name() or 'ThrustAllocation'}: the wanted wrench at "
                f"t = {context.get_time():.4f} s is not finite: {F}"
            )
        return self._allocate.flat(F)

    def _put_pwm(self, context: Context, output: BasicVector) -> None:
        put(output, self._both(context)[: output.size()])

    def _put_forces(self, context: Context, output: BasicVector) -> None:
        put(output, self._both(context)[output.size() :])


class PulseWidths(LeafSystem):
    """Pulse widths (µs) from outside in the place of an allocation, where an autopilot has its own.

    .. pydrake_system::

        name: PulseWidths
        input_ports:
        - pwm
        output_ports:
        - pwm

    """

    def __init__(self, thrusters: Thrusters):
        super().__init__()
        count = thrusters.positions.shape[1]
        self._pwm = self.DeclareVectorInputPort("pwm", count)
        self.DeclareVectorOutputPort("pwm", count, self._put, {self._pwm.ticket()})

    def _put(self, context: Context, output: BasicVector) -> None:
        put(output, value(self._pwm, context))
