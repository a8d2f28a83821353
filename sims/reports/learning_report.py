"""Results of training, as sections of a page."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended, core
from ...models.recordings.store import Recording
from ...models.recordings.summary import summarize
from ...models.se3 import AXES
from ...training.evaluation.evaluate import Evaluation
from ...training.fitting.fit import TrainingResult
from ...training.smoothing.complete import CHANNELS
from ..learning import FINE_SUBSTEPS, Learned
from .figures_learning import (
    bands_figure,
    coverage_figure,
    error_figure,
    learning_figure,
    recording_figure,
)
from .findings import add_findings
from .pages import Page

_NORMS = {
    "position": "m",
    "rotation": "rad",
    "linear_velocity": "(m/s)",
    "angular_velocity": "(rad/s)",
}
_SPEED = 0.5


def add_data(page: Page, recording: Recording) -> Page:
    """Contents and gaps of the recording."""
    minutes = recording.duration / 60
    page.section(
        "The data",
        f"{minutes:.1f} minutes at {1 / recording.dt:g} Hz in {int((recording.lengths > 0).sum())} "
        f"stretches; commands as `{recording.commands[0]}`.",
    )
    page.figure(recording_figure(recording), "Measured motion, one colour per stretch.")
    if recording.notes:
        page.table([(note,) for note in recording.notes], ("contents and gaps of the source",))
    page.details("Ranges of all variables", summarize(recording))
    return add_findings(page, recording)


def add_training(page: Page, learned: Learned) -> Page:
    """Learning curves, changes of the coefficients, and problems during training."""
    result, parts = learned.result, learned.parts
    validation = 0 if parts.validation is None else len(parts.validation)
    page.section(
        "Training",
        f"{result.steps} steps on {len(parts.learn)} windows of {parts.learn.length:g} s in "
        f"{result.seconds:.0f} s. {taken_words(result, validation)} The other "
        f"{len(parts.held_out)} windows were held out.",
    )
    caption = "Loss against steps (running median)."
    if result.refits:
        caption += (
            " Dotted lines: bandwidths were refitted; losses before and after are not comparable."
        )
    page.figure(learning_figure(result.metrics, result.refits, result.best_step), caption)
    rows = coefficient_rows(core(learned.preset), core(learned.model))
    told = scale_words(rows)
    if isinstance(learned.model, Extended):
        acting = ", ".join(dict.fromkeys(e.name for e in learned.model.effects)) or "none"
        told = f"Of the model without its effects ({acting}), which act beside it."
    page.table(
        rows,
        ("axis", "M preset", "M learned", "D preset", "D learned", "D^f preset", "D^f learned",
         "b preset", "b learned"),
        "Diagonals at rest: mass with added mass (kg, kg·m²), viscous and fluid drag, diffusion "
        "(N√s, N·m√s). Diffusions are estimated from prediction errors; where these grow with "
        "speed, that at rest is small. " + told,
        fold="Learned coefficients",
    )  # fmt: skip
    if learned.told:
        _add_told(page, learned)
    for event in result.events:
        page.text(f"Step {event['step']}: {event['text']}")
    return page


def _add_told(page: Page, learned: Learned) -> None:
    """Which coefficients the data determine, where some channels were not recorded."""
    page.table(
        [
            (t.name, "yes" if t.learned else "hardly", t.change, t.before, t.after)
            for t in learned.told
        ],
        (
            "coefficient",
            "told by the data",
            "change",
            "deviation before",
            "deviation given the data",
        ),
        "Coefficients fitted together before training, with velocities and positions that were "
        "not recorded inferred; deviations are given the thrust. Of masses and drags the "
        "logarithm is shown (0.1 is about 10 %), of the net buoyancy percent of the displacement, "
        "of the righting lever the relative change. Where the data hardly tell a coefficient, its "
        "change means little. Motion does not tell a common scale of mass, drag and thrust: "
        "it is that of the rigid body's mass.",
    )


def add_evaluation(page: Page, learned: Learned, window: int | None = None) -> Page:
    """Held-out errors and bands, and one window in full."""
    held_out, evaluation = learned.parts.held_out, learned.evaluation
    models = [str(m) for m in evaluation.dataset["model"].to_numpy()]
    page.section(
        f"Held-out error: {', '.join(models[:-1])} and {models[-1]}",
        f"{len(held_out)} windows of {held_out.length:g} s that do not overlap with training data.",
    )
    hidden = held_out.hidden
    if hidden is not None:
        known = np.any(hidden.seen, axis=(0, 2))
        unseen = [name for name, seen in zip(CHANNELS, known, strict=True) if not seen]
        page.text(
            f"Not measured, and not judged: {', '.join(unseen)}. The windows start from what each "
            "model infers of them from the commands and sensors until then."
        )
    page.figure(error_figure(evaluation), "Error of the noise-free prediction against its horizon.")
    page.table(
        side_by_side(evaluation),
        ("", *models),
        "Root mean square errors of the noise-free prediction, after each time and over all; share "
        "of records inside the bands, ideally 50 and 90 %; energy score: smaller is better.",
    )
    page.figure(coverage_figure(evaluation), "Calibration of the predicted bands.")
    index = len(held_out) // 2 if window is None else window
    page.figure(
        bands_figure(
            learned.model,
            learned.preset,
            held_out,
            index,
            (learned.substeps, FINE_SUBSTEPS),
        ),
        "One held-out window, relative to the learned model's noise-free motion: measured motion "
        "and the learned law's 50 % and 90 % bands. Dashed: the preset's prediction, cut off "
        "where it leaves the panel.",
    )
    return page


def side_by_side(evaluation: Evaluation) -> list[tuple[object, ...]]:
    """Rows of errors at some horizons and over all, coverage and scores; a column for a model."""
    d, overall = evaluation.dataset, evaluation.overall()
    horizon = d["horizon"].to_numpy()
    last = float(horizon[-1])
    rows: list[tuple[object, ...]] = []
    for norm, unit in _NORMS.items():
        name = norm.replace("_", " ")
        for after in (last / 4, last / 2, last):
            at = int(np.argmin(np.abs(horizon - after)))
            values = (float(v) for v in d["rmse"].sel(norm=norm).isel(horizon=at))
            rows.append((f"{name} after {horizon[at]:.3g} s / {unit}", *values))
        values = (row[f"rmse_{norm}"] for row in overall.values())
        rows.append((f"{name} over {last:.3g} s / {unit}", *values))
    for band in d["band"].to_numpy():
        shares = (f"{row[f'coverage_{band:g}']:.0%}" for row in overall.values())
        rows.append((f"inside the {100 * band:.0f} % band", *shares))
    for law in ("pose", "velocity"):
        values = (row[f"energy_{law}"] for row in overall.values())
        rows.append((f"energy score of {law}", *values))
    return rows


def taken_words(result: TrainingResult, validation: int) -> str:
    """The selected step and the reason; `validation` is the number of validation windows."""
    windows = f"{validation} validation window{'s' * (validation != 1)}"
    step, last = result.best_step, max(result.refits, default=0)
    if validation == 0:
        return f"There were too few data for validation windows; the last step, {step}, is used."
    if step == 0:
        return f"On {windows} no step was better than the starting model, which is used."
    if step <= last:
        return (
            f"Step {step} is used: on {windows} no step was better, also with the bandwidths "
            f"refitted at step {last}."
        )
    since = f" since bandwidths were refitted at step {last}" if last else ""
    return f"Step {step} is used; it has the lowest loss on {windows}{since}."


def scale_words(rows: Sequence[tuple[object, ...]]) -> str:
    """Common scale of mass, drag and thrust, which motion alone does not identify."""
    table = np.array([[float(str(cell)) for cell in row[1:]] for row in rows])
    mass = float(np.median(table[:, 1] / table[:, 0]))
    drag = [table[:, 2 + k] + _SPEED * table[:, 4 + k] for k in (0, 1)]
    ratio = float(np.median(drag[1] / np.maximum(drag[0], np.finfo(float).tiny)))
    told = (
        f"In the median over axes, mass is {mass:.2f} times and drag at {_SPEED:g} m/s or rad/s "
        f"{ratio:.2f} times the preset's."
    )
    if (mass - 1) * (ratio - 1) <= 0:
        return told
    does, shows = ("overestimates", "much") if mass > 1 else ("underestimates", "little")
    return f"{told} A preset that {does} thrust appears as too {shows} mass and drag."


def coefficient_rows(preset: Dynamics, learned: Dynamics) -> list[tuple[object, ...]]:
    """Diagonals of M, D, D^f and b at rest: preset, learned, for each axis."""
    columns = []
    for model in (preset, learned):
        rest = jnp.zeros(6, model.rigid_inertia.dtype)
        c = model.coefficients(rest)
        columns.append(
            [
                *(np.diag(o.matrix()) for o in (c.mass, c.linear_drag, c.quadratic_drag)),
                np.broadcast_to(np.asarray(c.diffusion), (6,)),
            ]
        )
    rows: list[tuple[object, ...]] = []
    for i, axis in enumerate(AXES):
        cells = [float(column[k][i]) for k in range(4) for column in columns]
        rows.append((axis, *cells))
    return rows
