"""Cases: a seed draws what is hidden; the files and the answer are given apart.

case = draw(7)                                 # one cause
case = draw(7, "null")                         # none
case = draw(7, "single", names=("thruster_lag",), size=0.3)
case = draw(7, "pair"); draw(7, "triple"); draw(7, "unknown")
case.write(tmp_path / "data")                  # what the code under test sees
case.answer()                                  # {"verdict": …, "causes": [{name, where, …}]}
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .effect import Effect
from .effects import CAUSES, FAMILY, UNKNOWN, draw_effect
from .scenarios import Plan, Scenarios, build, pulses
from .simulator import Noise, Truth, simulate, streams
from .vehicle import Vehicle
from .write import Run, runs, write_folder

KINDS = ("null", "single", "pair", "triple", "unknown")

TWINS: dict[str, tuple[str, ...]] = {
    # What data of this kind can't tell apart for physical reasons, whatever the method.
    "thrust_scale": ("voltage_sag", "payload"),
    "voltage_sag": ("thrust_scale",),
    "centre_of_gravity": ("payload",),
    "payload": ("centre_of_gravity", "net_buoyancy"),
    "net_buoyancy": ("payload",),
    "clock_offset": ("actuation_delay",),
    "actuation_delay": ("clock_offset", "thruster_lag"),
    "current_varying": ("current_steady", "disturbance_colour"),
}
"""Names that may be confused with good reason; a test decides whether to accept them."""


@dataclass(frozen=True)
class Case:
    """A drawn case.

    Attributes:
        seed: of the case; noise and commands follow from it.
        effects: what is hidden.
        plan: what is recorded.
        noise: of process and instruments; nominal unless changed.
        wrong: whether the belief is off by factors in nearly everything.
    """

    seed: int
    effects: tuple[Effect, ...] = ()
    plan: Plan = field(default_factory=Plan)
    noise: Noise = field(default_factory=Noise)
    wrong: bool = False

    def answer(self) -> dict[str, Any]:
        """What is hidden, in the words of a diagnosis; causes in the order drawn."""
        causes = [
            {"name": e.cause, "where": e.where, "parameters": e.parameters()} for e in self.effects
        ]
        for cause, effect in zip(causes, self.effects, strict=True):
            if effect.cause == "unknown":
                cause["kind"] = getattr(effect, "kind", "")
                cause["variables"] = list(getattr(effect, "variables", ()))
            else:
                cause["family"] = FAMILY[effect.cause]
                cause["twins"] = list(TWINS.get(effect.cause, ()))
        unknown = [e.cause == "unknown" for e in self.effects]
        verdict = "explained" if self.effects or self.wrong else "adequate"
        if any(unknown):
            verdict = "unexplained" if all(unknown) else "partly_explained"
        return {"verdict": verdict, "causes": causes}

    def vehicle(self) -> Vehicle:
        """The vehicle that is believed."""
        return Vehicle()

    def true_vehicle(self) -> Vehicle:
        """The one that is simulated."""
        return self.vehicle().off(streams(self.seed, 7)) if self.wrong else self.vehicle()

    def ratios(self) -> dict[str, dict[str, float]]:
        """True over believed coefficients, each over inertia, by name and axis."""
        true, believed = self.true_vehicle().over_inertia(), self.vehicle().over_inertia()
        return {
            name: {axis: value / believed[name][axis] for axis, value in of.items()}
            for name, of in true.items()
        }

    def scenarios(self, seed: int | None = None) -> Scenarios:
        """Commands, start states and time stamps; another `seed` gives fresh ones."""
        return build(self.plan, self.seed if seed is None else seed)

    def simulate(self, seed: int | None = None) -> Truth:
        """The runs under the hidden effects; another `seed` gives held-out ones."""
        seed = self.seed if seed is None else seed
        return simulate(
            build(self.plan, seed).setup,
            self.effects,
            self.noise,
            [seed, 1],
            self.true_vehicle(),
            dead_reckoned=self.plan.dead_reckoned,
        )

    def logged(self, seed: int | None = None, truth: Truth | None = None) -> list[Run]:
        """The runs in the columns of the files."""
        made = self.scenarios(seed)
        truth = truth or self.simulate(seed)
        commands = truth.forces
        if self.plan.form == "pwm":
            commands = made.pwm
            if commands is None:
                commands = pulses(truth.forces, made.believed_volts)
        elif self.plan.form == "wrench":
            commands = np.einsum("ij,njb->nib", self.vehicle().allocation(), truth.forces)
        volts = truth.voltage if self.plan.voltage else None
        return runs(truth, made.names, self.plan.form, commands, volts)

    def write(self, folder: Path, seed: int | None = None) -> list[Run]:
        """Write the folder that the code under test reads; return what is in it."""
        logged = self.logged(seed)
        write_folder(Path(folder), logged, rate=self.plan.rate)
        return logged


def draw(
    seed: int,
    kind: str = "single",
    *,
    names: Sequence[str] | None = None,
    size: float = 1.0,
    plan: Plan | None = None,
    noise: Noise | None = None,
    wrong: bool = False,
) -> Case:
    """Draw a case from a seed; `names` fixes the causes (or kinds of unknown) but not the rest."""
    rng = streams(seed, 6)
    plan = plan or Plan()
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind}")
    if names is None:
        count = {"null": 0, "single": 1, "pair": 2, "triple": 3, "unknown": 1}[kind]
        pool = sorted(UNKNOWN if kind == "unknown" else CAUSES)
        while True:
            names = [str(n) for n in rng.choice(pool, count, replace=False)]
            if not any(other in TWINS.get(name, ()) for name in names for other in names):
                break
    effects = tuple(draw_effect(name, rng, size) for name in names)
    if plan.form == "pwm" and "voltage_sag" in names:
        plan = replace(plan, voltage=False)  # who logs the voltage knows of the sag
    return Case(seed, effects, plan, noise or Noise(), wrong)


def table(
    sizes: Sequence[float] = (0.3, 1.0, 3.0), seeds: int = 2, nulls: int = 20, mixed: int = 10
) -> Iterator[tuple[str, float, Case]]:
    """The blind table: (kind or cause, size, case) of singles at each size, nulls and mixtures."""
    for size in sizes:
        for k, name in enumerate(CAUSES):
            for i in range(seeds):
                yield name, size, draw(1000 * (i + 1) + k, names=(name,), size=size)
    for i in range(nulls):
        loop = "closed" if i % 4 == 3 else "open"
        yield "null", 0.0, draw(50_000 + i, "null", plan=Plan(loop=loop))
    for kind in ("pair", "triple"):
        for i in range(mixed):
            yield kind, 1.0, draw(60_000 + i, kind)
    for k, name in enumerate(UNKNOWN):
        for i in range(seeds):
            yield name, 1.0, draw(70_000 + 10 * i + k, "unknown", names=(name,))
