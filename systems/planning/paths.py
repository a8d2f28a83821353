"""Paths through space and time that a reference can follow: poses as smooth functions of time.

Each kind is a dataclass for YAML; its `pose(t)` is pure JAX, and `motion` derives twist and
acceleration from it by forward differentiation, so a kind need not state them.
"""

import abc
import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.checks import Vector3, check_numbers, require

_from_position_rpy = jax.jit(se3.from_position_rpy)


@dataclass(frozen=True)
class PoseConfig:
    """A pose as position and roll, pitch, yaw.

    Attributes:
        position: of Bo in W (m).
        rpy_deg: roll, pitch and yaw (degrees).
    """

    position: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)

    def pose(self, dtype: jnp.dtype | type = float) -> Float[Array, "7"]:
        """X_WB."""
        rpy = jnp.asarray([math.radians(a) for a in self.rpy_deg], dtype)
        return _from_position_rpy(jnp.asarray(self.position, dtype), rpy)


class Motion(NamedTuple):
    """Pose, twist and the rate of the twist's components at given times."""

    X_WB: Float[Array, "7 *batch"]
    V_WB_B: Float[Array, "6 *batch"]
    A_WB_B: Float[Array, "6 *batch"]


class Path(abc.ABC):
    """A reference pose over time; time (s) counts from the start of the simulation."""

    @abc.abstractmethod
    def pose(self, t: Float[Array, " n"]) -> Float[Array, "7 n"]:
        """X_WB at times t."""

    def place(self) -> tuple[float, float] | None:
        """The x and y in W (m) at which it stays; None if it moves horizontally."""
        return None

    def motion(self, t: Float[Array, " n"]) -> Motion:
        """Poses with their twists and accelerations.

        With q̇ and ṗ by forward differentiation, v = Rᵀ ṗ and (0, ω) = 2 q* ∘ q̇.
        """
        (X, V), (_, A) = jax.jvp(self._state, (t,), (jnp.ones_like(t),))
        return Motion(X, V, A)

    def _state(self, t: Array) -> tuple[Array, Array]:
        X, dX = jax.jvp(self.pose, (t,), (jnp.ones_like(t),))
        zero = jnp.zeros_like(X[4:])
        conjugate = jnp.concatenate([X[:1], -X[1:4], zero])
        omega = 2 * se3.compose(conjugate, jnp.concatenate([dX[:4], zero]))[1:4]
        return X, jnp.concatenate([se3.rotate_inverse(X, dX[4:]), omega])


@dataclass(frozen=True)
class HoldPose(Path):
    """Stay at one pose.

    Attributes:
        at: the pose.
    """

    at: PoseConfig = PoseConfig()

    def pose(self, t: Float[Array, " n"]) -> Float[Array, "7 n"]:
        return jnp.broadcast_to(self.at.pose(t.dtype)[:, None], (7, *t.shape))

    def place(self) -> tuple[float, float] | None:
        return self.at.position[0], self.at.position[1]


@dataclass(frozen=True)
class Waypoints(Path):
    """From pose to pose along geodesics, coming to rest at each.

    Time along a leg follows the minimum-jerk profile 10 s³ − 15 s⁴ + 6 s⁵ (Flash and Hogan 1985),
    whose speed peaks at 15/8 of the mean.

    Attributes:
        poses: at least two; the first is that at `start`.
        speed: mean linear speed along a leg (m/s).
        turn_rate: mean angular speed (rad/s) that a leg doesn't exceed.
        pause: time at rest on each pose but the last (s).
        start: when the first pause begins (s).
    """

    poses: tuple[PoseConfig, ...]
    speed: float = 0.25
    turn_rate: float = 0.3
    pause: float = 2.0
    start: float = 0.0

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(len(self.poses) >= 2, self, "poses", "give at least two poses")
        require(self.speed > 0, self, "speed", "give a speed above zero")
        require(self.turn_rate > 0, self, "turn_rate", "give a rate above zero")
        require(self.pause >= 0, self, "pause", "give zero or more")

    def times(
        self, dtype: jnp.dtype | type = float
    ) -> tuple[Float[Array, " legs"], Float[Array, " legs"]]:
        """When each leg begins and how long it takes (s)."""
        X = jnp.stack([p.pose(dtype) for p in self.poses], axis=1)
        twist = se3.local(X[:, :-1], X[:, 1:])
        metres, turn = (jnp.linalg.norm(part, axis=0) for part in (twist[:3], twist[3:]))
        length = jnp.maximum(jnp.maximum(metres / self.speed, turn / self.turn_rate), 1e-3)
        ends = self.start + jnp.cumsum(length + self.pause)
        return ends - length, length

    def pose(self, t: Float[Array, " n"]) -> Float[Array, "7 n"]:
        begins, lengths = self.times(t.dtype)
        X = jnp.stack([p.pose(t.dtype) for p in self.poses], axis=1)
        leg = jnp.clip(jnp.searchsorted(begins, t, side="right") - 1, 0, len(self.poses) - 2)
        s = jnp.clip((t - begins[leg]) / lengths[leg], 0, 1)
        s = s**3 * (10 - 15 * s + 6 * s * s)
        return se3.interpolate(X[:, leg], X[:, leg + 1], s[None])

    def place(self) -> tuple[float, float] | None:
        places = {each.position[:2] for each in self.poses}
        return places.pop() if len(places) == 1 else None


@dataclass(frozen=True)
class FigureEight(Path):
    """A level figure eight (Lissajous 1:2) that begins and stays at its centre's crossing point.

    x = a sin φ, y = b sin 2φ about `centre`, φ̇ rising from rest to 2π/period within `ramp`.

    Attributes:
        centre: pose of the crossing point; the figure lies in its x-y plane.
        length: from tip to tip, 2a (m).
        width: of the lobes, 2b (m).
        period: of a whole figure (s).
        ramp: time to accelerate (s).
        follow: turn the bow along the path (else the heading stays that of `centre`).
    """

    centre: PoseConfig = PoseConfig()
    length: float = 4.0
    width: float = 2.0
    period: float = 40.0
    ramp: float = 5.0
    follow: bool = False

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("length", "width", "period", "ramp"):
            require(getattr(self, name) > 0, self, name, "give a number above zero")

    def pose(self, t: Float[Array, " n"]) -> Float[Array, "7 n"]:
        s = jnp.clip(t / self.ramp, 0, 1)
        # ∫ of the smooth step 3s² − 2s³; beyond the ramp the phase rate is constant
        run = self.ramp * (s**3 - s**4 / 2) + jnp.maximum(t - self.ramp, 0)
        phase = 2 * math.pi / self.period * run
        a, b = self.length / 2, self.width / 2
        zero = jnp.zeros_like(t)
        p = jnp.stack([a * jnp.sin(phase), b * jnp.sin(2 * phase), zero])
        heading = jnp.arctan2(2 * b * jnp.cos(2 * phase), a * jnp.cos(phase))
        heading = heading if self.follow else zero
        local = se3.from_position_rpy(p, jnp.stack([zero, zero, heading]))
        return se3.compose(self.centre.pose(t.dtype), local)
