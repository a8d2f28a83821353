"""Errors of the damping: by axis, direction, power and coupling."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..dynamics import Dynamics
from ..rigid_body import FossenDynamics
from ..se3 import AXES
from ..spd import Operator
from .base import Effect, Parameter, Plant, axes_only

COUPLINGS = (
    ("sway_from_yaw", 1, 5),
    ("yaw_from_sway", 5, 1),
    ("surge_from_pitch", 0, 4),
    ("pitch_from_surge", 4, 0),
    ("sway_from_roll", 1, 3),
    ("roll_from_sway", 3, 1),
    ("heave_from_pitch", 2, 4),
    ("pitch_from_heave", 4, 2),
    ("yaw_from_surge", 5, 0),
    ("surge_from_yaw", 0, 5),
)
"""(place, axis of the force, axis of the velocity): those that symmetry allows."""
_SPREAD = 3.0
"""Prior standard deviation of drag in a fit of all coefficients, as a multiple of itself."""


def _believed(base: Dynamics, axis: str) -> tuple[float, float]:
    """Linear and quadratic coefficient of an axis; zero where the drag is not constant."""
    if not isinstance(base, FossenDynamics):
        return 0.0, 0.0
    i = AXES.index(axis)
    return float(base.linear_drag.dense[i, i]), float(base.quadratic_drag.dense[i, i])


def _added(drag: Operator, change: Array) -> Float[np.ndarray, "6 6"]:
    return np.asarray(drag.matrix(), float) + np.diag(np.asarray(change, float))


class LinearDrag(Effect):
    """F_i = -Δd_i ξ_i on one axis (N·s/m, N·m·s)."""

    name: ClassVar[str] = "linear_drag"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("change", "N·s/m or N·m·s", (0.5,), -200.0, 200.0),)
    places: ClassVar = AXES
    passive: ClassVar[bool] = True
    refits: ClassVar = ("linear", "command", "all")
    source: ClassVar[str] = "published sets differ by factors"

    @classmethod
    def believed(cls, base: Dynamics, place: str) -> float:
        return _believed(base, place)[0]

    @classmethod
    def refit_prior(cls, base: Dynamics, place: str) -> tuple[float, float]:
        both = _believed(base, place)
        return _SPREAD * max(*both, 1e-3), -both[0]

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return -self.column(V_CB_B) * V_CB_B

    def in_constants(self, base: FossenDynamics, plant: Plant) -> FossenDynamics:
        del plant
        return base.with_constants(linear_drag=_added(base.linear_drag, self.values))


class QuadraticDrag(Effect):
    """F_i = -Δd_i |ξ_i| ξ_i on one axis (N·s²/m², N·m·s²)."""

    name: ClassVar[str] = "quadratic_drag"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("change", "N·s²/m² or N·m·s²", (2.0,), -500.0, 500.0),)
    places: ClassVar = AXES
    passive: ClassVar[bool] = True
    refits: ClassVar = ("linear", "command", "all")
    source: ClassVar[str] = "published sets differ by a factor of 8"

    @classmethod
    def believed(cls, base: Dynamics, place: str) -> float:
        return _believed(base, place)[1]

    @classmethod
    def refit_prior(cls, base: Dynamics, place: str) -> tuple[float, float]:
        both = _believed(base, place)
        return _SPREAD * max(*both, 1e-3), -both[1]

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return -self.column(V_CB_B) * jnp.abs(V_CB_B) * V_CB_B

    def in_constants(self, base: FossenDynamics, plant: Plant) -> FossenDynamics:
        del plant
        return base.with_constants(quadratic_drag=_added(base.quadratic_drag, self.values))


class DragAsymmetry(Effect):
    """F_i = -e_i ξ_i²: quadratic drag larger by e forwards and smaller by e backwards."""

    name: ClassVar[str] = "drag_asymmetry"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("difference", "N·s²/m² or N·m·s²", (2.0,), -200.0, 200.0),)
    places: ClassVar = AXES
    source: ClassVar[str] = "5 to 20 % between bow and stern"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return -self.column(V_CB_B) * V_CB_B * V_CB_B


class CubicDrag(Effect):
    """F_i = -c_i ξ_i³ on one axis."""

    name: ClassVar[str] = "cubic_drag"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("coefficient", "N·s³/m³ or N·m·s³", (2.0,), -300.0, 300.0),)
    places: ClassVar = AXES
    simpler: ClassVar = ("linear_drag", "quadratic_drag")
    source: ClassVar[str] = "0 to 10 % of the drag"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return -self.column(V_CB_B) * V_CB_B * V_CB_B * V_CB_B


class DragCoupling(Effect):
    """F_i = -c |ξ_j| ξ_j - l ξ_j: drag on axis i from motion along axis j."""

    name: ClassVar[str] = "drag_coupling"
    family: ClassVar = "body"
    parameters: ClassVar = (
        Parameter("quadratic", "N·s²/m²", (0.5,), -100.0, 100.0),
        Parameter("linear", "N·s/m", (0.2,), -100.0, 100.0),
    )
    places: ClassVar = tuple(name for name, _, _ in COUPLINGS)
    source: ClassVar[str] = "centre of pressure a few cm from Bo"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        entries: dict[int, Array] = {}
        for k, (_, i, j) in enumerate(COUPLINGS):
            v = V_CB_B[j]
            c, l = self.part(2 * k, V_CB_B), self.part(2 * k + 1, V_CB_B)
            term = -(c * jnp.abs(v) + l) * v
            entries[i] = entries[i] + term if i in entries else term
        return axes_only(entries, V_CB_B)
