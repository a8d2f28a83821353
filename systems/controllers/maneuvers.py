"""Maneuvers one after the other: to the start pose, at rest there, then open loop.

The protocol of the data sets of Palmer et al., "Field Experiments": a proportional-derivative
controller drives the vehicle to an initial configuration; when it is steady there, it gets the
maneuver's wrenches without feedback.
"""

import enum
import math
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ...models import se3
from ...models.config.checks import check_numbers, require
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State, shown
from ..drake import drake_array, group, set_groups, value, value_or_none
from .health_gate import LOST
from .impedance import ImpedanceLaw
from .without_position import horizontal_left_out


class Phase(enum.IntEnum):
    """What the controller does."""

    APPROACH = 0
    HOLD = 1
    """The start is reached, within the bounds of `Steadiness`."""
    OPEN_LOOP = 2
    FINISHED = 3


@dataclass(frozen=True)
class Steadiness:
    """When a vehicle is at rest at its start pose.

    Its deviation is averaged with the time constant `time` / 2: the noise of a gyroscope beside
    running thrusters, or that of a depth gauge, is no motion.

    Attributes:
        position: largest distance from the start (m).
        angle: largest rotation from it (degrees).
        speed: largest speed (m/s).
        turn_rate: largest angular velocity (rad/s).
        time: for which all of these hold before the maneuver begins (s).
        limit: longest time to get there (s); then the trajectory is left out.
        most: trajectories in a row that are left out before the rest is given up.
    """

    position: float = 0.2
    angle: float = 8.0
    speed: float = 0.08
    turn_rate: float = 0.08
    time: float = 1.0
    limit: float = 90.0
    most: int = 3

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("position", "angle", "speed", "turn_rate", "time", "limit"):
            require(getattr(self, name) > 0, self, name, "give a number above zero")
        require(self.most >= 1, self, "most", "give 1 or more")

    @property
    def bounds(self) -> Float[np.ndarray, "4"]:
        """Of distance (m), angle (rad), speed (m/s) and turn rate (rad/s)."""
        return np.array([self.position, math.radians(self.angle), self.speed, self.turn_rate])


class ManeuverProgram(eqx.Module):
    """Trajectories to take: where each begins, and the wrenches that follow.

    Attributes:
        start: X_WB of each trajectory.
        which: the row of `F_Bo_B` that each flies.
        F_Bo_B: wrenches of the maneuvers, each held for `step` (s).
        F_hold: wrench that holds a vehicle at each start by the model of its vehicle.
        step: (s).
        names: name and number of each trajectory.
    """

    start: Float[np.ndarray, "n 7"]
    which: np.ndarray
    F_Bo_B: Float[np.ndarray, "k steps 6"]
    F_hold: Float[np.ndarray, "n 6"]
    step: float = eqx.field(static=True)
    names: tuple[tuple[str, int], ...] = eqx.field(static=True)


def deviation(
    X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"], start: Float[Array, "7"]
) -> Float[Array, "12"]:
    """Distance vector (m), rotation vector (rad) and twist relative to rest at a pose."""
    turned = se3.local(X_WB, jnp.concatenate([start[:4], X_WB[4:]]))[3:]
    return jnp.concatenate([start[4:] - X_WB[4:], turned, V_WB_B])


def errors(deviation: Float[Array, "12"]) -> Float[Array, "4"]:
    """Distance (m), angle (rad), speed (m/s) and turn rate (rad/s) of a deviation."""
    return jnp.linalg.norm(deviation.reshape(4, 3), axis=1)


class ManeuverSequence(LeafSystem):
    """Flies a `ManeuverProgram` trajectory by trajectory.

    For each: `law` (without feedforward but for the static wrench) drives the vehicle to the start;
    when it is steady there, the wrenches of the maneuver are put out without feedback. They begin
    at multiples of the program's step, so that a log of that step has them exactly. A trajectory
    whose start is not reached in time, or whose estimate is lost, is left out. While the estimate
    is unknown the wrench is zero.

    The port `maneuver` is the phase (`Phase`), the number of the trajectory, the time since the
    phase began to count (s), the time since which the vehicle is steady (s, -1: it is not), and the
    number of trajectories in a row that were left out.

    .. pydrake_system::

        name: ManeuverSequence
        input_ports:
        - X_WB
        - V_WB_B
        - health
        output_ports:
        - F_Bo_B
        - maneuver

    """

    def __init__(
        self,
        program: ManeuverProgram,
        law: ImpedanceLaw,
        steady: Steadiness,
        period: float = 0.05,
        health: int | None = 5,
    ):
        """`period` divides the program's step; `health` is the size of the filter's.

        None leaves the port out, for a vehicle without a horizontal aid: its start is an attitude,
        a depth and a heading.
        """
        super().__init__()
        self.program, self.law, self.steady, self.period = program, law, steady, period
        self._horizontal = health is not None
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._health = None if health is None else self.DeclareVectorInputPort("health", health)
        self._F = self.DeclareDiscreteState(6)
        self._state = self.DeclareDiscreteState(drake_array([0.0, 0.0, 0.0, -1.0, 0.0]))
        self._mean = self.DeclareDiscreteState(drake_array(np.full(12, np.nan)))
        self._gain = -math.expm1(-2 * period / steady.time)
        self.DeclareStateOutputPort("F_Bo_B", self._F)
        self.DeclareStateOutputPort("maneuver", self._state)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self._step = VectorFunction(self._call, [1, 7, 6, 1, 5, 12], [6, 5, 12])

    def _call(
        self, t: Array, X: Array, V: Array, health: Array, state: Array, mean: Array
    ) -> tuple[Array, ...]:
        program, steady, now = self.program, self.steady, t[0]
        phase, index, since, rested, left_out = state
        count, steps = len(program.start), program.F_Bo_B.shape[1]
        starts = jnp.asarray(program.start)
        start = starts[jnp.clip(index, 0, count - 1).astype(jnp.int32)]
        known = jnp.all(jnp.isfinite(X)) & jnp.all(jnp.isfinite(V)) & (health[0] < LOST)
        seen, aim = (V, start) if self._horizontal else horizontal_left_out(X, V, start)
        mean, inside = self._averaged(mean, deviation(X, seen, aim), known)
        rested = jnp.where(inside, jnp.where(rested < 0, now, rested), -1.0)
        step = jnp.asarray(program.step)
        instant = jnp.abs(now / step - jnp.round(now / step)) < 1e-6
        going = phase < Phase.OPEN_LOOP
        begins = going & inside & instant & (now - rested >= steady.time - 1e-6)
        flying = phase == Phase.OPEN_LOOP
        k = jnp.round((now - since) / step * 1e3) / 1e3
        done = flying & (k >= steps)
        failed = (going & ~begins & (now - since > steady.limit)) | (flying & ~known & ~done)
        following = done | failed
        index = index + following.astype(index.dtype)
        left_out = jnp.where(done, 0, left_out + failed.astype(index.dtype))
        over = (index >= count) | (left_out >= steady.most) | (phase == Phase.FINISHED)
        phase = jnp.where(
            over,
            float(Phase.FINISHED),
            jnp.where(
                begins | (flying & ~following),
                float(Phase.OPEN_LOOP),
                jnp.where(inside & ~following, float(Phase.HOLD), float(Phase.APPROACH)),
            ),
        )
        k = jnp.where(begins, 0, k)
        since = jnp.where(begins | following, now, since)
        rested = jnp.where(begins | following, -1.0, rested)
        at = jnp.clip(index, 0, count - 1).astype(jnp.int32)
        seen, aim = (V, starts[at]) if self._horizontal else horizontal_left_out(X, V, starts[at])
        driven = self.law(X, seen, aim, jnp.zeros_like(V), jnp.asarray(program.F_hold)[at])
        number = jnp.clip(jnp.floor(k), 0, steps - 1).astype(jnp.int32)
        open_loop = jnp.asarray(program.F_Bo_B)[jnp.asarray(program.which)[at], number]
        F = jnp.where(phase == Phase.OPEN_LOOP, open_loop, driven)
        new = jnp.stack([phase, index, since, rested, left_out])
        return jnp.where(known, F, 0), new, jnp.where(following, jnp.nan, mean)

    def _averaged(self, mean: Array, now: Array, known: Array) -> tuple[Array, Array]:
        """The mean deviation, NaN before the first, and whether it is within its bounds."""
        mean = jnp.where(jnp.isnan(mean), now, mean + self._gain * (now - mean))
        mean = jnp.where(known, mean, jnp.nan)
        return mean, known & jnp.all(errors(mean) <= jnp.asarray(self.steady.bounds))

    def pure(self) -> Pure:
        """The update as a pure function."""

        def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
            health = inputs["health"][:1] if "health" in inputs else jnp.zeros(1)
            seen = inputs["X_WB"], inputs["V_WB_B"], health
            return dict(enumerate(self._call(t[None], *seen, *state[1:])))

        outputs = {"F_Bo_B": shown(0), "maneuver": shown(1)}
        return Pure((Event(self.period, update),), outputs)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        health = None if self._health is None else value_or_none(self._health, context)
        found = self._step(
            np.array([context.get_time()]),
            value(self._X, context),
            value(self._V, context),
            np.zeros(1) if health is None else health[:1],
            group(context, self._state),
            group(context, self._mean),
        )
        set_groups(state, [self._F, self._state, self._mean], found)
