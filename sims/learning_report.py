"""What training found, as sections of a page."""

import jax.numpy as jnp
import numpy as np

from ..models.dynamics import Dynamics
from ..models.recording import Recording
from .figures_learning import (
    bands_figure,
    coverage_figure,
    error_figure,
    learning_figure,
    recording_figure,
)
from .learning import FINE_SUBSTEPS, Learned
from .pages import Page

_LEFT_OUT = ("rmse_geodesic", "rmse_velocity", "finite")
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")


def add_data(page: Page, recording: Recording) -> Page:
    """What the recording holds, and lacks."""
    minutes = recording.duration / 60
    page.section(
        "The data",
        f"{minutes:.1f} minutes at {1 / recording.dt:g} Hz in {int((recording.lengths > 0).sum())} "
        f"stretches; commands as `{recording.commands[0]}`.",
    )
    page.figure(recording_figure(recording), "What was measured, one colour a stretch.")
    if recording.notes:
        page.table([(note,) for note in recording.notes], ("what the source had and lacked",))
    return page.details("Ranges of everything recorded", recording.summary())


def add_training(page: Page, learned: Learned) -> Page:
    """Learning curves, what the data changed in the coefficients, and what went wrong."""
    result, parts = learned.result, learned.parts
    validation = 0 if parts.validation is None else len(parts.validation)
    page.section(
        "Training",
        f"{result.steps} steps on {len(parts.learn)} windows of {parts.learn.length:g} s in "
        f"{result.seconds:.0f} s; the best of {validation} validation windows was reached at step "
        f"{result.best_step}. The other {len(parts.held_out)} windows were held out.",
    )
    page.figure(learning_figure(result.metrics), "Loss against steps (running median).")
    page.table(
        coefficient_rows(learned.preset, learned.model),
        ("axis", "M preset", "M learned", "D preset", "D learned", "D^f preset", "D^f learned",
         "b preset", "b learned"),
        "Diagonals at rest: mass with added mass (kg, kg·m²), viscous and fluid drag, diffusion "
        "(N√s, N·m√s). The preset's diffusion is estimated from its own errors. Thrust that the "
        "preset overrates shows up as too much mass and drag.",
    )  # fmt: skip
    for event in result.events:
        page.text(f"Step {event['step']}: {event['text']}")
    return page


def add_evaluation(page: Page, learned: Learned, window: int | None = None) -> Page:
    """Held-out errors and bands, and one window in full."""
    held_out, evaluation = learned.parts.held_out, learned.evaluation
    page.section(
        "Held-out error: preset against learned",
        f"{len(held_out)} windows of {held_out.length:g} s that share no moment with training.",
    )
    page.figure(error_figure(evaluation), "Error of the noise-free prediction against its horizon.")
    shown = [key for key in next(iter(evaluation.overall().values())) if key not in _LEFT_OUT]
    page.table(
        [(name, *(row[key] for key in shown)) for name, row in evaluation.overall().items()],
        ("model", *(key.replace("_", " ") for key in shown)),
        "Averages over all horizons; coverage should be 0.5 and 0.9, the energy score is small "
        "for a law that is sharp and right.",
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
        "One held-out window, seen from the learned model's noise-free motion: measured motion "
        "over the learned law's 50 % and 90 % bands; dashed, the preset's prediction (cut off "
        "where it leaves the panel).",
    )
    return page


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
