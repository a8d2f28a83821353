"""The estimate of a vehicle without a horizontal aid: attitude, depth, climb and turn rate."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from ...models import se3
from ..compiled.jit import VectorFunction
from ..compiled.pure import Inputs, Pure
from ..drake import put, value


def horizontal_left_out(
    X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"], start: Float[Array, "7"]
) -> tuple[Float[Array, "6"], Float[Array, "7"]]:
    """Twist and start pose without what a vehicle without a horizontal aid can't know.

    The twist keeps its climb and turn rate; the start lies at the vehicle's own place.
    """
    climb = se3.rotate(X_WB, V_WB_B[:3])[2]
    up = jnp.zeros(3, V_WB_B.dtype).at[2].set(climb)
    here = jnp.concatenate([start[:4], X_WB[4:6], start[6:]])
    return jnp.concatenate([se3.rotate_inverse(X_WB, up), V_WB_B[3:]]), here


class WithoutPosition(LeafSystem):
    """Passes an estimate on with its horizontal part replaced: at a given place, not moving there.

    A controller behind it holds attitude and depth, and its horizontal wrench is that of a vehicle
    without a horizontal error. The filter's health does not matter: it is lost where velocity is
    unknown, as here it always is.

    .. pydrake_system::

        name: WithoutPosition
        input_ports:
        - X_WB
        - V_WB_B
        output_ports:
        - X_WB
        - V_WB_B

    """

    def __init__(self, place: tuple[float, float]):
        """`place` is x and y in W (m)."""
        super().__init__()
        self.place = place
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._known = VectorFunction(self._call, [7, 6], [7, 6])
        needs = {self._X.ticket(), self._V.ticket()}
        for i, (name, size) in enumerate((("X_WB", 7), ("V_WB_B", 6))):

            def show(context: Context, output: BasicVector, i: int = i) -> None:
                seen = value(self._X, context), value(self._V, context)
                put(output, np.asarray(self._known(*seen)[i]))

            self.DeclareVectorOutputPort(name, size, show, needs)

    def _call(self, X_WB: Array, V_WB_B: Array) -> tuple[Array, Array]:
        return self._pose(X_WB), self._twist(X_WB, V_WB_B)

    def _pose(self, X_WB: Array) -> Array:
        return X_WB.at[4:6].set(jnp.asarray(self.place, X_WB.dtype))

    def _twist(self, X_WB: Array, V_WB_B: Array) -> Array:
        return horizontal_left_out(X_WB, V_WB_B, X_WB)[0]

    def pure(self) -> Pure:
        """The outputs as pure functions."""

        def pose(state: object, inputs: Inputs) -> Array:
            del state
            return self._pose(inputs["X_WB"])

        def twist(state: object, inputs: Inputs) -> Array:
            del state
            return self._twist(inputs["X_WB"], inputs["V_WB_B"])

        return Pure((), {"X_WB": pose, "V_WB_B": twist})
