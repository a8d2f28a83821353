"""Cases with a known answer: one folder each, with data, the truth and the true model's forecasts.

docs/blind-cases.md describes the format; cases are drawn and simulated by code that is independent
of this package.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from ...models.config import typed_yaml
from ...models.config.errors import UserError
from ...models.effects.library import kind
from ...models.effects.unknown import Unknown
from ...models.recordings.checks.examine import examine
from ...models.recordings.csv import read_csv
from ...models.recordings.csv_columns import METADATA
from ...models.recordings.store import Recording
from ...models.se3 import POSE, TWIST
from ...models.vehicles.vehicle import load_vehicle
from ...systems.logs.load import load_data
from ...training.diagnosis.findings.result import Verdict

USUAL = "usual"
"""Data recorded like those of most cases."""
Kind = Literal["null", "single", "part", "pair", "triple", "unknown", "fault", "wrong"]


@dataclass(frozen=True)
class Part:
    """When a hidden cause acts.

    Attributes:
        kind: as `When.kind` of a diagnosis.
        run: where it begins, as `When.first_run`.
        start, end: times in that run (s); the end is that of a window.
    """

    kind: Literal["window", "onwards", "drift"]
    run: str = ""
    start: float = 0.0
    end: float = 0.0


@dataclass(frozen=True)
class HiddenCause:
    """One hidden cause.

    Attributes:
        name: of the cause, or `unknown`.
        where: in the words of a diagnosis; empty if it is not judged.
        parameters: in the definitions and units of the effect of that name; only these are judged.
        tolerance: relative difference of a parameter due to different definitions, not an error.
        twins: names that are not distinguishable from it on such data for physical reasons.
        variables: of an unknown: inputs that it depends on.
        when: it acts, if not always.
    """

    name: str
    where: str = ""
    parameters: dict[str, float] = field(default_factory=dict)
    tolerance: float = 0.0
    twins: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()
    when: Part | None = None

    def __post_init__(self) -> None:
        if self.name != Unknown.name:
            known = {p.name for p in kind(self.name).parameters}
            if wrong := set(self.parameters) - known:
                raise ValueError(
                    f"parameters: {self.name} has {', '.join(sorted(known))}, not "
                    f"{', '.join(sorted(wrong))}"
                )


@dataclass(frozen=True)
class Truth:
    """`truth.yaml`: the truth of a case.

    Attributes:
        kind: the table that the case belongs to.
        label: the group in which it is counted; by default the hidden names.
        size: relative to a realistic size.
        data: how they were recorded, if not as usual; such cases are counted separately.
        verdict: the right verdict.
        causes: the hidden causes.
        vehicle: the belief; empty for the one that the data name.
        diffusion: of the belief (N√s, N·m√s); empty for none.
        every: samples per window of the forecasts in `oracle/`.
        ratios: true over believed coefficients, each over inertia, by name and axis.
        problems: words that must all be in the reported faults of the data.
        limits: words that must all be in the reported limits of identifiability.
    """

    kind: Kind
    verdict: Verdict
    label: str = ""
    size: float = 1.0
    data: str = USUAL
    causes: tuple[HiddenCause, ...] = ()
    vehicle: str = ""
    diffusion: tuple[float, ...] = ()
    every: int = 20
    ratios: dict[str, dict[str, float]] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.diffusion) not in (0, 6):
            raise ValueError(f"diffusion: give six numbers or none, not {len(self.diffusion)}")
        if self.every < 1:
            raise ValueError(f"every: is {self.every}; give at least 1")

    @property
    def called(self) -> str:
        """The group in which the case is counted."""
        return self.label or " + ".join(cause.name for cause in self.causes) or self.kind


@dataclass(frozen=True)
class Case:
    """A folder with a case."""

    folder: Path
    truth: Truth

    @property
    def name(self) -> str:
        """The name of the folder."""
        return self.folder.name

    def __str__(self) -> str:
        return self.name

    def read(self) -> Recording:
        """The data to diagnose, as `spinndrift diagnose` reads them.

        Raises:
            UserError: there are none, several logs, or they can't be read.
        """
        folder = self.folder / "data"
        if (folder / METADATA).exists():
            return read_csv(folder, resample=False)
        logs = sorted(path for path in folder.glob("*") if path.is_file())
        if len(logs) != 1:
            raise UserError(
                f"{folder}: holds {len(logs)} files and no {METADATA}; give a folder of CSV runs "
                "or one log"
            )
        recording = load_data(logs[0], resample=False)
        return examine(recording, load_vehicle(recording.vehicle), str(logs[0]))

    @property
    def has_oracle(self) -> bool:
        """Whether there are held-out data with the true model's forecasts."""
        return (self.folder / "oracle").is_dir() and (self.folder / "fresh").is_dir()


def find_cases(folder: str | os.PathLike[str], only: Sequence[str] = ()) -> list[Case]:
    """The cases in a folder, in the order of names; `only` are patterns of names or labels.

    Raises:
        UserError: there is none, or a truth can't be read.
    """
    paths = sorted(Path(folder).absolute().glob("*/truth.yaml"))
    if not paths:
        raise UserError(
            f"--cases {folder}: holds no case (a folder with truth.yaml); docs/blind-cases.md says "
            "how to write some"
        )
    cases = [Case(path.parent, typed_yaml.load(Truth, path)) for path in paths]
    if not only:
        return cases
    kept = [
        c for c in cases if any(fnmatchcase(n, o) for o in only for n in (c.name, c.truth.called))
    ]
    if not kept:
        raise UserError(f"--only {' '.join(only)}: fits none of the {len(cases)} cases there")
    return kept


def read_oracle(folder: Path) -> list[tuple[Float[np.ndarray, "7 N"], Float[np.ndarray, "6 N"]]]:
    """Poses and twists that the true model forecasts, run by run in the order of names.

    Raises:
        UserError: a column is missing.
    """
    names = [*POSE, *TWIST]
    found = []
    for path in sorted(folder.glob("*.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        if lacking := [n for n in names if n not in (table.dtype.names or ())]:
            raise UserError(f"{path}: lacks the column {lacking[0]}")
        values = np.stack([table[n] for n in names])
        found.append((values[:7], values[7:]))
    if not found:
        raise UserError(f"{folder}: holds no CSV file")
    return found
