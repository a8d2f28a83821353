"""The study's pages: report.html, and ablation.md for the documentation."""

import glob
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from ...models.config import typed_yaml as yaml
from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...training.methods import METHODS
from ..reports.pages import Page
from .claims import Verdict, targets, verdicts
from .config import REGIMES, StudyConfig, asked_for
from .figures import (
    curves_figure,
    diffusion_figure,
    distributions_figure,
    horizon_figure,
    ordered,
    results_figure,
    thinned_curve,
)
from .table import Row, collect, done_runs, summarise, write_csv, write_netcdf

_MET = {"reproduced": "met", "not reproduced": "not met", "not tested": "not tested"}
_TITLE = "# Ablation study"
_FIGURES = re.compile(r"results|diffusion|training|distributions-.*")
_COLUMNS = (
    ("w2", "W₂"),
    ("w2_ratio", "W₂ / floor"),
    ("w2_debiased", "W₂ debiased"),
    ("energy_score_ratio", "energy / floor"),
    ("rmse_mean_geodesic", "mean path, pose"),
    ("rmse_mean_velocity", "mean path, velocity"),
    ("rmse_samples_geodesic", "samples, pose"),
    ("spread_velocity_ratio", "spread / true"),
    ("coverage_90", "in 90 % band"),
    ("seconds_training", "training, s"),
)
_EXPLAINED = (
    "Values are means over successful runs (± one standard deviation over seeds). A run succeeds "
    "if training finishes, the final loss is not above the initial one, and all numbers and all "
    "sampled motions are finite. Every learned law is compared with the true law by samples, at "
    "evenly spaced times of the whole horizon. The floor is the same metric between two "
    "independent sample sets of the true law. W₂ is exact; the study's settings weight metres, "
    "radians and their rates in its ground distance. In many dimensions W₂ of a few hundred "
    "samples is mostly sampling error, and smaller for a narrow law; the debiased W₂ subtracts "
    "this error. The error of samples compares single motions, which favours a law without noise; "
    "the error of the mean path does not."
)


def is_page(path: Path) -> bool:
    """Whether a file is a page that `render` wrote."""
    try:
        return path.read_text(encoding="utf-8").startswith(f"{_TITLE}\n")
    except (OSError, UnicodeDecodeError):
        return False


def check_shown(docs: Path) -> None:
    """Check that a page's figures replace no other files than its own figures.

    Raises:
        UserError: naming such a file.
    """
    shown = docs.read_text(encoding="utf-8") if docs.exists() else ""
    for at in sorted(docs.parent.glob(f"{glob.escape(docs.stem)}-*.png")):
        name = at.name.removeprefix(f"{docs.stem}-").removesuffix(".png")
        if _FIGURES.fullmatch(name) and f"]({at.name})" not in shown:
            raise UserError(
                f"--docs {docs}: {at} is no figure of it and would be replaced; move it away or "
                "name another page"
            )


def render(out: str | os.PathLike[str], docs: str | os.PathLike[str] | None = None) -> list[Row]:
    """Write every table, figure and page of the runs in `out`; return the runs.

    Into `out`: table.csv (one row per run), summary.csv (one row per method), rich.nc and sparse.nc
    (all metrics over scenarios and time), results.png, diffusion.png, training.png,
    distributions-<scenario>.png, report.html and ablation.md. With `docs`, ablation.md is also
    written there, with its figures in the same folder.

    Raises:
        UserError: there is no finished run, or one is damaged.
    """
    out = Path(out)
    rows = collect(out)
    summary = summarise(rows)
    write_csv(out / "table.csv", rows)
    write_csv(out / "summary.csv", summary)
    write_netcdf(out)
    figures = {"results": results_figure(rows)}
    if any(r["success"] for r in rows):
        figures["diffusion"] = diffusion_figure(rows)
    figures["training"] = curves_figure(_curves(out))
    figures |= _distributions(out)
    for name, figure in figures.items():
        _save(figure, out / f"{name}.png")
    _page(out, rows, summary, figures).write(out / "report.html")
    _write_text(out / "ablation.md", ablation_text(rows, _settings(out), figures=list(figures)))
    if docs is not None:
        docs = Path(docs)
        kept = [n for n in figures if not n.startswith("distributions")]
        kept += [n for n in figures if n not in kept][:1]
        names = {name: f"{docs.stem}-{name}.png" for name in kept}
        for name, file in names.items():
            _save(figures[name], docs.with_name(file))
        _write_text(docs, ablation_text(rows, _settings(out), kept, names, docs.name))
    return rows


def _settings(out: Path) -> StudyConfig | None:
    path = out / "study.yaml"
    return yaml.load(StudyConfig, path) if path.exists() else None


def _distributions(out: Path) -> dict[str, Figure]:
    """The paper's distributions figure for each shown scenario, on sparse data if available."""
    for regime in reversed(REGIMES):
        motions: dict[str, xr.Dataset] = {}
        for folder in done_runs(out):
            path = folder / "motions.nc"
            if folder.parent.parent.name == regime and path.exists():
                with xr.open_dataset(path, engine="h5netcdf") as dataset:
                    motions.setdefault(folder.parent.name, dataset.load())
        if motions:
            scenarios = next(iter(motions.values()))["scenario"].to_numpy()
            return {
                f"distributions-{name}": distributions_figure(motions, str(name))
                for name in scenarios
            }
    return {}


def _page(
    out: Path, rows: Sequence[Row], summary: Sequence[Row], figures: dict[str, Figure]
) -> Page:
    found, aims = verdicts(rows), targets(rows)
    tested = [v for v in found if v.state != "not tested"]
    good = sum(v.state == "reproduced" for v in tested)
    page = Page("Ablation study", _told(rows))
    page.verdict(f"{good} of {len(tested)} tested claims of the paper reproduced.")
    page.table([(v.claim, v.state, v.evidence) for v in found], ("claim", "verdict", "numbers"))
    page.table([(v.claim, _MET[v.state], v.evidence) for v in aims], ("target", "", "numbers"))
    page.section("Errors and distances", _EXPLAINED)
    page.figure(
        figures["results"],
        "Every method in every regime, with its number of successful runs.",
    )
    for regime in REGIMES:
        lines = _lines(summary, regime)
        if lines:
            page.table(lines, ("method", "runs", *(t for _, t in _COLUMNS)), f"{regime} data")
    metrics = {}
    for regime in REGIMES:
        path = out / f"{regime}.nc"
        if path.exists():
            with xr.open_dataset(path, engine="h5netcdf") as dataset:
                metrics[regime] = dataset[["w2"]].load()
    if metrics:
        page.figure(horizon_figure(metrics), "W₂ to the true law over the horizon.")
    shown = [name for name in figures if name.startswith("distributions")]
    if shown:
        page.section("Distributions", "Samples of the true and of each learned law from above.")
        for name in shown:
            page.figure(figures[name], f"Scenario {name.removeprefix('distributions-')}.")
    if "diffusion" in figures:
        page.section("Diffusion", "Learned against true b, averaged over the true motion.")
        page.figure(figures["diffusion"], "Learned over true diffusion; the band is ± 20 %.")
    page.section("Training")
    page.figure(figures["training"], "Loss against steps; its unit differs by method.")
    failures = [(r["regime"], r["method"], r["seed"], r["failure"]) for r in rows if r["failure"]]
    if failures:
        page.table(failures, ("regime", "method", "seed", "why training failed"))
    study = _settings(out)
    if study is not None:
        page.details("All settings (study.yaml)", yaml.dump(study))
    return page


def _curves(out: Path) -> dict:
    curves: dict = {}
    for folder in done_runs(out):
        curve = thinned_curve(folder / "training" / "metrics.csv")
        key = (folder.parent.parent.name, folder.parent.name)
        curves.setdefault(key, []).extend([] if curve is None else [curve])
    return curves


def _told(rows: Sequence[Row]) -> str:
    seeds = len({r["seed"] for r in rows})
    methods = len({r["method"] for r in rows})
    regimes = " and ".join(r for r in REGIMES if any(row["regime"] == r for row in rows))
    return f"{methods} methods, {regimes} data, {seeds} seed{'s' * (seeds > 1)}, {len(rows)} runs"


def _command(rows: Sequence[Row], study: StudyConfig | None, docs: str) -> str:
    """The command for the same runs."""
    regimes = [r for r in REGIMES if any(row["regime"] == r for row in rows)]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    words = ["spinndrift study ablation"]
    if len(regimes) < len(REGIMES):
        words.append(f"--regime {' '.join(regimes)}")
    if set(methods) != set(METHODS):
        words.append(f"--methods {' '.join(methods)}")
    seeds = 1 + max(int(row["seed"]) for row in rows)
    options = "" if study is None else asked_for(study)
    words.append(f"--seeds {seeds}{options} --docs docs/{docs}")
    return " ".join(words)


def _lines(summary: Sequence[Row], regime: str) -> list[list[str]]:
    by_method = {r["method"]: r for r in summary if r["regime"] == regime}
    lines = []
    for method in ordered(list(by_method)):
        row = by_method[method]
        cells = [_cell(row.get(name, math.nan), row.get(f"{name}_std")) for name, _ in _COLUMNS]
        lines.append([f"`{method}`", f"{row['successes']}/{row['runs']}", *cells])
    return lines


def _cell(value: float, std: float | None) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:.3g}" + ("" if std is None or math.isnan(std) else f" ± {std:.1g}")


# ------------------------------------------------------------------------------------- ablation.md


def ablation_text(
    rows: Sequence[Row],
    study: StudyConfig | None,
    figures: Sequence[str] = (),
    names: dict[str, str] | None = None,
    docs: str = "ablation.md",
) -> str:
    """A page for docs/ with verdicts, targets and numbers, all computed from the rows."""
    files = {name: f"{name}.png" for name in figures} | (names or {})
    lines = [
        _TITLE,
        "",
        *_wrapped(f"{_told(rows)}. Written by"),
        "",
        "```",
        _command(rows, study, docs),
        "```",
        "",
    ]
    if study is not None:
        lines += [*_wrapped(_setting_words(study, rows)), ""]
    lines += ["## The paper's claims", "", "| claim | verdict | numbers |", "|---|---|---|"]
    lines += [_claim(v, v.state) for v in verdicts(rows)]
    lines += ["", "## This project's targets", "", "| target | | numbers |", "|---|---|---|"]
    lines += [_claim(v, _MET[v.state]) for v in targets(rows)]
    lines += ["", "## Numbers", "", *_wrapped(_EXPLAINED), ""]
    summary = summarise(rows)
    for regime in REGIMES:
        found = _lines(summary, regime)
        if not found:
            continue
        header = ["method", "succeeded", *(t for _, t in _COLUMNS)]
        lines += [f"### {regime.capitalize()} data", "", f"| {' | '.join(header)} |"]
        lines += ["|" + "---|" * len(header)]
        lines += [f"| {' | '.join(line)} |" for line in found]
        lines += [""]
    for name, file in files.items():
        lines += [f"![{name.replace('-', ', ')}]({file})", ""]
    return "\n".join(lines).rstrip() + "\n"


def _setting_words(study: StudyConfig, rows: Sequence[Row]) -> str:
    b = ", ".join(f"{x:g}" for x in study.truth.diffusion)
    parts = []
    for regime in REGIMES:
        if any(r["regime"] == regime for r in rows):
            c = study.regime(regime)
            parts.append(
                f"{regime} data are {c.trajectories} trajectories of each of {len(c.maneuvers)} "
                f"maneuver{'s' * (len(c.maneuvers) > 1)} of {c.duration:g} s at {c.rate:g} Hz"
            )
    e, words = study.evaluation, "; ".join(parts)
    fitted = study.size.drift_iterations != 0
    return (
        f"The truth is the preset `{study.truth.vehicle}` with the diffusion b = ({b}) N√s and "
        f"N·m√s; networks are pre-trained to the preset `{study.belief}`"
        f"{'' if fitted else ', and their coefficients are not fitted to data before training'}. "
        f"{words[:1].upper()}{words[1:]}. "
        f"Laws are compared by {e.samples} samples per scenario at {e.times} times. The weights of "
        f"the ground distance are {e.metric.position:g} per m, {e.metric.rotation:g} per rad, "
        f"{e.metric.linear_velocity:g} per m/s and {e.metric.angular_velocity:g} per rad/s."
    )


def _claim(verdict: Verdict, state: str) -> str:
    return f"| {verdict.claim} | **{state}** | {verdict.evidence} |"


def _wrapped(text: str, width: int = 100) -> list[str]:
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > width:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}".strip()
    return [*lines, line]


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _save(figure: Figure, path: Path) -> None:
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=140, metadata={"Software": None})
