"""A system's events and outputs as pure functions, to compile a whole diagram.

A Drake system of this package computes in compiled functions, one call per event. Some systems also
return their events as functions of JAX arrays, by a method `pure()`; `systems.compiled.simulator`
then steps a diagram of such systems without leaving compiled code.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float

State = Sequence[Float[Array, "_"]]
"""A system's groups of discrete state."""

Inputs = Mapping[str, Float[Array, "_"]]
"""Values of a system's connected input ports by name; an unconnected port is missing. Values are
computed on demand."""

Output = Callable[[State, Inputs], Float[Array, "_"]]


class Event(NamedTuple):
    """A periodic update of discrete state.

    Attributes:
        period: of the event (s); the first one is at 0.
        update: from time, state and inputs to the groups that change, by their number.
        every: it happens once in this many periods (1: in all).
    """

    period: float
    update: Callable[[Float[Array, ""], State, Inputs], Mapping[int, Float[Array, "_"]]]
    every: int = 1


class Pure(NamedTuple):
    """A system's periodic events and output ports.

    Attributes:
        events: the periodic updates; initialisation is left to Drake.
        outputs: functions of all output ports that other systems may read.
        noise: input ports with new random numbers at every period of the first event.
        finite: groups of state that must be finite; otherwise the simulation ends.
    """

    events: tuple[Event, ...]
    outputs: Mapping[str, Output]
    noise: tuple[str, ...] = ()
    finite: tuple[int, ...] = ()


@runtime_checkable
class HasPure(Protocol):
    """A system with pure functions."""

    def pure(self) -> Pure:
        """Its events and outputs as pure functions."""
        ...


def shown(group: int) -> Output:
    """An output port whose value is a group of state."""
    return lambda state, _: state[group]
