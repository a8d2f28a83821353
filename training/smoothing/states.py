"""State of the smoother, its transition and what is measured of it.

Errors are right-multiplied, X = X_ref exp(ξ), so that a state's error has the components

    [displacement (3), rotation (3), twist (6), bias (3), lever (3), push (6), scales (22)].

`bias` (m/s²) and `lever` (m) are the accelerometer's constant error and its place from Bo, `push` a
disturbance wrench that fades within a second. `scales` are what is not known of the model: the
logarithms of factors on the diagonals of M, D and D^f, and the error of its restoring force and
lever. A common scale of mass, drag and thrust is not among them: motion does not tell it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended, core
from ...models.rigid_body import GRAVITY
from ...models.spd import Spd

POSE, TWIST = slice(0, 6), slice(6, 12)
BIAS, LEVER, PUSH, SCALES = slice(12, 15), slice(15, 18), slice(18, 24), slice(24, 46)
SIZE = 46
MASS, LINEAR, QUADRATIC, BUOYANCY, RIGHTING = (
    slice(0, 6),
    slice(6, 12),
    slice(12, 18),
    slice(18, 19),
    slice(19, 22),
)
"""Parts of the scales."""
FADING = 1.0
"""Time constant of a push (s)."""

MEASURED = (
    *("x", "y", "z", "rx", "ry", "rz", "u", "v", "w", "p", "q", "r", "climb"),
    *("fx", "fy", "fz"),
)
"""Measured quantities: pose errors in W (position) and B (rotation), twist, vertical velocity in W,
specific force in B."""
MEASUREMENTS = len(MEASURED)


class State(NamedTuple):
    """Pose, twist, and the 34 other components by their order in the error."""

    X: Float[Array, "*batch 7"]
    V: Float[Array, "*batch 6"]
    others: Float[Array, "*batch 34"]


class Track(NamedTuple):
    """Runs side by side, padded to one length.

    Attributes:
        F: what drives the model in the substeps (S of them, or one for all) from n to n + 1: the
            wrench, or with effects the thrusters' forces and the relative voltage; the last one
            acts on.
        seen: measured values, poses' rotations as quaternions apart.
        q: measured attitudes.
        known: which of them were measured.
        lasts: whether sample n + 1 exists.
    """

    F: Float[Array, "R N S k"]
    seen: Float[Array, "R N 16"]
    q: Float[Array, "R N 4"]
    known: Bool[Array, "R N 16"]
    lasts: Bool[Array, "R N"]


class Scaled(NamedTuple):
    """A model with factors on its coefficients (`scales`)."""

    model: Dynamics
    righting: Float[Array, ""]
    """Unit of the lever's error (N·m)."""
    weight: Float[Array, ""]
    """Unit of the restoring force's error (N)."""

    @classmethod
    def of(cls, model: Dynamics) -> "Scaled":
        """Units from the model: its righting moment at 90° of roll, 1 % of its displacement."""
        heeled = jnp.zeros(7, model.displaced_mass.dtype).at[:2].set(0.5**0.5)
        moment = jnp.linalg.norm(model.potential_wrench(heeled)[3:])
        weight = 0.01 * GRAVITY * model.displaced_mass
        return cls(model, jnp.maximum(moment, 0.01 * weight), weight)

    def acceleration(
        self, X: Float[Array, "7"], V: Float[Array, "6"], F: Float[Array, " k"], scales: Array
    ) -> Float[Array, "6"]:
        """The drift of the twist."""
        V_r, turning, extra, pushed = V, None, None, F
        if isinstance(self.model, Extended):
            V_r, turning = self.model.through_water(X, V)
            extra = self.model.extra_inertia()
            pushed = self.model.push(F[:-1], X, V, F[-1:])
            pushed = pushed + self.model.extra_wrench(X, V_r, extra)
        c = core(self.model).coefficients(V_r)
        m, d, f = (jnp.exp(scales[part] / 2) for part in (MASS, LINEAR, QUADRATIC))
        up_B = se3.rotate_inverse(X, jnp.asarray([0.0, 0.0, 1.0], V.dtype))
        wrench = se3.coad_apply(V_r, m * c.mass.matvec(m * V_r)) + pushed
        wrench = wrench - d * c.linear_drag.matvec(d * V_r)
        wrench = wrench - f * c.quadratic_drag.matvec(f * jnp.abs(V_r) * V_r)
        wrench = wrench + self.model.potential_wrench(X)
        force = self.weight * scales[BUOYANCY] * up_B
        moment = se3.cross(self.righting * scales[RIGHTING], up_B)
        wrench = wrench + jnp.concatenate([force, moment])
        a = _solved(c.mass, m, extra, wrench)
        return a if turning is None else a + turning

    def advance(
        self, state: State, F: Float[Array, "S k"], dt: Any, substeps: int
    ) -> tuple[Float[Array, "7"], Float[Array, "6"]]:
        """Pose and twist a step of `dt` (s) later, without noise, by the midpoint rule.

        Euler's rule would turn the attitude by h ω̇ dt / 2 too little, many times its noise.
        """
        X, V, h = state.X, state.V, dt / substeps

        def step(carry: tuple[Array, Array], F: Array) -> tuple[tuple[Array, Array], None]:
            X, V = carry
            middle = V + h / 2 * self._pushed(X, V, F, state)
            halfway = self.model.displace(X, V * (h / 2))
            after = self.model.displace(X, middle * h)
            return (after, V + h * self._pushed(halfway, middle, F, state)), None

        return jax.lax.scan(step, (X, V), jnp.broadcast_to(F, (substeps, F.shape[1])))[0]

    def _pushed(self, X: Array, V: Array, F: Array, state: State) -> Array:
        """The drift of the twist under a wrench and the push.

        The push acts on the model's own mass: otherwise scales of the mass would explain noise.
        """
        own = self.model.mass_and_diffusion(V)[0].solve(_other(state, PUSH))
        return self.acceleration(X, V, F, _other(state, SCALES)) + own

    def measured(self, state: State, F: Float[Array, " k"]) -> Float[Array, "13"]:
        """Position, twist, climb and specific force of a state."""
        X, V = state.X, state.V
        a = self._pushed(X, V, F, state)
        omega, r = V[3:], _other(state, LEVER)
        f = a[:3] + se3.cross(omega, V[:3]) + se3.cross(a[3:], r)
        f = f + se3.cross(omega, se3.cross(omega, r)) + _other(state, BIAS)
        f = f + se3.rotate_inverse(X, jnp.asarray([0.0, 0.0, GRAVITY], V.dtype))
        climb = se3.rotate(X, V[:3])[2:]
        return jnp.concatenate([X[4:], V, climb, f])


def _solved(mass: Spd, m: Array, extra: Array | None, wrench: Array) -> Array:
    """The acceleration of a wrench under a scaled mass and an extra one."""
    if extra is None:
        return mass.solve(wrench / m) / m
    return jnp.linalg.solve(mass.matrix() * jnp.outer(m, m) + extra, wrench)


def _other(state: State, part: slice) -> Array:
    return state.others[part.start - TWIST.stop : part.stop - TWIST.stop]


def moved(state: State, error: Float[Array, "46"]) -> State:
    """The state with an error added."""
    X = se3.retract(state.X, error[POSE])
    return State(X, state.V + error[TWIST], state.others + error[TWIST.stop :])


class Linear(NamedTuple):
    """The problem linearised about a reference: errors δ of it obey

    δ' = A δ + c + w,   y = H δ + v.
    """

    A: Float[Array, "R N 46 46"]
    c: Float[Array, "R N 46"]
    H: Float[Array, "R N 16 46"]
    y: Float[Array, "R N 16"]


def linearised(model: Scaled, reference: State, track: Track, dt: Any, substeps: int) -> Linear:
    """Transition and measurement of every sample, about a reference (R, N)."""
    zero = jnp.zeros(SIZE, reference.V.dtype)
    fade = jnp.exp(-dt / FADING)

    def one(at: State, after: State, F: Array, F_here: Array, seen: Array, q: Array) -> Any:
        def transition(error: Array) -> Array:
            state = moved(at, error)
            X, V = model.advance(state, F, dt, substeps)
            rest = state.others.at[6:12].multiply(fade) - after.others
            return jnp.concatenate([se3.local(after.X, X), V - after.V, rest])

        def measurement(error: Array) -> Array:
            state = moved(at, error)
            found = model.measured(state, F_here)
            pose = jnp.concatenate([q, state.X[4:]])
            turned = -se3.local(state.X, pose)[3:]
            return jnp.concatenate([found[:3] - seen[:3], turned, found[3:] - seen[6:]])

        return (
            jax.jacfwd(transition)(zero),
            transition(zero),
            jax.jacfwd(measurement)(zero),
            -measurement(zero),
        )

    after = jax.tree.map(lambda a: jnp.concatenate([a[:, 1:], a[:, -1:]], axis=1), reference)
    # at a sample the wrench changes: what an instrument of finite bandwidth shows is between
    first, last = track.F[:, :, 0], track.F[:, :, -1]
    here = (first + jnp.concatenate([first[:, :1], last[:, :-1]], axis=1)) / 2
    given = (reference, after, track.F, here, track.seen, track.q)
    A, c, H, y = jax.vmap(jax.vmap(one))(*given)
    lasts, known = track.lasts[..., None], track.known
    A = jnp.where(lasts[..., None], A, jnp.eye(SIZE, dtype=A.dtype))
    return Linear(
        A,
        jnp.where(lasts, c, 0.0),
        jnp.where(known[..., None], H, 0.0),
        jnp.where(known, y, 0.0),
    )
