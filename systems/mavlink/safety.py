"""Guards of a dive: limits on the wrench, watchdogs, and the order to stop.

Pure functions of what is seen at one time; nothing here knows controllers, sockets or threads. A
guard that trips ends the dive for good: neutral thrusters first, then the configured end. Its
sentence is the reason in the log.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ...models.config.checks import Vector6, check_numbers, require

Order = Literal["fly", "neutral", "hold_depth", "disarm", "yield"]
"""What the actuation does: send the wrench; send neutral; neutral in the mode ALT_HOLD; disarm;
send nothing at all, because a pilot steers."""

_NEUTRAL_FOR = 0.5  # s of neutral before the end: some ten messages, of which one arrives
_LOST = 2  # health of the filter: 0 good, 1 degraded, 2 lost


@dataclass(frozen=True)
class SafetyConfig:
    """Limits and watchdogs.

    Attributes:
        max_wrench: largest magnitude of each component (N, N·m).
        max_wrench_rate: largest rate of each component (N/s, N·m/s).
        min_depth: least depth of Bo below the surface (m); negative is above it.
        max_depth: greatest depth (m).
        fence: half sides of the box about the start in which Bo stays, along x and y of W (m).
        silence: longest time without any message of the vehicle (s).
        stale: longest age of attitude and depth, and for an own estimate of inertial samples (s).
        stale_aid: longest age of what a horizontal estimate without a covariance rests on (s): the
            autopilot's position; the velocity or position aid of a filter that tells no health.
        dead_reckoning: longest time for which a filter that tells its health bridges the lack of a
            velocity or position aid (s). With the shipped sensors σ of the position grows by 0.2 m
            in 6 s and by 0.5 to 0.7 m in 10 s; the covariance covers the errors for as long as the
            aid is missing (`tests/test_dead_reckoning.py`).
        plan_age: longest age of the plan that is followed (s).
        late: longest time by which the loop may be late (s): the computer is too busy.
        lost: longest time for which the estimator may be lost (s): its velocity or its attitude is
            more uncertain than `lost_velocity` or `lost_attitude` of the filter.
        outputs: longest time for which the vehicle's outputs may differ from the commanded ones
            (s); the verticals' do for half a second after arming.
        min_voltage: least battery voltage under load (V); 0 switches the guard off.
        dead_man: longest time between presses of the dead-man key (s); 0 needs none.
        end: what follows neutral thrusters.
        hold: longest time for which depth is held before the vehicle is disarmed (s).
    """

    max_wrench: Vector6 = (80.0, 80.0, 80.0, 8.0, 8.0, 14.0)
    max_wrench_rate: Vector6 = (400.0, 400.0, 400.0, 40.0, 40.0, 70.0)
    min_depth: float = -0.5
    max_depth: float = 30.0
    fence: tuple[float, float] = (20.0, 20.0)
    silence: float = 1.0
    stale: float = 0.5
    stale_aid: float = 2.0
    dead_reckoning: float = 6.0
    plan_age: float = 2.0
    late: float = 0.5
    lost: float = 1.0
    outputs: float = 2.0
    min_voltage: float = 13.2
    dead_man: float = 0.0
    end: Literal["hold_depth", "disarm"] = "hold_depth"
    hold: float = 60.0

    def __post_init__(self) -> None:
        """Check signs."""
        check_numbers(self)
        for name in ("max_wrench", "max_wrench_rate", "fence"):
            require(min(getattr(self, name)) > 0, self, name, "give numbers above zero")
        times = ("silence", "stale", "stale_aid", "dead_reckoning", "plan_age", "late")
        for name in (*times, "lost", "outputs", "hold"):
            require(getattr(self, name) > 0, self, name, "give a time above zero")
        for name in ("min_voltage", "dead_man"):
            require(getattr(self, name) >= 0, self, name, "give zero or more")
        require(self.max_depth > self.min_depth, self, "max_depth", "give more than min_depth")


class Snapshot(NamedTuple):
    """What is seen at one time. Ages are in s, infinite where nothing came yet."""

    t: float
    """Time of the dive (s)."""
    F_Bo_B: Float[np.ndarray, "6"]
    """The wanted wrench (N, N·m)."""
    p_WBo: Float[np.ndarray, "3"]
    """Estimated position (m)."""
    health: int
    """Of the estimator: 0 good, 1 degraded, 2 lost."""
    ages: Mapping[str, float]
    """Of `vehicle` (any message), `attitude`, `depth`; where there is one, of `imu`, of `aid` or
    `dead_reckoning`, of `plan`, `loop`, `dead_man`."""
    armed: bool
    mode: str
    voltage: float
    """Of the battery (V), NaN if unknown."""
    failsafe: str = ""
    """The vehicle's own failsafe, in its words; empty if none is on."""
    rivals: int = 0
    """Other ground stations with our system id."""
    outputs: float = 0.0
    """Time for which the vehicle's outputs have not been those that are commanded (s)."""
    depth_healthy: bool = True
    """Whether the vehicle takes its depth sensor for healthy."""


class State(NamedTuple):
    """The guard's state."""

    mode: str
    """The mode that we set."""
    p_WBo: Float[np.ndarray, "3"]
    """Centre of the fence (m)."""
    F_Bo_B: Float[np.ndarray, "6"] = np.zeros(6)
    """The wrench that was sent last (N, N·m)."""
    t: float = 0.0
    lost_since: float | None = None
    tripped: str = ""
    """Name of the guard that ended the dive."""
    reason: str = ""
    """Its sentence."""
    since: float = 0.0
    """When it tripped (s)."""


Guard = Callable[[SafetyConfig, State, Snapshot], str]
"""The reason to stop, or nothing."""


def _wrench(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del config, state
    finite = np.isfinite(snapshot.F_Bo_B).all()
    return "" if finite else f"the controller wants a wrench that is not finite: {snapshot.F_Bo_B}"


def _stale(name: str, field: str, words: str) -> Guard:
    """A guard on the age of `name`, with its limit in the field `field`; a limit of 0 is none."""

    def guard(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
        del state
        age, limit = snapshot.ages.get(name), getattr(config, field)
        if age is None or limit == 0 or age <= limit:
            return ""
        return f"{words} for {age:.1f} s (limit {limit:g} s)"

    return guard


def _estimate(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    if not np.isfinite(snapshot.p_WBo).all():
        return f"the estimated position is not finite: {snapshot.p_WBo}"
    since = state.lost_since
    if snapshot.health < _LOST or since is None or snapshot.t - since <= config.lost:
        return ""
    return f"the estimator has been lost for {snapshot.t - since:.1f} s (limit {config.lost:g} s)"


def _depth_limits(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del state
    depth = -float(snapshot.p_WBo[2])
    if config.min_depth <= depth <= config.max_depth:
        return ""
    return f"depth {depth:.1f} m is outside {config.min_depth:g} to {config.max_depth:g} m"


def _fence(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    x, y = np.abs(snapshot.p_WBo - state.p_WBo)[:2]
    if x <= config.fence[0] and y <= config.fence[1]:
        return ""
    half = f"{config.fence[0]:g} × {config.fence[1]:g} m"
    return f"{x:.1f} m and {y:.1f} m from the start along x and y: outside the fence of ± {half}"


def _pilot(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del config
    if snapshot.mode == state.mode:
        return ""
    return f"the mode was changed to {snapshot.mode} (we had set {state.mode}): a pilot steers"


def _disarmed(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del config, state
    return "" if snapshot.armed else "the vehicle was disarmed"


def _failsafe(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del config, state
    return f"the vehicle's failsafe is on: {snapshot.failsafe}" if snapshot.failsafe else ""


def _depth_sensor(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del config, state
    return "" if snapshot.depth_healthy else "the vehicle's depth sensor is not healthy"


def _rival(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del config, state
    return "another ground station uses our system id" if snapshot.rivals else ""


def _outputs(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del state
    time = snapshot.outputs
    if time <= config.outputs:
        return ""
    return (
        f"the vehicle's outputs have differed from the commanded ones for {time:.1f} s: "
        "somebody else commands, or its parameters are others"
    )


def _battery(config: SafetyConfig, state: State, snapshot: Snapshot) -> str:
    del state
    if np.isnan(snapshot.voltage) or snapshot.voltage >= config.min_voltage:
        return ""
    return f"battery {snapshot.voltage:.1f} V is below {config.min_voltage:g} V"


AGED: dict[str, tuple[str, str, str]] = {
    "silence": ("vehicle", "silence", "the vehicle was not heard"),
    "attitude": ("attitude", "stale", "no new attitude came"),
    "depth": ("depth", "stale", "no new depth came"),
    "imu": ("imu", "stale", "no new inertial sample came"),
    "aid": ("aid", "stale_aid", "no new velocity or position came"),
    "dead_reckoning": (
        "dead_reckoning",
        "dead_reckoning",
        "the filter has bridged the lack of a velocity or position",
    ),
    "loop": ("loop", "late", "the loop on this computer has been late"),
    "plan": ("plan", "plan_age", "the planner made no new plan"),
    "dead_man": ("dead_man", "dead_man", "the dead-man key was not pressed"),
}
"""Guards on ages: the age in a `Snapshot`, the limit's field of `SafetyConfig`, the words."""

GUARDS: dict[str, Guard] = {
    "pilot": _pilot,
    "disarmed": _disarmed,
    "rival": _rival,
    "outputs": _outputs,
    "failsafe": _failsafe,
    "silence": _stale(*AGED["silence"]),
    "attitude": _stale(*AGED["attitude"]),
    "depth": _stale(*AGED["depth"]),
    "depth_sensor": _depth_sensor,
    "imu": _stale(*AGED["imu"]),
    "aid": _stale(*AGED["aid"]),
    "dead_reckoning": _stale(*AGED["dead_reckoning"]),
    "loop": _stale(*AGED["loop"]),
    "estimate": _estimate,
    "plan": _stale(*AGED["plan"]),
    "dead_man": _stale(*AGED["dead_man"]),
    "depth_limits": _depth_limits,
    "fence": _fence,
    "battery": _battery,
    "wrench": _wrench,
}
"""All guards, by name; the first that trips names the reason."""

_YIELDING = ("pilot", "disarmed")


class Decision(NamedTuple):
    """What to do now."""

    state: State
    order: Order
    F_Bo_B: Float[np.ndarray, "6"]
    """The limited wrench to send (N, N·m); zero unless the order is to fly."""


@dataclass(frozen=True)
class Supervisor:
    """All guards with their configuration."""

    config: SafetyConfig = field(default_factory=SafetyConfig)
    guards: Mapping[str, Guard] = field(default_factory=lambda: dict(GUARDS))

    def step(self, state: State, snapshot: Snapshot) -> Decision:
        """The order at one time.

        Once a guard has tripped, thrusters are neutral for half a second. Then the dive ends as
        configured, or by leaving the vehicle to the pilot who took it. A lost depth sensor, a
        silent vehicle or one whose depth is out of bounds is disarmed: it can't hold its depth.
        """
        lost = snapshot.health >= _LOST
        since = (snapshot.t if state.lost_since is None else state.lost_since) if lost else None
        state = state._replace(lost_since=since)
        if not state.tripped:
            for name, guard in self.guards.items():
                reason = guard(self.config, state, snapshot)
                if reason:
                    state = state._replace(tripped=name, reason=reason, since=snapshot.t)
                    break
        if state.tripped:
            ended = state._replace(F_Bo_B=np.zeros(6), t=snapshot.t)
            return Decision(ended, self._end(state, snapshot.t), np.zeros(6))
        F = limited(self.config, state.F_Bo_B, snapshot.F_Bo_B, snapshot.t - state.t)
        return Decision(state._replace(F_Bo_B=F, t=snapshot.t), "fly", F)

    def _end(self, state: State, t: float) -> Order:
        if state.tripped in _YIELDING:
            return "yield" if t - state.since >= _NEUTRAL_FOR else "neutral"
        if t - state.since < _NEUTRAL_FOR:
            return "neutral"
        blind = state.tripped in ("depth", "depth_sensor", "depth_limits", "silence")
        if blind or t - state.since > self.config.hold:
            return "disarm"
        return self.config.end


def limited(
    config: SafetyConfig,
    before: Float[np.ndarray, "6"],
    wanted: Float[np.ndarray, "6"],
    dt: float,
) -> Float[np.ndarray, "6"]:
    """The wrench within its limits and its rates (N, N·m), after `dt` (s)."""
    most = np.asarray(config.max_wrench)
    step = np.asarray(config.max_wrench_rate) * max(dt, 0.0)
    return np.clip(np.clip(wanted, -most, most), before - step, before + step)
