"""A whole diagram in one compiled loop, for simulations at many times real time."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, RandomSource

from ..drake import set_groups
from .jit import VectorFunction
from .network import Network, Port, Ports, changed_by, places, simultaneous

_STEPS = 32  # per call
_DRAWN = 500  # periods of noise drawn at once


class CompiledSimulator:
    """Steps a diagram as Drake's `Simulator` does, in one compiled loop.

    Every system must have pure functions (`systems.compiled.pure`), or be a constant, a log whose
    period is given, or a source of noise that draws at its reader's period. Times are exactly those
    of Drake's events, and so is the order at one time: logs, noise, then all updates from the state
    before. After every `AdvanceTo` state and logs are in the context, so that all ports can be
    read; only the noise sources are not advanced there. Two runs with one seed are bit-identical.
    They differ from Drake's own run by rounding only, because one program rounds in other places
    than several.

    Example:
        >>> scenario = load_scenario("trajectory_tracking_calm")
        >>> diagram = build_diagram(scenario.station, scenario.controller)
        >>> simulator = CompiledSimulator(diagram)
        >>> seeded(diagram, simulator.get_mutable_context(), seed=3)
        >>> simulator.Initialize()
        >>> simulator.AdvanceTo(0.5)
        >>> simulator.get_mutable_context().get_time()
        0.5
    """

    def __init__(self, diagram: Diagram, log_periods: Mapping[str, float] | None = None):
        """`log_periods` (s) of Drake's own logs by their systems' names; a `SignalLog` has its own.

        Raises:
            NotPureError: the diagram contains a system that only Drake can step.
        """
        self._drake = Simulator(diagram)
        self._context = self._drake.get_mutable_context()
        self._network = network = Network.of(diagram, log_periods or {})
        self._drawn: list[Port] = [(source, 0) for source, _ in network.noise]
        self._columns, self._logged = places(log.port for log in network.logs)
        self._schedule = _Schedule(self._network)
        self._noise: list[_Noise] = []
        self._state: Float[np.ndarray, " n"] | None = None

    def get_mutable_context(self) -> Context:
        """The diagram's context as of the end of the last `AdvanceTo`."""
        return self._context

    def reset_context(self, context: Context) -> None:
        """Continue in another context of the diagram; compiled programs are kept."""
        self._drake.reset_context(context)
        self._context = self._drake.get_mutable_context()
        self._state = None

    def compile(self) -> None:
        """Compile the loop now rather than at the first step."""
        self._loop.flat(*(np.zeros(size) for size in self._sizes))

    def Initialize(self) -> None:
        """Run Drake's initialisation events and start from the resulting state."""
        self._drake.Initialize()
        network, root = self._network, self._context
        self._state = np.zeros(self._sizes[0])
        for (system, group), part in network.groups:
            state = system.GetMyContextFromRoot(root).get_discrete_state(group)
            self._state[part] = state.value()
        self._constants = np.zeros(self._sizes[1])
        for (source, index), part in zip(
            network.constants, places(network.constants)[0], strict=True
        ):
            port: Any = source.get_output_port(index)
            self._constants[part] = port.Eval(source.GetMyContextFromRoot(root))
        self._schedule.start(root.get_time())
        self._noise = [_Noise(source, period, root) for source, period in network.noise]

    def AdvanceTo(self, boundary_time: float) -> None:
        """Step to a time (s). Updates at that exact time are left to the next call.

        Raises:
            FloatingPointError: a state that must be finite no longer is; the context keeps its
                state from before this call.
        """
        if self._state is None:
            self.Initialize()
        assert self._state is not None
        size, state = self._state.size, self._state
        for block in self._schedule.blocks(boundary_time):
            drawn = [
                source.rows(block.ticks[:, self._schedule.periods.index(source.period)])
                for source in self._noise
            ]
            noise = np.concatenate([np.zeros((_STEPS, 0)), *drawn], axis=1)
            count = np.array([float(block.count)])
            result = self._loop.flat(
                state, self._constants, count, block.times, block.ticks.ravel(), noise.ravel()
            )
            state = result[:size]
            self._log(block, result[size:].reshape(_STEPS, -1))
        self._check(state, boundary_time)
        self._state = state
        self._context.SetTime(boundary_time)
        for (system, index), part in self._network.groups:
            own = system.GetMyMutableContextFromRoot(self._context)
            set_groups(own, [index], [state[part]])

    def _log(self, block: "_Block", seen: Float[np.ndarray, "steps size"]) -> None:
        for log, part, steps in zip(self._network.logs, self._columns, block.logged, strict=True):
            if steps:
                rows: Any = log.system.FindMutableLog(self._context)
                for step in steps:
                    rows.AddData(block.times[step], seen[step, part])

    def _check(self, state: Float[np.ndarray, " n"], end: float) -> None:
        for (system, group), part in self._network.groups:
            finite = self._network.by_system[system].pure.finite
            if group in finite and not np.isfinite(state[part]).all():
                raise FloatingPointError(
                    f"{system.get_name()}: the state is not finite after a step between "
                    f"t = {self._context.get_time():.4f} s and {end:.4f} s; what acts on it was "
                    "not finite, or the model diverged: take a smaller period, more substeps, or "
                    "check the model"
                )

    @cached_property
    def _sizes(self) -> list[int]:
        """Sizes of the loop's inputs: state, constants, count, times, ticks, noise."""
        network = self._network
        state = network.groups[-1][1].stop if network.groups else 0
        constants, noise = (places(ports)[1] for ports in (network.constants, self._drawn))
        width = self._schedule.width
        return [state, constants, 1, _STEPS, _STEPS * width, _STEPS * noise]

    @cached_property
    def _loop(self) -> VectorFunction:
        results = [self._sizes[0], _STEPS * self._logged]
        return VectorFunction(self._run, self._sizes, results, keep=True)

    def _run(
        self, state: Array, constants: Array, count: Array, times: Array, ticks: Array, noise: Array
    ) -> tuple[Array, Array]:
        """Some steps of the diagram: the state after them, and the logged values before each."""
        network, logged = self._network, self._logged
        ticks, noise = ticks.reshape(_STEPS, -1), noise.reshape(_STEPS, -1)

        def by_port(ports: Sequence[Port], values: Array) -> dict[Port, Array]:
            return {p: values[part] for p, part in zip(ports, places(ports)[0], strict=True)}

        def step(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            flat, seen = carry
            t, due = times[i], ticks[i]
            old = {name: flat[part] for name, part in network.groups}
            given = by_port(network.constants, constants) | by_port(self._drawn, noise[i])

            def ports() -> Ports:
                return Ports(network, old, given)

            def look() -> Array:
                own = ports()
                return jnp.concatenate([own.value(log.port) for log in network.logs])

            if logged:
                row = jax.lax.cond(due[-1] >= 0, look, lambda: jnp.zeros(logged))
                seen = jax.lax.dynamic_update_slice(seen, row[None], (i, jnp.zeros_like(i)))
            new = dict(old)
            for (j, every), events in simultaneous(network, self._schedule.periods).items():
                names, change = changed_by(events, ports, t)
                happens = (due[j] >= 0) & (jnp.mod(due[j], every) == 0)
                stay = tuple(old[name] for name in names)
                values = jax.lax.cond(happens, change, lambda stay=stay: stay)
                new |= dict(zip(names, values, strict=True))
            return jnp.concatenate([new[name] for name, _ in network.groups]), seen

        seen = jnp.zeros((_STEPS, logged))
        state, seen = jax.lax.fori_loop(0, count[0].astype(int), step, (state, seen))
        return state, seen.ravel()


class _Block(NamedTuple):
    """A block of steps, of which only the first `count` are executed.

    `ticks` are the numbers of the periods that begin at each step, -1 for none; the last column
    is 0 at steps with a log. `logged` are the steps at which each log takes its value.
    """

    count: int
    times: Float[np.ndarray, " steps"]
    ticks: Float[np.ndarray, "steps width"]
    logged: list[list[int]]


class _Schedule:
    """Drake's times of periodic events: integer multiples of their periods in floating point."""

    def __init__(self, network: Network):
        events = (event for leaf in network.leaves for event in leaf.pure.events)
        self.periods = sorted({event.period for event in events})
        self.width = len(self.periods) + 1
        self._logs = network.logs

    def start(self, now: float) -> None:
        """Start at a time whose logs have been taken already."""
        self._ticks = [_first(period, now) for period in self.periods]
        self._log_ticks = [_first(log.period, now, log.offset) for log in self._logs]
        self._log_ticks = [
            k + (at == now) for k, at in zip(self._log_ticks, self._log_times(), strict=True)
        ]

    def _log_times(self) -> list[float]:
        return [
            log.offset + k * log.period for k, log in zip(self._log_ticks, self._logs, strict=True)
        ]

    def blocks(self, boundary: float) -> Iterator[_Block]:
        """All steps before a time, and the logs until that time."""
        block = self._empty()
        while True:
            times = [k * p for k, p in zip(self._ticks, self.periods, strict=True)]
            log_times = self._log_times()
            step = min(times, default=np.inf)
            t = min(step, min(log_times, default=np.inf))
            if t > boundary or (t == boundary and t not in log_times):
                break
            row = block.count
            block.times[row] = t
            for number, at in enumerate(log_times):
                if at == t:
                    block.ticks[row, -1] = 0
                    block.logged[number].append(row)
                    self._log_ticks[number] += 1
            if t < boundary:
                for j, at in enumerate(times):
                    if at == t:
                        block.ticks[row, j] = self._ticks[j]
                        self._ticks[j] += 1
            block = block._replace(count=row + 1)
            if block.count == _STEPS:
                yield block
                block = self._empty()
        if block.count:
            yield block

    def _empty(self) -> _Block:
        ticks = np.full((_STEPS, self.width), -1.0)
        return _Block(0, np.zeros(_STEPS), ticks, [[] for _ in self._logs])


def _first(period: float, now: float, offset: float = 0.0) -> int:
    """Number of the first period that begins at or after a time."""
    k = max(0, int(np.ceil((now - offset) / period)))
    return k if offset + k * period >= now else k + 1


class _Noise:
    """The draws of a noise source by the number of the period, from its context's state on."""

    def __init__(self, source: RandomSource, period: float, root: Context):
        self.period, self._start = period, _first(period, root.get_time())
        size = source.get_output_port(0).size()
        builder = DiagramBuilder()
        # the kind of distribution is part of the state
        twin = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, size, period))
        self._log = LogVectorOutput(twin.get_output_port(), builder, period)
        self._simulator = Simulator(builder.Build())
        context = self._simulator.get_mutable_context()
        own = source.GetMyContextFromRoot(root)
        twin.GetMyMutableContextFromRoot(context).SetStateAndParametersFrom(own)
        self._first, self._values, self._newest = 0, np.zeros((0, size)), 0

    def rows(self, ticks: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n size"]:
        """The source's output at steps that begin the given periods; the last draw at others (-1).

        A source draws before other systems read, so no event reads its initial output.
        """
        found = np.zeros((ticks.size, self._values.shape[1]))
        for row, tick in enumerate(ticks.astype(int)):
            if tick >= 0:
                self._newest = tick - self._start + 1
            while self._newest - self._first >= len(self._values):
                self._draw()
            found[row] = self._values[self._newest - self._first]
        return found

    def _draw(self) -> None:
        """Draw the next block; the last row of the previous one is kept."""
        context = self._simulator.get_mutable_context()
        now = context.get_time()
        self._simulator.AdvanceTo(now + (_DRAWN + 0.5 * (now == 0)) * self.period)
        log = self._log.FindMutableLog(context)
        new = log.data().T.copy()
        log.Clear()
        self._first += max(0, len(self._values) - 1)
        self._values = np.concatenate([self._values[-1:], new])
