"""The plan vector: the output of a planner or a reference for the tracking controller."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3


class Plan(NamedTuple):
    """States at t0 + k dt for k = 0 … H and the wrenches held between them."""

    t0: Float[Array, ""]
    X_WB: Float[Array, "7 n"]
    V_WB_B: Float[Array, "6 n"]
    F_Bo_B: Float[Array, "6 h"]


class Setpoint(NamedTuple):
    """A plan at one instant."""

    X_WB: Float[Array, "7"]
    V_WB_B: Float[Array, "6"]
    F_Bo_B: Float[Array, "6"]
    valid: Bool[Array, ""]


@dataclass(frozen=True)
class PlanLayout:
    """Layout of a plan in a flat vector: t0, then (H+1) × (pose 7, twist 6), then H × wrench 6.

    A vector of zeros holds no plan (its quaternions have length zero): `at` then returns not valid.

    Attributes:
        horizon: H, the number of intervals.
        dt: length of one (s).
    """

    horizon: int = 80
    dt: float = 0.05

    def __post_init__(self) -> None:
        """Check numbers."""
        if self.horizon < 1 or not self.dt > 0:
            raise ValueError(f"plan of {self.horizon} × {self.dt} s: both must be positive")

    @property
    def size(self) -> int:
        """Length of the vector."""
        return 1 + 13 * (self.horizon + 1) + 6 * self.horizon

    def pack(self, plan: Plan) -> Float[Array, " size"]:
        """The flat vector of a plan."""
        states = jnp.concatenate([plan.X_WB, plan.V_WB_B]).T
        return jnp.concatenate([plan.t0.reshape(1), states.ravel(), plan.F_Bo_B.T.ravel()])

    def unpack(self, vector: Float[Array, " size"]) -> Plan:
        """The plan of a flat vector."""
        split = 1 + 13 * (self.horizon + 1)
        states = vector[1:split].reshape(self.horizon + 1, 13).T
        wrenches = vector[split:].reshape(self.horizon, 6).T
        return Plan(vector[0], states[:7], states[7:], wrenches)

    def at(self, vector: Float[Array, " size"], t: Float[Array, ""]) -> Setpoint:
        """The plan at time t (s): geodesic between poses, linear between twists, wrench held.

        Before t0 it is the first state. After the end the vehicle holds its pose: the last pose, a
        twist of zero, and the last wrench, which includes the static wrenches.
        """
        plan = self.unpack(vector)
        s = (t - plan.t0) / jnp.asarray(self.dt, vector.dtype)
        valid = jnp.all(jnp.isfinite(vector)) & (jnp.sum(plan.X_WB[:4, 0] ** 2) > 0.25)
        ended = s >= self.horizon
        s = jnp.clip(jnp.where(jnp.isfinite(s), s, 0), 0, self.horizon)
        k = jnp.minimum(jnp.floor(s).astype(jnp.int32), self.horizon - 1)
        part = s - k.astype(s.dtype)
        rest = se3.identity(vector.dtype)
        X0 = jnp.where(valid, plan.X_WB[:, k], rest)
        X1 = jnp.where(valid, plan.X_WB[:, k + 1], rest)
        V0, V1 = plan.V_WB_B[:, k], plan.V_WB_B[:, k + 1]
        V = jnp.where(ended, 0, V0 + part * (V1 - V0))
        return Setpoint(
            se3.interpolate(X0, X1, part),
            jnp.where(valid, V, 0),
            jnp.where(valid, plan.F_Bo_B[:, k], 0),
            valid,
        )
