"""Recordings: measured or simulated motion with its commands, in one checked form.

An `xarray.Dataset` with dims (scenario, trajectory, time, component); poses, twists and wrenches in
the conventions of `models/se3.py`, but batch first. `docs/recording.md` is the user's page.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import xarray as xr

from ..config.errors import UserError
from ..files.netcdf import load_netcdf, save_netcdf
from ..se3 import WRENCH
from ..vehicles.places import named_in
from .build import Trajectory, assemble, window
from .commands import forces_of, thrusters_of, voltage_of
from .origin import PERIOD, of_all
from .outputs import common_outputs, with_outputs
from .schema import (
    COMMANDS,
    FORMAT,
    LABELS,
    LEADING,
    SENSORS,
    STATES,
    UNEVEN,
    check,
    check_plausible,
    is_recording,
    observed,
    present,
)
from .splits import run_parts, time_parts


@dataclass(frozen=True)
class Recording:
    """A checked dataset of trajectories; every method that changes something returns a new one.

    Raises:
        ValueError: at construction, if the dataset does not follow `docs/recording.md`.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> recording = generate(GenerateConfig(trajectories=1, duration=4.0), vehicle)
        >>> learn, held_out = recording.split_by_time(0.25, gap=0.5)
        >>> learn.commands
        ('F_Bo_B', 'thruster_force')
    """

    dataset: xr.Dataset

    def __post_init__(self) -> None:
        check(self.dataset)

    @classmethod
    def from_trajectories(
        cls,
        trajectories: Sequence[Trajectory],
        dt: float,
        *,
        vehicle: str = "",
        source: str = "",
        notes: Sequence[str] = (),
    ) -> "Recording":
        """Stack trajectories of equal step `dt` (s); equal scenario names are repetitions."""
        return cls(assemble(trajectories, dt, vehicle=vehicle, source=source, notes=notes))

    # content

    @property
    def dt(self) -> float:
        """Time step (s)."""
        return float(self.dataset.attrs["dt"])

    @property
    def command_period(self) -> float:
        """Period (s) of the commands in the log; `dt` if unknown."""
        return float(self.dataset.attrs.get(PERIOD, self.dt))

    @property
    def commands_sampled(self) -> bool:
        """Whether commands are a log's samples of faster ones; else each was held over its step."""
        return PERIOD in self.dataset.attrs

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Names of the scenarios."""
        return tuple(str(name) for name in self.dataset["scenario"].to_numpy())

    @property
    def mask(self) -> np.ndarray:
        """Samples that exist, bool (scenario, trajectory, time)."""
        return self.dataset["mask"].to_numpy()

    @property
    def lengths(self) -> np.ndarray:
        """Samples of each trajectory, int (scenario, trajectory)."""
        return self.mask.sum(axis=2)

    @property
    def duration(self) -> float:
        """Time recorded in all trajectories together (s)."""
        return float(np.maximum(self.lengths - 1, 0).sum() * self.dt)

    @property
    def vehicle(self) -> str:
        """Name of the vehicle's preset, or path of its file, or empty."""
        return str(self.dataset.attrs.get("vehicle", ""))

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the source and what it lacked, one sentence each."""
        text = str(self.dataset.attrs.get("notes", ""))
        return tuple(line for line in text.split("\n") if line)

    @property
    def commands(self) -> tuple[str, ...]:
        """Which of F_Bo_B, thruster_force, pwm the recording has."""
        return present(self.dataset, COMMANDS)

    @property
    def thrust_from(self) -> str:
        """The most direct command of the thrusters' forces."""
        return next(c for c in ("thruster_force", "pwm", "F_Bo_B") if c in self.commands)

    @property
    def missing(self) -> dict[str, tuple[str, ...]]:
        """State channels that some trajectory lacks, by variable: {"X_WB": ("x", "y"), …}."""
        exists = (self.lengths > 0)[..., None]
        found: dict[str, tuple[str, ...]] = {}
        for name, (dim, _) in STATES.items():
            lacking = exists & ~observed(self.dataset[name].to_numpy(), self.mask)
            if lacking.any():
                found[name] = tuple(
                    label
                    for label, no in zip(LABELS[dim], np.any(lacking, axis=(0, 1)), strict=True)
                    if no
                )
        return found

    def trajectories(self) -> Iterator[Trajectory]:
        """Yield every trajectory without its padding, scenario by scenario."""
        lengths = self.lengths
        known = COMMANDS | SENSORS
        start = self.dataset.get("start_time")
        for j, scenario in enumerate(self.scenarios):
            for k in np.flatnonzero(lengths[j]):
                arrays = {
                    str(name): variable.to_numpy()[j, k, : lengths[j, k]]
                    for name, variable in self.dataset.data_vars.items()
                    if variable.dims[:3] == LEADING and name != "mask"
                }
                commands = {name: arrays[name] for name in self.commands}
                sensors = {
                    name: values
                    for name, values in arrays.items()
                    if name not in commands
                    and name not in STATES
                    and (name not in known or np.isfinite(values).any())
                }
                yield Trajectory(
                    scenario,
                    arrays["X_WB"],
                    arrays["V_WB_B"],
                    commands,
                    sensors,
                    0.0 if start is None else float(start.to_numpy()[j, k]),
                )

    @property
    def uneven(self) -> bool:
        """Whether samples have individual times (`elapsed`) instead of a grid."""
        return UNEVEN in self.dataset

    def elapsed(self, scenario: int, trajectory: int) -> np.ndarray:
        """Times of a trajectory's samples since its first one (s), (N,)."""
        length = int(self.lengths[scenario, trajectory])
        if self.uneven:
            times = self.dataset[UNEVEN].to_numpy()[scenario, trajectory, :length]
            if np.isfinite(times).all():
                return times - times[:1]
        return self.dt * np.arange(length)

    # inputs

    def wrench(self, vehicle: Any = None) -> xr.DataArray:
        """Return the commanded wrench F_Bo_B (N, N·m).

        The first of these that the recording has: `F_Bo_B` itself; thruster forces with the
        vehicle's allocation; PWM and voltage with its thruster curve (steady state: no lag) and the
        allocation. Samples without a voltage take the vehicle's nominal one.

        Args:
            vehicle: a `Vehicle`, the name of a preset, or None for the one named in the recording.

        Raises:
            UserError: if a vehicle is needed and none is known, or its thruster count differs.
        """
        if "F_Bo_B" in self.dataset:
            return self.dataset["F_Bo_B"]
        name = self.commands[0]
        thrusters = thrusters_of(self.dataset, vehicle, name)
        forces = forces_of(self.dataset, name, thrusters)
        F = np.moveaxis(np.asarray(thrusters.wrench(forces)), 0, -1)
        return xr.DataArray(
            np.where(self.mask[..., None], F, np.nan),
            dims=(*LEADING, "wrench_component"),
            coords={
                "scenario": self.dataset["scenario"],
                "time": self.dataset["time"],
                "wrench_component": list(WRENCH),
            },
            attrs={"units": COMMANDS["F_Bo_B"][1], "made from": name},
        )

    def thrust(self, vehicle: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the thrusters' commanded forces (N) and the voltage relative to the nominal one.

        Arrays (scenario, trajectory, time, n) and (scenario, trajectory, time), finite throughout.
        They are the recorded forces, else PWM with the vehicle's curve at the recorded voltage
        (steady state: no lag), else the wrench allocated to the thrusters with the least effort.

        Args:
            vehicle: a `Vehicle`, the name of a preset, or None for the one named in the recording.

        Raises:
            UserError: if no vehicle is known, or its thruster count differs.
        """
        name = self.thrust_from
        thrusters = thrusters_of(self.dataset, vehicle, self.commands[0])
        if name == "F_Bo_B":
            F = np.moveaxis(self.dataset[name].to_numpy(), -1, 0)
            level = jnp.tensordot(thrusters.inverse, jnp.asarray(F), 1)
        else:
            level = forces_of(self.dataset, name, thrusters)
        volts = voltage_of(self.dataset, thrusters) / float(thrusters.nominal_voltage)
        return np.nan_to_num(np.moveaxis(np.asarray(level), 0, -1)), volts

    # parts

    def select(self, scenarios: str | Sequence[str]) -> "Recording":
        """Return only the named scenarios.

        Raises:
            UserError: if a name is unknown; the message lists the known ones.
        """
        names = [scenarios] if isinstance(scenarios, str) else list(scenarios)
        unknown = [name for name in names if name not in self.scenarios]
        if unknown or not names:
            told = f"scenario {', '.join(unknown)}: is not here" if unknown else "scenario: no name"
            raise UserError(f"{told}; the recording has {', '.join(self.scenarios)}")
        rows = [self.scenarios.index(name) for name in names]
        kept = self.dataset.isel(scenario=rows)
        stop = kept["mask"].to_numpy().sum(axis=2)
        return type(self)(window(kept, np.zeros_like(stop), stop))

    def cut(self, start: float = 0.0, stop: float = np.inf) -> "Recording":
        """Return the samples with start ≤ t < stop (s) of every trajectory; time restarts at 0."""
        N = self.mask.shape[2]
        first, last = (
            int(np.clip(np.ceil(t / self.dt - 1e-6), 0, N)) for t in (start, min(stop, N * self.dt))
        )
        ones = np.ones_like(self.lengths)
        if last <= first or not (self.lengths > first).any():
            raise UserError(f"cut: no sample between {start:g} and {stop:g} s")
        return type(self)(window(self.dataset, first * ones, last * ones))

    def split_by_time(
        self, held_out: float = 0.25, gap: float = 1.0
    ) -> "tuple[Recording, Recording]":
        """Split every trajectory: the first part for training, the last part held out.

        The `gap` (s) between them is dropped so that the two parts are nearly independent.
        """
        known, rest = time_parts(self.lengths, self.dt, held_out, gap)
        learn = window(self.dataset, np.zeros_like(known), known)
        return type(self)(learn), type(self)(window(self.dataset, rest, self.lengths))

    def split_by_run(
        self, held_out: float | Sequence[str] = 0.25, seed: int | None = None
    ) -> "tuple[Recording, Recording]":
        """Split by whole runs: named scenarios held out, or a fraction of each scenario's runs.

        With a fraction every scenario keeps at least one run on each side. The last runs are held
        out, or a random choice if a seed is given.
        """
        if not isinstance(held_out, float | int):
            inside = [name for name in self.scenarios if name not in set(held_out)]
            return self.select(inside), self.select(list(held_out))
        learn, test = run_parts(self.lengths, self.scenarios, float(held_out), seed)
        zero = np.zeros_like(learn)
        parts = window(self.dataset, zero, learn), window(self.dataset, zero, test)
        return type(self)(parts[0]), type(self)(parts[1])

    def split(
        self,
        held_out: float = 0.25,
        by: Literal["auto", "time", "run"] = "auto",
        gap: float = 1.0,
    ) -> "tuple[Recording, Recording]":
        """Split by run where every scenario has several runs, else by time."""
        if by == "auto":
            by = "run" if (np.count_nonzero(self.lengths, axis=1) > 1).all() else "time"
        return self.split_by_run(held_out) if by == "run" else self.split_by_time(held_out, gap)

    @classmethod
    def concat(cls, recordings: "Sequence[Recording]") -> "Recording":
        """Join recordings of equal step; runs of equal scenario names become repetitions.

        Commands that some lack and outputs that differ are dropped; other variables are NaN there.

        Raises:
            UserError: for unequal steps, thruster counts or vehicles, or no command in common.
        """
        if not recordings:
            raise UserError("concat: no recording given")
        steps = {recording.dt for recording in recordings}
        if max(steps) - min(steps) > 1e-9 * max(steps):
            raise UserError(f"concat: unequal steps {sorted(steps)} s; import at one rate")
        vehicles = {recording.vehicle for recording in recordings} - {""}
        if len(vehicles) > 1:
            raise UserError(f"concat: different vehicles {sorted(vehicles)}; join them one by one")
        common = [c for c in COMMANDS if all(c in recording.commands for recording in recordings)]
        if not common:
            raise UserError(
                "concat: no command in common; turn each into F_Bo_B with its wrench(vehicle) first"
            )
        parts = [
            Trajectory(
                t.scenario, t.X_WB, t.V_WB_B, {c: t.commands[c] for c in common}, t.sensors, t.start
            )
            for recording in recordings
            for t in recording.trajectories()
        ]
        notes = dict.fromkeys(note for recording in recordings for note in recording.notes)
        sources = dict.fromkeys(str(r.dataset.attrs.get("source", "")) for r in recordings)
        joined = cls.from_trajectories(
            parts,
            recordings[0].dt,
            vehicle=vehicles.pop() if vehicles else "",
            source="; ".join(source for source in sources if source),
            notes=list(notes),
        )
        datasets = [r.dataset for r in recordings]
        dataset = with_outputs(joined.dataset, common_outputs(datasets))
        return cls(dataset.assign_attrs(of_all(datasets)))

    # files

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write NetCDF-4 (compressed), atomically."""
        encoding = {
            name: {"zlib": True, "complevel": 4, "shuffle": True}
            for name, variable in self.dataset.data_vars.items()
            if variable.ndim >= 3
        }
        save_netcdf(self.dataset, path, encoding)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Recording":
        """Read what `save` wrote, into memory.

        Raises:
            UserError: if the file is missing, not NetCDF, or not a recording.
        """
        path = Path(path)
        dataset = load_netcdf(path)
        if not is_recording(dataset):
            raise UserError(f"{path}: a NetCDF file, but no recording (see docs/recording.md)")
        if dataset.attrs["format"] != FORMAT:
            raise UserError(
                f"{path}: written as '{dataset.attrs['format']}', this version reads '{FORMAT}'"
            )
        try:
            recording = cls(dataset)
            check_plausible(dataset)
        except ValueError as error:
            raise UserError(f"{path}: {error}") from error
        if recording.vehicle:
            dataset.attrs["vehicle"] = named_in(recording.vehicle, path.parent)
        return recording

    @staticmethod
    def is_one(path: Path) -> bool:
        """Whether a file carries the format mark of `save`, valid or not."""
        try:
            return is_recording(load_netcdf(path))
        except UserError:
            return False
