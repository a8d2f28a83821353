"""A diagnosis as a page."""

from ..training.diagnosis.diagnose import Finding
from ..training.diagnosis.result import Value
from .figures_diagnosis import (
    horizon_figure,
    innovations_figure,
    map_figure,
    names_figure,
    residual_figure,
)
from .pages import Page


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
    page.figure(names_figure(finding), "Each name alone, fitted on the other scenarios.")
    page.section(
        "Where the error lives",
        "Innovations are the errors of one-step predictions, in units of what the noise explains.",
    )
    page.figure(
        map_figure(finding),
        "How much of each axis' error depends on each state and input. Pale is noise.",
    )
    page.figure(innovations_figure(finding), "Repeated runs average the noise, errors stay.")
    page.figure(residual_figure(finding), "What is left by channel.")
    page.section("Gain", "Noise-free simulations from recorded states, on scenarios left out.")
    page.figure(horizon_figure(d), "Root mean square error; bands: 95 % over scenarios.")
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
    low, high = v.interval95
    return f"{name} = {v.value:.4g} ({low:.4g} … {high:.4g}) {v.unit}"
