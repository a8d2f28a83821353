"""Ports, state and outputs of Drake's systems with the types that they have.

Drake's stubs type the value of a port as `object`, the index of a state group as no int, and a
vector by a shape that no array has. What touches them goes through here, and type checks of
arguments are off in this file alone.
"""
# pyright: reportArgumentType=false, reportReturnType=false, reportCallIssue=false

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteStateIndex,
    DiscreteValues,
    InputPort,
    OutputPort,
)
from pydrake.systems.primitives import ConstantVectorSource

Group = DiscreteStateIndex | int
"""Index of a group of discrete state."""


def value(port: InputPort | OutputPort, context: Context) -> Float[np.ndarray, "n"]:
    """Value of a vector port."""
    return port.Eval(context)


def value_or_none(port: InputPort, context: Context) -> Float[np.ndarray, "n"] | None:
    """Value of a vector input port, None while nothing is connected to it."""
    try:  # `HasValue` costs half as much as `Eval`, and most ports are connected
        return port.Eval(context)
    except RuntimeError:
        if port.HasValue(context):
            raise
        return None


def value_or_zeros(port: InputPort, context: Context) -> Float[np.ndarray, "n"]:
    """Value of a vector input port, zeros while nothing is connected to it."""
    found = value_or_none(port, context)
    return np.zeros(port.size()) if found is None else found


def group(context: Context, index: Group) -> Float[np.ndarray, "n"]:
    """Value of a group of discrete state."""
    return context.get_discrete_state(index).value()


def parameter(context: Context, index: int) -> Float[np.ndarray, "n"]:
    """Value of a numeric parameter."""
    return context.get_numeric_parameter(index).value()


def vector(values: Sequence[float] | Float[np.ndarray, "n"]) -> BasicVector:
    """A vector, as the default of a parameter."""
    return BasicVector(np.asarray(values, float))


def set_parameter(context: Context, index: int, new: Float[np.ndarray, "n"]) -> None:
    """Set a numeric parameter."""
    context.get_mutable_numeric_parameter(index).SetFromVector(new)


def set_groups(
    state: DiscreteValues | Context,
    indices: Iterable[Group],
    values: Iterable[Float[np.ndarray, "_"]],
) -> None:
    """Write groups of discrete state, in an update's result or in a context."""
    write = state.SetDiscreteState if isinstance(state, Context) else state.set_value
    for index, new in zip(indices, values, strict=True):
        write(index, new)


def put(output: BasicVector, new: Float[np.ndarray, "n"]) -> None:
    """Set the value of an output port."""
    output.SetFromVector(new)


def drake_array(values: ArrayLike) -> Any:
    """An array as an argument of Drake."""
    return np.asarray(values)


def constant(values: Sequence[float]) -> ConstantVectorSource:
    """A system whose output is constant."""
    return ConstantVectorSource(np.array(values, float))
