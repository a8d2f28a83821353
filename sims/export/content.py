"""What a run or a recording shows: topics of frames, poses, paths, scene, plots and messages."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...models.recordings.build import Trajectory
from ...models.recordings.checks.finding import findings_of
from ...models.recordings.schema import LABELS, PWM_RISE, PWM_STD, UNEVEN
from ...models.recordings.store import Recording
from ...models.se3 import TWIST, WRENCH, XYZ
from ...systems.planning.mppi import FIGURES
from ..reports.figures_path import Scene
from ..run.estimate import HEALTH
from ..run.log import Plans, RunLog
from . import foxglove as fox
from .mcap_file import Channels
from .surroundings import GHOST, PLANNED, samples, surroundings

WORLD = "world"
_PAUSE_S = 1.0
"""Between trajectories whose own times are unknown or overlap."""
_POINTS = 500
"""Of a path, at most."""
_FRAMES = {"X_WB": "body", "X_WB_estimate": "estimate", "X_WB_plan": "setpoint"}
_TOPICS = {"body": "", "estimate": "/estimate", "setpoint": "/setpoint"}
_TWISTS = {"X_WB": "V_WB_B", "X_WB_estimate": "V_WB_B_estimate", "X_WB_plan": "V_WB_B_plan"}
_STATE = ("x", "y", "z", "roll", "pitch", "yaw", *TWIST)
_ERRORS = tuple(f"{kind}_{axis}" for kind in ("position", "rotation", "velocity") for axis in XYZ)
_SKIPPED = {*_FRAMES, *_TWISTS.values(), "error_covariance", "plan_valid", UNEVEN}
_PLOTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "F_Bo_B": ("/command/wrench", WRENCH),
    "thruster_force": ("/command/thruster_force", ()),
    "pwm": ("/command/pwm", ()),
    PWM_STD: ("/command/pwm_std", ()),
    PWM_RISE: ("/command/pwm_rise", ()),
    "voltage": ("/sensors/voltage", ("voltage",)),
    "pressure_depth": ("/sensors/pressure_depth", ("depth",)),
    "vertical_velocity": ("/sensors/vertical_velocity", ("climb",)),
    "imu_specific_force": ("/sensors/specific_force", LABELS["axis"]),
    "imu_angular_rate": ("/sensors/angular_rate", LABELS["axis"]),
    "rc": ("/sensors/rc", ()),
    "error_std": ("/estimate/error_std", _ERRORS),
    "health": ("/estimate/health", ("health", "imu")),
    "nis": ("/estimate/nis", ()),
    "rejected": ("/estimate/rejected", ()),
    "F_disturbance_Bo_B": ("/disturbance/wrench", WRENCH),
    "flow_W": ("/disturbance/flow", ("vx", "vy", "vz", "ax", "ay", "az")),
}
"""Topic of each variable, and the names of its first components."""


@dataclass(frozen=True)
class Shown:
    """Numbers of one trajectory as they are written; times (s) are on the file's clock."""

    trajectory: Trajectory
    start: float
    t: np.ndarray
    fused: tuple[str, ...]

    def poses(self) -> dict[str, np.ndarray]:
        """Poses (n, 7) by frame; unknown coordinates are 0, unknown attitudes NaN."""
        variables, found = self.trajectory.variables(), {}
        for name, frame in _FRAMES.items():
            if name in variables:
                X = variables[name].copy()
                X[:, 4:] = np.nan_to_num(X[:, 4:])
                if name == "X_WB_plan":
                    X[variables["plan_valid"] < 0.5] = np.nan
                found[frame] = X
        return found

    def states(self) -> dict[str, np.ndarray]:
        """Position, roll pitch yaw (rad) and twist (n, 12) by frame."""
        variables, found = self.trajectory.variables(), {}
        for name, frame in _FRAMES.items():
            if name not in variables:
                continue
            X = variables[name]
            known = np.isfinite(X[:, :4]).all(axis=1)
            angles = np.full((len(X), 3), np.nan)
            q = Rotation.from_quat(X[known, :4], scalar_first=True)
            angles[known] = q.as_euler("ZYX", suppress_warnings=True)[:, ::-1]
            twist = variables.get(_TWISTS[name], np.full((len(X), 6), np.nan))
            both = np.concatenate([X[:, 4:], angles, twist], axis=1)
            if name == "X_WB_plan":
                both[variables["plan_valid"] < 0.5] = np.nan
            found[frame] = both
        return found

    def plots(self) -> Iterator[tuple[str, tuple[str, ...], np.ndarray]]:
        """Topic, names and values (n, k) of all other variables."""
        for name, values in self.trajectory.variables().items():
            if name in _SKIPPED:
                continue
            topic, names = _PLOTS.get(name, (f"/other/{name}", ()))
            values = values.reshape(len(values), -1)
            if name in ("nis", "rejected"):
                names = self.fused
            elif name == "health":
                names = (*names, *self.fused)
            elif not names:
                names = tuple(f"c{k}" for k in range(1, values.shape[1] + 1))
            count = min(len(names), values.shape[1])
            yield topic, names[:count], values[:, :count]


def write_recording(
    into: Channels,
    recording: Recording,
    scene: Scene | None = None,
    said: Sequence[str] = (),
    progress: Callable[[float], None] = lambda fraction: None,
) -> float:
    """Write all trajectories one after another; returns the end of the last one (s).

    `scene` is the surroundings, `said` are sentences for the end.
    """
    log = RunLog(recording)
    parts = list(_placed(recording, log.fused))
    _tell(into, recording, parts)
    plans = log.plans
    end = 0.0
    for k, part in enumerate(parts):
        into_scene = surroundings(part.start, scene, part.poses())
        into.add("/scene", "foxglove.SceneUpdate", part.start, into_scene)
        into.add("/log", "foxglove.Log", part.start, fox.log(part.start, part.trajectory.scenario))
        _motion(into, part)
        _numbers(into, part)
        end = float(part.t[-1])
        progress((k + 1) / len(parts))
    if plans is not None and parts:
        _planned(into, plans, parts[0].start)
    for text in said:
        into.add("/log", "foxglove.Log", end, fox.log(end, text))
    return end


def _placed(recording: Recording, fused: tuple[str, ...]) -> Iterator[Shown]:
    """Trajectories at their own times if these are known and apart, else one after another."""
    found = list(recording.trajectories())
    spans = [_elapsed(one, recording.dt) for one in found]
    starts = np.array([one.start for one in found])
    order = np.argsort(starts, kind="stable")
    ends = starts + [t[-1] for t in spans]
    apart = np.isfinite(starts).all() and bool((starts[order][1:] >= ends[order][:-1]).all())
    if not apart:
        order = np.arange(len(found))
        lengths = np.array([t[-1] + _PAUSE_S for t in spans])
        starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    starts = starts - (starts[order[0]] if starts.size else 0.0)
    for i in order:
        yield Shown(found[i], float(starts[i]), starts[i] + spans[i], fused)


def _elapsed(one: Trajectory, dt: float) -> np.ndarray:
    """Times since the first sample (s)."""
    own = one.sensors.get(UNEVEN)
    if own is not None and np.isfinite(own).all():
        return own - own[0]
    return dt * np.arange(len(one))


def _tell(into: Channels, recording: Recording, parts: Sequence[Shown]) -> None:
    """Notes and findings of the recording, at its start."""
    if not parts:
        return
    t = parts[0].start
    for note in recording.notes:
        into.add("/log", "foxglove.Log", t, fox.log(t, note))
    for finding in findings_of(recording.dataset):
        into.add("/log", "foxglove.Log", t, fox.log(t, str(finding), "warning"))


def _motion(into: Channels, part: Shown) -> None:
    """Frames, poses and the path flown."""
    poses = part.poses()
    known: dict[str, np.ndarray] = {
        frame: np.asarray(np.isfinite(X).all(axis=1)) for frame, X in poses.items()
    }
    for i, t in enumerate(part.t.tolist()):
        here = {frame: X[i] for frame, X in poses.items() if known[frame][i]}
        into.add("/tf", "foxglove.FrameTransforms", t, fox.transforms(t, WORLD, here))
        for frame, X in here.items():
            message = fox.pose_in_frame(t, WORLD, X)
            into.add(f"{_TOPICS[frame]}/pose", "foxglove.PoseInFrame", t, message)
    flown = poses["body"][known["body"]]
    step = max(1, -(-len(flown) // _POINTS))
    path = fox.poses_in_frame(part.start, WORLD, flown[::step])
    into.add("/path", "foxglove.PosesInFrame", part.start, path)


def _numbers(into: Channels, part: Shown) -> None:
    """Plots, and what changes of the filter's health."""
    series = [(f"{_TOPICS[frame]}/state", _STATE, x) for frame, x in part.states().items()]
    for topic, names, values in [*series, *part.plots()]:
        schema = f"spinndrift.{topic.strip('/').replace('/', '.')}"
        into.define(schema, fox.plot_schema(schema, names))
        for t, row in zip(part.t.tolist(), values.tolist(), strict=True):
            message = fox.plot(names, row)
            if message:
                into.add(topic, schema, t, message)
    health = part.trajectory.variables().get("health")
    if health is None:
        return
    state = np.nan_to_num(health[:, 0]).astype(int)
    for i in np.flatnonzero(np.diff(state)) + 1:
        word = HEALTH[min(max(state[i], 0), len(HEALTH) - 1)]
        level = {"good": "info", "degraded": "warning"}.get(word, "error")
        t = float(part.t[i])
        into.add("/log", "foxglove.Log", t, fox.log(t, f"estimator {word}", level))


def _planned(into: Channels, plans: Plans, start: float) -> None:
    """Every plan, the sampled paths that it was chosen from, and the planner's figures."""
    schema = "spinndrift.planner"
    into.define(schema, fox.plot_schema(schema, FIGURES))
    for k, time in enumerate(plans.time.tolist()):
        t = start + time
        X = plans.X_WB[k][np.isfinite(plans.X_WB[k]).all(axis=1)]
        into.add("/plan", "foxglove.PosesInFrame", t, fox.poses_in_frame(t, WORLD, X))
        lines = [fox.line(X[:, 4:], PLANNED, 3.0)] if len(X) > 1 else []
        update = [fox.entity(t, WORLD, "plan", lines=lines)]
        if plans.p_WB is not None:
            update.append(fox.entity(t, WORLD, "samples", lines=samples(plans, k, GHOST)))
        into.add("/plan/scene", "foxglove.SceneUpdate", t, fox.scene(update))
        if plans.figures is not None:
            into.add("/planner", schema, t, fox.plot(FIGURES, plans.figures[k]))


def outcome_of(metrics: Mapping[str, object]) -> list[str]:
    """The sentence on a run's outcome in its metrics, if there is one."""
    outcome = metrics.get("outcome")
    words = outcome.get("words") if isinstance(outcome, Mapping) else None
    return [words] if isinstance(words, str) else []
