"""Deterministic motion over a held command, of fourth order on the group."""

from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import se3
from ..dynamics import Memory
from .inertia import Inertia

_AT = np.array([-1.0, 0.0, 0.0, 1.0])
_AHEAD = np.array([0.5, 0.5, 1.0, 0.0])
_WEIGHT = np.array([1.0, 2.0, 2.0, 1.0]) / 6


@runtime_checkable
class Actuated(Protocol):
    """A model driven by thruster forces: `effects.Extended`, which documents these methods."""

    def actuate(
        self, memory: Memory, command: Array, dt: Any, substeps: int, rise: Array | None = None
    ) -> tuple[Memory, Array]:
        """Memories after a step, and mean thruster forces over its substeps."""
        ...

    def feel(self, memory: Memory, V_WB_B: Array, dt: Any) -> tuple[Memory, Array | None]:
        """Memories after a step at a velocity, and the resulting wrench, if any."""
        ...

    def drift(
        self,
        inertia: Inertia,
        X_WB: Array,
        V_WB_B: Array,
        level: Array,
        voltage: Array | None = None,
        push: Array | None = None,
    ) -> Array:
        """dV/dt under thruster forces (memory effects applied) and a wrench `push`."""
        ...


def advance(
    model: Actuated,
    inertia: Inertia,
    memory: Memory,
    X_WB: Float[Array, "7 *#batch"],
    V_WB_B: Float[Array, "6 *#batch"],
    command: Float[Array, "n *#batch"],
    dt: Any,
    substeps: int = 1,
    voltage: Float[Array, "1 *#batch"] | None = None,
    push: Float[Array, "6 *#batch"] | None = None,
    rise: Float[Array, "n *#batch"] | None = None,
) -> tuple[
    Memory, Float[Array, "7 *#batch"], Float[Array, "6 *#batch"], Float[Array, "12 *#batch"]
]:
    """Memory, pose and twist after `dt` s, and dV/dt and d²V/dt² at the end of the last substep.

    The second derivative is the difference quotient of the first over that substep. `dt` is a
    scalar, or (1, *batch) where columns have different steps; over it the command may `rise`.

    Runge–Kutta–Munthe-Kaas of order 4 for X' = X V (Munthe-Kaas 1999; Owren and Marthinsen 1999).
    Thruster forces are linear over a substep, with the means of its two halves: a fast turn depends
    on their timing within 0.01 s. `inertia` is `model.inertia()`. The four stages are one loop, so
    that a model of many effects compiles once.
    """
    memory, levels = model.actuate(memory, command, dt, 2 * substeps, rise)
    memory, felt = model.feel(memory, V_WB_B, dt)
    if felt is not None:
        push = felt if push is None else push + felt
    dtype = V_WB_B.dtype
    first, second = levels[..., ::2], levels[..., 1::2]
    middle, change = (first + second) / 2, second - first
    h = jnp.asarray(dt / substeps, dtype)
    own = inertia.inverse.shape[2:] if inertia.inverse.ndim - 1 == V_WB_B.ndim else ()
    batch = jnp.broadcast_shapes(X_WB.shape[1:], V_WB_B.shape[1:], middle.shape[1:-1], own)
    X = jnp.broadcast_to(X_WB, (7, *batch))
    V = jnp.broadcast_to(V_WB_B, (6, *batch))
    table = tuple(jnp.asarray(column, dtype) for column in (_AT, _AHEAD, _WEIGHT))

    def substep(carry: Any, force: tuple[Array, Array]) -> Any:
        X, V, _ = carry
        middle, change = force

        def stage(carry: Any, numbers: Any) -> Any:
            X_s, V_s, twist, gain, _ = carry
            at, ahead, weight = numbers
            a = model.drift(inertia, X_s, V_s, middle + at * change, voltage, push)
            twist, gain = twist + weight * V_s, gain + weight * a
            following = se3.retract(X, ahead * h * V_s), V + ahead * h * a
            return (*following, twist, gain, a), (V_s, a)

        zero = jnp.zeros_like(V)
        (_, _, twist, gain, a), (V_s, a_s) = jax.lax.scan(stage, (X, V, zero, zero, zero), table)
        twist = twist + h / 12 * se3.ad_apply(V_s[0], V_s[3])
        rates = jnp.concatenate([a, (a - a_s[0]) / h])
        return (se3.retract(X, h * twist), V + h * gain, rates), None

    forces = (jnp.moveaxis(middle, -1, 0), jnp.moveaxis(change, -1, 0))
    (X, V, a), _ = jax.lax.scan(substep, (X, V, jnp.zeros((12, *batch), dtype)), forces)
    return memory, X, V, a
