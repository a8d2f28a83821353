"""Faults of a small four-thruster AUV, told by physics from a model of its healthy runs.

Run it: `python examples/labelled_faults.py haizhe_train.npz --out runs/faults`. The file is that of
docs/labelled-faults.md. Labels choose the healthy runs that are fitted, and judge: no fault is
fitted to. Each run is judged by a model of healthy runs that has not seen it.
"""

import argparse
import sys
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from spinndrift.models.config.errors import UserError
from spinndrift.sims.diagnosis_benchmark.tables import interval
from spinndrift.training.diagnosis.against.calibration import Calibration, calibrate

STEP = 0.05  # s between rows; the file's own time counts whole seconds
COLUMNS = ("pwm1", "depth", "press", "voltage", "roll", "pitch", "w_yaw")
IDLE = 1150.0  # µs below which the thrusters stand still
CLASSES = ("Normal", "AddWeight", "PressureGain_constant", "PropellerDamage_slight",
           "PropellerDamage_bad")  # fmt: skip
TOLD = ("nothing", "weight", "depth sensor", "propeller")
DIVE, HELD = (1.0, 4.0), (1.0, 5.0)  # s after the thrusters start
FOLDS = 5
TESTS = 3
RATE = 0.125  # of false alarms, over all tests together


@dataclass(frozen=True)
class Runs:
    """What each of n runs tells; rows are runs.

    Attributes:
        label: the class, for fitting the healthy ones and for judging.
        sensor: depth (m) that is shown at the surface, and slope of depth against pressure.
        dive: w|w| of the descent (m²/s²): what the net downward force over the drag comes to.
        turn: change of roll and pitch (°) from rest to thrust, and yaw rate (°/s).
        drive: 1, PWM (µs, less 1200) and battery voltage under load (V, less 12).
        rest: roll and pitch (°) at the surface, for the record only.
    """

    label: np.ndarray
    sensor: Float[np.ndarray, "n 2"]
    dive: Float[np.ndarray, "n 1"]
    turn: Float[np.ndarray, "n 3"]
    drive: Float[np.ndarray, "n 3"]
    rest: Float[np.ndarray, "n 2"]

    def select(self, kept: Bool[np.ndarray, " n"]) -> "Runs":
        """Some of the runs."""
        return Runs(*(getattr(self, field.name)[kept] for field in fields(self)))


def read_runs(path: Path) -> Runs:
    """Read the file and reduce every run to numbers that mean something.

    Raises:
        UserError: the file is missing, or an array or column in it.
    """
    if not path.is_file():
        raise UserError(
            f"{path}: no such file; give haizhe_train.npz (see docs/labelled-faults.md)"
        )
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: can't be read as .npz ({error})") from error
    for name in ("data", "lengths", "label", "columns"):
        if name not in stored:
            raise UserError(f"{path}: array `{name}` is missing; take the file as published")
    names = [str(name) for name in stored["columns"]]
    for column in COLUMNS:
        if column not in names:
            raise UserError(f"{path}: column `{column}` is missing; it has {', '.join(names)}")
    at = [names.index(column) for column in COLUMNS]
    parts = np.split(stored["data"].astype(float), np.cumsum(stored["lengths"])[:-1])
    rows = []
    for number, part in enumerate(parts):
        found = _reduced(part[:, at].T)
        if found is None:
            raise UserError(f"{path}: run {number} has no step of PWM with 5 s of data after it")
        rows.append(found)
    table = np.array(rows)
    return Runs(
        np.array([str(label) for label in stored["label"]]),
        table[:, 0:2], table[:, 2:3], table[:, 3:6], table[:, 6:9], table[:, 9:11],
    )  # fmt: skip


def _reduced(run: Float[np.ndarray, "7 n"]) -> list[float] | None:
    pwm, depth, press, voltage, roll, pitch, yaw_rate = run
    moving = np.flatnonzero(pwm > IDLE)
    if not moving.size or moving[0] == 0 or len(pwm) < moving[0] + HELD[1] / STEP:
        return None
    start = int(moving[0])
    dive, held = (slice(start + round(a / STEP), start + round(b / STEP)) for a, b in (DIVE, HELD))
    t = STEP * np.arange(len(pwm))
    w = np.polyfit(t[dive], depth[dive], 1)[0]
    rest = [float(np.median(x[:start])) for x in (depth, roll, pitch)]
    return [
        rest[0], float(np.polyfit(press, depth, 1)[0]),
        w * abs(w),
        float(np.median(roll[held])) - rest[1], float(np.median(pitch[held])) - rest[2],
        float(np.median(yaw_rate[held])),
        1.0, float(np.median(pwm[dive])) - 1200, float(np.median(voltage[dive])) - 12,
        rest[1], rest[2],
    ]  # fmt: skip


@dataclass(frozen=True)
class Healthy:
    """Linear model of healthy runs, y = B x + e, and how far the healthy runs themselves lie off.

    Attributes:
        x, y: what it was fitted to (n, k), (n, m).
        calibration: limit that a further healthy run exceeds at a rate, from the scores of these
            runs, each by a model that was fitted without it.
    """

    x: Float[np.ndarray, "n k"]
    y: Float[np.ndarray, "n m"]
    calibration: Calibration | None = None

    @classmethod
    def fit(
        cls, x: Float[np.ndarray, "n k"], y: Float[np.ndarray, "n m"], rate: float
    ) -> "Healthy":
        """Fit, and set the limit by leaving out one run at a time."""
        scores = []
        for i in range(len(x)):
            kept = np.arange(len(x)) != i
            scores.append(cls(x[kept], y[kept]).score(x[i : i + 1], y[i : i + 1])[0])
        return cls(x, y, calibrate(np.array(scores), rate))

    @property
    def limit(self) -> float:
        """The limit of the score; infinite without a calibration."""
        return np.inf if self.calibration is None else self.calibration.threshold

    def off(self, x: Float[np.ndarray, "r k"], y: Float[np.ndarray, "r m"]) -> np.ndarray:
        """Measured less predicted, (r, m)."""
        return y - x @ np.linalg.lstsq(self.x, self.y, rcond=None)[0]

    def score(self, x: Float[np.ndarray, "r k"], y: Float[np.ndarray, "r m"]) -> np.ndarray:
        """Hotelling's T² of new runs, with the doubt of the fit at their x (r,)."""
        e = self.off(self.x, self.y)
        S = e.T @ e / (len(self.x) - self.x.shape[1])
        lever = np.einsum("ri,ij,rj->r", x, np.linalg.pinv(self.x.T @ self.x), x)
        r = self.off(x, y)
        return np.einsum("ri,ij,rj->r", r, np.linalg.inv(S), r) / (1 + lever)


@dataclass(frozen=True)
class Judge:
    """Three tests, each against what healthy runs do."""

    sensor: Healthy
    dive: Healthy
    turn: Healthy

    @classmethod
    def fit(
        cls, runs: Runs, kept: Bool[np.ndarray, " n"], rate: float = RATE, pwm_known: bool = True
    ) -> "Judge":
        """Fit to the runs kept, which are healthy; without the PWM if it shall tell nothing.

        `rate` is that of false alarms of all tests together: each test gets an equal share.
        """
        one, each = runs.drive[kept, :1], rate / TESTS
        return cls(
            Healthy.fit(one, runs.sensor[kept, :1], each),
            Healthy.fit(runs.drive[kept] if pwm_known else one, runs.dive[kept], each),
            Healthy.fit(one, runs.turn[kept], each),
        )

    def ratios(self, runs: Runs) -> Float[np.ndarray, "n 3"]:
        """Scores over limits of weight, depth sensor, propeller; a slower dive is no weight."""
        one, d = runs.drive[:, :1], self.dive
        drive = runs.drive[:, : d.x.shape[1]]
        weight = np.where(d.off(drive, runs.dive)[:, 0] > 0, d.score(drive, runs.dive), 0.0)
        sensor = self.sensor.score(one, runs.sensor[:, :1])
        turn = self.turn.score(one, runs.turn)
        parts = ((weight, d), (sensor, self.sensor), (turn, self.turn))
        return np.stack([score / model.limit for score, model in parts], axis=1)


def folds(runs: Runs) -> np.ndarray:
    """Which fold a run is left out with: every fifth of its class."""
    fold = np.zeros(len(runs.label), int)
    for label in np.unique(runs.label):
        own = np.flatnonzero(runs.label == label)
        fold[own] = np.arange(len(own)) % FOLDS
    return fold


def cross_fitted(
    runs: Runs, rate: float = RATE, pwm_known: bool = True
) -> Float[np.ndarray, "n 3"]:
    """Ratios of every run from a model of healthy runs of other folds."""
    healthy, fold = runs.label == CLASSES[0], folds(runs)
    found = np.zeros((len(healthy), 3))
    for k in range(FOLDS):
        judge = Judge.fit(runs, healthy & (fold != k), rate, pwm_known)
        found[fold == k] = judge.ratios(runs)[fold == k]
    return found


def told(ratios: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Index into `TOLD`: the test that is exceeded most, or nothing."""
    return np.where(ratios.max(axis=1) > 1, 1 + ratios.argmax(axis=1), 0)


def beyond(
    runs: Runs, y: Float[np.ndarray, "n m"], reference: str, rate: float = RATE
) -> dict[str, int]:
    """How many runs of each class lie beyond the limit of a class taken as the reference."""
    own, fold = runs.label == reference, folds(runs)
    hits: dict[str, int] = {label: 0 for label in CLASSES}  # noqa: C420
    one = runs.drive[:, :1]
    for k in range(FOLDS):
        model = Healthy.fit(one[own & (fold != k)], y[own & (fold != k)], rate / TESTS)
        far = (model.score(one, y) > model.limit) & (fold == k)
        for label in CLASSES:
            hits[label] += int(far[runs.label == label].sum())
    return hits


def table(runs: Runs, said: np.ndarray, kept: Bool[np.ndarray, " n"]) -> str:
    """Confusion table in Markdown: counts, and the share of what is right with its interval."""
    right = dict(zip(CLASSES, (0, 1, 2, 3, 3), strict=True))
    lines = ["| labelled | " + " | ".join(TOLD) + " | right (95 %) |", "|---" * 6 + "|"]
    for label in CLASSES:
        counts = np.bincount(said[(runs.label == label) & kept], minlength=4)
        hits, of = int(counts[right[label]]), int(counts.sum())
        low, high = interval(hits, of)
        cells = " | ".join(str(c) for c in counts)
        lines.append(f"| {label} | {cells} | {hits / of:.2f} ({low:.2f} to {high:.2f}) |")
    return "\n".join(lines)


def judge_new(runs: Runs, path: Path | None, rate: float) -> None:
    """Judge runs that neither a model nor a limit nor a choice of tests has seen.

    Those of another file by all healthy runs; without one the odd-numbered by the even-numbered.
    """
    healthy, odd = runs.label == CLASSES[0], np.arange(len(runs.label)) % 2 == 1
    if path is None:
        print("\nOdd-numbered runs, judged by a model of even-numbered healthy ones:\n")
        judge, new = Judge.fit(runs, healthy & ~odd, rate), runs.select(odd)
    else:
        print(f"\nRuns of {path.name}, judged by a model of all healthy ones:\n")
        judge, new = Judge.fit(runs, healthy, rate), read_runs(path)
    print(table(new, told(judge.ratios(new)), np.ones(len(new.label), bool)))
    found = judge.turn.calibration
    assert found is not None
    print(
        f"\nRate of false alarms: {rate:g} asked for, {found.rate:.3g} a test; {found.units} "
        "healthy runs, each left out in turn, can show "
        f"{TESTS / (found.units + 1):.3g} by count at least"
    )


def draw(runs: Runs, path: Path) -> None:
    """The three things that tell, run by run."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    rng = np.random.default_rng(0)
    colours = ("0.6", "tab:blue", "tab:green", "tab:orange", "tab:red")
    for k, (label, colour) in enumerate(zip(CLASSES, colours, strict=True)):
        own = runs.label == label
        across = k + rng.uniform(-0.3, 0.3, own.sum())
        axes[0].plot(across, runs.sensor[own, 0], ".", color=colour)
        axes[1].plot(1200 + runs.drive[own, 1], 1e3 * runs.dive[own, 0], ".", color=colour)
        axes[2].plot(runs.turn[own, 0], runs.turn[own, 2], ".", color=colour, label=label)
    axes[0].set(ylabel="depth shown at the surface (m)", xticks=[], xlabel="one column a class")
    axes[1].set(
        xlabel="PWM (µs)",
        ylabel="w|w| of the descent (10⁻³ m²/s²)",
        xlim=(1178, 1208),
        ylim=(0, 16),
    )
    axes[2].set(xlabel="change of roll under thrust (°)", ylabel="yaw rate (°/s)", xlim=(-14, 14))
    figure.legend(loc="outside lower center", ncols=5, fontsize="small", frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Read, judge, print the tables, write the figure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", type=Path, help="haizhe_train.npz")
    parser.add_argument("--new", type=Path, help="further runs, judged by all healthy ones of FILE")
    parser.add_argument(
        "--rate", type=float, default=RATE, help=f"of false alarms (default {RATE:g})"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/faults"), help="folder to write")
    given = parser.parse_args(arguments)
    rate = given.rate
    if not 0.0 < rate < 0.5:
        raise UserError(f"--rate {rate:g}: give a number between 0 and 0.5")
    runs = read_runs(given.file)
    absent = [label for label in CLASSES if label not in runs.label]
    if absent:
        raise UserError(f"{given.file}: no run is labelled {absent[0]}; take the file as published")
    ratios = cross_fitted(runs, rate)
    number = np.arange(len(runs.label))
    print("All runs, each judged by a model that has not seen it:\n")
    print(table(runs, told(ratios), number >= 0))
    judge_new(runs, given.new, rate)
    blind = told(cross_fitted(runs, rate, pwm_known=False))
    print("\nThe same, all runs, if the law of the dive may not use PWM and voltage:\n")
    print(table(runs, blind, number >= 0))
    usual = (runs.label != CLASSES[0]) | (np.abs(runs.drive[:, 1]) < 20)
    rest = runs.select(usual)
    print(f"\nThe same without {int((~usual).sum())} healthy run far from the others' PWM:\n")
    print(table(rest, told(cross_fitted(rest, rate)), np.ones(int(usual.sum()), bool)))
    told_apart = beyond(runs, runs.turn, "PressureGain_constant", rate)
    print("\nTurning beyond the runs with a faulty depth sensor, whose trim is that of the damaged"
          f" propellers: {told_apart}")  # fmt: skip
    print("Attitude at rest alone, before a thruster turns, beyond the healthy runs: "
          f"{beyond(runs, runs.rest, CLASSES[0], rate)}")  # fmt: skip
    print("\nMedian, and in brackets standard deviation, by class:\n")
    print(
        "| labelled | depth at the surface (m) | m per unit of pressure | w\\|w\\| (10⁻³ m²/s²) "
        "| PWM (µs) | roll, pitch under thrust (°) | yaw rate (°/s) | roll, pitch at rest (°) |"
    )
    print("|---" * 8 + "|")
    for label in CLASSES:
        own = runs.label == label

        def cell(x: np.ndarray, digits: int, own: np.ndarray = own) -> str:
            return f"{np.median(x[own]):.{digits}f} ({np.std(x[own]):.{digits}f})"

        print(f"| {label} | {cell(runs.sensor[:, 0], 3)} | {cell(runs.sensor[:, 1], 5)} "
              f"| {cell(1e3 * runs.dive[:, 0], 1)} | {cell(1200 + runs.drive[:, 1], 0)} "
              f"| {cell(runs.turn[:, 0], 1)}, {cell(runs.turn[:, 1], 1)} "
              f"| {cell(runs.turn[:, 2], 0)} | {cell(runs.rest[:, 0], 1)}, "
              f"{cell(runs.rest[:, 1], 1)} |")  # fmt: skip
    law = Judge.fit(runs, runs.label == CLASSES[0]).dive
    B = np.linalg.lstsq(law.x, law.y, rcond=None)[0][:, 0]
    print(f"\nHealthy dive: w|w| = {1e3 * B[0]:.2f} + {1e3 * B[1]:.3f} (PWM - 1200 µs) + "
          f"{1e3 * B[2]:.1f} (V - 12 V), in 10⁻³ m²/s²")  # fmt: skip
    slope = np.linalg.lstsq(*(a[usual & (runs.label == CLASSES[0])] for a in
                              (runs.drive, runs.dive)), rcond=None)[0][1, 0]  # fmt: skip
    print(f"  without that run {1e3 * slope:.3f} a µs")
    heavier = np.median(law.off(runs.drive, runs.dive)[runs.label == "AddWeight", 0])
    print(f"Added weight: as much net force as {heavier / B[1]:.0f} µs of PWM")
    given.out.mkdir(parents=True, exist_ok=True)
    draw(runs, given.out / "labelled-faults.png")
    print(f"\nwrote {given.out / 'labelled-faults.png'}")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
