"""A vehicle's log to a recording: telemetry (.tlog), DataFlash (.BIN), ROS bags."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from ...models.config.errors import UserError
from ...models.recordings.checks.finding import enforce, with_findings
from ...models.recordings.csv import METADATA, read_csv
from ...models.recordings.origin import ESTIMATED, LOW_PASS, PERIOD
from ...models.recordings.outputs import with_outputs
from ...models.recordings.schema import check_plausible
from ...models.recordings.store import Recording
from ...models.vehicles.places import absolute
from ...models.vehicles.vehicle import load_vehicle
from ..mavlink.codec import filter_delay
from .align import aligned, reference
from .bags.bag import bag_kind
from .bags.signals import read_bag
from .between import gyro_tells
from .consistency import motion_findings
from .dataflash import read_bin
from .frame import settled
from .fuse import FAST_HZ, fuse
from .log_bytes import Progress, no_progress, read_log_bytes
from .report import ImportReport, tell
from .signals import Series, Signals
from .signals_dataflash import WANTED as BIN_WANTED
from .signals_dataflash import signals_from_bin
from .signals_tlog import ANYONE, signals_from_tlog
from .signals_tlog import WANTED as TLOG_WANTED
from .sound import sound
from .tlog import read_tlog

RATE = 20.0
"""Rate (Hz) of an imported log, if none is given and attitude and body rates are not slower."""
_FASTEST, _SLOW = 50.0, 10.0
"""Largest and least rate (Hz) of an imported log, if none is given."""
_ENOUGH, _NEAR, _LOST = 0.95, 0.01, 1.5
"""Share of a rate that a stream reaches if it drops a few samples, and by which a rate is near
another; multiple of a usual step from which on samples were lost."""


@dataclass(frozen=True)
class LogOptions:
    """Options of the import of a vehicle's log.

    Attributes:
        minimum: shortest stretch kept (s).
        gap: longest pause between samples of one signal within a stretch (s).
        water_density: kg/m³, to correct depth and the slow part of the climb of an autopilot that
            assumed fresh water, if its height is from the barometer (`depth.in_water`); None leaves
            them uncorrected.
        disarmed: keep disarmed stretches too.
        system: MAVLink system id, if several autopilots are in the log.
        topics: topic map of a ROS bag; None takes the one beside the bag, or else a proposed one.
        align: a recording of the same dive, or the folder of its run, whose samples and world frame
            the result is to have (`align`).
    """

    minimum: float = 5.0
    gap: float = 0.5
    water_density: float | None = None
    disarmed: bool = False
    system: int | None = None
    topics: Path | None = None
    align: Path | None = None


def import_log(  # long: a third of it says what it takes and refuses
    path: str | os.PathLike[str],
    *,
    rate: float | None = None,
    fine: bool = False,
    vehicle: str | None = None,
    options: LogOptions | None = None,
    accept: Sequence[str] = (),
    progress: Progress = no_progress,
) -> tuple[Recording, ImportReport]:
    """Import a log: one scenario for each stretch of constant mode, armed, without gaps or resets.

    Args:
        path: the log; its kind is determined from its content.
        rate: of the recording (Hz); None takes about 20 (`usual_rate`).
        fine: without a rate, take that of the streams (`own_rate`).
        vehicle: preset or file whose thruster directions the PWM is to have; None takes the preset
            with the thrusters of the log's frame (`wiring`). It is named in the result.
        options: what is taken from the log.
        accept: words of severe findings that are accepted (docs/checks.md).
        progress: called with the fraction done, 0 to 1.

    Raises:
        UserError: if there is no such log, it can't be read, nothing usable is in it, its frame
            has another number of thrusters than the vehicle, or a severe finding is not accepted.
    """
    path = Path(path)
    options = options or LogOptions()
    _check_options(RATE if rate is None else rate, options)
    if vehicle is not None:
        load_vehicle(vehicle)
        vehicle = absolute(vehicle)
    other = None if options.align is None else reference(options.align)
    damage, signals = _signals(path, vehicle, options, progress)
    signals = sound(signals)
    enforce(str(path), signals.findings, accept)
    try:
        if other is not None:
            rate = 1.0 / other.dt
            trajectories, lines, dropped, note = aligned(
                signals, other, options.minimum, options.gap, options.disarmed
            )
            signals = replace(signals, notes=(*signals.notes, note))
        else:
            if rate is None:
                rate = own_rate(signals) if fine else usual_rate(signals)
            trajectories, lines, dropped = fuse(
                signals,
                rate=rate,
                minimum=options.minimum,
                gap=options.gap,
                disarmed=options.disarmed,
            )
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    if not trajectories:
        raise UserError(
            f"{path}: no stretch of {options.minimum:g} s with attitude and thruster outputs is "
            f"left ({' '.join(dropped) or 'nothing overlaps'}); allow shorter ones "
            "(--minimum) or longer gaps (--gap)"
        )
    progress(0.95)
    report = tell(signals, path.name, trajectories, lines, [*damage, *dropped], 1.0 / rate)
    try:
        recording = Recording.from_trajectories(
            trajectories,
            1.0 / rate,
            vehicle=signals.vehicle,
            source=path.name,
            notes=report.notes(),
        )
        check_plausible(recording.dataset)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    period = 1.0 / (signals.outputs.measured or signals.outputs.rate)
    # the reader of a bag compares the axes of topics with the motion, and is believed if accepted
    told = any(f.word == "wrong-frame" for f in signals.findings)
    moved = [] if told else motion_findings(signals, trajectories, recording)
    enforce(str(path), moved, accept)
    progress(1.0)
    recording = Recording(with_outputs(recording.dataset, signals.channels))
    recording, settled_ = settled(recording, signals.turned, signals.turned_since)
    dataset = with_findings(recording.dataset, [*signals.findings, *moved, *settled_])
    attrs = {PERIOD: period} | ({ESTIMATED: 1} if signals.estimated else {})
    attrs |= {LOW_PASS: signals.low_pass} if filter_delay(signals.low_pass) else {}
    return Recording(dataset.assign_attrs(attrs)), report


def usual_rate(signals: Signals) -> float:
    """About 20 Hz, or the rate of attitude or body rates if that is slower, from 10 Hz on.

    Body rates below 40 Hz keep their own rate or a part of it: what is read between their samples
    is smoothed.
    """
    rotation = _rotation_rate(signals)
    if rotation < _ENOUGH * RATE:
        return max(_SLOW, rotation)
    return RATE if rotation >= _ENOUGH * 2 * RATE else _part(signals.rates, rotation)


def own_rate(signals: Signals) -> float:
    """The rate of the body rates or a part of it, so that they are not interpolated: 50 Hz at most.

    It is the largest part that every stream of the state reaches, or else the least one from 20 Hz
    on; below it is that of `usual_rate`. Without a horizontal velocity the accelerometer counts as
    such a stream: nothing else tells of surge and sway, and it has no reading at a sample between
    two of its own. From 10 to 20 Hz its own rate is taken; one below 10 Hz is too slow to tell.
    """
    rotation = _rotation_rate(signals)
    if rotation < _ENOUGH * RATE:
        return max(_SLOW, rotation)
    reached = [rotation, _FASTEST]
    v, force = signals.velocity, signals.specific_force
    if v is not None:
        reached.append(v.rate)
    if force is not None and (v is None or not np.isfinite(v.x[:2]).any()):
        if force.rate >= _ENOUGH * RATE:
            reached.append(force.rate)
        elif force.rate >= _ENOUGH * _SLOW:
            return max(_SLOW, _nominal(force))
    return _part(signals.rates, min(reached))


def _part(rates: Series, most: float) -> float:
    """The largest part of a stream's rate up to `most` Hz, or else the least one from 20 Hz on.

    A stream that is averaged about each instant counts as one of `FAST_HZ`.
    """
    rate = min(_nominal(rates), FAST_HZ)
    parts = rate / np.arange(1, max(int(rate / (_ENOUGH * RATE)), 1) + 1)
    reached = parts[parts <= most / _ENOUGH]
    return float(reached[0] if reached.size else parts[-1])


def _rotation_rate(signals: Signals) -> float:
    """Rate (Hz) up to which a rotation is known: that of the slower of attitude and body rates.

    It is that of the body rates where these tell of the attitude between its samples.
    """
    own = _nominal(signals.rates)
    told = gyro_tells(signals.attitude, signals.rates)
    return own if told else min(own, _nominal(signals.attitude))


def _nominal(series: Series) -> float:
    """Rate (Hz) of a stream that loses no samples, in halves of 1 Hz if it is near one."""
    steps = np.diff(series.t)
    usual = 1.0 / float(np.mean(steps[steps < _LOST * np.median(steps)]))
    near = round(2 * usual) / 2
    return near if abs(near - usual) < _NEAR * usual else usual


def load_data(  # long: half of it says what it takes and refuses
    path: str | os.PathLike[str],
    *,
    rate: float | None = None,
    vehicle: str | None = None,
    options: LogOptions | None = None,
    resample: bool = True,
    accept: Sequence[str] = (),
    progress: Progress = no_progress,
) -> Recording:
    """Read data of any kind: a recording (.nc), a CSV folder, a vehicle's log or a ROS bag.

    Args:
        path: file, folder with a `recording.yaml`, or folder of a ROS 2 bag.
        rate: Hz; None keeps that of the data; that of logs is said in `import_log`.
        vehicle: preset or file; None keeps the one that the data name, or that of a log's frame.
        options: what is taken from a log.
        resample: False keeps the unevenly spaced samples of CSV files, and the rate of a log.
        accept: words of severe findings in a log that are accepted (docs/checks.md).
        progress: called with the fraction done, 0 to 1.

    Raises:
        UserError: if the data can't be read, a stored recording has another rate, or options for
            logs are given for something else.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> generate(GenerateConfig(trajectories=1, duration=4.0), vehicle).save("dive.nc")
        >>> load_data("dive.nc").vehicle
        'bluerov2_heavy'
    """
    path = Path(path)
    options = options or LogOptions()
    if path.suffix.lower() == ".csv" and path.is_file():
        raise UserError(f"{path}: give its folder, with a {METADATA} in it (see docs/recording.md)")
    bag = path.is_dir() and bag_kind(path) is not None and not (path / METADATA).exists()
    if (path.is_dir() and not bag) or path.suffix.lower() in (".yaml", ".yml"):
        recording = read_csv(path, rate=rate, resample=resample)
    elif path.suffix.lower() in (".nc", ".nc4", ".h5"):
        recording = Recording.load(path)
        if rate is not None and abs(recording.dt * rate - 1) > 1e-6:
            raise UserError(
                f"{path}: recorded at {1 / recording.dt:g} Hz, not {rate:g}; import the source anew"
            )
    else:
        logged, _ = import_log(
            path,
            rate=rate,
            fine=not resample,
            vehicle=vehicle,
            options=options,
            accept=accept,
            progress=progress,
        )
        return logged
    for given in fields(options):
        if getattr(options, given.name) != given.default:
            option = f"--{given.name.replace('_', '-')}"
            raise UserError(f"{path}: {option} is for logs of a vehicle; leave it out here")
    progress(1.0)
    if not vehicle:
        return recording
    return Recording(recording.dataset.assign_attrs(vehicle=absolute(vehicle)))


def _signals(
    path: Path, vehicle: str | None, options: LogOptions, progress: Progress
) -> tuple[tuple[str, ...], Signals]:
    """Sentences on damage of the file, and its signals."""
    density = options.water_density
    if bag_kind(path) is not None:
        return (), read_bag(path, options.topics, vehicle, density, progress)
    raw = read_log_bytes(path, progress)
    if options.topics is not None:
        raise UserError(f"{path}: --topics is for ROS bags; leave it out here")
    try:
        if raw.kind == "bin":
            read = read_bin(raw.data, BIN_WANTED, progress)
            return raw.notes, signals_from_bin(read, vehicle, density)
        log = read_tlog(raw.data, TLOG_WANTED, options.system, progress, ANYONE)
        return raw.notes, signals_from_tlog(log, vehicle, density)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _check_options(rate: float, options: LogOptions) -> None:
    density = options.water_density
    for name, value, low, high in (
        ("rate", rate, 1.0, 400.0),
        ("minimum", options.minimum, 0.5, 3600.0),
        ("gap", options.gap, 0.01, 60.0),
        ("water_density", 1000.0 if density is None else density, 900.0, 1100.0),
    ):
        if not low <= value <= high:
            raise UserError(f"{name}: must lie between {low:g} and {high:g}, got {value:g}")
