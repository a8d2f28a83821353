"""Fossen's model of a submerged vehicle: constant coefficients under the Euler–Poincaré drift."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import se3
from .dynamics import Coefficients, Dynamics
from .growth import Growth
from .spd import ConstantOperator, ConstantSpd, Spd

GRAVITY = 9.80665
"""Standard gravity, m/s² (CGPM 1901)."""


def spatial_inertia(
    mass: float, p_BoBcm_B: Float[np.ndarray, "3"], I_BBcm_B: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "6 6"]:
    """Rigid-body inertia about Bo for twists [v, ω] (Fossen 2011, eq. 3.44).

    `mass` in kg, `p_BoBcm_B` in m, `I_BBcm_B` in kg·m² about the centre of mass.
    """
    x, y, z = p_BoBcm_B
    S = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[mass * np.eye(3), -mass * S], [mass * S, I_BBcm_B - mass * S @ S]])


class FossenDynamics(Dynamics):
    """M = M_RB + M_A, D, D^f, weight and buoyancy, all constant; b constant or growing with speed.

    With a diagonal `quadratic_drag` the fluid drag is Fossen's D_n(ν)ν = diag(d_i |ν_i|) ν.

    Example:
        >>> model = load_vehicle("bluerov2_heavy").dynamics(diffusion=np.full(6, 0.5))
        >>> float(model.diffusion[0])
        0.5
    """

    rigid_inertia: Float[Array, "6 6"]
    displaced_mass: Float[Array, ""]
    p_BoCb_B: Float[Array, "3"]
    mass: ConstantSpd
    linear_drag: ConstantOperator
    quadratic_drag: ConstantOperator
    diffusion: Float[Array, "6"]
    weight: Float[Array, ""]
    buoyancy: Float[Array, ""]
    p_BoBcm_B: Float[Array, "3"]
    growth: Growth | None = None
    """How `diffusion` grows with the twist; None: it is constant."""

    def __init__(
        self,
        *,
        rigid_inertia: Float[np.ndarray, "6 6"],
        added_mass: Float[np.ndarray, "6 6"],
        linear_drag: Float[np.ndarray, "6 6"],
        quadratic_drag: Float[np.ndarray, "6 6"],
        weight: float,
        buoyancy: float,
        p_BoBcm_B: Float[np.ndarray, "3"],
        p_BoCb_B: Float[np.ndarray, "3"],
        displaced_mass: float | None = None,
        diffusion: Float[np.ndarray, "6"] | None = None,
        growth: Growth | None = None,
        dtype: jnp.dtype | type = float,
    ):
        """SI units: kg, m, N, N·s/m, N·s²/m²; `displaced_mass` ρ∇ defaults to buoyancy / g.

        Raises:
            ValueError: M_RB + M_A is not symmetric positive definite, or a value is not finite.
        """
        total = np.asarray(rigid_inertia, float) + np.asarray(added_mass, float)
        if not np.all(np.isfinite(total)) or not np.allclose(total, total.T, atol=1e-9):
            raise ValueError("mass matrix M_RB + M_A must be finite and symmetric")
        if np.linalg.eigvalsh(total)[0] <= 0:
            raise ValueError("mass matrix M_RB + M_A must be positive definite; check added_mass")
        b = np.zeros(6) if diffusion is None else np.asarray(diffusion, float)
        if b.shape != (6,) or not np.all(b >= 0):
            raise ValueError("diffusion must be six non-negative numbers (N√s, N·m√s)")
        self.rigid_inertia = jnp.asarray(rigid_inertia, dtype)
        self.displaced_mass = jnp.asarray(
            buoyancy / GRAVITY if displaced_mass is None else displaced_mass, dtype
        )
        self.p_BoCb_B = jnp.asarray(p_BoCb_B, dtype)
        self.p_BoBcm_B = jnp.asarray(p_BoBcm_B, dtype)
        self.mass = ConstantSpd(jnp.asarray(total, dtype), jnp.asarray(np.linalg.inv(total), dtype))
        self.linear_drag = ConstantOperator(jnp.asarray(linear_drag, dtype))
        self.quadratic_drag = ConstantOperator(jnp.asarray(quadratic_drag, dtype))
        self.diffusion = jnp.asarray(b, dtype)
        self.growth = growth
        self.weight = jnp.asarray(weight, dtype)
        self.buoyancy = jnp.asarray(buoyancy, dtype)

    def with_constants(self, **changed: Any) -> "FossenDynamics":
        """The same model with some of the constructor's arguments replaced."""
        rigid = np.asarray(self.rigid_inertia, float)
        own = {
            "rigid_inertia": rigid,
            "added_mass": np.asarray(self.mass.matrix(), float) - rigid,
            "linear_drag": np.asarray(self.linear_drag.matrix(), float),
            "quadratic_drag": np.asarray(self.quadratic_drag.matrix(), float),
            "weight": float(self.weight),
            "buoyancy": float(self.buoyancy),
            "p_BoBcm_B": np.asarray(self.p_BoBcm_B, float),
            "p_BoCb_B": np.asarray(self.p_BoCb_B, float),
            "displaced_mass": float(self.displaced_mass),
            "diffusion": np.asarray(self.diffusion, float),
            "growth": self.growth,
            "dtype": self.rigid_inertia.dtype,
        }
        return FossenDynamics(**(own | changed))

    def coefficients(self, V_WB_B: Float[Array, "6 *#batch"]) -> Coefficients:
        b = self._diffusion(V_WB_B)
        return Coefficients(self.mass, self.linear_drag, self.quadratic_drag, b)

    def mass_and_diffusion(self, V_WB_B: Float[Array, "6 *#batch"]) -> tuple[Spd, Array]:
        return self.mass, self._diffusion(V_WB_B)

    def _diffusion(self, V_WB_B: Array) -> Array:
        if self.growth is None:
            return self.diffusion
        return self.growth(self.diffusion, V_WB_B)

    def potential(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "*#batch"]:
        """Weight × height of the centre of mass - buoyancy × height of the centre of buoyancy."""
        z_cm = se3.act(X_WB, self.p_BoBcm_B)[2]
        z_cb = se3.act(X_WB, self.p_BoCb_B)[2]
        return self.weight * z_cm - self.buoyancy * z_cb

    def potential_wrench(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "6 *#batch"]:
        """-g(η) of Fossen (2011, eq. 4.6), z up."""
        up_W = jnp.zeros(3, X_WB.dtype).at[2].set(1)
        up_B = se3.rotate_inverse(X_WB, up_W)
        lever, _ = se3.align(self.p_BoCb_B * self.buoyancy - self.p_BoBcm_B * self.weight, up_B)
        force = (self.buoyancy - self.weight) * up_B
        return jnp.concatenate([force, se3.cross(lever, up_B)])
