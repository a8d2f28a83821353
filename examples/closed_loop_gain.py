"""What a diagnosis is worth in closed loop: a crossing planned with the belief and with its model.

Run it: `PYTHONPATH=tests python examples/closed_loop_gain.py --out runs/loop`. For each hidden
effect it makes data with the simulator of `tests/hidden`, diagnoses them, and flies the pylon
crossing with the effect in the plant, planned with the preset (`belief`), with the model that the
diagnosis found (`extended`) and with the effect itself (`truth`). docs/closed-loop-gain.md tells
what came of it. What is done stays done: a later call flies what is missing and writes the tables
anew.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import Extended, kind
from spinndrift.models.files.atomic import atomic_path
from spinndrift.models.files.checkpoint import save_model
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import Vehicle, load_vehicle
from spinndrift.sims.compile_cache import keep_compiled
from spinndrift.sims.diagnosis_benchmark.tables import share
from spinndrift.sims.run.folder import run_metrics, scene
from spinndrift.sims.run.loop import Run, simulate_seeds
from spinndrift.sims.scenarios.scenario import Scenario, load_scenario
from spinndrift.systems.controllers.kinds import MppiImpedance
from spinndrift.training.diagnosis.pipeline import diagnose

VEHICLE = "bluerov2_heavy"
PLANNERS = ("belief", "extended", "truth")
NONE = "nothing"
"""The name under which the preset flies itself."""
FIGURES = ("time", "clearance", "off_plan", "depth", "force")
"""Numbers of a flight: see `Flight`."""
EVERY = 4  # samples of the log (20 Hz) between points of a path that is kept


@dataclass(frozen=True)
class Hidden:
    """A cause as the diagnosis should tell it.

    Attributes:
        name, where, parameters: in the published definitions (`models.effects`).
        write: writes the data of the vehicle that has it into a new folder.
    """

    name: str
    where: str
    parameters: dict[str, float]
    write: Callable[[Path], object]

    def model(self, vehicle: Vehicle, diffusion: Sequence[float]) -> Extended:
        """The preset with the effect."""
        effect = kind(self.name).of(self.where, **self.parameters)
        base = vehicle.dynamics(np.array(diffusion))
        return Extended.create(base, (effect,), vehicle.thrusters())


def hidden_causes(seed: int = 1) -> dict[str, Hidden]:
    """What may be hidden, by the name of its folder.

    Raises:
        UserError: the simulator of the tests can't be imported.
    """
    try:
        from hidden.blind import SCALES, told
        from hidden.draw import Case
        from hidden.effects_actuation import ActuationDelay, ThrusterGain, ThrusterLag, ThrustScale
        from hidden.effects_body import NetBuoyancy
        from hidden.effects_environment import CurrentSteady
    except ModuleNotFoundError as error:
        raise UserError(
            f"{error}: the simulator lies in the folder tests; set PYTHONPATH=tests"
        ) from error
    plan, _ = SCALES["small"]
    effects = {
        "dead_thruster": ThrusterGain(2, gain=0.0),
        "weak_thrust": ThrustScale(scale=0.5),
        "current": CurrentSteady(east=-0.25, north=0.35),
        "ballast": NetBuoyancy(force=-20.0),
        "lag": ThrusterLag(tau=0.4),
        "delay": ActuationDelay(seconds=0.25),
    }
    found = {}
    for name, effect in effects.items():
        cause = told(effect)
        write = Case(seed, (effect,), plan).write
        found[name] = Hidden(cause["name"], cause["where"], cause["parameters"], write)
    return found


# ------------------------------------------------------------------------------------ diagnosing


def models(
    name: str, hidden: Hidden, scenario: Scenario, out: Path, tell: Callable[[str], None]
) -> dict[str, Path]:
    """The plant and what the planners believe, as checkpoints: data, diagnosis and truth.

    The planner's noise is what waves and wake do, not what the data were made with: all three have
    that of the scenario.
    """
    vehicle, folder = load_vehicle(VEHICLE), out / name
    paths = {p: folder / f"{p}.spinn" for p in ("plant", *PLANNERS)}
    if all(path.exists() for path in paths.values()):
        return paths
    diffusion = planner_of(scenario).diffusion
    if not (folder / "data" / "recording.yaml").exists():
        hidden.write(folder / "data")
    recording = read_csv(folder / "data")
    finding = diagnose(recording, vehicle)
    finding.diagnosis.save(folder / "diagnosis.json")
    tell(f"{name}: {finding.diagnosis.sentence} ({finding.diagnosis.seconds:.0f} s)")
    belief = vehicle.dynamics(np.array(diffusion))
    save_model(paths["belief"], belief)
    save_model(paths["extended"], dataclasses.replace(finding.extended, base=belief))
    save_model(paths["truth"], hidden.model(vehicle, diffusion))
    save_model(paths["plant"], hidden.model(vehicle, [0.0] * 6))
    return paths


def found_in(folder: Path) -> str:
    """The causes of a diagnosis with their values."""
    causes = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))["causes"]
    words = []
    for cause in causes:
        values = [f"{v['value']:.3g} {v['unit']}" for v in cause["parameters"].values()]
        words.append(f"`{cause['name']}` {cause['where']}: {', '.join(values)}")
    return "; ".join(words) or "nothing"


# ---------------------------------------------------------------------------------------- flying


@dataclass(frozen=True)
class Flight:
    """What came of a flight.

    Attributes:
        reason: why it ended; `goal` is success.
        time: when it ended (s).
        clearance: least distance of hull and pylons (m).
        off_plan: distance from the plan (m, RMS).
        depth: distance from the depth of start and goal (m, RMS).
        force: that was asked for (N, RMS).
        path: p_WB every 0.2 s (m).
    """

    reason: str
    time: float
    clearance: float
    off_plan: float
    depth: float
    force: float
    path: list[list[float]]

    @property
    def reached(self) -> bool:
        """Whether it came to the goal without touching a pylon."""
        return self.reason == "goal"


def planner_of(scenario: Scenario) -> MppiImpedance:
    """The planner of a scenario.

    Raises:
        UserError: it has none.
    """
    if not isinstance(scenario.controller, MppiImpedance):
        raise UserError(f"--scenario: {scenario.name} is not steered by MppiImpedance")
    return scenario.controller


def prepared(scenario: Scenario, plant: Path | None, planner: Path | None) -> Scenario:
    """The scenario with a model in the plant and one in the planner (None: the preset)."""
    changed = scenario.with_changes(model=planner)
    return dataclasses.replace(changed, station=dataclasses.replace(changed.station, model=plant))


def reduced(run: Run) -> Flight:
    """A run in numbers."""
    values = run_metrics(run)
    p = run.log["X_WB"][:, 4:]
    off_plan = values["tracking"]["position_rms_m"]
    return Flight(
        run.outcome.reason,
        run.outcome.time,
        values["path"]["min_clearance_m"],
        float("nan") if off_plan is None else off_plan,
        float(np.sqrt(np.mean((p[:, 2] - p[0, 2]) ** 2))),
        values["effort"]["force_rms_N"],
        np.round(p[::EVERY], 3).tolist(),
    )


def flown(
    scenario: Scenario, seeds: Sequence[int], folder: Path, name: str, tell: Callable[[str], None]
) -> list[Flight]:
    """The flights of some seeds, of which only those are flown whose file is not there."""
    at = {seed: folder / f"{name}-{seed}.json" for seed in seeds}
    missing = [seed for seed in seeds if not at[seed].exists()]
    for run in simulate_seeds(scenario, missing) if missing else ():
        flight = reduced(run)
        with atomic_path(at[run.scenario.seed]) as partial:
            partial.write_text(json.dumps(dataclasses.asdict(flight)) + "\n", encoding="utf-8")
        tell(f"{folder.parent.name}, {name}, seed {run.scenario.seed}: {run.outcome.sentence}")
    return [Flight(**json.loads(path.read_text(encoding="utf-8"))) for path in at.values()]


# --------------------------------------------------------------------------------------- judging

Flights = dict[str, dict[str, list[Flight]]]
"""By hidden cause and planner, seeds in order."""


def bootstrap(
    values: Float[np.ndarray, " n"], draws: int = 10_000, seed: int = 0
) -> tuple[float, float, float]:
    """Mean and its 95 % interval by drawing seeds again; NaN are left out."""
    kept = values[np.isfinite(values)]
    if not kept.size:
        return np.nan, np.nan, np.nan
    rng = np.random.default_rng(seed)
    means = kept[rng.integers(0, kept.size, (draws, kept.size))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(kept.mean()), float(low), float(high)


def numbers(flights: Sequence[Flight], figure: str) -> Float[np.ndarray, " n"]:
    """A number of each flight; the time of those that did not reach the goal is NaN."""
    values = np.array([getattr(f, figure) for f in flights], float)
    if figure == "time":
        values[[not f.reached for f in flights]] = np.nan
    return values


def _cell(values: Float[np.ndarray, " n"], digits: int = 2, sign: str = "") -> str:
    mean, low, high = bootstrap(values)
    if not np.isfinite(mean):
        return "–"
    return f"{mean:{sign}.{digits}f} ({low:{sign}.{digits}f} to {high:{sign}.{digits}f})"


HEAD = "time (s) | clearance (m) | off the plan (m) | off the depth (m) | force (N) |"
DIGITS = dict(zip(FIGURES, (1, 2, 3, 3, 1), strict=True))


def table(flights: Flights) -> str:
    """Every planner on every plant: share that reached the goal, and means with intervals."""
    lines = ["| in the plant | planned with | reached | " + HEAD, "|---" * 8 + "|"]
    for name, by_planner in flights.items():
        for planner, own in by_planner.items():
            cells = [_cell(numbers(own, f), DIGITS[f]) for f in FIGURES]
            reached = share(sum(f.reached for f in own), len(own))
            lines.append(f"| {name} | {planner} | {reached} | {' | '.join(cells)} |")
    return "\n".join(lines)


def differences(flights: Flights) -> str:
    """Planner less belief on the same seeds, and in how many seeds each alone reached the goal."""
    lines = ["| in the plant | planned with | only it, only the belief reached | " + HEAD,
             "|---" * 8 + "|"]  # fmt: skip
    for name, by_planner in flights.items():
        belief = by_planner["belief"]
        for planner, own in by_planner.items():
            if planner == "belief":
                continue
            pairs = list(zip(own, belief, strict=True))
            alone = [sum(a.reached > b.reached for a, b in pairs),
                     sum(a.reached < b.reached for a, b in pairs)]  # fmt: skip
            cells = [_cell(numbers(own, f) - numbers(belief, f), DIGITS[f], "+") for f in FIGURES]
            lines.append(f"| {name} | {planner} | {alone[0]}, {alone[1]} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(flights: Flights, scenario: Scenario, path: Path) -> None:
    """Paths from above and depths, planned with the belief and with the extended model."""
    import matplotlib.pyplot as plt

    from spinndrift.sims.reports.figures_path import draw_above

    shown = {name: f for name, f in flights.items() if "extended" in f}
    figure, axes = plt.subplots(
        2, len(shown), figsize=(3.1 * len(shown), 5.4), layout="constrained", sharey="row",
        squeeze=False, height_ratios=(1.5, 1),
    )  # fmt: skip
    colours = {"belief": "tab:red", "extended": "tab:blue"}
    for (name, by_planner), (above, below) in zip(shown.items(), axes.T, strict=True):
        draw_above(above, scene(scenario), names=False)
        for planner, colour in colours.items():
            for i, flight in enumerate(by_planner[planner]):
                p = np.array(flight.path)
                label = planner if i == 0 else None
                above.plot(p[:, 0], p[:, 1], color=colour, lw=0.8, alpha=0.7, label=label)
                t = 0.05 * EVERY * np.arange(len(p))
                below.plot(t, p[:, 2], color=colour, lw=0.8, alpha=0.7)
                if not flight.reached:
                    above.plot(*p[-1, :2], "x", color=colour, ms=6, zorder=7)
        above.set(title=name, xlabel="x (m)", aspect="equal")
        below.set(xlabel="time (s)")
    axes[0, 0].set(ylabel="y (m)")
    axes[1, 0].set(ylabel="z (m)")
    axes[0, 0].legend(fontsize="small", frameon=False, loc="lower left")
    figure.savefig(path, dpi=64)
    plt.close(figure)


def study(
    causes: dict[str, Hidden],
    scenario: Scenario,
    seeds: Sequence[int],
    out: Path,
    tell: Callable[[str], None],
) -> tuple[Flights, str]:
    """All flights, seed by seed, and what the diagnoses said (Markdown)."""
    made = {name: models(name, cause, scenario, out, tell) for name, cause in causes.items()}
    plans: list[tuple[str, str, Path | None, Path | None]] = [(NONE, "belief", None, None)]
    plans += [(n, p, paths["plant"], paths[p]) for p in PLANNERS for n, paths in made.items()]
    flights: Flights = {}
    for name, planner, plant, model in plans:
        folder, changed = out / name / scenario.name, prepared(scenario, plant, model)
        flights.setdefault(name, {})[planner] = flown(changed, seeds, folder, planner, tell)
    lines = ["| hidden | truth | diagnosed |", "|---|---|---|"]
    for name, cause in causes.items():
        values = ", ".join(f"{k} {v:.3g}" for k, v in cause.parameters.items())
        told = f"`{cause.name}` {cause.where}: {values}"
        lines.append(f"| {name} | {told} | {found_in(out / name)} |")
    return flights, "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Make data, diagnose, fly, print the tables, write the figure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/loop"), help="folder to write")
    parser.add_argument("--scenario", default="pylon_crossing_harbour", help="name or YAML file")
    parser.add_argument("--seeds", type=int, default=10, help="flights of each kind")
    parser.add_argument("--only", nargs="+", help="hidden causes; all by default")
    parser.add_argument("--text", default="", help="YAML laid over it, with a `name` of its own")
    given = parser.parse_args(arguments)
    causes = hidden_causes()
    for name in given.only or ():
        if name not in causes:
            raise UserError(f"--only: `{name}` is none of {', '.join(causes)}")
    causes = {n: c for n, c in causes.items() if not given.only or n in given.only}
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    keep_compiled()
    scenario = load_scenario(given.scenario, given.text)
    scenario = dataclasses.replace(scenario, log=dataclasses.replace(scenario.log, samples=False))

    def tell(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    seeds = range(1, given.seeds + 1)
    flights, diagnosed = study(causes, scenario, seeds, given.out, tell)
    print(diagnosed, table(flights), differences(flights), sep="\n\n")
    draw(flights, scenario, given.out / f"{scenario.name}.png")
    print(f"\nwrote {given.out / f'{scenario.name}.png'}")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
