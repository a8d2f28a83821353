"""Impedance control: tracks a plan with stiffness and damping."""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ...models import se3
from ...models.config.checks import Vector6, check_numbers, require
from ...models.dynamics import Dynamics
from ...models.integrate import cast
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import set_groups, value
from ..planning.plan import PlanLayout
from ..plant.wrench_limits import WrenchLimits


@dataclass(frozen=True)
class ImpedanceGains:
    """Stiffness and damping, stated as the closed loop's bandwidth and damping ratio per axis.

    With the model's mass M at rest, K_p = diag(M_ii ω_i²) and K_d = diag(2 ζ_i ω_i M_ii): each
    axis is then a second-order system with ω_i and ζ_i if drag and coupling are left out.

    Attributes:
        bandwidth: ω of x, y, z, roll, pitch, yaw (rad/s).
        damping: ζ of the same.
    """

    bandwidth: Vector6 = (1.5, 1.5, 1.8, 2.5, 2.5, 2.0)
    damping: Vector6 = (1.0, 1.0, 1.0, 0.9, 0.9, 1.0)

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("bandwidth", "damping"):
            require(min(getattr(self, name)) >= 0, self, name, "give six numbers of zero or more")

    def matrices(
        self, dynamics: Dynamics
    ) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"]]:
        """K_p (N/m, N·m/rad) and K_d (N·s/m, N·m·s/rad) for a vehicle's model."""
        rest = jnp.zeros(6, dynamics.rigid_inertia.dtype)
        M = np.diag(np.asarray(dynamics.coefficients(rest).mass.matrix(), float))
        w, z = np.asarray(self.bandwidth), np.asarray(self.damping)
        return np.diag(M * w**2), np.diag(2 * z * w * M)


class ImpedanceLaw(eqx.Module):
    """u = u_opt + K_p log(g⁻¹ g_opt) + K_d (ξ_opt − ξ), saturated at the thrusters' limits.

    Palmer et al., "Field Experiments". The error log(g⁻¹ g_opt) is a twist in B: the pose of the
    plan relative to the vehicle. `error_limit` (m and rad) bounds the norms of its linear and its
    angular part, and thereby the stiffness wrench of a distant plan.
    """

    K_p: Float[Array, "6 6"]
    K_d: Float[Array, "6 6"]
    limits: WrenchLimits
    error_limit: tuple[float, float] = eqx.field(static=True)

    def __init__(
        self,
        K_p: Float[np.ndarray, "6 6"],
        K_d: Float[np.ndarray, "6 6"],
        limits: WrenchLimits,
        error_limit: tuple[float, float] = (1.0, 1.0),
        dtype: jnp.dtype | type = float,
    ):
        """Stiffness, damping and limits.

        Raises:
            ValueError: a gain is not a finite (6, 6) matrix, or a limit is not positive.
        """
        for name, K in (("K_p", K_p), ("K_d", K_d)):
            if np.shape(K) != (6, 6) or not np.all(np.isfinite(K)):
                raise ValueError(f"{name} must be a (6, 6) matrix of finite numbers")
        if min(error_limit) <= 0:
            raise ValueError(f"error_limit {error_limit} must be positive (m, rad)")
        self.K_p, self.K_d = jnp.asarray(K_p, dtype), jnp.asarray(K_d, dtype)
        self.limits = cast(limits, dtype)
        self.error_limit = error_limit

    def __call__(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        X_opt: Float[Array, "7"],
        V_opt: Float[Array, "6"],
        F_opt: Float[Array, "6"],
    ) -> Float[Array, "6"]:
        """The wrench F_Bo_B; zero if any input is not finite."""
        error = se3.local(X_WB, X_opt)
        parts = []
        for part, limit in zip((error[:3], error[3:]), self.error_limit, strict=True):
            norm = jnp.sqrt(jnp.sum(part * part) + jnp.finfo(part.dtype).tiny)
            parts.append(part * jnp.minimum(1, limit / norm))
        F = F_opt + self.K_p @ jnp.concatenate(parts) + self.K_d @ (V_opt - V_WB_B)
        return self.limits.clip(jnp.where(jnp.all(jnp.isfinite(F)), F, 0))


def _tracking_wrench(
    law: ImpedanceLaw, layout: PlanLayout, t: Array, plan: Array, X: Array, V: Array
) -> Array:
    wanted = layout.at(plan, t[0])
    F = law(X, V, wanted.X_WB, wanted.V_WB_B, wanted.F_Bo_B)
    return jnp.where(wanted.valid, F, 0)


class Impedance(LeafSystem):
    """Tracks the `plan` of a planner or a reference every `period` with an `ImpedanceLaw`.

    The plan is read at the present time (`PlanLayout.at`): geodesic between its states, wrench
    held; past its end its last pose is held. Without a plan the wrench is zero.

    .. pydrake_system::

        name: Impedance
        input_ports:
        - plan
        - X_WB
        - V_WB_B
        output_ports:
        - F_Bo_B

    """

    def __init__(self, law: ImpedanceLaw, layout: PlanLayout, period: float = 0.02):
        """`layout` is that of the plan's source."""
        super().__init__()
        if not period > 0:
            raise ValueError(f"period is {period}: give a time above 0 s")
        self.law, self.layout, self.period = law, layout, period
        self._plan = self.DeclareVectorInputPort("plan", layout.size)
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._F = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("F_Bo_B", self._F)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self._call = partial(_tracking_wrench, law, layout)
        self._step = VectorFunction(self._call, [1, layout.size, 7, 6], [6])

    def pure(self) -> Pure:
        """The update as a pure function."""

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            del state
            return {0: self._call(t[None], inputs["plan"], inputs["X_WB"], inputs["V_WB_B"])}

        return Pure((Event(self.period, update),), {"F_Bo_B": shown(0)})

    def _update(self, context: Context, state: DiscreteValues) -> None:
        F = self._step.flat(
            np.array([context.get_time()]),
            *(value(port, context) for port in (self._plan, self._X, self._V)),
        )
        set_groups(state, [self._F], [F])
