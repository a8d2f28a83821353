"""Three tank runs of a real BlueROV2 Heavy: from motion capture and a pilot's channels to causes.

Run it: `python examples/tank_runs.py FOLDER --out runs/tank`. FOLDER holds the runs as CSV files
(docs/tank-runs.md says which); they are converted to the project's CSV form in `--out`/recording,
and models from the preset to one with named causes are judged on the run they were not fitted to.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float
from multi_step_fit import (
    MultiStepFit,
    Windows,
    fit_forecasts,
    forecast_errors,
    rmse,
    windows,
)
from scipy.spatial.transform import Rotation

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.library import Library, kind
from spinndrift.models.effects.thrust import AxisThrust
from spinndrift.models.frames import pose_to_enu, twist_frd_to_flu
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.csv import read_csv, write_csv
from spinndrift.models.recordings.csv_table import read_table
from spinndrift.models.recordings.resample import continuous, geodesic, grid, hold, linear
from spinndrift.models.recordings.store import Recording
from spinndrift.models.se3 import AXES
from spinndrift.models.vehicles.vehicle import Vehicle, load_vehicle
from spinndrift.training.diagnosis.filter.problem import DiagnosisProblem

RATE = 10.0  # Hz
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
HORIZON, EVERY = 2.0, 2.0  # s: length of the forecasts that are fitted and judged, and their starts
LEVERS = (
    "yaw_from_sway",
    "yaw_from_surge",
    "pitch_from_surge",
    "pitch_from_heave",
    "roll_from_sway",
)
LADDER: tuple[tuple[str, tuple[tuple[str, tuple[str, ...] | None], ...]], ...] = (
    ("preset", ()),
    ("gain of the command, by axis", (("axis_thrust", None),)),
    ("and drag, net buoyancy", (("linear_drag", None), ("quadratic_drag", None),
                                ("net_buoyancy", ("all",)))),
    ("and centre of gravity", (("centre_of_gravity", None),)),
    ("and thruster lag", (("thruster_lag", ("all",)),)),
    ("and drag coupling", (("drag_coupling", LEVERS),)),
)  # fmt: skip
"""Causes and their places (all without any), each line beside those before."""
FLICKER = 0.5  # rad/s between the pose's turning and the recorded rate
GAP = 0.25  # s between bins: longer ones would be filled with straight lines
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

    What a channel does to other axes (thrusters above or below Bo) is left out: `axis_thrust`
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
    """Even steps, the lost attitude put back, cut at flickers and gaps; and a note on it.

    Bins are averages, so they hold at their middle; a command acts as long as its bin.
    """
    t, dt = middles(run.start), 1 / rate
    offset, off = lost_attitude(t, run)
    q = Rotation.from_euler("xyz", run.euler.T + offset).as_quat(scalar_first=True).T
    X = pose_to_enu(np.concatenate([continuous(q), run.position]))
    X[:4] = continuous(X[:4])
    V = twist_frd_to_flu(run.twist)
    bad = (off > FLICKER) | (np.diff(t) > GAP)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], bad, [True]]).astype(int)))
    trajectories = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):  # steps a … b-1 are good
        part = slice(a, b + 1)
        if t[b] - t[a] < SHORTEST:
            continue
        even = grid(float(t[a]), float(t[b]), dt)
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
        f"yaw {yaw:.3f} rad; {int(bad.sum())} flickers and gaps cut; poses turn off the rates by "
        f"{np.median(off):.3f} rad/s (median), with bins stamped at their start by "
        f"{np.median(lost_attitude(run.start, run)[1]):.3f}."
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


# ------------------------------------------------------------------------------------ judging


@dataclass(frozen=True)
class Judged:
    """One line of the ladder: errors on runs left out, in the order of `block`, and fits by run."""

    name: str
    errors: Float[np.ndarray, "M 12 K"]
    fits: dict[str, MultiStepFit]


def rows_of(library: Library, lines: int) -> list[int]:
    """Parameters that are free on a line of the ladder."""
    found = []
    for _, causes in LADDER[: lines + 1]:
        for cause, places in causes:
            for where in kind(cause).places if places is None else places:
                found += library.at(cause, where)
    return found


def climb(
    recording: Recording, lines: int = len(LADDER), tell: Callable[[str], None] = print
) -> tuple[DiagnosisProblem, Windows, list[Judged]]:
    """Fit every line of the ladder without each run in turn, and forecast that run."""
    problem = DiagnosisProblem.of(recording, load_vehicle("bluerov2_heavy"))
    problem = problem.with_effect(AxisThrust.neutral())
    w = windows(problem.data, HORIZON, EVERY)
    judged = []
    for number, (name, _) in enumerate(LADDER[:lines]):
        errors, fits = np.zeros((w.u.shape[0], 12, len(w.block))), {}
        rows = rows_of(problem.library, number)
        for s, run in enumerate(problem.data.names):
            fit = fit_forecasts(problem, w, rows, kept=w.scenario != s)
            own = w.scenario == s
            errors[..., own] = forecast_errors(problem, fit.theta, w)[..., own]
            fits[run] = fit
        tell(f"fitted: {name}")
        judged.append(Judged(name, errors, fits))
    return problem, w, judged


def tables(problem: DiagnosisProblem, w: Windows, judged: list[Judged]) -> str:
    """What is gained on runs left out, and the values found, in Markdown."""
    rule = "|---" * 5 + "|"
    lines = [f"Errors after {HORIZON:g} s on the run left out, 95 % intervals, blocks of 10 s:", ""]
    lines += ["| model | position (m) | rotation (rad) | velocity (m/s) | rate (rad/s) |", rule]
    for j in judged:
        cells = rmse(j.errors, w.block, np.random.default_rng(0)).values()
        lines.append(f"| {j.name} | " + " | ".join(_cell(*c) for c in cells) + " |")
    lines += ["", "Ratio to the line before:", ""]
    lines += ["| model | position | rotation | velocity | rate |", "|---" * 5 + "|"]
    for before, j in pairwise(judged):
        cells = rmse(j.errors, w.block, np.random.default_rng(0), before.errors).values()
        lines.append(f"| {j.name} | " + " | ".join(_cell(*c, digits=2) for c in cells) + " |")
    lines += ["", "Position (m) and rotation (rad) by the run left out:", ""]
    lines += ["| model | " + " | ".join(problem.data.names) + " |", "|---" * 4 + "|"]
    for j in judged:
        cells = []
        for s in range(len(problem.data.names)):
            own = w.scenario == s
            found = rmse(j.errors[..., own], w.block[own], np.random.default_rng(0))
            cells.append(f"{found['position'][0]:.3f}, {found['rotation'][0]:.3f}")
        lines.append(f"| {j.name} | " + " | ".join(cells) + " |")
    if len(judged) > 1:
        lines += [
            "",
            "Gain of surge, sway, heave, fitted without one run (alone, inertia and drag",
            "of the preset):",
            "",
        ]
        for run, fit in judged[1].fits.items():
            rows = [problem.library.index("axis_thrust", axis, "scale") for axis in AXES[:3]]
            lines.append(f"- without {run}: " + ", ".join(f"{1 + fit.theta[i]:.2f}" for i in rows))
    return "\n".join(lines)


def values(problem: DiagnosisProblem, fit: MultiStepFit) -> str:
    """Coefficients by axis, for the inertia believed, with standard errors."""
    error = dict(zip(fit.rows, fit.errors, strict=True))

    def of(cause: str, where: str, parameter: str = "") -> tuple[float, float]:
        rows = [i for i in problem.library.at(cause, where)
                if parameter in ("", problem.library.entries[i].parameter.name)]  # fmt: skip
        return float(fit.theta[rows[0]]), float(error.get(rows[0], 0.0))

    M = np.diag(problem.mass(problem.believed))
    lines = ["| axis | thrust of the preset's | linear drag (believed) | quadratic drag (believed) "
             "| quadratic drag / inertia | drag / thrust, of the preset's |",
             "|---" * 6 + "|"]  # fmt: skip
    for i, axis in enumerate(AXES):
        (g, ge), (l, le), (d, de) = (of(c, axis) for c in
                                    ("axis_thrust", "linear_drag", "quadratic_drag"))  # fmt: skip
        l0, d0 = (problem.believes(c, axis) for c in ("linear_drag", "quadratic_drag"))
        lines.append(
            f"| {axis} | {1 + g:.2f} ± {ge:.2f} | {l0 + l:.2f} ± {le:.2f} ({l0:.2f}) "
            f"| {d0 + d:.2f} ± {de:.2f} ({d0:.2f}) | {(d0 + d) / M[i]:.2f} "
            f"| {(d0 + d) / d0 / (1 + g):.2f} |"
        )
    others = [i for i in fit.rows if problem.library.entries[i].cause not in
              ("axis_thrust", "linear_drag", "quadratic_drag")]  # fmt: skip
    for i in others:
        e = problem.library.entries[i]
        lines.append(
            f"- {e.cause} {e.where} {e.parameter.name}: {fit.theta[i]:.4g} ± {error[i]:.2g} "
            f"{e.parameter.unit}"
        )
    return "\n".join([*lines[:8], "", *lines[8:]])


def _cell(value: float, low: float, high: float, digits: int = 3) -> str:
    return f"{value:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def draw(w: Windows, judged: list[Judged], dt: float, path: Path) -> None:
    """Growth of errors with time, and where they end, run by run."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    t = dt * (1 + np.arange(w.u.shape[0]))
    for j in judged:
        for axis, part in zip(axes[:2], (slice(0, 3), slice(3, 6)), strict=True):
            axis.plot(t, np.sqrt((j.errors[:, part] ** 2).sum(axis=1).mean(axis=1)), label=j.name)
    axes[0].set(xlabel="time ahead (s)", ylabel="position error (m, RMS)", ylim=(0, None))
    axes[1].set(xlabel="time ahead (s)", ylabel="rotation error (rad, RMS)", ylim=(0, None))
    for j, style in ((judged[0], "o"), (judged[-1], ".")):
        for s, colour in enumerate(("tab:blue", "tab:orange", "tab:green")):
            own = w.scenario == s
            e = np.linalg.norm(j.errors[-1, :3][:, own], axis=0)
            axes[2].plot(np.sort(e), np.linspace(0, 1, e.size), style, color=colour, markersize=3,
                         markerfacecolor="none" if style == "o" else colour)  # fmt: skip
    axes[2].set(xlabel="position error at the end (m)", ylabel="share of windows", xscale="log",
                title="rings: preset, dots: last line; a colour a run")  # fmt: skip
    axes[2].title.set_fontsize("small")
    axes[0].legend(fontsize="x-small", frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Convert, climb the ladder, print the tables, write the figure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of the runs as CSV files")
    parser.add_argument("--out", type=Path, default=Path("runs/tank"), help="folder to write")
    parser.add_argument("--lines", type=int, default=len(LADDER), help="lines of the ladder")
    parser.add_argument("--convert", action="store_true", help="only convert")
    parser.add_argument("--mixed", action="store_true",
                        help="convert to PWM of thrusters as MANUAL mode mixes them")  # fmt: skip
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    recording = convert_folder(given.folder, given.out / "recording", given.mixed)
    print("\n".join(recording.notes))
    print(f"wrote {given.out / 'recording'}\n")
    if given.convert:
        return
    problem, w, judged = climb(recording, given.lines, lambda text: print(text, file=sys.stderr))
    print(tables(problem, w, judged))
    fit = fit_forecasts(problem, w, rows_of(problem.library, given.lines - 1))
    print(f"\n{judged[-1].name}, fitted to all runs, inertia as believed:\n")
    print(values(problem, fit))
    draw(w, judged, recording.dt, given.out / "tank-runs.png")
    print(f"\nwrote {given.out / 'tank-runs.png'}")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
