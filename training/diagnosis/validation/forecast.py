"""Noise-free forecasts of recorded runs, window by window."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ....models.effects.extended import Extended
from ....models.effects.inertia import times
from ..data.arrays import Data
from ..filter.along_records import AlongRecords, Records, State, Step, scan, substeps


@runtime_checkable
class Learned(Protocol):
    """Learned acceleration error of a model, by any method; a pytree of arrays."""

    def acceleration(
        self, X: Float[Array, "7 S R"], V: Float[Array, "6 S R"], u: Array, before: Array
    ) -> Float[Array, "6 S R"]:
        """Correction to dV/dt (m/s², rad/s²), given commands and those a step before."""
        ...


def states(
    model: Extended,
    records: Records,
    every: int,
    count: int,
    rest: Learned | None = None,
    reckoned: tuple[int, ...] = (),
) -> tuple[Float[Array, "N 7 R"], Float[Array, "N 6 R"]]:
    """`forecast` of arrays, in `count` substeps, to be compiled or differentiated."""
    along = AlongRecords.of(model, count, reckoned=reckoned)

    def forecast_step(state: State, given: Step) -> tuple[State, tuple[Array, Array]]:
        state = along.restart(state, given.X, given.V, given.number % every == 0)
        push = None
        if rest is not None:
            now = state.X, state.V, given.command, given.before
            lacking = rest.acceleration(*(a[:, None] for a in now))
            push = times(along.inertia.matrix, lacking[:, 0])
        state = along.step(state, given, push)
        return state, along.observe(state)

    return scan(forecast_step, along.init(records), records)


_states = eqx.filter_jit(states)


def forecast(
    model: Extended, data: Data, every: int, rest: Learned | None = None
) -> tuple[Float[np.ndarray, "N 7 R"], Float[np.ndarray, "N 6 R"]]:
    """Poses and twists as they would be recorded at steps 1 … N.

    Windows start at steps 0, `every`, 2 `every`, … from the record there; actuator states continue
    from window to window. `rest` is added to the model's acceleration.
    """
    given = every, substeps(data.longest), rest, data.reckoned
    X, V = _states(model, Records.of(data), *given)
    return np.asarray(X), np.asarray(V)
