"""The Euclidean SPINN: the networks of `models.spinn` with the state in R¹², a baseline.

The state is position, Euler angles Θ = (roll, pitch, yaw) about z-y'-x'' and body twist, with

    dp/dt = R(Θ) v,   dΘ/dt = T(Θ) ω   (Fossen 2011, eqs. 2.18 and 2.28),

integrated by a plain Euler–Heun step in R¹². Nothing is wrapped or projected: the angles of data
jump at ±π and T is singular at pitch ±π/2, as this is the baseline that the group's structure is
compared with (Palmer et al., simulation experiments).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import se3
from .networks import Heads, MlpStack, expand
from .potential import Potential
from .rigid_body import FossenDynamics
from .spinn import Spinn, SpinnConfig, restoring


def coordinates(X_WB: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
    """Coordinates (p, Θ): position (m), Euler angles (rad) in the ranges of atan2 and asin."""
    return jnp.concatenate([X_WB[4:], se3.rpy(X_WB)])


def pose(q: Float[Array, "6 *batch"]) -> Float[Array, "7 *batch"]:
    """The pose of coordinates; angles that differ by a full turn give the same pose."""
    return se3.from_position_rpy(q[:3], q[3:])


def rotation(q: Float[Array, "6 *batch"]) -> list[list[Array]]:
    """R(Θ) by rows."""
    (cr, cp, cy), (sr, sp, sy) = (jnp.unstack(f(q[3:])) for f in (jnp.cos, jnp.sin))
    return [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]


def angle_rates(q: Float[Array, "6 *batch"]) -> list[list[Array]]:
    """T(Θ) by rows; infinite at pitch ±π/2."""
    (cr, cp, _), (sr, sp, _) = (jnp.unstack(f(q[3:])) for f in (jnp.cos, jnp.sin))
    one, zero = jnp.ones_like(cr), jnp.zeros_like(cr)
    return [[one, sr * sp / cp, cr * sp / cp], [zero, cr, -sr], [zero, sr / cp, cr / cp]]


def _times(rows: list[list[Array]], x: Array) -> Array:
    components = jnp.unstack(x)
    return jnp.stack([sum(a * b for a, b in zip(row, components, strict=True)) for row in rows])


def _transposed_times(rows: list[list[Array]], x: Array) -> Array:
    return _times([list(column) for column in zip(*rows, strict=True)], x)


def coordinate_rates(
    q: Float[Array, "6 *batch"], V_WB_B: Float[Array, "6 *batch"]
) -> Float[Array, "6 *batch"]:
    """(R(Θ) v, T(Θ) ω)."""
    return jnp.concatenate([_times(rotation(q), V_WB_B[:3]), _times(angle_rates(q), V_WB_B[3:])])


class EulerPotential(Potential):
    """V(p, Θ) as a network of the coordinates themselves, its gradient mapped to a wrench in B.

    With `pose` V = λ tanh(MLP(p / length, Θ) + s·u + s_z z), else (`gravity`) V =
    λ tanh(MLP(roll, pitch) + s·u) - f_b z; s·u with u = Rᵀ e_z is the reference's restoring energy,
    the initial V. The wrench is -[Rᵀ ∂V/∂p, Tᵀ ∂V/∂Θ].
    """

    hidden: MlpStack
    head: Heads
    skip: Float[Array, "3"]
    height: Float[Array, ""]
    bound: Float[Array, ""]
    net_buoyancy: Float[Array, ""]
    length: Float[Array, ""]
    whole_pose: bool = eqx.field(static=True)

    @classmethod
    def create(
        cls, config: SpinnConfig, reference: FossenDynamics, key: Array, dtype: Any
    ) -> "EulerPotential":
        """V that approximates the reference's restoring energy."""
        slope, heave, bound = restoring(config, reference)
        whole = config.potential == "pose"
        buoyancy = float(reference.buoyancy) - float(reference.weight)
        return cls(
            hidden=MlpStack.create(
                1, 6 if whole else 2, config.width, config.depth, config.activation, key, dtype
            ),
            head=Heads.constant(jnp.zeros((1, 1), dtype), config.width),
            skip=jnp.asarray(slope, dtype),
            height=jnp.asarray(-heave / bound / config.length_scale if whole else 0.0, dtype),
            bound=jnp.asarray(bound, dtype),
            net_buoyancy=jnp.asarray(0.0 if whole else buoyancy, dtype),
            length=jnp.asarray(config.length_scale, dtype),
            whole_pose=whole,
        )

    def energy_at(self, q: Float[Array, "6 *batch"]) -> Float[Array, "*batch"]:
        """V in J at coordinates with angles of any size."""
        p, angles = jnp.split(q, 2)
        up = jnp.stack(rotation(q)[2])
        raw = jnp.tensordot(self.skip, up, 1)
        if not self.whole_pose:
            raw = raw + self.head(self.hidden(angles[:2], 1), 1)[0, 0]
            return self.bound * jnp.tanh(raw) - self.net_buoyancy * p[2]
        x = jnp.concatenate([p / jax.lax.stop_gradient(self.length), angles])
        raw = raw + self.head(self.hidden(x, 1), 1)[0, 0] + self.height * p[2]
        return self.bound * jnp.tanh(raw)

    def wrench_at(self, q: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        """The wrench at coordinates with angles of any size."""
        dp, dangles = jnp.split(jax.grad(lambda q: jnp.sum(self.energy_at(q)))(q), 2)
        force = _transposed_times(rotation(q), dp)
        return -jnp.concatenate([force, _transposed_times(angle_rates(q), dangles)])

    def energy(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "*batch"]:
        return self.energy_at(coordinates(X_WB))

    def wrench(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
        return self.wrench_at(coordinates(X_WB))


class EuclideanSpinn(Spinn):
    """A SPINN whose pose is integrated by an Euler step in position and Euler angles.

    As a `Dynamics` it takes and returns poses, which brings angles back into their ranges after
    each step; `rollout` does not wrap them, as training in R¹² requires.
    """

    @staticmethod
    def starting_potential(
        config: SpinnConfig, reference: FossenDynamics, key: Array, dtype: Any
    ) -> Potential:
        return EulerPotential.create(config, reference, key, dtype)

    def trainable(self) -> "Spinn":
        """As in `Spinn`; parameters that the chosen potential does not use are not trained."""
        spec = super().trainable()
        whole = self._potential.whole_pose
        names = ("length", "net_buoyancy") if whole else ("length", "height")
        return eqx.tree_at(
            lambda m: [getattr(m.learned_potential, n) for n in names], spec, [False, False]
        )

    @property
    def _potential(self) -> EulerPotential:
        assert isinstance(self.learned_potential, EulerPotential)
        return self.learned_potential

    def displace(
        self, X_WB: Float[Array, "7 *#batch"], twist_dt: Float[Array, "6 *#batch"]
    ) -> Float[Array, "7 *#batch"]:
        """The pose of q + (R(Θ) v, T(Θ) ω) dt."""
        X_WB, twist_dt = se3.align(X_WB, twist_dt)
        q = coordinates(X_WB)
        return pose(q + coordinate_rates(q, twist_dt))

    def step(
        self,
        q: Float[Array, "6 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        F_Bo_B: Float[Array, "6 *#batch"],
        dt: float,
        dW: Float[Array, "6 *batch"] | None = None,
    ) -> tuple[Float[Array, "6 *batch"], Float[Array, "6 *batch"]]:
        """One Euler–Heun step of (q, ξ) in R¹² (Roberts 2012), dW as in `integrate.step`."""
        h = jnp.asarray(dt, V_WB_B.dtype)
        c = self.coefficients(V_WB_B)
        wrench = se3.coad_apply(V_WB_B, c.mass.matvec(V_WB_B)) + self.drag_wrench(V_WB_B, c)
        dV = h * c.mass.solve(wrench + self._potential.wrench_at(q) + F_Bo_B)
        if dW is not None and self.stochastic:
            first = self.noise_acceleration(V_WB_B, dW, (c.mass, c.diffusion))
            dV = dV + (first + self.noise_acceleration(V_WB_B + first, dW)) / 2
        return q + h * coordinate_rates(q, V_WB_B), V_WB_B + dV

    def rollout(
        self,
        q: Float[Array, "6 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        F_Bo_B: Float[Array, "T 6 *command"],
        dt: float,
        dW: Float[Array, "T 6 *batch"] | None = None,
    ) -> tuple[Float[Array, "T 6 *batch"], Float[Array, "T 6 *batch"]]:
        """Coordinates and twists at dt, 2 dt, …, T dt under zero-order-held wrenches."""

        def advance(carry: tuple[Array, Array], inputs: tuple[Array, Array | None]) -> Any:
            F, w = inputs
            carry = self.step(*carry, expand(F, V_WB_B.ndim), dt, w)
            return carry, carry

        _, (qs, Vs) = jax.lax.scan(jax.checkpoint(advance), (q, V_WB_B), (F_Bo_B, dW))
        return qs, Vs


def create_spinn(
    config: SpinnConfig,
    reference: FossenDynamics,
    key: Array,
    dtype: jnp.dtype | type | None = None,
) -> Spinn:
    """A model in the coordinates of `config`, starting at `reference`."""
    cls = EuclideanSpinn if config.coordinates == "euler" else Spinn
    return cls.create(config, reference, key, dtype)
