"""The vehicle as a discrete-time system around any model of its dynamics."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from pydrake.common import RandomDistribution
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ...models import integrate
from ...models.dynamics import Dynamics, Flow
from ...models.effects.extended import Extended
from ...models.effects.stepping import Stepper
from ...models.thruster_curves import NEUTRAL
from ...models.thrusters import Thrusters
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import group, put, set_groups, value, value_or_none, value_or_zeros


class LearnedPlant(LeafSystem):
    """Steps a `Dynamics` (physics or learned) with `substeps` Lie-group steps every `period`.

    One update is `models.integrate.step` repeated: X ← X exp(h ξ), ξ ← ξ + h a + Heun noise, with
    h = period / substeps and dW = √h · `noise`. Wrenches are held over the period; the water's
    velocity changes with its acceleration. `A_WB_B` is the mean rate of the components of `V_WB_B`
    over the last period, as an accelerometer measures it. Unconnected inputs count as zero. The
    state at time t is the output at t, before that time's update.

    With `thrusters` the update at t first advances their forces over [t, t + period] towards those
    of the thrust curve at the pulse widths `pwm` (µs) and the battery's voltage under load
    (`Thrusters.lag_from_rest`); the mean of the forces at both ends (without a lag, the force at
    the end) acts on the body in addition to `F_Bo_B`. `voltage` is the battery's open-circuit
    voltage (V), nominal while unconnected; with `pwm` unconnected the thrusters are stopped.
    `thruster_force` (N) and `voltage_loaded` (V), the voltage under load, are those of the end of
    the last period. These four ports exist with thrusters only.

    A model with effects (`models.effects.extended.Extended`) is simulated with all of them: those
    on thrusters act on each thruster's force, with the voltage under load (`F_Bo_B` is allocated to
    thruster forces of least effort, a disturbance bypasses the thrusters); memories and random
    states are part of the state, and `noise` includes the draws of random states, which start from
    their stationary distribution. `thruster_lag` replaces the thrusters' own lag. `X_WB_seen` and
    `V_WB_B_seen` are pose and twist as measured through the effects on instruments.

    .. pydrake_system::

        name: LearnedPlant
        input_ports:
        - F_Bo_B
        - F_disturbance_Bo_B
        - flow_W
        - noise
        - pwm
        - voltage
        output_ports:
        - X_WB
        - V_WB_B
        - A_WB_B
        - state
        - X_WB_seen
        - V_WB_B_seen
        - thruster_force
        - voltage_loaded

    """

    def __init__(
        self,
        dynamics: Dynamics,
        period: float = 0.01,
        substeps: int = 2,
        X0_WB: ArrayLike | None = None,
        V0_WB_B: ArrayLike | None = None,
        thrusters: Thrusters | None = None,
    ):
        """Start at pose `X0_WB` (the identity) with twist `V0_WB_B` (at rest), thrusters at rest.

        Raises:
            ValueError: `period` or `substeps` is not positive, or the start is not a state.
        """
        super().__init__()
        if not (np.isfinite(period) and period > 0):
            raise ValueError(f"period is {period}: give a time above 0 s")
        if substeps < 1:
            raise ValueError(f"substeps is {substeps}: give at least 1")
        self.period = period
        self.substeps = substeps
        X0 = np.array([1.0, 0, 0, 0, 0, 0, 0]) if X0_WB is None else X0_WB
        X0, V0 = check_state(X0, np.zeros(6) if V0_WB_B is None else V0_WB_B)

        self._F = self.DeclareVectorInputPort("F_Bo_B", 6)
        self._F_disturbance = self.DeclareVectorInputPort("F_disturbance_Bo_B", 6)
        self._flow = self.DeclareVectorInputPort("flow_W", 6)
        gaussian = RandomDistribution.kGaussian
        model = integrate.cast(dynamics, jnp.float64)
        extended = isinstance(model, Extended)
        self._effects = effects = Stepper(model, period, substeps) if extended else None
        draws = substeps * (6 if effects is None else effects.gaussians)
        self._noise = self.DeclareVectorInputPort("noise", draws, gaussian)
        self._X = self.DeclareDiscreteState(BasicVector(X0.tolist()))
        self._V = self.DeclareDiscreteState(BasicVector(V0.tolist()))
        self._A = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("X_WB", self._X)
        self.DeclareStateOutputPort("V_WB_B", self._V)
        self.DeclareStateOutputPort("A_WB_B", self._A)
        self.DeclareVectorOutputPort("state", 13, self._calc_state, {self.xd_ticket()})
        self._declare_seen()
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self._thrusters = None if thrusters is None else integrate.cast(thrusters, jnp.float64)
        bank = self._declare_thrusters(self._thrusters) if self._thrusters is not None else []

        carried = []
        if effects is not None and effects.start.size:
            self.DeclareDiscreteState(BasicVector(np.array(effects.start, float).tolist()))
            carried = [effects.start.size]

        sizes = [7, 6, 6, 6, draws, *bank, *carried]
        results = [7, 6, 6, 1, *bank[2:], *carried]
        self._steps = self._step(model, False), self._step(model, True)
        self._still = VectorFunction(self._steps[0], sizes, results)
        self._flowing = VectorFunction(self._steps[1], [*sizes, 6], results)

    def _declare_seen(self) -> None:
        """Add the ports of the state as measured through the effects on instruments."""
        if self._effects is None or not self._effects.reads:
            self.DeclareStateOutputPort("X_WB_seen", self._X)
            self.DeclareStateOutputPort("V_WB_B_seen", self._V)
            return
        see = VectorFunction(self._effects.seen, [7, 6, 6], [7, 6])
        for name, size, part in (("X_WB_seen", 7, slice(0, 7)), ("V_WB_B_seen", 6, slice(7, 13))):

            def show(context: Context, output: BasicVector, part: slice = part) -> None:
                put(output, see.flat(*(group(context, i) for i in range(3)))[part])

            self.DeclareVectorOutputPort(name, size, show, {self.xd_ticket()})

    def _declare_thrusters(self, thrusters: Thrusters) -> list[int]:
        """Add the thrusters' ports and state; sizes of pwm, of voltage, and of the state."""
        n = len(thrusters.motor_directions)
        self._nominal = np.array([float(thrusters.nominal_voltage)])
        self._neutral = np.full(n, NEUTRAL)
        self._pwm = self.DeclareVectorInputPort("pwm", n)
        self._voltage = self.DeclareVectorInputPort("voltage", 1)
        start = np.concatenate([np.zeros(2 * n), self._nominal])
        self._bank = self.DeclareDiscreteState(BasicVector(start.tolist()))
        for name, part in (("thruster_force", slice(0, n)), ("voltage_loaded", slice(2 * n, None))):

            def show(context: Context, output: BasicVector, part: slice = part) -> None:
                put(output, group(context, self._bank)[part])

            size = len(start[part])
            self.DeclareVectorOutputPort(name, size, show, {self.xd_ticket()})
        return [n, 1, 2 * n + 1]

    def _step(self, model: Dynamics, flowing: bool) -> Callable[..., tuple[Array, ...]]:
        """One update as a pure function of the vectors that `_update` gathers."""
        period, substeps, thrusters = self.period, self.substeps, self._thrusters
        h = period / substeps

        effects = self._effects
        nominal = self._nominal if thrusters is not None else np.ones(1)
        lags = effects is None or not effects.lags

        def turn(pwm: Array, voltage: Array, bank: Array) -> tuple[Array, Array]:
            """The thrusters' mean forces over the period and their state at its end."""
            assert thrusters is not None
            before, waited = bank[: pwm.size], bank[pwm.size : 2 * pwm.size]
            loaded = thrusters.loaded_voltage(pwm, voltage[0])
            mean = after = thrusters.force(pwm, loaded)
            if lags:
                after, waited = thrusters.lag_from_rest(before, waited, after, period)
                mean = jnp.where(thrusters.time_constant > 0, (before + after) / 2, after)
            return mean, jnp.concatenate([after, waited, loaded[None]])

        def advance(
            X: Array, V: Array, F: Array, F_disturbance: Array, noise: Array, *more: Array
        ) -> tuple[Array, ...]:
            start, force, bank = V, None, ()
            if thrusters is not None:
                force, *bank = turn(*more[:3])
            water = [None] * substeps
            if flowing:
                flow, more = more[-1], more[:-1]
                water = [Flow(flow[:3] + s * h * flow[3:], flow[3:]) for s in range(substeps)]
            noise = noise.reshape(substeps, -1)
            if effects is None:
                F = F + F_disturbance
                F = F if force is None or thrusters is None else F + thrusters.wrench(force)
                for s in range(substeps):
                    X, V = integrate.step(model, X, V, F, h, h**0.5 * noise[s], water[s])
                carried = ()
            else:
                level = effects.model.inverse @ F
                level = level if force is None else level + force
                volts = bank[0][-1:] / nominal if bank else None
                kept = more[-1] if effects.start.size else jnp.zeros(0)
                X, V, kept = effects(X, V, kept, level, volts, F_disturbance, noise, water)
                carried = (kept,) if effects.start.size else ()
            finite = jnp.all(jnp.isfinite(jnp.concatenate([X, V])))
            return X, V, (V - start) / period, finite.astype(V.dtype), *bank, *carried

        return advance

    def pure(self) -> Pure:
        """The update as a pure function."""
        still = {"F_Bo_B": np.zeros(6), "F_disturbance_Bo_B": np.zeros(6)}
        still["noise"] = np.zeros(self._noise.size())
        outputs = {name: shown(i) for i, name in enumerate(("X_WB", "V_WB_B", "A_WB_B"))}
        effects = self._effects
        for i, name in enumerate(("X_WB_seen", "V_WB_B_seen")):
            outputs[name] = shown(i)
            if effects is not None and effects.reads:
                outputs[name] = lambda state, _, i=i: effects.seen(*state[:3])[i]
        outputs["state"] = lambda state, _: jnp.concatenate(state[:2])
        if self._thrusters is not None:
            n = self._neutral.size
            still |= {"pwm": self._neutral, "voltage": self._nominal}
            outputs["thruster_force"] = lambda state, _: state[3][:n]
            outputs["voltage_loaded"] = lambda state, _: state[3][2 * n :]

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            del t
            parts = [
                inputs[name] if name in inputs else jnp.asarray(value)
                for name, value in still.items()
            ]
            flow = [inputs["flow_W"]] if "flow_W" in inputs else []
            advance = self._steps[len(flow)]
            X, V, A, _, *rest = advance(*state[:2], *parts, *state[3:], *flow)
            return dict(enumerate([X, V, A, *rest]))

        return Pure((Event(self.period, update),), outputs, ("noise",), (0, 1))

    def set_state(self, context: Context, X_WB: ArrayLike, V_WB_B: ArrayLike) -> None:
        """Write pose and twist into this system's context.

        Raises:
            ValueError: not a state.
        """
        X, V = check_state(X_WB, V_WB_B)
        set_groups(context, (self._X, self._V, self._A), (X, V, np.zeros(6)))

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        put(output, np.concatenate([group(context, self._X), group(context, self._V)]))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        held = [group(context, i) for i in range(context.num_discrete_state_groups())]
        parts = held[:2]
        # With thrusters this wrench is seldom connected, and `HasValue` is cheaper than a failure.
        parts.append(value(self._F, context) if self._F.HasValue(context) else np.zeros(6))
        parts += [value_or_zeros(port, context) for port in (self._F_disturbance, self._noise)]
        if self._thrusters is not None:
            pwm = value_or_none(self._pwm, context)
            voltage = value_or_none(self._voltage, context)
            parts.append(self._neutral if pwm is None else pwm)
            parts.append(self._nominal if voltage is None else voltage)
        parts += held[3:]
        flow = value_or_none(self._flow, context)
        if flow is None:
            result = self._still.flat(*parts)
        else:
            parts.append(flow)
            result = self._flowing.flat(*parts)
        if not result[19]:
            raise FloatingPointError(self._explain(context.get_time(), parts, result[7:13]))
        # the flag that the state is finite stands after the rates, before the other groups
        rest = np.split(result[20:], np.cumsum([each.size for each in held[3:]]))[:-1]
        new = (result[:7], result[7:13], result[13:19], *rest)
        set_groups(discrete_state, range(len(new)), new)

    def _explain(self, t: float, parts: list[np.ndarray], V: np.ndarray) -> str:
        names = ["X_WB", "V_WB_B", "F_Bo_B", "F_disturbance_Bo_B", "noise"]
        if self._thrusters is not None:
            names += ["pwm", "voltage", "thruster_force"]
        if self._effects is not None and self._effects.start.size:
            names.append("effects")
        told = dict(zip([*names, "flow_W"], parts, strict=False))
        bad = [name for name, part in told.items() if not np.all(np.isfinite(part))]
        cause = (
            f"its {' and '.join(bad)} already was not finite"
            if bad
            else "the model diverged: take a smaller period, more substeps, or check the model"
        )
        with np.printoptions(precision=4, suppress=True):
            return (
                f"{self.get_name() or 'LearnedPlant'}: the state is not finite after the step from "
                f"t = {t:.4f} s; {cause}. Before the step X_WB = {parts[0]}, V_WB_B = {parts[1]}, "
                f"F_Bo_B = {parts[2]}; after it V_WB_B = {V}."
            )


def check_state(
    X_WB: ArrayLike, V_WB_B: ArrayLike
) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "6"]]:
    """Pose with its quaternion normalised, and twist.

    Raises:
        ValueError: a wrong size, a value that is not finite, or a quaternion far from unit length.
    """
    X, V = np.array(X_WB, float), np.array(V_WB_B, float)
    if X.shape != (7,) or V.shape != (6,):
        raise ValueError(f"X_WB needs 7 and V_WB_B 6 numbers; got shapes {X.shape} and {V.shape}")
    if not (np.all(np.isfinite(X)) and np.all(np.isfinite(V))):
        raise ValueError(f"X_WB and V_WB_B must be finite; got {X} and {V}")
    norm = float(np.linalg.norm(X[:4]))
    if abs(norm - 1) > 1e-3:
        raise ValueError(f"the quaternion of X_WB has length {norm:.4g}: give one of length 1")
    X[:4] /= norm
    return X, V
