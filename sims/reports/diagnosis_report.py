"""A diagnosis as a page."""

from ...models.se3 import AXES
from ...training.diagnosis.findings.maneuver_library import MANEUVERS
from ...training.diagnosis.findings.result import Diagnosis
from ...training.diagnosis.pipeline import Finding
from .against_section import add_against
from .diagnosis_answer import MODELS, add_answer, interval, verdict_words
from .figures_diagnosis import (
    experiments_figure,
    horizon_figure,
    innovations_figure,
    names_figure,
    residual_figure,
)
from .figures_maps import in_one_noise, map_figure
from .figures_simulated import axes_figure, bands_figure, runs_figure, simulated_map_figure
from .figures_structure import memory_figure, repeats_figure, state_space_figure
from .pages import Page

_LEFT_OUT = {
    "scenario": "Each model and its noise levels were fitted without the scenario it is judged on.",
    "run": "There is one scenario: each model was fitted without the runs that it is judged on.",
    "block": "There are few runs: each model was fitted without the stretch that it is judged on.",
    "nothing": "Nothing could be left out: the models are judged on what they were fitted to.",
}
_UNITS = (
    "Both models are measured in one noise, that estimated with the causes: with its own noise "
    "estimate a wrong model would hide its errors in the noise."
)
_NOISE = {
    "position_m": "of positions / m",
    "attitude_rad": "of attitudes / rad",
    "velocity_m_s": "of velocities / (m/s)",
    "rate_rad_s": "of turning rates / (rad/s)",
    "slip_position": "of an estimator: drift of positions / (m/√s)",
    "slip_attitude": "of an estimator: drift of attitudes / (rad/√s)",
}
_WORDS = {
    "over inertia": "Divided by the inertia of the axis. All forces and masses scaled alike leave "
    "the motion as it is, so it determines nothing else.",
    "nat": "Unit of log likelihood: what wins n nats makes the data eⁿ times as likely. One nat a "
    "sample is won by forecasts over one step whose errors on each of 12 channels are 8 % smaller "
    "(e to the −1/12). Won on data that were left out of the fit, so that more parameters win "
    "nothing by themselves.",
    "p": "The probability that noise alone makes one of all names look so good. Runs are counted "
    "as independent, samples are not.",
    "innovation": "The error of a prediction over one step that is not the noise of the record it "
    "starts from. For a right model it has unit variance and is uncorrelated in time.",
    "belief": "The model that was given, as it is.",
    "refitted": "The belief with its coefficients fitted (added mass, drag and buoyancy, unless "
    "others are asked for) and no cause named: what tuning alone wins.",
    "with the causes": "The belief with the causes in it: the extended model.",
    "black box": "The belief and a regression of its errors on random features, that names "
    "nothing: shows what could be predicted without physics.",
    "energy score": "Mean distance of simulations with noise from the record, less half their "
    "mean distance from each other, over position, rotation, velocity and turning rate with m, "
    "rad, m/s and rad/s counted alike. Smaller is better.",
    "inside 50 %, 90 %": "The share of records inside the bands that hold 50 and 90 % of "
    "simulations. Less: too sure of itself; more: not sure enough.",
    "u, v, w; p, q, r": "Velocity forward, left, up; turning rate about the same axes.",
    "f1, f2, …; X, Y, Z, K, M, N": "Commanded force of each thruster; or force and moment, where "
    "these are commanded. Effort is the sum of the thrusters' absolute forces.",
}


def diagnosis_page(finding: Finding, title: str) -> Page:
    """The page of a diagnosis: verdict, causes, localisation of the error, gain, data."""
    d = finding.diagnosis
    shared = in_one_noise(finding)
    page = Page(
        title, f"{len(d.data.scenarios)} scenarios, {d.data.runs} runs, {d.data.seconds:.0f} s"
    )
    against = d.against
    good = d.verdict == "adequate" if against is None else against.verdict == "unchanged"
    page.verdict(d.sentence, good=good)
    if against is None:
        page.text(f"{verdict_words(d)} Words are explained [at the end](#words).")
    else:
        add_against(page, against)
        page.section("The healthy model, with the changes, on the new data", verdict_words(d))
        page.text("Words are explained [at the end](#words).")
    add_answer(page, d)
    _add_experiments(page, finding)
    _add_simulations(page, finding, shared)
    _add_error_maps(page, shared)
    _add_memory(page, shared)
    _add_gain(page, d)
    _add_data(page, d)
    page.section("Words").table(_WORDS)
    return page.footer(f"{d.tested} names, {d.seconds:.0f} s")


def _add_experiments(page: Page, finding: Finding) -> None:
    d = finding.diagnosis
    page.section("The causes that were tried")
    page.figure(
        names_figure(finding),
        "Log likelihood that each cause alone wins on data left out of its fit.",
    )
    following = experiments_figure(d)
    if following is not None:
        page.figure(
            following,
            "Expected information of each maneuver about a cause against its closest rivals, from "
            "simulations of the model with the causes, evaluated as these data were. With n nats a "
            "minute the cause's standard error is eⁿ times smaller after a minute.",
        )
        maneuvers = dict.fromkeys(t for c in d.causes for t in c.experiments)
        page.table(
            [(t, MANEUVERS[t].text) for t in maneuvers if t in MANEUVERS],
            ("maneuver", "what to do"),
        )


def _add_simulations(page: Page, finding: Finding, shared: Finding) -> None:
    page.section("Simulations and records")
    page.figure(
        bands_figure(finding),
        "The run with the median error in the scenario that the belief forecasts worst. Bands hold "
        "the disturbance and the records' noise.",
    )
    page.figure(
        axes_figure(finding),
        "Root mean square error of noise-free simulations from recorded states, axis by axis.",
    )
    page.figure(
        runs_figure(shared),
        "Root mean square of all axes, run by run (long runs: piece by piece). " + _UNITS,
    )


def _add_error_maps(page: Page, shared: Finding) -> None:
    page.section(
        "Where the error lives",
        "Innovations are the errors of one-step predictions, in units of what the noise explains. "
        + _UNITS,
    )
    page.figure(
        map_figure(shared),
        "Share of each axis' innovations that depends on each state and input, on time in the run "
        "and on the run. Pale is noise; grey did not vary.",
    )
    page.figure(
        simulated_map_figure(shared),
        "The same of the errors at the ends of simulations, against the means over each of them. "
        "Grey did not vary: time, say, where each run has room for one simulation.",
    )
    page.figure(
        state_space_figure(shared),
        "Errors in state space: axes with most structure, over the inputs that explain most of it.",
    )


def _add_memory(page: Page, shared: Finding) -> None:
    page.section("Error or noise")
    page.figure(
        repeats_figure(shared),
        "Errors that repeat are the model's; those that do not are noise. Dashed: noise alone.",
    )
    page.figure(
        innovations_figure(shared),
        "The mean over repeated runs: noise averages out, errors of the model remain.",
    )
    page.figure(
        memory_figure(shared),
        "Autocorrelation and spectrum of the innovations. Grey and dashed: white noise.",
    )
    page.figure(
        residual_figure(shared),
        "Residual by channel: errors of pose (in the body frame) and twist.",
    )


def _add_gain(page: Page, d: Diagnosis) -> None:
    page.section("Forecasts on left-out data", _LEFT_OUT[d.left_out])
    page.figure(
        horizon_figure(d),
        "Root mean square error of noise-free simulations from recorded states, and energy score "
        "of simulations with noise (m, rad, m/s and rad/s alike); bands: 95 %. ↑: the largest "
        "error of a model that is far beyond the panel.",
    )
    page.table(
        _scores(d),
        ("model", "nats a sample", "won over the belief", "energy score"),
        "Log score of forecasts over one step, and energy score of simulations.",
        fold="Scores of forecasts",
    )


def _add_data(page: Page, d: Diagnosis) -> None:
    page.section("Data")
    page.table(
        {
            "commands": d.data.command,
            "step / s": d.data.step,
            **{f"estimated noise {_noise(k)}": v for k, v in d.data.noise.items()},
        },
        caption="Standard deviations of the records, mean over axes, and diffusion of the random "
        "disturbance, as estimated from these data with the causes.",
    )


def _noise(key: str) -> str:
    """A noise level of the data in words, with its unit."""
    axis = key.removeprefix("diffusion_")
    if axis == key:
        return _NOISE.get(key, key.replace("_", " "))
    return f"of the disturbance, {axis} / {'N√s' if axis in AXES[:3] else 'N·m√s'}"


def _scores(d: Diagnosis) -> list[tuple[str, ...]]:
    """One row per model: log score, and energy score over the longest horizon."""
    rows = []
    for name, g in d.gain.items():
        last = list(g.energy_score)[-1]
        energy = f"{interval(g.energy_score[last])} at {last} s"
        row = (interval(g.log_score, 2), interval(g.log_score_gain, 2), energy)
        rows.append((MODELS[name], *row))
    return rows
