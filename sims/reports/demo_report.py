"""The page of the demo: what the preset gets wrong, what was learned, the dive."""

from typing import Any

from ...models.recordings.checks.finding import findings_of
from ...models.recordings.store import Recording
from ...models.vehicles.vehicle import Vehicle
from ...systems.controllers.kinds import MppiImpedance
from ..demo_diagnosis import Diagnosed
from ..learning import Learned
from ..run.folder import scene
from ..run.loop import Run
from ..run.metrics import clearance
from ..scenarios.scenario import Scenario
from .diagnosis_answer import add_answer, verdict_words
from .figures_path import path_figure, samples_figure
from .figures_time import progress_figure, tracking_figure
from .learning_report import add_data, add_evaluation, add_training
from .pages import Page
from .run_report import consistency

NORMS = ("position", "rotation", "linear_velocity", "angular_velocity")
UNITS = ("m", "rad", "m/s", "rad/s")


def demo_page(
    source: str,
    recording: Recording,
    vehicle: Vehicle,
    found: Diagnosed,
    learned: Learned,
    run: Run,
    values: dict[str, Any],
) -> Page:
    """The page: verdict, what the preset gets wrong, held-out errors, dive, training, data."""
    overall = learned.evaluation.overall()
    outcome = values["outcome"]
    better = all(_error(overall, "learned", n) < _error(overall, "preset", n) for n in NORMS)
    page = Page("From a log to a dive", f"`{source}`, from the preset `{vehicle.name}`")
    told = "" if found.diagnosis is None else f"The preset: {found.diagnosis.sentence} "
    page.verdict(
        f"{told}On held-out data: {compared(overall, 'position', 'm')}; "
        f"{compared(overall, 'linear_velocity', 'm/s')}. {outcome['words']}",
        better and outcome["success"],
    )
    checked = findings_of(recording.dataset)
    if checked:
        page.text(
            f"The checks of the data found: {', '.join(f.word for f in checked)}. See "
            "[there](#checks-of-the-data)."
        )
    others = [m for m in overall if m != "learned"]
    page.tiles(
        [
            (
                f"{norm.replace('_', ' ')} error",
                f"{_error(overall, 'learned', norm):.3g} {unit}",
                ", ".join(f"{m} {_error(overall, m, norm):.3g} {unit}" for m in others),
            )
            for norm, unit in zip(NORMS, UNITS, strict=True)
        ]
    )
    _add_diagnosis(page, vehicle, found, learned)
    add_evaluation(page, learned)
    _add_dive(page, vehicle, run, values)
    return add_data(add_training(page, learned), recording)


def _add_diagnosis(page: Page, vehicle: Vehicle, found: Diagnosed, learned: Learned) -> None:
    """The answer of the diagnosis, and what training starts from."""
    d = found.diagnosis
    if d is None:
        page.section("Diagnosis", start_words(found, learned))
        return
    page.text(
        f'{verdict_words(d)} "Yours" is the preset `{vehicle.name}`. Only the training part of the '
        "data was diagnosed. Figures and all evidence are in [its report](diagnosis/report.html)."
    )
    page.text(start_words(found, learned))
    add_answer(page, d)


def start_words(found: Diagnosed, learned: Learned) -> str:
    """What training started from, and whether it got further."""
    if found.start is None:
        return f"{found.why} The SPINN was learned from the preset."
    told = (
        "The SPINN was learned on top of the extended model (`diagnosis/extended/model.spinn`): "
        "the preset with the fitted coefficients and the causes."
    )
    if learned.result.best_step == 0:
        told += " No step of training forecast validation windows better than that model itself."
    return told


def _add_dive(page: Page, vehicle: Vehicle, run: Run, values: dict[str, Any]) -> None:
    page.section(
        "The dive",
        f"The learned model is both the plant and MPPI's model: {task_words(run.scenario)}, on the "
        f"estimates of the Kalman filter.{consistency(values['estimate'])} The run has a "
        "[report](dive/report.html) and a [3-D replay](dive/meshcat.html).",
    )
    around = scene(run.scenario)
    page.figure(path_figure(run.log, around), "Planned, flown and estimated path.")
    room = clearance(run.log, vehicle, run.scenario.station.obstacles)
    for figure, caption in (
        (
            progress_figure(run.log, room, around.goal, around.goal_radius),
            "Distance to the goal, and clearance.",
        ),
        (samples_figure(run.log, around), "Sampled paths at six times."),
        (tracking_figure(run.log), "Plan minus truth, in B."),
    ):
        if figure is not None:
            page.figure(figure, caption)


def task_words(scenario: Scenario) -> str:
    """The task in words: start, goal, planning rate."""

    def place(p: Any) -> str:
        return f"({', '.join(f'{x:g}' for x in p)}) m"

    start = place(scenario.station.initial_state()[0][4:])
    to = "" if scenario.goal is None else f" to {place(scenario.goal)}"
    assert isinstance(scenario.controller, MppiImpedance)
    return f"from {start}{to}, with {1 / scenario.controller.planner.period:g} plans a second"


def compared(overall: dict[str, dict[str, float]], norm: str, unit: str) -> str:
    """A learned model's error, and its share of the preset's error."""
    learned, preset = (_error(overall, model, norm) for model in ("learned", "preset"))
    share = f"{100 * learned / preset:.0f} % of the preset's {preset:.2g} {unit}"
    return f"{norm.replace('_', ' ')} error {learned:.2g} {unit}, {share}"


def _error(overall: dict[str, dict[str, float]], model: str, norm: str) -> float:
    return overall[model][f"rmse_{norm}"]
