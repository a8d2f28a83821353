"""A diagnosis as a page."""

from ..training.diagnosis.diagnose import Finding
from ..training.diagnosis.result import Diagnosis, Interval, Value
from .figures_diagnosis import (
    experiments_figure,
    horizon_figure,
    innovations_figure,
    map_figure,
    names_figure,
    residual_figure,
)
from .figures_simulated import axes_figure, bands_figure, runs_figure, simulated_map_figure
from .figures_structure import memory_figure, repeats_figure, state_space_figure
from .pages import Page

_LEFT_OUT = {
    "scenario": "Each model and its noise levels were fitted without the scenario it is judged on.",
    "run": "There is one scenario: each model was fitted without the runs that it is judged on.",
    "block": "There is one run: each model was fitted without the stretch that it is judged on.",
    "nothing": "Nothing could be left out: the models are judged on what they were fitted to.",
}


def diagnosis_page(finding: Finding, title: str) -> Page:
    """Verdict, causes, where the error lives, gain, data."""
    d = finding.diagnosis
    page = Page(
        title, f"{len(d.data.scenarios)} scenarios, {d.data.runs} runs, {d.data.seconds:.0f} s"
    )
    page.verdict(d.sentence, good=d.verdict == "adequate")
    for problem in d.data.problems:
        page.text(f"**Data:** {problem}")
    page.section("Causes")
    if d.causes:
        page.table(
            [
                (
                    c.name,
                    c.where,
                    "; ".join(_told(k, v) for k, v in c.parameters.items()),
                    f"{c.evidence.heldout_gain:.0f}",
                    ", ".join(c.indistinguishable_from) or "–",
                    c.next_experiment,
                )
                for c in d.causes
            ],
            ("cause", "where", "parameters (95 %)", "nats", "could as well be", "next experiment"),
        )
    else:
        page.text(
            f"None of {d.tested} names wins more than noise alone can win ({d.threshold:.1f} nats "
            f"at a false-alarm rate of {d.alpha:g})."
        )
    for c in d.causes:
        if c.structure is not None:
            s = c.structure
            page.text(
                f"**Unknown:** {s.description} wins {s.heldout_gain:.0f} nats; the best name would "
                f"win {s.best_name_gain:.0f} of them."
            )
    if d.ratios:
        page.text("What the motion tells whatever the mass, over the inertia of the axis:")
        page.table(
            [(r.name, r.where, f"{r.believed:.4g}", _valued(r.found))
             for r in d.ratios],
            ("ratio", "where", "believed", "found (95 %)"),
        )  # fmt: skip
    if d.refitted:
        page.text("Coefficients that were fitted before any cause was named:")
        page.table(
            [(r.name, r.where, f"{r.believed:.4g}", _told(r.parameter, r.fitted))
             for r in d.refitted],
            ("coefficient", "where", "believed", "fitted (95 %)"),
        )  # fmt: skip
    page.figure(names_figure(finding), "Each name alone, fitted on the other scenarios.")
    following = experiments_figure(d)
    if following is not None:
        page.figure(
            following,
            "What each maneuver of a set is expected to tell about a cause, beside its closest "
            "rivals: simulated by the model with the causes, looked at as these data were.",
        )
    page.section("Simulations beside the records")
    page.figure(
        bands_figure(finding),
        "The run with the median error in the scenario that the belief forecasts worst. Bands hold "
        "the disturbance and the records' noise.",
    )
    page.figure(
        axes_figure(finding),
        "Root mean square error of noise-free simulations from recorded states, axis by axis.",
    )
    page.figure(runs_figure(finding), "Root mean square of all axes, run by run.")
    page.section(
        "Where the error lives",
        "Innovations are the errors of one-step predictions, in units of what the noise explains.",
    )
    page.figure(
        map_figure(finding),
        "How much of each axis' innovations depends on each state and input. Pale is noise.",
    )
    page.figure(
        simulated_map_figure(finding),
        "The same of the errors at the ends of simulations, against the means over each of them.",
    )
    page.figure(
        state_space_figure(finding),
        "Where in state space: the axes with most structure, over what tells most of each.",
    )
    page.section("Error or noise")
    page.figure(
        repeats_figure(finding),
        "What repeats is error, what doesn't is noise. Dashed: as much as noise alone makes.",
    )
    page.figure(innovations_figure(finding), "Repeated runs average the noise, errors stay.")
    page.figure(
        memory_figure(finding),
        "What innovations remember, and at which frequencies they are. Grey and dashed: noise.",
    )
    page.figure(residual_figure(finding), "What is left by channel.")
    page.section("Gain", _LEFT_OUT[d.left_out])
    page.table(
        _gains(d),
        ("model", "nats a sample", "over the base", "energy score", "in 50 %", "in 90 %"),
    )
    page.figure(
        horizon_figure(d),
        "Root mean square error of noise-free simulations from recorded states, and energy score "
        "of simulated laws; bands: 95 %.",
    )
    page.section("Data")
    page.table(
        {
            "commands": d.data.command,
            "step / s": d.data.step,
            **{k.replace("_", " "): v for k, v in d.data.noise.items()},
        }
    )
    for limit in d.data.limits:
        page.text(f"Not told: {limit}.")
    return page.footer(f"{d.tested} names, {d.seconds:.0f} s")


def _told(name: str, v: Value) -> str:
    return f"{name} = {_valued(v)}"


def _valued(v: Value) -> str:
    low, high = v.interval95
    return f"{v.value:.4g} ({low:.4g} … {high:.4g}) {v.unit}"


def _gains(d: Diagnosis) -> list[tuple[str, ...]]:
    """A row a model: scores, and bands at the longest horizon."""
    rows = []
    for name, g in d.gain.items():
        last = list(g.energy_score)[-1]
        shares = [_interval(bands[last], 2) for bands in g.coverage.values()]
        energy = f"{_interval(g.energy_score[last])} at {last} s"
        row = (name.replace("_", " "), _interval(g.log_score, 2), _interval(g.log_score_gain, 2))
        rows.append((*row, energy, *shares))
    return rows


def _interval(v: Interval, digits: int = 3) -> str:
    low, high = v.interval95
    return f"{v.value:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})"
