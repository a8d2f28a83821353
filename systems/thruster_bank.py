"""From a wrench to eight pulse widths and back to a wrench."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
)

from ..models import integrate
from ..models.thrusters import Thrusters
from .jit import VectorFunction, value_or_none


class ThrustAllocation(LeafSystem):
    """Pulse widths (µs) and thruster forces (N) that give a wanted wrench, without delay.

    A wrench beyond the thrusters' limits is scaled down and keeps its direction. The inverse of the
    thrust curve at the battery's expected voltage steps over the dead band. Wrenches that are not
    finite are refused.

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

        self._allocate = VectorFunction(allocate, [6], [count, count])
        self._F = self.DeclareVectorInputPort("F_Bo_B", 6)
        once = {self._F.ticket()}  # computed anew for another wrench, not for another time
        self.DeclareVectorOutputPort("pwm", count, self._put_pwm, once)
        self.DeclareVectorOutputPort("thruster_force", count, self._put_forces, once)

    def _both(self, context: Context) -> list[np.ndarray]:
        F = np.asarray(self._F.Eval(context))
        if not np.all(np.isfinite(F)):
            raise FloatingPointError(
                f"{self.get_name() or 'ThrustAllocation'}: the wanted wrench at "
                f"t = {context.get_time():.4f} s is not finite: {F}"
            )
        return self._allocate(F)

    def _put_pwm(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._both(context)[0])

    def _put_forces(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._both(context)[1])


class ThrusterBank(LeafSystem):
    """The thrusters themselves: dead band and voltage, start from rest, first-order lag.

    Every `period` the forces move towards the curve's force at the commanded pulse widths (µs) and
    the battery's voltage under load. `voltage` is the open-circuit voltage (V), nominal while
    unconnected. With `pwm` unconnected the thrusters stand still. `voltage_loaded` is what remains
    at the thrusters.

    .. pydrake_system::

        name: ThrusterBank
        input_ports:
        - pwm
        - voltage
        output_ports:
        - F_Bo_B
        - thruster_force
        - voltage_loaded

    """

    def __init__(self, thrusters: Thrusters, period: float = 0.01):
        """Update every `period` seconds.

        Raises:
            ValueError: the period is not positive.
        """
        super().__init__()
        if not (np.isfinite(period) and period > 0):
            raise ValueError(f"period is {period}: give a time above 0 s")
        model = integrate.cast(thrusters, jnp.float64)
        count = model.positions.shape[1]
        self._nominal = np.array([float(model.nominal_voltage)])
        self._neutral = np.full(count, 1500.0)
        self._pwm = self.DeclareVectorInputPort("pwm", count)
        self._voltage = self.DeclareVectorInputPort("voltage", 1)
        sizes = {"F_Bo_B": 6, "thruster_force": count, "voltage_loaded": 1}
        starts = [np.zeros(6), np.zeros(count), self._nominal]
        self._shown = [self.DeclareDiscreteState(start) for start in starts]
        self._waited = self.DeclareDiscreteState(count)
        for name, index in zip(sizes, self._shown, strict=True):
            self.DeclareStateOutputPort(name, index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

        def advance(pwm: Array, voltage: Array, force: Array, waited: Array) -> tuple[Array, ...]:
            loaded = model.loaded_voltage(pwm, voltage[0])
            command = model.force(pwm, loaded)
            force, waited = model.lag_from_rest(force, waited, command, period)
            return model.wrench(force), force, loaded[None], waited

        self._advance = VectorFunction(advance, [count, 1, count, count], [*sizes.values(), count])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        pwm, voltage = value_or_none(self._pwm, context), value_or_none(self._voltage, context)
        state = context.get_discrete_state()
        results = self._advance(
            self._neutral if pwm is None else pwm,
            self._nominal if voltage is None else voltage,
            state.value(1),
            state.value(3),
        )
        for index, value in enumerate(results):
            discrete_state.set_value(index, value)
