"""Blind cases as folders: data to diagnose, data to judge by, and the sealed answer.

docs/blind-cases.md describes the form. `told` says what is hidden in the definitions of that form,
which are those of the published effects; where they differ from the simulator's by more than a
change of variables, nothing is said of a parameter, or a tolerance is given.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import effects_actuation as actuation
from . import effects_body as body
from . import effects_disturbance as disturbance
from . import effects_environment as environment
from . import effects_measurement as measurement
from .draw import TWINS, Case, draw
from .effect import Effect
from .effects import CAUSES, UNKNOWN
from .episode import APART, PARTS, Episode, When, draw_episode
from .faults import spoil
from .oracle import predict
from .scenarios import Plan
from .simulator import Noise, streams
from .telemetry import Streams, write_tlog
from .vehicle import AXES, Vehicle
from .write import STATE, change, write_folder

FRESH = 7_000_000
"""Added to a case's seed for the runs that the diagnosis never sees."""
WINDOW = 1.0  # s, of forecasts
SCALES = {
    "tiny": (Plan(scenarios=5, runs=1, seconds=6.0), 1),
    "small": (Plan(scenarios=10, runs=3, seconds=10.0), 10),
    "full": (Plan(scenarios=10, runs=20, seconds=10.0), 20),
}
"""Amount of data, and number of nulls."""
DATA: dict[str, Callable[[Plan], Plan]] = {
    "usual": lambda plan: plan,
    "closed": lambda plan: replace(plan, loop="closed"),
    "uneven": lambda plan: replace(plan, even=False),
    "minute": Plan.short,
    "slow": lambda plan: replace(plan, rate=10.0),
    "fast": lambda plan: replace(plan, rate=50.0),
    "long": lambda plan: replace(plan, scenarios=10, runs=1, seconds=60.0, loop="closed"),
    "pwm": lambda plan: replace(plan, form="pwm"),
    "stretches": lambda plan: replace(
        plan, scenarios=4, runs=1, seconds=60.0, rate=50.0, dead_reckoned=True
    ),
    "flights": lambda plan: replace(
        plan, scenarios=3, runs=1, seconds=90.0, loop="closed", dead_reckoned=True
    ),
    "dive": lambda plan: replace(
        plan, scenarios=4, runs=1, seconds=45.0, rate=200.0, form="pwm", dead_reckoned=True
    ),
    "piloted": lambda plan: replace(DATA["dive"](plan), loop="closed"),
    **dict.fromkeys(("calm", "exact", "coarse"), lambda plan: plan),
}
"""How it is recorded: commands played, a pilot in closed loop, uneven time steps, 60 s in all, at
10 or 50 Hz, a pilot's runs of a minute each, commands as PWM with each run's voltage; the real
form: four stretches of 60 s at 50 Hz, or a pilot's three of 90 s, through an estimator, and a
telemetry log of four stretches of 45 s, played or piloted; `NOISE`."""
ESTIMATED = Noise(
    velocity=0.012, attitude=0.0035, position=0.0, velocity_memory=0.8, attitude_memory=3.0
)
"""Errors of an estimator: 1.2 cm/s with a memory of 0.8 s, 0.2° with one of 3 s."""
NOISE = {
    "calm": Noise(diffusion=tuple(0.05 * b for b in Noise().diffusion)),
    "exact": Noise(velocity=0.0, rate=0.0, attitude=0.0, position=0.0),
    "coarse": Noise(velocity=0.02, rate=0.004, attitude=0.007, position=0.02),
    "stretches": ESTIMATED,
    "flights": ESTIMATED,
    "dive": replace(ESTIMATED, rate_filter=20.0),
    "piloted": replace(ESTIMATED, rate_filter=20.0),
}
"""Hardly a disturbance, nothing but it, instruments four times as noisy, and an estimator."""
TLOG = ("dive", "piloted")
"""Written as telemetry: filtered angular rates, streams at rates drawn from the seed."""
REAL = ("stretches", "flights", *TLOG)
"""Data in the form of real logs; their users know no diffusion."""
BESIDE_WRONG = ("thruster_gain", "thruster_lag", "tether", "current_steady", "dvl_misalignment")
"""Hidden causes where the belief is off by factors as well, which no coefficient can stand for."""


@dataclass(frozen=True)
class Blind:
    """A case with its name and the table that it belongs to."""

    name: str
    kind: str
    case: Case
    size: float = 1.0
    fault: str = ""
    data: str = "usual"
    when: When | None = None

    def write(self, folder: Path) -> None:
        """Write data/, truth.yaml last, and, where means differ, fresh/ and oracle/."""
        case = self.case
        folder.mkdir(parents=True, exist_ok=True)
        shown = case.simulate()
        runs, limits, problems = case.logged(truth=shown), [], []
        if self.fault:
            runs, _ = spoil(runs, self.fault, case.seed)
            problems = [SAID[self.fault]]
        if self.kind == "part":
            runs = [change(r, t=r.columns["t"] + APART * k) for k, r in enumerate(runs)]
        if case.plan.idle:
            limits = [AXES[i] for i in case.plan.idle]
        if self.data in TLOG:
            sent = Streams.draw(case.seed)
            write_tlog(folder / "data" / "dive.tlog", shown, sent, case.noise.rate_filter)
        else:
            write_folder(folder / "data", runs, rate=case.plan.rate)
        always = not case.plan.dead_reckoned and self.when is None  # as in the windows of an oracle
        if always and case.plan.even and any(has_mean(e) for e in case.effects):
            fewer = replace(case, plan=replace(case.plan, runs=min(case.plan.runs, 2)))
            truth = fewer.simulate(case.seed + FRESH)
            write_folder(
                folder / "fresh", fewer.logged(case.seed + FRESH, truth), rate=case.plan.rate
            )
            write_oracle(folder / "oracle", fewer, truth)
        answer = case.answer()
        told_ = {
            "kind": self.kind,
            "verdict": answer["verdict"],
            "label": self.label(),
            "size": self.size,
            "data": self.data,
            "causes": [told(e) | self.acting() for e in case.effects],
            "diffusion": [] if self.data in REAL else list(case.noise.diffusion),
            "every": every(case),
            "ratios": case.ratios() if case.wrong else {},
            "problems": problems,
            "limits": limits,
        }
        lines = [f"{key}: {json.dumps(value)}" for key, value in told_.items()]
        (folder / "truth.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def label(self) -> str:
        """Of its group in the tables."""
        if self.kind == "part":
            return self.name.removeprefix("part-").rsplit("-", 1)[0]
        return self.fault or " + ".join(label(e) for e in self.case.effects) or self.kind

    def acting(self) -> dict[str, Any]:
        """When the hidden cause acts, if not always."""
        if self.when is None:
            return {}
        names, k = self.case.scenarios().names, self.when.run - 1
        alone = names.count(names[k]) == 1
        run = names[k] if alone else f"{names[k]}, run {names[: k + 1].count(names[k])}"
        return {"when": asdict(self.when) | {"run": run}}


SAID = {
    "stuck": "stuck",
    "lost_lock": "stuck",
    "gap": "missing",
    "clock_jump": "clock",
    "pose_jump": "jumps",
    "outliers": "outliers",
}
"""What the diagnosis must say of a fault."""


def has_mean(effect: Effect) -> bool:
    """Whether an effect changes what is expected, and not only its scatter."""
    scatter = (environment.CurrentVarying, environment.Waves)
    return not isinstance(effect, scatter) and not effect.cause.startswith("disturbance")


def every(case: Case) -> int:
    """Samples of a window."""
    return round(WINDOW * case.plan.rate)


def label(effect: Effect) -> str:
    return getattr(effect, "kind", "") or effect.cause


def write_oracle(folder: Path, case: Case, truth: Any) -> None:
    """A file a run: what the true model expects to be recorded, from each window's first record."""
    folder.mkdir(parents=True)
    steps, window = truth.t.shape[0] - 1, every(case)
    starts = range(0, steps - window + 1, window)
    seen = predict(case, truth, list(starts), window)
    for b in range(truth.t.shape[1]):
        X, V = [truth.X[:1, :, b]], [truth.V[:1, :, b]]
        for k in range(len(starts)):
            X.append(seen.X[k, 1:, :, b])
            V.append(seen.V[k, 1:, :, b])
        X, V = np.concatenate(X), np.concatenate(V)
        t = truth.t[: len(X), b]
        table = np.concatenate([t[:, None], X[:, 4:], X[:, :4], V], axis=1)
        np.savetxt(
            folder / f"run_{b + 1:03d}.csv", table, "%.10g", ",", header=",".join(["t", *STATE]),
            comments="",
        )  # fmt: skip


def told(effect: Effect) -> dict[str, Any]:
    """Name, place, parameters in the published definitions, and what they may be confused with."""
    effect = effect.inner if isinstance(effect, Episode) else effect
    found = {"name": effect.cause, "twins": list(TWINS.get(effect.cause, ()))}
    if effect.cause == "unknown":
        return found | {"variables": list(getattr(effect, "variables", ()))}
    own = {name: number["value"] for name, number in effect.parameters().items()}
    place, values, tolerance = effect.where, own, 0.0
    match effect:
        case actuation.ThrustCurve():
            change = effect.exponent - 1
            values = {"exponent": change, "gain": (10 / actuation.FULL_THRUST) ** change - 1}
        case actuation.ThrustAsymmetry():
            values = {"reverse_gain": effect.reverse - 1}
        case actuation.ThrusterGain():
            values = {"gain": effect.gain - 1}
        case actuation.ThrustScale():
            values = {"scale": effect.scale - 1}
        case actuation.LoadDroop():
            values = {"loss": own["loss_at_40_N"]}
            tolerance = 0.1  # published to first order in the loss
        case actuation.InflowThrustLoss():
            values = {"loss": effect.coefficient}
        case body.NetBuoyancy() | body.Payload():
            at_Cb = isinstance(effect, body.NetBuoyancy) and effect.height != 0
            place = "centre_of_buoyancy" if at_Cb else "all"
            if isinstance(effect, body.Payload):
                values = {
                    "mass": effect.mass + own["added_mass"],
                    "weight": own["weight_in_water"],
                    "moment_x": own["weight_times_x"],
                    "moment_y": own["weight_times_y"],
                }
        case body.CentreOfGravity():
            values = {"shift": effect.offset}
        case body.DragAsymmetry():
            d = Vehicle().quadratic[effect.axis]
            values = {"difference": float(effect.coefficient * d)}
        case body.DragCoupling():
            values = {"quadratic": own["coefficient"]}
            tolerance = 0.1  # the moment follows from the speed at the lever's end
        case body.Lift():
            place = "heave_from_surge"
        case body.AddedMassCoupling():
            values = {"change": effect.mass}
        case body.MunkMoment():
            values = {"change": effect.scale - 1}
        case body.Proximity():
            values = {}
            place = "" if effect.boundary == "wall" else effect.boundary
        case environment.Tether():
            k, a = effect.stiffness, effect.anchor
            values = {"stiffness": k, "pull_east": k * a[0], "pull_north": k * a[1]}
        case environment.Waves():
            values = {name: own[name] for name in ("amplitude", "frequency", "direction")}
        case disturbance.DisturbanceLevel():
            place, values = "", {"change": effect.factor - 1}
        case disturbance.DisturbanceColour() | disturbance.DisturbanceImpacts():
            place = ""
            values.pop("impulse", None)
        case disturbance.DisturbanceStateDependence():
            place, values = "", {}
        case measurement.DvlLeverArm():
            values = {"offset": own[place]}
        case measurement.DvlScale():
            place, values = "all", {"scale": effect.error}
        case measurement.GyroBias():
            place = "xyz"[effect.axis]
        case measurement.ClockOffset():
            values = {"delay": effect.seconds}
        case measurement.HeadingError():
            place = "all"
            values["offset"] = values.pop("constant")
        case _:
            pass
    return found | {
        "where": place,
        "parameters": {k: float(v) for k, v in values.items()},
        "tolerance": tolerance,
    }


def table(
    plan: Plan,
    nulls: int,
    seeds: int = 1,
    sizes: Sequence[float] = (1.0,),
    mixed: int = 4,
    data: Sequence[str] = ("usual",),
) -> Iterator[Blind]:
    """Singles of every cause at each size, in parts of the data, effects without a name, nulls,
    mixtures, faulty data.

    Other `data` than the usual are there for singles of realistic size and some nulls alone.
    """
    for variety in (d for d in data if d != "usual"):
        given = {"plan": DATA[variety](plan), "noise": NOISE.get(variety)}
        for k, name in enumerate(CAUSES):
            if variety in REAL and name == "disturbance_level":
                continue  # nobody states a level that could be wrong
            for i in range(seeds):
                case = draw(1000 * (i + 1) + k, names=(name,), **given)
                yield Blind(f"{name}-{variety}-{i}", "single", case, data=variety)
        for i in range(nulls // 5):
            case = draw(51_000 + i, "null", **given)
            yield Blind(f"null-{variety}-{i}", "null", case, data=variety)
        if variety not in REAL:
            continue
        for i in range(0 if variety in TLOG else seeds):  # a log is cut at large steps
            effect, when = draw_episode("steel", given["plan"], streams(54_000 + i, 6))
            case = Case(54_000 + i, (effect,), **given)
            yield Blind(f"part-steel-{variety}-{i}", "part", case, data=variety, when=when)
        for i in range(nulls // 5):
            case = draw(52_000 + i, "null", wrong=True, **given)
            yield Blind(f"wrong-{variety}-{i}", "wrong", case, data=variety)
        for i, name in enumerate(BESIDE_WRONG):
            case = draw(53_000 + i, names=(name,), wrong=True, **given)
            yield Blind(f"wrong-{name}-{variety}", "wrong", case, data=variety)
    if "usual" not in data:
        return
    for size in sizes:
        for k, name in enumerate(CAUSES):
            for i in range(seeds):
                case = draw(1000 * (i + 1) + k, names=(name,), size=size, plan=plan)
                yield Blind(f"{name}-{size:g}-{i}", "single", case, size)
    for k, name in enumerate(PARTS):
        for i in range(seeds):
            seed = 90_000 + 10 * i + k
            effect, when = draw_episode(name, plan, streams(seed, 6))
            yield Blind(f"part-{name}-{i}", "part", Case(seed, (effect,), plan), when=when)
    for i in range(nulls // 10):
        yield Blind(f"part-nothing-{i}", "part", draw(91_000 + i, "null", plan=plan))
    for k, name in enumerate(UNKNOWN):
        for i in range(seeds):
            case = draw(70_000 + 10 * i + k, "unknown", names=(name,), plan=plan)
            yield Blind(f"{name}-{i}", "unknown", case)
    for i in range(nulls):
        loop = "closed" if i % 4 == 3 else "open"
        case = draw(50_000 + i, "null", plan=replace(plan, loop=loop))
        yield Blind(f"null-{loop}-{i}", "null", case)
    for kind, first in (("pair", 60_000), ("triple", 61_000)):
        for i in range(mixed):
            yield Blind(f"{kind}-{i}", kind, draw(first + i, kind, plan=plan))
    for k, fault in enumerate(SAID):
        yield Blind(f"fault-{fault}", "fault", draw(80_000 + k, "null", plan=plan), fault=fault)
    idle = replace(plan, idle=(1,))
    yield Blind("fault-idle-sway", "fault", draw(80_100, "null", plan=idle), fault="")
