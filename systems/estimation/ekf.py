"""The state estimator as a system; the filter itself is in `systems.estimation`."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from numpy.typing import ArrayLike
from pydrake.common import RandomDistribution
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ...models import se3
from ...models.config.checks import require
from ...models.config.errors import UserError
from ...models.sensors import SHIPPED, Imu, Sensor
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import group, parameter, set_groups, set_parameter, value_or_zeros, vector
from ..plant.learned_plant import check_state
from .config import EkfConfig
from .delayed import DelayedFilter
from .state import FilterState, Readings, health_names, status_names

_WAITING = 6  # state group of the buffered samples, after the filter's own and the outputs'


class _Flat:
    """The filter's functions of flat vectors, as which Drake keeps its state."""

    def __init__(self, core: DelayedFilter):
        self.core = core
        like = jax.eval_shape(core.init, jnp.zeros(7), jnp.zeros(6))
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
        self.unravel = ravel_pytree(zeros)[1]

    def start(self, X_WB: Array, V_WB_B: Array) -> Array:
        """The state at a start without error."""
        return ravel_pytree(self.core.init(X_WB, V_WB_B))[0]

    def initialise(self, w: Array, X_WB: Array, V_WB_B: Array) -> tuple[Array, ...]:
        """State and outputs at time 0 for a start, with an initial error of the noise `w`."""
        error = self.core.deviations()[:9] * w
        X = se3.retract(X_WB, error[:6])
        V = V_WB_B + jnp.concatenate([error[6:], jnp.zeros(3, w.dtype)])
        flat = self.start(X, V)
        return flat, *self.show(flat, jnp.zeros((), w.dtype))

    def show(self, flat: Array, t: Array) -> tuple[Array, ...]:
        """The outputs at time `t`: the newest sample is one period old when it comes."""
        core, state = self.core, self.unravel(flat)
        X, V, P = core.present(state, jnp.minimum(t, core.period + core.config.imu_latency))
        k = jnp.round(t / core.period) - 1
        P_shown = P[: core.shown, : core.shown].reshape(-1)
        return X, V, P_shown, core.status(state, k), core.health(state, P, k)

    def take_in(self, flat: Array, *given: Array) -> tuple[Array, Array, Array]:
        """`DelayedFilter.take_in` and the first `move`: state, slot that needs `fuse`, slots.

        `given`: samples that wait, the newest one, outputs of the other sensors, its number.
        """
        waiting, newest, *shown, last = given
        samples = jnp.concatenate([waiting, newest]).reshape(-1, 6)
        marked = tuple(each.marked(x) for each, x in zip(self.core.aids, shown, strict=True))
        readings = Readings(samples[-1], marked)
        state, slots = self.core.take_in(self.unravel(flat), samples, readings, last[0])
        state, at = self.core.move(state, slots, jnp.zeros_like(last[0]))
        return ravel_pytree(state)[0], at, slots

    def move(self, flat: Array, slots: Array, first: Array) -> tuple[Array, Array]:
        """`DelayedFilter.move`."""
        slots = slots.reshape(-1, self.core.slot)
        state, at = self.core.move(self.unravel(flat), slots, first[0])
        return ravel_pytree(state)[0], at

    def fuse(self, flat: Array, slot: Array, k: Array) -> Array:
        """`DelayedFilter.fuse`."""
        return ravel_pytree(self.core.fuse(self.unravel(flat), slot, k[0]))[0]


def _filter(
    on_board: Mapping[str, Sensor], config: EkfConfig
) -> tuple[DelayedFilter, dict[str, Sensor]]:
    """The filter of the sensors, and those that it fuses besides the IMU."""
    imu = on_board.get("imu")
    aids = {name: each for name, each in on_board.items() if each.observes is not None}
    if not (isinstance(imu, Imu) and aids):
        raise UserError(
            "sensing: the filter needs an IMU called `imu` and a sensor to fuse with it, such "
            "as dvl, depth or compass; add one, or give a filter of your own (!OwnFilter)"
        )
    core = DelayedFilter(imu, tuple(aids.values()), config)
    ratio = imu.rate / config.output_rate
    divides = abs(ratio - round(ratio)) < 1e-6 and ratio > 1 - 1e-6
    remedy = f"give a rate that divides the IMU's {imu.rate:g} Hz, or change that"
    require(divides, config, "output_rate", remedy)
    return core, aids


class Ekf(LeafSystem):
    """Error-state Kalman filter on SE(3), driven by the IMU, at a delayed horizon.

    At every IMU period it reads the sample of one period ago. At `config.output_rate` (more often
    if a sensor reads faster) it predicts over the new samples, fuses the other sensors that
    `observes` something `config.horizon` in the past in the order of their times of validity
    (`systems.estimation.delayed`), and predicts the present state with the buffered samples. The
    order and frame of the error are those of `systems.estimation.error_state`: `covariance` is its
    square matrix by rows without the sensors' offsets; its first six rows and columns belong to
    [δp, δθ] in body axes. What no
    sensor observes is dead reckoning: its variance grows, as that of horizontal position does with
    the shipped sensors. `status` has the components `status_names`, `health` those of
    `health_names`.

    The estimate starts at the given pose and twist, or those of `set_start`. With `initial_noise`
    connected (a simulation) it starts with an error drawn from `config`'s standard deviations: δp,
    δθ, δv.

    .. pydrake_system::

        name: Ekf
        input_ports:
        - imu
        - dvl
        - depth
        - compass
        - initial_noise
        output_ports:
        - X_WB
        - V_WB_B
        - covariance
        - status
        - health

    """

    def __init__(
        self,
        on_board: Mapping[str, Sensor] = SHIPPED,
        config: EkfConfig | None = None,
        X0_WB: ArrayLike | None = None,
        V0_WB_B: ArrayLike | None = None,
    ):
        """Expect the given sensors by their ports' names and start at `X0_WB`, `V0_WB_B`.

        Raises:
            ValueError: the start is not a state.
            UserError: the output rate does not divide the IMU's rate, or the horizon is shorter
                than a reading is late.
            UserError: the horizon is shorter than a sensor's latency, there is no IMU, or nothing
                to fuse with it.
        """
        super().__init__()
        self.filter, aids = _filter(on_board, config or EkfConfig())
        core = self.filter
        X0 = np.array([1.0, 0, 0, 0, 0, 0, 0]) if X0_WB is None else X0_WB
        X0, V0 = check_state(X0, np.zeros(6) if V0_WB_B is None else V0_WB_B)
        self._flat = flat = _Flat(core)
        start = np.asarray(flat.start(jnp.asarray(X0), jnp.asarray(V0)))

        sizes = {"imu": core.imu.port_size}
        sizes |= {name: each.port_size for name, each in aids.items()}
        self._readings = [self.DeclareVectorInputPort(*item) for item in sizes.items()]
        gaussian = RandomDistribution.kGaussian
        self._initial_noise = self.DeclareVectorInputPort("initial_noise", 9, gaussian)

        outputs = {"X_WB": 7, "V_WB_B": 6, "covariance": core.shown**2}
        outputs |= {"status": len(status_names([*aids])), "health": len(health_names([*aids]))}
        self._ratio, self._period = round(core.imu.rate / core.config.output_rate), core.period
        self._samples = core.samples_at_once(self._ratio)
        self._filter = self.DeclareDiscreteState(BasicVector(start.tolist()))
        self._outputs = [self.DeclareDiscreteState(size) for size in outputs.values()]
        self._given = self.DeclareNumericParameter(vector(np.concatenate([X0, V0])))
        self._waiting = self.DeclareDiscreteState(6 * (self._samples - 1))
        for name, index in zip(outputs, self._outputs, strict=True):
            self.DeclareStateOutputPort(name, index)
        self.DeclareInitializationDiscreteUpdateEvent(self._initialise)
        self.DeclarePeriodicDiscreteUpdateEvent(core.period, 0.0, self._update)

        n, m, results = start.size, self._samples, list(outputs.values())
        self._start = VectorFunction(flat.initialise, [9, 7, 6], [n, *results])
        # Several calls: XLA runs small programs inline and larger ones on its thread pool.
        self._take_in = VectorFunction(
            flat.take_in, [n, 6 * (m - 1), *sizes.values(), 1], [n, 1, core.slot * m]
        )
        self._move = VectorFunction(flat.move, [n, core.slot * m, 1], [n, 1])
        self._fuse = VectorFunction(flat.fuse, [n, core.slot, 1], [n])
        self._show = VectorFunction(lambda x, t: flat.show(x, t[0]), [n, 1], results)

    def set_start(self, context: Context, X_WB: ArrayLike, V_WB_B: ArrayLike) -> None:
        """Start at another pose and twist when the context is initialised.

        Raises:
            ValueError: they are not a state.
        """
        set_parameter(context, self._given, np.concatenate(check_state(X_WB, V_WB_B)))

    def filter_state(self, context: Context) -> FilterState:
        """The filter's state at its horizon, for inspection."""
        return self._flat.unravel(jnp.asarray(group(context, self._filter)))

    def pure(self) -> Pure:
        """The update as a pure function."""
        do = self._flat
        n, width = self._samples, self.filter.slot
        sizes = {port.get_name(): port.size() for port in self._readings}

        def step(state: State, given: list[Array], last: Array) -> Array:
            """The filter's state after the buffered samples and the present one."""
            flat, at, slots = do.take_in(state[0], state[_WAITING], *given, last[None])

            def fuse_and_move(carry: tuple[Array, Array]) -> tuple[Array, Array]:
                flat, at = carry
                slot = jax.lax.dynamic_slice(slots.reshape(-1), (width * at.astype(int),), (width,))
                flat = do.fuse(flat, slot, (last - n + 1 + at)[None])
                return do.move(flat, slots, (at + 1)[None])  # no slot left at at = n

            return jax.lax.while_loop(lambda carry: carry[1] < n, fuse_and_move, (flat, at))[0]

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            given = [inputs.get(name, jnp.zeros(size)) for name, size in sizes.items()]
            tick = jnp.round(t / self._period)
            phase = jnp.mod(tick, n)
            slot = (jnp.maximum(phase, 1) - 1).astype(int)
            kept = jax.lax.dynamic_update_slice(state[_WAITING], given[0], (6 * slot,))
            waiting = jnp.where(phase > 0, kept, state[_WAITING]) if n > 1 else state[_WAITING]
            flat = jax.lax.cond(phase > 0, lambda: state[0], lambda: step(state, given, tick - 1))
            told = jax.lax.cond(
                jnp.mod(tick, self._ratio) == 0,
                lambda: do.show(flat, t),
                lambda: tuple(state[1:_WAITING]),
            )
            return dict(enumerate([flat, *told, waiting]))

        names = ("X_WB", "V_WB_B", "covariance", "status", "health")
        outputs = {name: shown(i) for i, name in enumerate(names, 1)}
        return Pure((Event(self._period, update),), outputs)

    def _initialise(self, context: Context, discrete_state: DiscreteValues) -> None:
        start = parameter(context, self._given)
        results = self._start(value_or_zeros(self._initial_noise, context), start[:7], start[7:])
        set_groups(discrete_state, [self._filter, *self._outputs], results)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        """Buffer the present sample; with the last of several, step over all of them."""
        t = context.get_time()
        tick = round(t / self._period)
        phase = tick % self._samples
        imu = value_or_zeros(self._readings[0], context)
        if phase:
            waiting = discrete_state.get_mutable_value(_WAITING)
            waiting[6 * phase - 6 : 6 * phase] = imu
            return
        last = tick - 1.0  # the present output was sampled one period ago
        readings = [value_or_zeros(port, context) for port in self._readings[1:]]
        state, at, slots = self._take_in(
            group(context, 0), group(context, _WAITING), imu, *readings, np.array([last])
        )
        n, width, i = self._samples, self.filter.slot, int(at[0])
        while i < n:
            number = np.array([last - n + 1 + i])
            state = self._fuse.flat(state, slots[width * i : width * (i + 1)], number)
            if i == n - 1:
                break
            state, at = self._move(state, slots, np.array([i + 1.0]))
            i = int(at[0])
        set_groups(discrete_state, [0], [state])
        if tick % self._ratio == 0:
            set_groups(discrete_state, self._outputs, self._show(state, np.array([t])))
