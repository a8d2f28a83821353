"""Data at fault, found before anything is explained by physics."""

import numpy as np

from ...models.recording import Recording
from .data import Data

AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
_STUCK = 0.5  # s


def problems(recording: Recording) -> list[str]:
    """Sensors that stand still while others move, jumps of the pose; one sentence each.

    A channel is stuck where it repeats one value exactly for longer than half a second in a run
    in which it otherwise changes, or never changes while the vehicle is driven.
    """
    found = []
    labels = {
        "X_WB": ("qw", "qx", "qy", "qz", "x", "y", "z"),
        "V_WB_B": ("u", "v", "w", "p", "q", "r"),
    }
    stuck: dict[str, int] = {}
    jumps = 0
    for run in recording.trajectories():
        for name, values in (("X_WB", run.X_WB), ("V_WB_B", run.V_WB_B)):
            for label, column in zip(labels[name], values.T, strict=True):
                if _longest_repeat(column) * recording.dt > _STUCK and np.isfinite(column).all():
                    stuck[f"{name}.{label}"] = stuck.get(f"{name}.{label}", 0) + 1
        moved = np.linalg.norm(np.diff(run.X_WB[:, 4:], axis=0), axis=1)
        speed = np.linalg.norm(run.V_WB_B[:-1, :3], axis=1) * recording.dt
        excess = np.abs(moved - speed)
        scale = np.nanmedian(excess) + 1e-6
        jumps += int(np.nansum(excess > 30 * scale + 0.1))
    still = len([1 for _ in recording.trajectories()])
    for channel, count in stuck.items():
        if count < still or channel.startswith("V"):
            found.append(
                f"{channel} repeats one value for {_STUCK:g} s or more in {count} runs: stuck?"
            )
    if jumps:
        found.append(f"the position jumps {jumps} times by far more than the velocity says")
    return found


def _longest_repeat(column: np.ndarray) -> int:
    same = np.concatenate([[False], np.diff(column) == 0, [False]]).astype(int)
    edges = np.flatnonzero(np.diff(same))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0


def unexcited(data: Data, share: float = 0.02) -> list[str]:
    """Axes along which the vehicle hardly moved: what acts there can't be told from these data."""
    w = data.weight[:, None]
    rms = np.sqrt((data.V[:-1] ** 2 * w).sum(axis=(0, 2)) / data.weight.sum())
    scale = np.repeat([rms[:3].max(), rms[3:].max()], 3)
    quiet = rms < share * np.maximum(scale, 1e-9)
    return [
        f"{axis} was hardly excited: its drag and inertia are not identifiable from these data"
        for axis, still in zip(AXES, quiet, strict=True)
        if still
    ]


def limits(data: Data) -> list[str]:
    """What these data can't tell, one sentence each."""
    found = unexcited(data)
    if data.command == "F_Bo_B":
        found.append("commands are wrenches: single thrusters can't be told apart")
    if not data.has_voltage:
        found.append("no voltage was recorded: voltage_sag can't be told")
    if data.left_out == "run":
        found.append(
            "there is one scenario: runs were left out in turn, other motions stay unknown"
        )
    if data.left_out == "block":
        found.append(
            "there is one run: blocks of it were left out in turn, other runs stay unknown"
        )
    return found
