"""Unnamed structure: a sparse residual of a few weighted terms in stated inputs."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import se3
from ..networks import expand
from ..se3 import AXES, TWIST
from .base import Effect, Parameter, Plant, axes_only, force_only
from .following import FOLLOWERS

MOTION: dict[str, Callable[[Array], Array]] = {
    **{n: lambda V, i=i: V[i] for i, n in enumerate(TWIST)},
    **{f"|{n}|{n}": lambda V, i=i: jnp.abs(V[i]) * V[i] for i, n in enumerate(TWIST)},
    **{f"{n}³": lambda V, i=i: V[i] ** 3 for i, n in enumerate(TWIST)},
    **{
        f"{TWIST[i]}·{TWIST[j]}": lambda V, i=i, j=j: V[i] * V[j]
        for i in range(6)
        for j in range(i, 6)
    },
}
"""Terms of a wrench in the velocities (u, v, w, p, q, r)."""
POSE = ("cos ψ", "sin ψ", "cos 2ψ", "sin 2ψ", "φ", "θ")
"""Terms in heading ψ, roll φ and pitch θ."""
COURSE = tuple(f"{turn}·{n}" for turn in POSE[:2] for n in TWIST)
"""Terms in the heading times a velocity."""
POWERS = ("|f|f", "f²", "f³")
"""Terms in a thruster's force, in units of 10 N."""
WORLD = ("east", "north", "up")
_SIZES = {
    "flow": 0.004, "place": 0.1, "depth": 0.1, "exchange": 0.1, **dict.fromkeys(FOLLOWERS, 0.3)
}  # fmt: skip
_FOLLOWED = 2.0
"""Memory duration (s) assumed for thrusters that follow their command (`FOLLOWERS`)."""
_PUSHES = ("motion", "pose", "course", "place", "depth", "damping")


class Unknown(Effect):
    """Σ_k w_k φ_k on one axis, thruster or in W; φ by `kind`, with its constants in `numbers`.

    `motion`: terms of `MOTION` by index, a wrench on an axis. `pose` and `course`: all of `POSE`
    or of `COURSE`, likewise.
    `memory`: ξ, Re z and Im z with z' = (-1/T + 2πi f) z + ξ, ξ a velocity; numbers T (s), f (Hz)
    and its index, by default that of the axis. `thruster`: all of `POWERS` on one thruster.
    `place`: a force in W of bumps exp(-½ |p - c|² / s²) over the horizontal plane, east and north
    for each; numbers s (m) and centres. `flow`: the same as a velocity of the water. `depth`: a
    force in W of (z - c) / s and its square, in three directions; numbers c and s (m). `damping`:
    a wrench on an axis of (z - c) / s times its own velocity, and times that velocity's square.
    `play`, `slew` and `steps`: one thruster or all (`thrusters`) have backlash of ± numbers[0] (N),
    a rate limit of numbers[0] (N/s), or forces in multiples of numbers[0] (N) alone; the weight 0
    is no such effect, 1 the full one.
    `exchange`: two thrusters, by number, take a share (the weight) of each other's command.
    Shares are not negative: what runs ahead of its command stands for something else.
    """

    name: ClassVar[str] = "unknown"
    family: ClassVar = "body"
    order: ClassVar[int] = 12
    source: ClassVar[str] = "matched to data"
    kind: str = eqx.field(static=True, default="motion")
    acts_on: str = eqx.field(static=True, default="surge")
    numbers: tuple[float, ...] = eqx.field(static=True, default=(0.0,))
    thrusters: int = eqx.field(static=True, default=0)

    @classmethod
    def neutral(cls, dtype: Any = float, **options: Any) -> "Unknown":
        options = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
        blank = cls(jnp.zeros(0, dtype), **options)
        return cls(jnp.zeros(len(blank.terms), dtype), **options)

    @property
    def terms(self) -> tuple[str, ...]:
        """The term that each value weights."""
        if self.kind == "motion":
            return tuple(list(MOTION)[int(i)] for i in self.numbers)
        if self.kind == "memory":
            own = TWIST[self.remembered]
            return own, f"Re z({own})", f"Im z({own})"
        if self.kind in ("pose", "course"):
            return POSE if self.kind == "pose" else COURSE
        if self.kind == "thruster":
            return POWERS
        if self.kind in FOLLOWERS or self.kind == "exchange":
            return (self.kind,)
        if self.kind == "depth":
            return tuple(f"{d} z{p}" for p in ("", "²") for d in WORLD)
        if self.kind == "damping":
            own = TWIST[AXES.index(self.acts_on)]
            return f"z {own}", f"z |{own}|{own}"
        count = len(self.numbers) // 2
        return tuple(f"{d} {i + 1}" for d in WORLD[:2] for i in range(count))

    @property
    def places(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self.acts_on,)

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        units = {"flow": "m/s", "exchange": "1", **dict.fromkeys(FOLLOWERS, "1")}
        unit = units.get(self.kind, "N a unit or N·m a unit")
        least = 0.0 if self.is_share else -math.inf
        return tuple(Parameter(t, unit, (_SIZES.get(self.kind, 1.0),), least) for t in self.terms)

    @property
    def is_share(self) -> bool:
        """Whether its one weight is a share: 0 is no effect, 1 the full one."""
        return self.kind in FOLLOWERS or self.kind == "exchange"

    def for_thrusters(self, count: int) -> "Unknown":
        return dataclasses.replace(self, thrusters=count)

    def acts(self, hook: str) -> bool:  # pyright: ignore[reportIncompatibleMethodOverride]
        acting = {"flow": "flow", "memory": "feel", "thruster": "thrust", "exchange": "thrust"}
        acting |= dict.fromkeys(FOLLOWERS, "actuate")
        return hook == acting.get(self.kind, "wrench")

    # ---------------------------------------------------------------------------------- terms

    def of_state(
        self, X_WB: Float[Array, "7 *#b"], V_CB_B: Float[Array, "6 *#b"]
    ) -> Float[Array, "k *b"]:
        """φ of the kinds that depend on the current pose and velocity alone.

        Those in W have one row for each bump or power, shared by all directions.
        """
        if self.kind == "motion":
            names = list(MOTION)
            return jnp.stack([MOTION[names[int(i)]](V_CB_B) for i in self.numbers])
        if self.kind == "pose":
            return _attitude(X_WB)
        if self.kind == "course":
            turn = _attitude(X_WB)[:2]
            return (turn[:, None] * V_CB_B[None]).reshape(len(COURSE), *V_CB_B.shape[1:])
        if self.kind == "depth":
            c, s = self.numbers
            z = (X_WB[6] - c) / s
            return jnp.stack([z, z * z])
        if self.kind == "damping":
            c, s = self.numbers
            z, v = (X_WB[6] - c) / s, V_CB_B[AXES.index(self.acts_on)]
            return jnp.stack([z * v, z * jnp.abs(v) * v])
        width, centres = self.numbers[0], np.array(self.numbers[1:]).reshape(-1, 2)
        shape = (-1,) + (1,) * (X_WB.ndim - 1)
        x, y = (jnp.asarray(c.reshape(shape), X_WB.dtype) for c in centres.T)
        return jnp.exp(-((X_WB[4][None] - x) ** 2 + (X_WB[5][None] - y) ** 2) / (2 * width**2))

    def _vector(self, X: Array, V: Array) -> Array:
        """Σ w φ as a vector in W."""
        phi = self.of_state(X, V)
        w = self.column(X)
        count = len(phi)
        if self.kind == "depth":  # powers outside, directions inside
            rows = [w[d::3] * phi for d in range(3)]
        else:
            rows = [w[d * count : (d + 1) * count] * phi for d in range(2)]
        parts = [jnp.sum(r, axis=0) for r in rows]
        return jnp.stack([*parts, *(jnp.zeros_like(parts[0]) for _ in range(3 - len(parts)))])

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        if self.kind not in _PUSHES:
            return jnp.zeros_like(V_CB_B)
        if self.kind in ("place", "depth"):
            return force_only(se3.rotate_inverse(X_WB, self._vector(X_WB, V_CB_B)))
        total = jnp.sum(self.column(V_CB_B) * self.of_state(X_WB, V_CB_B), axis=0)
        return axes_only({AXES.index(self.acts_on): total}, V_CB_B)

    def flow(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "3 *#batch"]:
        return self._vector(X_WB, X_WB[:6]) if self.kind == "flow" else jnp.zeros_like(X_WB[4:])

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        if self.kind == "exchange":
            order = list(range(len(force)))
            i, j = (int(k) - 1 for k in self.numbers)
            order[i], order[j] = j, i
            return force + self.column(force) * (force[np.array(order)] - force)
        if self.kind != "thruster":
            return force
        k = int(self.acts_on) - 1
        more = jnp.sum(self.column(force) * powers(force[k]), axis=0)[None]
        unit = jnp.arange(len(force)).reshape((-1,) + (1,) * (more.ndim - 1)) == k
        return force + jnp.where(unit, more, jnp.zeros_like(more))

    # --------------------------------------------------------------------------------- memory

    @property
    def remembered(self) -> int:
        """Index of the twist component that a memory filters."""
        return int(self.numbers[2]) if len(self.numbers) > 2 else AXES.index(self.acts_on)

    @property
    def memory_size(self) -> int:
        return self.thrusters if self.kind in FOLLOWERS else 2 * (self.kind == "memory")

    @property
    def memory_duration(self) -> float:
        if self.kind in FOLLOWERS:
            return _FOLLOWED
        return 5 * self.numbers[0] if self.kind == "memory" else 0.0

    def initial(self, command: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
        """For drives that follow their command the command itself: the actual output is unknown."""
        return command if self.kind in FOLLOWERS else super().initial(command)

    def actuate(
        self,
        memory: Float[Array, "m *#batch"],
        level: Float[Array, "n *#batch S"],
        dt: Float[Array, "..."],
    ) -> tuple[Float[Array, "m *#batch"], Float[Array, "n *#batch S"]]:
        if self.kind not in FOLLOWERS:
            return memory, level
        follow, h = FOLLOWERS[self.kind], dt / level.shape[-1]
        weight, means = self.column(level[..., 0]), []
        if self.acts_on != "thrusters":
            one = jnp.arange(len(level)) == int(self.acts_on) - 1
            weight = weight * expand(one.astype(level.dtype), level.ndim - 1)
        for s in range(level.shape[-1]):
            memory, mean = follow(memory, level[..., s], h, self.numbers[0])
            means.append(level[..., s] + weight * (mean - level[..., s]))
        return memory, jnp.stack(means, axis=-1)

    def feel(
        self, memory: Float[Array, "2 *#batch"], V_WB_B: Float[Array, "6 *#batch"], dt: Any
    ) -> tuple[Float[Array, "2 *#batch"], Float[Array, "6 *#batch"]]:
        """The memory after a step at this velocity, and the wrench during it."""
        x = V_WB_B[self.remembered]
        h = dt[0] if jnp.ndim(dt) else dt
        after = convolved(memory, x, self.numbers[0], self.numbers[1], h)
        mean = (memory + after) / 2
        w = self.column(V_WB_B)
        total = w[0] * x + w[1] * mean[0] + w[2] * mean[1]
        return after, axes_only({AXES.index(self.acts_on): total}, V_WB_B)


def convolved(
    z: Float[Array, "2 *#b"], x: Float[Array, " *#b"], time: float, frequency: float, dt: Any
) -> Float[Array, "2 *b"]:
    """After dt of z' = (-1/T + 2πi f) z + x, with x held: real and imaginary part of z."""
    h = jnp.asarray(dt, x.dtype)
    a, b = -1 / time, float(2 * np.pi * frequency)
    size = jnp.exp(a * h)
    c, s = size * jnp.cos(b * h), size * jnp.sin(b * h)
    # (turn - 1) / rate with rate a + b i
    square = a * a + b * b
    re, im = ((c - 1) * a + s * b) / square, (s * a - (c - 1) * b) / square
    return jnp.stack([c * z[0] - s * z[1] + re * x, s * z[0] + c * z[1] + im * x])


def powers(force: Float[Array, " *b"]) -> Float[Array, "3 *b"]:
    """Terms of `POWERS`."""
    f = force / 10
    return jnp.stack([jnp.abs(f) * f, f * f, f * f * f])


def _attitude(X: Array) -> Array:
    w, x, y, z = jnp.unstack(X[:4])
    s, c = 2 * (w * z + x * y), 1 - 2 * (y * y + z * z)
    size = jnp.sqrt(s * s + c * c)
    s, c = s / size, c / size
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1, 1))
    return jnp.stack([c, s, c * c - s * s, 2 * s * c, roll, pitch])
