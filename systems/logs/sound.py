"""Readings of a log that can't be right: sensors that stand still, and a gravity that is none."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from ...models.recordings.checks.finding import Finding
from ...models.recordings.resample import rotations, slerp
from ...models.vehicles.vehicle import load_vehicle
from ..mavlink import codec
from .plane import plane_findings
from .signals import Series, Signals

_GRAVITY, _UPRIGHT = (8.0, 12.0), 0.5
"""m/s² of the median specific force of a vehicle in water; its vertical share in any attitude."""
_FEWEST, _LEFT = 50, 0.3
"""Readings that are compared; what a right sign of roll or pitch leaves of the horizontal force."""
_TILTS = 0.5
"""m/s² rms of horizontal specific force below which roll and pitch are not judged."""
_HELD_S, _HELD = 2.0, 10
"""A value that stands for this long, and for so many readings, is no reading,"""
_TURNS = 0.01
"""rad/s: if the rates vary by so much meanwhile. A simulated vehicle on deck has no noise."""


_REPEATS, _SLOWEST_S, _LONGER = 3, 3.0, 4
"""Readings of one value in a stream that repeats most of them, and for how long (s) at most; times
the usual length of a real hold."""
_VOLTS = 4.0
"""Factor between a battery's voltage and the vehicle's nominal one."""


def sound(signals: Signals) -> Signals:
    """The signals without readings that can't be right, with a finding for each kind."""
    findings: list[Finding] = []
    notes: list[str] = []
    force = _moving(signals.specific_force, signals.rates, findings)
    depth = _moving(signals.pressure_depth, signals.rates, findings)
    if force is not None:
        wrong = _gravity_finding(signals.attitude, force)
        findings += [wrong] if wrong is not None else _tilt_findings(signals.attitude, force)
        force = force if wrong is None else None
    if not findings:  # of an accelerometer that is right
        findings += plane_findings(signals.attitude, signals.velocity, force)
    voltage = _battery(signals, findings)
    position, attitude, velocity = (
        _refreshed(one, rows, notes)
        for one, rows in (
            (signals.position, slice(0, 2)),
            (signals.attitude, slice(0, 4)),
            (signals.velocity, slice(0, 2)),
        )
    )
    return replace(
        signals,
        attitude=attitude or signals.attitude,
        position=position,
        velocity=velocity,
        voltage=voltage,
        notes=(*signals.notes, *notes),
        specific_force=force,
        pressure_depth=depth,
        findings=(*signals.findings, *findings),
    )


def stands_still(one: Series, rates: Series) -> Bool[np.ndarray, " n"]:
    """Readings that repeat the one before, in holds that no working sensor makes."""
    x = one.x.reshape(-1, one.t.size)
    edges = np.flatnonzero((np.diff(x, axis=1) != 0).any(axis=0)) + 1
    edges = np.concatenate([[0], edges, [one.t.size]])
    held = np.zeros(one.t.size, bool)
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if stop - start < _HELD or one.t[stop - 1] - one.t[start] < _HELD_S:
            continue
        inside = slice(*np.searchsorted(rates.t, one.t[[start, stop - 1]]))
        meanwhile = rates.x[:, inside]
        if meanwhile.size and np.ptp(meanwhile, axis=1).max() > _TURNS:
            held[start + 1 : stop] = True
    return held


def _refreshed(one: Series | None, rows: slice, notes: list[str]) -> Series | None:
    """The readings of a stream that repeats each of them: only the first is one.

    A value that is held for much longer than the usual ones stays: it is a sensor without a lock.
    """
    if one is None:
        return None
    new = (np.diff(one.x[rows], axis=1) != 0).any(axis=0)
    starts = np.concatenate([[0], np.flatnonzero(new) + 1])
    lengths = np.diff([*starts.tolist(), one.t.size])
    usual = float(np.median(np.repeat(lengths, lengths)))
    if starts.size < _HELD or usual < _REPEATS or usual / one.rate > _SLOWEST_S:
        return one
    kept = np.repeat(lengths > _LONGER * usual, lengths)
    kept[starts] = True
    found = replace(one, t=one.t[kept], x=one.x[..., kept])
    notes.append(
        f"{one.source}: its values change at {found.rate:.1f} Hz, though it is sent at "
        f"{one.rate:.0f} Hz; repeated ones were left out."
    )
    return found


def _battery(signals: Signals, findings: list[Finding]) -> Series | None:
    """The voltage, if the vehicle's thrusters can run at it."""
    one = signals.voltage
    if one is None:
        return None
    nominal = float(load_vehicle(signals.vehicle).propulsion.voltage)
    median = float(np.median(one.x))
    if 1 / _VOLTS < median / nominal < _VOLTS:
        return one
    findings.append(
        Finding(
            "sensor-left-out",
            one.source,
            f"its {median:.3g} V are no voltage of a vehicle with {nominal:g} V; they are left out",
            "correct BATT_VOLT_MULT, or name the vehicle (--vehicle)",
        )
    )
    return None


def _moving(one: Series | None, rates: Series, findings: list[Finding]) -> Series | None:
    """A sensor without the time in which it stands still; None if it always does."""
    if one is None or not (held := stands_still(one, rates)).any():
        return one
    lost = float(np.diff(one.t)[held[1:]].sum())
    findings.append(
        Finding(
            "sensor-left-out",
            one.source,
            f"its readings stand still at one value for {lost:.1f} s of "
            f"{one.t[-1] - one.t[0]:.1f} s: they are left out there",
            "check the sensor and its connection",
        )
    )
    if np.count_nonzero(~held) < _HELD:
        return None
    return replace(one, t=one.t[~held], x=one.x[..., ~held])


def _in_time(attitude: Series, force: Series) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes and specific forces at the times of the force."""
    inside = (force.t >= attitude.t[0]) & (force.t <= attitude.t[-1])
    return slerp(force.t[inside], attitude.t, attitude.x), force.x[:, inside]


def _gravity_finding(attitude: Series, force: Series) -> Finding | None:
    """An accelerometer in another unit or other axes: a vehicle in water falls nowhere."""
    q, f = _in_time(attitude, force)
    if f.shape[1] < _FEWEST or not np.isfinite(f).all():
        return None
    size = float(np.median(np.linalg.norm(f, axis=0)))
    felt = np.median(rotations(q).apply(f.T), axis=0)
    if not _GRAVITY[0] < size < _GRAVITY[1]:
        text = f"its specific force is {size:.3g} m/s², not gravity's 9.8: another unit, or a fault"
    elif felt[2] < _UPRIGHT * size:
        text = (
            "the specific force does not point up in the world, as gravity demands, but along "
            f"({', '.join(f'{x:.1f}' for x in felt)}) m/s²: its axes or the attitude's are others"
        )
    else:
        return None
    return Finding(
        "sensor-left-out",
        force.source,
        f"{text}; the accelerometer is left out",
        "check its unit, its mounting and AHRS_ORIENTATION",
    )


def _tilt_findings(attitude: Series, force: Series) -> list[Finding]:
    """Roll or pitch with the other sign: the horizontal specific force is then mostly gravity."""
    q, f = _in_time(attitude, force)
    if f.shape[1] < _FEWEST or not np.isfinite(f).all():
        return []
    roll, pitch, yaw = codec.euler_from_attitude(q)
    left = {}
    for what, a, b in (("", 1, 1), ("roll", -1, 1), ("pitch", 1, -1), ("roll and pitch", -1, -1)):
        turned = codec.attitude_from_euler(a * roll, b * pitch, yaw)
        left[what] = float(np.mean(np.sum(rotations(turned).apply(f.T)[:, :2] ** 2, axis=1)))
    best = min(left, key=lambda what: left[what])
    if not best or left[""] < _TILTS**2 or left[best] > _LEFT * left[""]:
        return []
    return [
        Finding(
            "motion-contradiction",
            f"{attitude.source}, {force.source}",
            f"{best} of the attitude has the other sign than the accelerometer's",
            "check AHRS_ORIENTATION, or the source of the attitude",
        )
    ]
