"""A planner's task: costs and a constraint, apart from the algorithm that plans."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...models.integrate import cast


class Wanted(NamedTuple):
    """The state that a task asks for at a time."""

    X_WB: Float[Array, "7"]
    V_WB_B: Float[Array, "6"]


class Task(eqx.Module):
    """The problem that a planner solves, but for the vehicle, its limits and its noise:

        min_u E[∫ l(t, g, ξ) dt + φ(T, g(T), ξ(T))]  subject to  P(c(t, g, ξ) > 0 until T) ≥ 1 − α

    with the running cost l (1/s), the terminal cost φ and the clearance c (m). The planner adds the
    cost of the wrench and holds the attitude of the wanted state.

    Time t (s) counts from the start of the run. The functions get one time and n states, in the
    planner's precision, to which it casts the module's arrays.
    """

    @abc.abstractmethod
    def wanted(self, t: Float[Array, ""]) -> Wanted:
        """The wanted state."""

    @abc.abstractmethod
    def running_cost(
        self, t: Float[Array, ""], X_WB: Float[Array, "7 n"], V_WB_B: Float[Array, "6 n"]
    ) -> Float[Array, " n"]:
        """The cost rates l of states (1/s)."""

    def terminal_cost(
        self, t: Float[Array, ""], X_WB: Float[Array, "7 n"], V_WB_B: Float[Array, "6 n"]
    ) -> Float[Array, " n"] | None:
        """The costs φ of the last states; None for none.

        It is added to `MppiConfig.terminal_time` seconds of their running cost.
        """
        del t, X_WB, V_WB_B
        return None

    def clearance(
        self, t: Float[Array, ""], X_WB: Float[Array, "7 n"], V_WB_B: Float[Array, "6 n"]
    ) -> Float[Array, " n"] | None:
        """The least distances c (m) to what must not be touched, negative inside; None for none."""
        del t, X_WB, V_WB_B
        return None


def check_task(task: Task) -> None:
    """Check the sizes and the precision of what a task returns.

    Raises:
        ValueError: a function returns another size, or not the precision of its arguments.
    """
    task, name = cast(task, jnp.float32), type(task).__name__
    t = jax.ShapeDtypeStruct((), jnp.float32)
    states = (jax.ShapeDtypeStruct((size, 3), jnp.float32) for size in (7, 6))
    calls = {"wanted": (t,)} | dict.fromkeys(
        ("running_cost", "terminal_cost", "clearance"), (t, *states)
    )
    for function, arguments in calls.items():
        found = jax.eval_shape(getattr(task, function), *arguments)
        shapes = [(part.shape, part.dtype) for part in jax.tree.leaves(found)]
        sizes = [(7,), (6,)] if function == "wanted" else [(3,)]
        if not shapes and function in ("terminal_cost", "clearance"):
            continue
        if shapes != [(size, t.dtype) for size in sizes]:
            wrong = ", ".join(f"{dtype}{list(shape)}" for shape, dtype in shapes) or "nothing"
            right = ", ".join(f"float32{list(size)}" for size in sizes)
            raise ValueError(
                f"{name}.{function} returns {wrong} for 3 float32 states: return {right}; numbers "
                "of other precision belong into the module's fields, as JAX arrays"
            )
