"""False alarms and names of `diagnose --against` on an independent simulator (`tests/hidden`).

    python benchmarks/against.py --pairs 40                        # healthy against healthy
    python benchmarks/against.py --pairs 40 --model 0.8            # by a model that is wrong
    python benchmarks/against.py --causes thruster_gain net_buoyancy --form stretches

A pair is a set of healthy runs and a new one, each of a seed of its own. With --causes, new runs
hide one of them. What is printed: verdict, scores, thresholds, changes, and counts at the end.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))

from hidden.blind import DATA, NOISE
from hidden.draw import TWINS, Case, draw
from hidden.scenarios import Plan

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.against.pipeline import ChangeDiagnoser, Healthy
from spinndrift.training.diagnosis.config import DiagnoseConfig
from spinndrift.training.diagnosis.selection.state import Selection

FORMS = {
    "six": Plan(scenarios=6, runs=1, seconds=6.0),
    "ten": Plan(scenarios=10, runs=3, seconds=10.0),
    "stretches": DATA["stretches"](Plan()),
    "flights": DATA["flights"](Plan()),
}
FIRST = 5000  # seed of the new runs of the first pair


def recorded(seed: int, form: str, cause: str | None) -> tuple[Case, Recording]:
    """Runs of a seed, with a cause or without."""
    kind, names = ("null", None) if cause is None else ("single", (cause,))
    case = draw(seed, kind, names=names, plan=FORMS[form], noise=NOISE.get(form))
    with tempfile.TemporaryDirectory() as folder:
        case.write(Path(folder) / "data")
        return case, read_csv(Path(folder) / "data", resample=False)


def main() -> None:
    """Judge all pairs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--form", choices=sorted(FORMS), default="six")
    parser.add_argument("--pairs", type=int, default=1, help="of each cause, or of healthy runs")
    parser.add_argument("--causes", nargs="+", default=[None])
    parser.add_argument("--model", type=float, default=1.0, help="factor on the model's drag")
    parser.add_argument("--alpha", type=float, default=0.01)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    vehicle = load_vehicle("bluerov2_heavy")
    damping = tuple(given.model * d for d in vehicle.quadratic_damping)
    model = replace(vehicle, quadratic_damping=damping).dynamics()
    alarms = right = only = of = 0
    for cause in given.causes:
        for pair in range(given.pairs):
            started = time.monotonic()
            _, healthy = recorded(pair, given.form, None)
            case, new = recorded(FIRST + pair, given.form, cause)
            diagnoser = ChangeDiagnoser(
                new, vehicle, Healthy(healthy, model, "healthy"), DiagnoseConfig(given.alpha)
            )
            problem = diagnoser.problem
            first = problem.evaluate(problem.believed)
            found = diagnoser.changed(Selection.start(problem, first))
            limits, scores = diagnoser.limits, diagnoser.scores
            names = [choice.hypothesis for choice in found.accepted]
            values = [found.current.theta[problem.library.at(*h)] for h in names]
            of += 1
            alarms += limits.exceeded(scores)
            if cause is not None:
                allowed = {cause, *TWINS.get(cause, ())}
                right += bool(names) and names[0][0] in allowed
                only += bool(names) and {name for name, _ in names} <= allowed
            hidden = [
                (
                    c["name"],
                    c["where"],
                    {k: round(v["value"], 4) for k, v in c["parameters"].items()},
                )
                for c in case.answer()["causes"]
            ]
            told = [(*h, np.round(v, 4).tolist()) for h, v in zip(names, values, strict=True)]
            print(  # noqa: T201
                f"pair {pair}: {hidden or 'healthy'}: {told or 'none'}, scores {scores.causes:.1f} "
                f"and {scores.noise:.1f}, limits {limits.causes.threshold:.1f} and "
                f"{limits.noise.threshold:.1f}, {limits.causes.units} "
                f"{diagnoser.baseline.level} units, {time.monotonic() - started:.0f} s",
                flush=True,
            )
    told = f"{alarms} alarms, {right} first names right, {only} with no other name"
    print(f"{of} pairs: {told}")  # noqa: T201


if __name__ == "__main__":
    main()
