"""Base of the errors of instruments."""

from typing import ClassVar

from jaxtyping import Array, Float

from .base import Effect
from .recent import Recent

State = tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]


class MeasurementEffect(Effect):
    """What instruments show differs from the truth: a pose by `pose`, a twist by `twist`.

    Each maps a true value to the recorded one, and back if `inverse`. Errors that depend on the
    history of the twist override `measure` and `unmeasure` themselves.
    """

    family: ClassVar = "measurement"

    def pose(
        self, X_WB: Float[Array, "7 *#batch"], inverse: bool = False
    ) -> Float[Array, "7 *#batch"]:
        """The recorded pose, or the true one."""
        del inverse
        return X_WB

    def twist(
        self, V_WB_B: Float[Array, "6 *#batch"], inverse: bool = False
    ) -> Float[Array, "6 *#batch"]:
        """The recorded twist, or the true one."""
        del inverse
        return V_WB_B

    def measure(
        self, X_WB: Float[Array, "7 *#batch"], V_WB_B: Float[Array, "6 *#batch"], recent: Recent
    ) -> State:
        del recent
        return self.pose(X_WB), self.twist(V_WB_B)

    def unmeasure(
        self, X_WB: Float[Array, "7 *#batch"], V_WB_B: Float[Array, "6 *#batch"], recent: Recent
    ) -> State:
        del recent
        return self.pose(X_WB, inverse=True), self.twist(V_WB_B, inverse=True)
