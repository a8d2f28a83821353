"""Windows of recordings: short pieces of equal length for training and evaluation.

Every window is one sample of a conditional law: that of the motion given the initial state and the
commands. Arrays are time-major, component-first, windows last (`models.se3`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.effects.recorded_rollout import Commands
from ...models.recordings.store import Recording
from ..smoothing.complete import Completed
from .behind_filter import with_rises, wrench_rise

Normalisation = Literal["heading", "identity", "none"]
_REMEMBERED = 10.0  # s of commands and motion before a window, at most


class Hidden(NamedTuple):
    """What windows of a recording that lacks channels have of them.

    Attributes:
        seen: 1 for channels that were recorded (x, y, z, then the twist), else 0.
        spread: factor L of the covariance L Lᵀ of the twist at t_0.
        force: specific force at Bo at t_0 … t_T; zero with `felt` 0 where it was not recorded.
        felt: 1 or 0.
    """

    seen: Float[Array | np.ndarray, "1 9 W"]
    spread: Float[Array | np.ndarray, "6 6 W"]
    force: Float[Array | np.ndarray, "N 3 W"]
    felt: Float[Array | np.ndarray, "1 1 W"]


@dataclass(frozen=True)
class Windows:
    """W windows of T steps of `dt` (s).

    Attributes:
        X: poses at t_0 … t_T.
        V: body twists at t_0 … t_T.
        F: mean wrenches, the n-th acting from t_n to t_(n+1).
        dt: step (s).
        scenario: index into `names` of each window's scenario.
        run: label of the trajectory within its scenario.
        start: time of t_0 on the run's clock (s).
        names: scenario names.
        normalise: normalisation of the windows' first pose.
        commands: thruster commands in the windows and before them, for models with effects.
        hidden: of recordings without some channels, for which X and V then hold estimates.
        rise: change of the wrenches over each step; None if they are held.
    """

    X: Float[np.ndarray, "N 7 W"]
    V: Float[np.ndarray, "N 6 W"]
    F: Float[np.ndarray, "T 6 W"]
    dt: float
    scenario: Int[np.ndarray, " W"]
    run: Int[np.ndarray, " W"]
    start: Float[np.ndarray, " W"]
    names: tuple[str, ...]
    normalise: Normalisation = "heading"
    commands: Commands | None = None
    hidden: Hidden | None = None
    rise: Float[np.ndarray, "T 6 W"] | None = None

    def __len__(self) -> int:
        return self.X.shape[2]

    @property
    def steps(self) -> int:
        """T, the number of steps of each window."""
        return self.F.shape[0]

    @property
    def length(self) -> float:
        """Duration of each window (s)."""
        return self.steps * self.dt

    def label(self, index: int) -> str:
        """Name one window for a message: scenario, run and start time."""
        name = self.names[int(self.scenario[index])]
        return f"scenario '{name}', run {int(self.run[index])}, from {self.start[index]:.2f} s"

    def take(self, indices: Sequence[int] | np.ndarray) -> "Windows":
        """Return the windows of these indices, in this order."""
        i = np.asarray(indices, int)
        return replace(
            self,
            X=self.X[..., i],
            V=self.V[..., i],
            F=self.F[..., i],
            scenario=self.scenario[i],
            run=self.run[i],
            start=self.start[i],
            commands=jax.tree.map(lambda a: a[..., i], self.commands),
            hidden=jax.tree.map(lambda a: a[..., i], self.hidden),
            rise=None if self.rise is None else self.rise[..., i],
        )

    def thin(self, count: int) -> "Windows":
        """Return at most `count` windows, evenly spread over all."""
        if len(self) <= count:
            return self
        return self.take(np.linspace(0, len(self) - 1, count).round().astype(int))

    def subdivide(self, steps: int) -> "Windows":
        """Cut every window into ⌊T / steps⌋ shorter ones with the same normalisation."""
        if not 1 <= steps <= self.steps:
            raise ValueError(f"steps: must lie between 1 and {self.steps}, got {steps}")
        parts = [
            replace(
                self,
                X=self.X[k : k + steps + 1],
                V=self.V[k : k + steps + 1],
                F=self.F[k : k + steps],
                start=self.start + k * self.dt,
                commands=self._commands_from(k, steps),
                hidden=self._hidden_from(k, steps),
                rise=None if self.rise is None else self.rise[k : k + steps],
            )
            for k in range(0, self.steps - steps + 1, steps)
        ]

        def joined(name: str) -> Any:
            of_parts = (getattr(part, name) for part in parts)
            return jax.tree.map(lambda *a: np.concatenate(a, axis=-1), *of_parts)

        whole = ("V", "F", "scenario", "run", "start", "commands", "hidden", "rise")
        X = _normalised(joined("X"), self.normalise)
        return replace(parts[0], X=X, **{name: joined(name) for name in whole})

    def _hidden_from(self, k: int, steps: int) -> Hidden | None:
        """What is hidden in windows that begin k steps later; their starts count as known."""
        h = self.hidden
        if h is None:
            return None
        spread = h.spread if k == 0 else np.zeros_like(h.spread)
        return Hidden(h.seen, spread, h.force[k : k + steps + 1], h.felt)

    def _commands_from(self, k: int, steps: int) -> Commands | None:
        """The commands of windows that begin k steps later."""
        c = self.commands
        if c is None:
            return None
        earlier = len(c.before)
        return Commands(
            c.level[k : k + steps],
            c.voltage[k : k + steps],
            np.concatenate([c.before, c.level[:k]])[-earlier:],
            np.concatenate([c.V_before, self.V[:k]])[-earlier:],
            None if c.rise is None else c.rise[k : k + steps],
        )

    def overlaps(self, other: "Windows") -> bool:
        """Whether a window here overlaps one of `other` in time, in the same run."""
        mine = [self.names[s] for s in self.scenario]
        theirs = [other.names[s] for s in other.scenario]
        for i, name in enumerate(mine):
            for j, other_name in enumerate(theirs):
                if name != other_name or self.run[i] != other.run[j]:
                    continue
                first, second = float(self.start[i]), float(other.start[j])
                margin = 0.5 * self.dt
                if first <= second + other.length - margin and (
                    second <= first + self.length - margin
                ):
                    return True
        return False


def make_windows(
    recording: Recording,
    vehicle: Any = None,
    *,
    length_s: float = 4.0,
    stride_s: float | None = None,
    normalise: Normalisation = "heading",
    remembered: float | None = None,
    dtype: Any = np.float32,
    completed: Completed | None = None,
) -> Windows:
    """Cut every trajectory of a recording into windows of `length_s`, one every `stride_s`.

    `normalise` moves each window's start: "heading" to the origin with zero yaw, so that gravity
    keeps its direction; "identity" to the group's identity, as the paper does; "none" leaves it.
    `stride_s` defaults to a quarter of the length. Trajectories shorter than a window are left
    out; `vehicle` is as in `Recording.wrench`. With `remembered` (s) the windows also have the
    thruster commands, in the window and for that time before it; before the beginning of a run its
    first command is assumed. A recording without some channels is given `completed`; its windows
    start from what was known by then.

    Raises:
        UserError: no trajectory is long enough, or a channel of pose or twist is missing.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> recording = generate(GenerateConfig(trajectories=1, duration=4.0), vehicle)
        >>> make_windows(recording, length_s=1.0).steps
        20
    """
    recording, rise = with_rises(_whole(recording, completed, normalise), vehicle)
    steps, places = window_places(recording, length_s, stride_s)
    X, V = (recording.dataset[name].to_numpy() for name in ("X_WB", "V_WB_B"))

    def cut(values: np.ndarray, first: int = 0, last: int = steps) -> np.ndarray:
        at = np.arange(first, last)
        return np.stack([values[j, k, np.maximum(n + at, 0)] for j, k, n in places], axis=-1)

    commands = None
    if remembered is not None:
        back = max(1, round(remembered / recording.dt))
        commands = _commands(cut, *recording.thrust(vehicle), V, rise, back, dtype)
    change = wrench_rise(recording, vehicle, rise)
    twists, hidden = cut(V, 0, steps + 1), None
    if completed is not None:
        twists[0] = cut(completed.causal, 0, 1)[0]
        hidden = _hidden(completed, places, cut(completed.force, 0, steps + 1), dtype)
    return Windows(
        X=_normalised(cut(X, 0, steps + 1), normalise).astype(dtype),
        V=twists.astype(dtype),
        F=cut(recording.wrench(vehicle).to_numpy()).astype(dtype),
        dt=recording.dt,
        **_labels(recording, places),
        names=recording.scenarios,
        normalise=normalise,
        commands=commands,
        hidden=hidden,
        rise=None if change is None else cut(change).astype(dtype),
    )


def _commands(
    cut: Callable[..., np.ndarray],
    level: Float[np.ndarray, "J K N n"],
    voltage: Float[np.ndarray, "J K N"],
    V: Float[np.ndarray, "J K N 6"],
    rise: Float[np.ndarray, "J K N n"] | None,
    back: int,
    dtype: Any,
) -> Commands:
    """Commands that `cut` takes for the windows, and those of `back` steps before them."""
    past = cut(level, -back, 0), cut(V, -back, 0)
    found = Commands(cut(level), cut(voltage)[:, None], *past, None if rise is None else cut(rise))
    return jax.tree.map(lambda part: part.astype(dtype), found)


def windowing(model: Dynamics | None, normalise: Normalisation) -> dict[str, Any]:
    """Arguments of `make_windows` for a model; effects depend on world pose and thrusters."""
    if not isinstance(model, Extended):
        return {"normalise": normalise}
    return {"normalise": "none", "remembered": min(model.memory_duration, _REMEMBERED)}


def _labels(recording: Recording, places: Sequence[tuple[int, int, int]]) -> dict[str, np.ndarray]:
    """Scenario, number of the trajectory, and start time (s) of each window."""
    data, lengths = recording.dataset, recording.lengths
    named, timed = "trajectory" in data.coords, "start_time" in data
    runs = data["trajectory"].to_numpy() if named else np.arange(lengths.shape[1])
    clock = data["start_time"].to_numpy() if timed else np.zeros(lengths.shape)
    return {
        "scenario": np.array([j for j, _, _ in places], int),
        "run": np.array([runs[k] for _, k, _ in places], int),
        "start": np.array([clock[j, k] + n * recording.dt for j, k, n in places], float),
    }


def _whole(
    recording: Recording, completed: Completed | None, normalise: Normalisation
) -> Recording:
    """The recording with all channels; refuses one that lacks some and was not completed."""
    if completed is not None:
        if normalise == "identity":
            raise UserError(
                "windows: normalise: identity mixes the axes of positions, and some were not "
                "recorded; use heading"
            )
        return completed.recording
    if lacking := recording.missing:
        channels = ", ".join(f"{name} {'/'.join(which)}" for name, which in lacking.items())
        raise UserError(
            f"recording: {channels} is missing in some trajectory; complete it first "
            "(`training.smoothing`), or select the trajectories that have them"
        )
    return recording


def _hidden(
    completed: Completed,
    places: list[tuple[int, int, int]],
    force: Float[np.ndarray, "N 3 W"],
    dtype: Any,
) -> Hidden:
    seen = np.stack([completed.followed[j, k] for j, k, _ in places], axis=-1)
    P = np.stack([completed.causal_cov[place] for place in places])
    values, vectors = np.linalg.eigh((P + np.swapaxes(P, 1, 2)) / 2)
    spread = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    felt = np.all(np.isfinite(force), axis=(0, 1), keepdims=True)
    parts = seen[None], np.moveaxis(spread, 0, -1), np.nan_to_num(force), felt
    return Hidden(*(part.astype(dtype) for part in parts))


def window_places(
    recording: Recording, length_s: float, stride_s: float | None
) -> tuple[int, list[tuple[int, int, int]]]:
    """Steps of a window, and scenario, run and first sample of each; refused if there are none."""
    if recording.uneven:
        raise UserError(
            "recording: its samples stand at times of their own; windows need one step, so read "
            "the CSV files with resampling"
        )
    steps = round(length_s / recording.dt)
    stride = round((length_s / 4 if stride_s is None else stride_s) / recording.dt)
    if steps < 1 or stride < 1:
        raise UserError(
            f"window length_s {length_s:g} and stride_s must be at least one step of "
            f"{recording.dt:g} s"
        )
    lengths = recording.lengths
    if lengths.max() < steps + 1:
        raise UserError(
            f"recording: its longest trajectory lasts {(lengths.max() - 1) * recording.dt:g} s, "
            f"a window needs {steps * recording.dt:g} s; record longer or give a shorter length"
        )
    return steps, [
        (j, k, n)
        for j, k in np.argwhere(lengths > steps).tolist()
        for n in range(0, int(lengths[j, k]) - steps, stride)
    ]


def _normalised(
    X_WB: Float[np.ndarray, "N 7 W"], normalise: Normalisation
) -> Float[np.ndarray, "N 7 W"]:
    """Poses in the frame that `normalise` attaches to each window's start."""
    if normalise == "none":
        return X_WB
    X = np.moveaxis(X_WB, 1, -1).astype(np.float64)  # NumPy, for double precision
    R = Rotation.from_quat(X[..., :4], scalar_first=True)
    back = R[0].inv()
    if normalise == "heading":
        w, x, y, z = X[0, :, :4].T
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        back = Rotation.from_rotvec(-heading[:, None] * [0.0, 0.0, 1.0])
    turned = (back * R).as_quat(scalar_first=True)
    moved = back.apply(X[..., 4:] - X[:1, :, 4:])
    parts = [np.moveaxis(a, -1, 1) for a in (turned, moved)]
    return np.concatenate(parts, axis=1).astype(X_WB.dtype)


def split_windows(
    recording: Recording,
    vehicle: Any = None,
    *,
    held_out: float = 0.25,
    by: Literal["auto", "time", "run"] = "auto",
    gap_s: float = 1.0,
    length_s: float = 4.0,
    stride_s: float | None = None,
    normalise: Normalisation = "heading",
    dtype: Any = np.float32,
) -> tuple[Windows, Windows]:
    """Training windows and held-out windows, which do not overlap in any run.

    The recording is split first (`Recording.split`: by whole runs where every scenario has
    several, else each run's last part is held out after a gap) and cut afterwards. Held-out
    windows don't overlap each other (their stride is their length).

    Raises:
        UserError: one of the two sides has no trajectory as long as a window.
    """
    learn, test = recording.split(held_out, by, gap_s)
    parts = []
    for part, side, stride in ((learn, "training", stride_s), (test, "held-out", length_s)):
        try:
            parts.append(
                make_windows(
                    part,
                    vehicle,
                    length_s=length_s,
                    stride_s=stride,
                    normalise=normalise,
                    dtype=dtype,
                )
            )
        except UserError as error:
            raise UserError(f"{side} part (held_out {held_out:g}): {error}") from error
    return parts[0], parts[1]
