"""Three tank runs of a real BlueROV2 Heavy: from motion capture and a pilot's channels to causes.

Run it: `python examples/tank_runs.py FOLDER --out runs/tank`. FOLDER holds the runs as CSV files
(docs/tank-runs.md says which); they are converted to the project's CSV form in `--out`/recording,
and models from the preset to one with named causes are judged on the run they were not fitted to.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from spinndrift.models.csv_table import read_table
from spinndrift.models.errors import UserError
from spinndrift.models.recording import Recording
from spinndrift.models.recording_build import Trajectory
from spinndrift.models.recording_csv import read_csv, write_csv
from spinndrift.models.frames import pose_to_enu, twist_frd_to_flu
from spinndrift.models.resample import continuous, geodesic, grid, hold, linear
from spinndrift.models.vehicle import Vehicle, load_vehicle

RATE = 10.0  # Hz
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
POSITION, EULER = ("x_m", "y_m", "z_m"), ("roll_rad", "pitch_rad", "yaw_rad")
TWIST = ("u_mps", "v_mps", "w_mps", "p_radps", "q_radps", "r_radps")
COMMAND = tuple(f"cmd_{axis}" for axis in AXES)
COLUMNS = ("t_s", *POSITION, *EULER, *TWIST, *COMMAND)

# ArduPilot, libraries/AP_Motors/AP_Motors6DOF.cpp, SUB_FRAME_VECTORED_6DOF: what each motor gets of
# surge, sway, heave (down), roll, pitch, yaw, in forward-right-down axes.
MIXER = np.array(
    [
        [-1, 1, 0, 0, 0, 1],
        [-1, -1, 0, 0, 0, -1],
        [1, 1, 0, 0, 0, -1],
        [1, -1, 0, 0, 0, 1],
        [0, 0, 1, 1, -1, 0],
        [0, 0, 1, -1, -1, 0],
        [0, 0, 1, 1, 1, 0],
        [0, 0, 1, -1, 1, 0],
    ],
    float,
)
FLICKER = 0.5  # rad/s between the pose's turning and the recorded rate
SHORTEST = 5.0  # s


@dataclass(frozen=True)
class Run:
    """A file's rows, component first: times of the bins' starts (s), and what was measured."""

    name: str
    start: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "3 n"]
    euler: Float[np.ndarray, "3 n"]
    twist: Float[np.ndarray, "6 n"]
    command: Float[np.ndarray, "6 n"]


def read_run(path: Path) -> Run:
    """Read one file.

    Raises:
        UserError: a column is missing, a number is not finite, or time doesn't rise.
    """
    table = read_table(path)
    for column in COLUMNS:
        if column not in table.names:
            raise UserError(
                f"{path}: column `{column}` is missing; needed are {','.join(COLUMNS)} "
                "(see docs/tank-runs.md)"
            )
    values = table[list(COLUMNS)]
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values).all(axis=0)))
        raise UserError(f"{table.at(row)}: a number is missing; remove the line")
    if values.shape[1] < 10 or np.any(np.diff(values[0]) <= 0):
        raise UserError(f"{path}: column `t_s` must rise over at least 10 lines")
    return Run(path.stem, values[0], values[1:4], values[4:7], values[7:13], values[13:])


def middles(start: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """When a bin's averages hold: half-way to the next bin (s); the last is as long as usual."""
    width = np.diff(start, append=start[-1] + np.median(np.diff(start)))
    return start + width / 2


def lost_attitude(
    t: Float[np.ndarray, " n"], run: Run
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "n-1"]]:
    """Roll, pitch, yaw (rad) that were subtracted at the start, and how far rates then are off.

    Each Euler angle was recorded less its first value, so that poses only agree with body
    velocities if these values are put back: p' = R(φ + φ₀, θ + θ₀, ψ + ψ₀) v tells all three.
    The second result is |log(R_nᵀ R_n+1)/dt - ω| (rad/s) by step.
    """
    dt = np.diff(t)
    moved = np.diff(run.position) / dt
    v, w = ((a[:, 1:] + a[:, :-1]) / 2 for a in (run.twist[:3], run.twist[3:]))

    def errors(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R = Rotation.from_euler("xyz", run.euler.T + offset)
        turned = (R[:-1].inv() * R[1:]).as_rotvec()
        middle = R[:-1] * Rotation.from_rotvec(turned / 2)
        return moved.T - middle.apply(v.T), turned / dt[:, None] - w.T

    def residual(offset: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [e.ravel() / s for e, s in zip(errors(offset), (0.1, 1), strict=True)]
        )

    best = scipy.optimize.least_squares(residual, np.zeros(3), loss="soft_l1", f_scale=0.1)
    return best.x, np.linalg.norm(errors(best.x)[1], axis=1)


def pwm_of(command: Float[np.ndarray, "6 n"]) -> Float[np.ndarray, "8 n"]:
    """Thruster PWM (µs) of the pilot's channels if the autopilot only mixes them (MANUAL mode)."""
    return 1500 + 400 * np.clip(MIXER @ command, -1, 1)


def wrench_of(command: Float[np.ndarray, "6 n"], vehicle: Vehicle) -> Float[np.ndarray, "6 n"]:
    """F_Bo_B (N, N·m) of each channel by itself through the preset's thrusters, on its own axis.

    What a channel does to other axes (thrusters above or below Bo) is left out: `command_gain`
    scales an axis' wrench, whatever it comes from.
    """
    thrusters = vehicle.thrusters()
    F = np.zeros_like(command)
    for i, channel in enumerate(command):
        pwm = 1500 + 400 * np.clip(MIXER[:, i : i + 1] * channel, -1, 1)
        F[i] = np.asarray(thrusters.wrench(thrusters.force(jnp.asarray(pwm))))[i]
    return F


def convert(
    run: Run, vehicle: Vehicle, rate: float = RATE, mixed: bool = False
) -> tuple[list[Trajectory], str]:
    """Even steps, the lost attitude put back, cut where markers flicker; and a note on it.

    Bins are averages, so they hold at their middle; a command acts as long as its bin.
    """
    t, dt = middles(run.start), 1 / rate
    offset, off = lost_attitude(t, run)
    q = Rotation.from_euler("xyz", run.euler.T + offset).as_quat(scalar_first=True).T
    X = pose_to_enu(np.concatenate([continuous(q), run.position]))
    X[:4] = continuous(X[:4])
    V = twist_frd_to_flu(run.twist)
    bad = off > FLICKER
    edges = np.flatnonzero(np.diff(np.concatenate([[True], bad, [True]]).astype(int)))
    trajectories = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):  # steps a … b-1 are good
        part = slice(a, b + 1)
        if t[b] - t[a] < SHORTEST:
            continue
        even = grid(t[a], t[b], dt)
        command = hold(even, run.start[part], run.command[:, part], dt)
        trajectories.append(
            Trajectory(
                run.name,
                geodesic(even, t[part], X[:, part]).T,
                linear(even, t[part], V[:, part]).T,
                {"pwm": pwm_of(command).T} if mixed else {"F_Bo_B": wrench_of(command, vehicle).T},
                {},
                float(even[0]),
            )
        )
    roll, pitch, yaw = offset
    note = (
        f"{run.name}: attitude at the start put back: roll {roll:.3f}, pitch {pitch:.3f}, "
        f"yaw {yaw:.3f} rad; {int(bad.sum())} flickers cut."
    )
    return trajectories, note


def convert_folder(folder: Path, out: Path, mixed: bool = False) -> Recording:
    """Convert all files of a folder, write them in the project's CSV form, and read that.

    Raises:
        UserError: there are no files, or a file can't be read.
    """
    files = sorted(folder.glob("*.csv")) if folder.is_dir() else []
    if len(files) < 2:
        raise UserError(
            f"{folder}: fewer than two .csv files in it; give the folder of the runs "
            "(see docs/tank-runs.md)"
        )
    vehicle = load_vehicle("bluerov2_heavy")
    made, notes = (
        [],
        ["PWM is what MANUAL mode makes of the pilot's channels; it was not recorded."],
    )
    for path in files:
        trajectories, note = convert(read_run(path), vehicle, mixed=mixed)
        made += trajectories
        notes.append(note)
    recording = Recording.from_trajectories(
        made, 1 / RATE, vehicle="bluerov2_heavy", source=folder.name, notes=notes
    )
    write_csv(recording, out)
    return read_csv(out)
