"""Stochastic Euler–Poincaré dynamics of a vehicle in water: the one implementation of the drift.

Kinematics dg = g ξ dt and momentum balance in B (Palmer et al., eqs. 9-11; Fossen 2011, eq. 6.42)

    M dξ = (ad*_ξ(M ξ) - D ξ - D^f (|ξ| ∘ ξ) + F_V(g) + F) dt + b(ξ) ∘ dW,

with ξ = `V_WB_B`, F the commanded wrench, F_V the left-trivialised derivative of -V(g), D and D^f
the viscous and the fluid drag matrix and b the diagonal diffusion (N√s, N·m√s); a model may
correlate the axes of dW. Subclasses define M, D, D^f, b and V: constants for a Fossen model,
networks for a SPINN.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import se3
from .spd import Operator, Spd

Memory = tuple[Array, ...]
"""Memory of earlier commands and motion: arrays (m, *batch)."""


class Coefficients(NamedTuple):
    """The coefficients that depend on the body velocity, evaluated in one pass."""

    mass: Spd
    linear_drag: Operator
    quadratic_drag: Operator
    diffusion: Float[Array, "6 *#batch"]


class Flow(NamedTuple):
    """Velocity (m/s) and acceleration (m/s²) of the undisturbed water at Bo, expressed in W."""

    v_WC_W: Float[Array, "3 *#batch"]
    a_WC_W: Float[Array, "3 *#batch"]


class Dynamics(eqx.Module):
    """Drift and diffusion of a vehicle; arrays and frames as in `models.se3`.

    `rigid_inertia` is the dry vehicle's spatial inertia about Bo and `displaced_mass` = ρ∇: moving
    water acts through M - `rigid_inertia` (added mass) and through ρ∇ (Froude–Krylov) only.
    """

    rigid_inertia: eqx.AbstractVar[Float[Array, "6 6"]]
    displaced_mass: eqx.AbstractVar[Float[Array, ""]]
    p_BoCb_B: eqx.AbstractVar[Float[Array, "3"]]

    @property
    def stochastic(self) -> bool:
        """Whether b may differ from zero; if not, integrators skip the noise."""
        return True

    @property
    def brownian_size(self) -> int:
        """Number of Brownian motions of a rollout: 6, and 6 more for coloured noise."""
        return 6

    def lasting_push(
        self, w: Float[Array, "T 6 *batch"], dt: float | Float[Array, ""]
    ) -> Float[Array, "T 6 *batch"]:
        """The wrench of the coloured noise, from unit Gaussians at T steps of `dt` (s).

        Raises:
            ValueError: the model has no coloured noise.
        """
        raise ValueError(f"{type(self).__name__} has no pushes that last: give it noise of 6 axes")

    @property
    def remembers(self) -> bool:
        """Whether earlier commands or motion have later effects: rollouts then carry a memory."""
        return False

    def commanded(self, F_Bo_B: Float[Array, "6 *batch"]) -> Memory:
        """Steady-state memory under a constant commanded wrench."""
        del F_Bo_B
        return ()

    def arriving(
        self,
        memory: Memory,
        F_Bo_B: Float[Array, "6 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dt: Any,
        substeps: int,
    ) -> tuple[Memory, Float[Array, "6 *batch S"]]:
        """Memory after a wrench is commanded for `dt` s, and the actual wrench in S substeps."""
        del V_WB_B, dt
        return memory, jnp.broadcast_to(F_Bo_B[..., None], (*F_Bo_B.shape, substeps))

    @abc.abstractmethod
    def coefficients(self, V_WB_B: Float[Array, "6 *#batch"]) -> Coefficients:
        """M, D, D^f and b at a body velocity."""

    @abc.abstractmethod
    def mass_and_diffusion(
        self, V_WB_B: Float[Array, "6 *#batch"]
    ) -> tuple[Spd, Float[Array, "6 *#batch"]]:
        """M and b alone, for the second stage of the Heun step."""

    @abc.abstractmethod
    def potential(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "*#batch"]:
        """Potential energy V(g) in J, up to a constant."""

    @abc.abstractmethod
    def potential_wrench(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "6 *#batch"]:
        """F_V: minus the derivative of V along g exp(s e_i), a wrench about Bo in B."""

    def displace(
        self, X_WB: Float[Array, "7 *#batch"], twist_dt: Float[Array, "6 *#batch"]
    ) -> Float[Array, "7 *#batch"]:
        """The pose after a step in which ξ dt = `twist_dt`: X exp(ξ dt), the Lie-Euler step."""
        return se3.retract(X_WB, twist_dt)

    def correlate(
        self, V_WB_B: Float[Array, "6 *#batch"], dW: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        """C(ξ) dW, C Cᵀ the correlation matrix of the noise wrench b ∘ (C dW); here dW itself."""
        del V_WB_B
        return dW

    def drag_wrench(
        self, V_CB_B: Float[Array, "6 *#batch"], coefficients: Coefficients | None = None
    ) -> Float[Array, "6 *#batch"]:
        """-D ξ - D^f (|ξ| ∘ ξ) for the velocity ξ = `V_CB_B` relative to the water."""
        c = self.coefficients(V_CB_B) if coefficients is None else coefficients
        return -c.linear_drag.matvec(V_CB_B) - c.quadratic_drag.matvec(jnp.abs(V_CB_B) * V_CB_B)

    def acceleration(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        F_Bo_B: Float[Array, "6 *#batch"],
        flow: Flow | None = None,
        coefficients: Coefficients | None = None,
    ) -> Float[Array, "6 *#batch"]:
        """The drift of ξ: the time derivative of the components of `V_WB_B`, without noise."""
        mass, wrench = self.balance(X_WB, V_WB_B, F_Bo_B, flow, coefficients)
        return mass.solve(wrench)

    def balance(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        F_Bo_B: Float[Array, "6 *#batch"],
        flow: Flow | None = None,
        coefficients: Coefficients | None = None,
    ) -> tuple[Spd, Float[Array, "6 *#batch"]]:
        """M and the wrench M dξ/dt of all forces and of the rotating frame, without noise.

        In moving water drag and added mass depend on ξ_r = ξ - ξ_c and its rate, and the pressure
        gradient of the undisturbed flow gives ρ∇ a_c at the centre of buoyancy (Fossen 2011,
        eq. 8.3; Maxey and Riley 1983 for the pressure-gradient term).
        """
        V = V_WB_B
        if flow is None:
            c = self.coefficients(V) if coefficients is None else coefficients
            wrench = se3.coad_apply(V, c.mass.matvec(V)) + self.drag_wrench(V, c)
            return c.mass, wrench + self.potential_wrench(X_WB) + F_Bo_B
        v_c = se3.rotate_inverse(X_WB, flow.v_WC_W)
        a_c = se3.rotate_inverse(X_WB, flow.a_WC_W)
        zero = jnp.zeros_like(v_c)
        V_r = V - jnp.concatenate([v_c, zero])
        dV_c = jnp.concatenate([a_c - se3.cross(V[3:], v_c), zero])
        c = self.coefficients(V_r) if coefficients is None else coefficients

        def added(x: Array) -> Array:
            return c.mass.matvec(x) - jnp.tensordot(self.rigid_inertia, x, 1)

        pressure = self.displaced_mass * a_c
        r, _ = se3.align(self.p_BoCb_B, a_c)
        wrench = se3.coad_apply(V, jnp.tensordot(self.rigid_inertia, V, 1))
        wrench = wrench + se3.coad_apply(V_r, added(V_r)) + added(dV_c)
        wrench = wrench + jnp.concatenate([pressure, se3.cross(r, pressure)])
        wrench = wrench + self.drag_wrench(V_r, c) + self.potential_wrench(X_WB) + F_Bo_B
        return c.mass, wrench

    def noise_acceleration(
        self,
        V_WB_B: Float[Array, "6 *#batch"],
        dW: Float[Array, "6 *#batch"],
        coefficients: tuple[Spd, Array] | None = None,
    ) -> Float[Array, "6 *#batch"]:
        """M(ξ)⁻¹ b(ξ) C(ξ) dW: the velocity increment of a Brownian increment dW (√s)."""
        if coefficients is None:
            coefficients = self.mass_and_diffusion(V_WB_B)
        mass, b = coefficients
        b, dW = se3.align(b, self.correlate(V_WB_B, dW))
        return mass.solve(b * dW)

    def kinetic_energy(self, V_WB_B: Float[Array, "6 *#batch"]) -> Float[Array, "*#batch"]:
        """½ ξᵀ M ξ in J."""
        return jnp.sum(V_WB_B * self.coefficients(V_WB_B).mass.matvec(V_WB_B), axis=0) / 2
