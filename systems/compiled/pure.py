"""What a system computes, as pure functions: for those who compile a whole diagram.

A Drake system of this package computes in compiled functions, one call an event. Some systems also
tell what these events do in terms of JAX arrays, by a method `pure()`; `systems.compiled.simulator`
then steps a diagram of such systems without leaving compiled code.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float

State = Sequence[Float[Array, "_"]]
"""A system's groups of discrete state."""

Inputs = Mapping[str, Float[Array, "_"]]
"""Values of a system's input ports by name; one that nothing is connected to is missing. A value is
computed when it is asked for."""

Output = Callable[[State, Inputs], Float[Array, "_"]]


class Event(NamedTuple):
    """A periodic update of discrete state.

    Attributes:
        period: of the event (s); it happens at 0 for the first time.
        update: from time, state and inputs to the groups that change, by their number.
        every: it takes part in every so many of the periods (1: in all).
    """

    period: float
    update: Callable[[Float[Array, ""], State, Inputs], Mapping[int, Float[Array, "_"]]]
    every: int = 1


class Pure(NamedTuple):
    """A system's periodic events and output ports.

    Attributes:
        events: what happens when; initialisation is left to Drake.
        outputs: of every port that others may read.
        noise: input ports with new random numbers at every period of the first event.
        finite: groups of state in which a number that is not finite ends the simulation.
    """

    events: tuple[Event, ...]
    outputs: Mapping[str, Output]
    noise: tuple[str, ...] = ()
    finite: tuple[int, ...] = ()


@runtime_checkable
class HasPure(Protocol):
    """A system that tells what it computes."""

    def pure(self) -> Pure:
        """Its events and outputs as pure functions."""
        ...


def shown(group: int) -> Output:
    """An output port that shows a group of state."""
    return lambda state, _: state[group]
