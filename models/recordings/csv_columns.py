"""Columns of a CSV file of a recording: which they are, and the checks of their values."""

import difflib
import re
from collections.abc import Sequence

import numpy as np

from ..config.errors import UserError
from ..se3 import POSE, TWIST, WRENCH, XYZ
from .csv_table import Table
from .schema import LIMITS, MAY_LACK, QUANTITIES, variable_units

METADATA = "recording.yaml"
QUATERNION = POSE[:4]
STATE: tuple[str, ...] = ("t", *XYZ, *QUATERNION, *TWIST)
STEMS = {"thruster_force": "f", "pwm": "pwm"}
"""Columns of the commands of thrusters are numbered from 1: f1, f2, …"""
_LACKABLE = MAY_LACK["X_WB"] + MAY_LACK["V_WB_B"]
_NORM = 0.02
_RANGES = {"pwm": (500.0, 2500.0, "µs (1500 is stopped)"), "voltage": (1.0, 100.0, "V")}
_LATEST = 1e10
"""Latest time (s): beyond any count of seconds since 1970."""


def checked_groups(table: Table, ignore: Sequence[str]) -> dict[str, list[str]]:
    """Columns by variable, commands and voltage, of a table whose values have been checked.

    Raises:
        UserError: naming line and column.
    """
    groups = _groups(table, ignore)
    _check_time(table)
    _check_finite(table, [*STATE, *(c for columns in groups.values() for c in columns)])
    _check_limits(table, groups)
    return groups


def _groups(table: Table, ignore: Sequence[str]) -> dict[str, list[str]]:
    """Columns by variable: commands and voltage."""
    names = [name for name in table.names if name not in ignore]
    missing = [name for name in STATE if name not in names]
    if missing:
        raise UserError(
            f"{table.path}: column `{missing[0]}` is missing; needed are {','.join(STATE)} "
            "and a command"
        )
    groups: dict[str, list[str]] = {}
    rest = [name for name in names if name not in STATE]
    if any(name in rest for name in WRENCH):
        groups["F_Bo_B"] = list(WRENCH)
    for variable, stem in STEMS.items():
        count = sum(1 for name in rest if re.fullmatch(rf"{stem}[0-9]+", name))
        if count:
            groups[variable] = [f"{stem}{i}" for i in range(1, count + 1)]
    if not groups:
        raise UserError(
            f"{table.path}: no command; add X,Y,Z,K,M,N or f1..fn or pwm1..pwmn after the state"
        )
    if "voltage" in rest:
        groups["voltage"] = ["voltage"]
    wanted = [column for columns in groups.values() for column in columns]
    for column in wanted:
        if column not in rest:
            raise UserError(f"{table.path}: column `{column}` is missing beside {wanted[0]}")
    for name in rest:
        if name not in wanted:
            close = difflib.get_close_matches(name, [*STATE, *wanted, "voltage"], 1)
            hint = f"did you mean `{close[0]}`?" if close else "remove it"
            raise UserError(
                f"{table.path}: column `{name or '(without a name)'}` is not known; {hint} "
                f"(or list it under `ignore` in {METADATA})"
            )
    return groups


def _check_time(table: Table) -> None:
    t = table[["t"]][0]
    if not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        raise UserError(f"{table.at(row)}: column `t` is no finite number; give seconds")
    _check_range(table, "t", -_LATEST, _LATEST, "s")
    if t.size < 2:
        raise UserError(f"{table.path}: a single sample is no trajectory; give at least two")
    for row in (np.flatnonzero(np.diff(t) <= 0)[:1] + 1).tolist():
        kind = "repeats" if t[row] == t[row - 1] else "goes back from"
        raise UserError(
            f"{table.at(row)}: time {t[row]:g} s {kind} {t[row - 1]:g} s; "
            "sort the lines by time and remove doubles"
        )


def _check_finite(table: Table, columns: Sequence[str]) -> None:
    for column in columns:
        values = table[[column]][0]
        bad = ~np.isfinite(values)
        if bad.all() and column in _LACKABLE:
            continue
        if bad.any():
            whole = f"; only {','.join(_LACKABLE)} may lack, and then in the whole file"
            raise UserError(
                f"{table.at(int(np.argmax(bad)))}: column `{column}` has no finite number{whole}"
            )


def _check_limits(table: Table, groups: dict[str, list[str]]) -> None:
    """Refuse values beyond what any vehicle does, with the units of the files."""
    columns = {"X_WB": ["", "", "", "", *XYZ], "V_WB_B": list(TWIST)} | groups
    for variable, names in columns.items():
        quantities = QUANTITIES[variable]
        for i, name in enumerate(names):
            limits = LIMITS[quantities[i if len(quantities) > 1 else 0]]
            usual = (*limits, variable_units(variable))
            if name:
                _check_range(table, name, *_RANGES.get(variable, usual))


def _check_range(table: Table, column: str, low: float, high: float, unit: str) -> None:
    values = table[[column]][0]
    bad = (values < low) | (values > high)
    if bad.any():
        row = int(np.argmax(bad))
        raise UserError(
            f"{table.at(row)}: column `{column}` is {values[row]:g}; "
            f"give {low:g} to {high:g} {unit}"
        )


def unit_quaternions(table: Table) -> np.ndarray:
    """Attitudes w x y z of unit length; refused if they are not near it."""
    q = table[QUATERNION]
    with np.errstate(over="ignore"):  # an infinite norm is refused like any other wrong one
        norm = np.linalg.norm(q, axis=0)
    bad = np.abs(norm - 1) > _NORM
    if bad.any():
        row = int(np.argmax(bad))
        raise UserError(
            f"{table.at(row)}: qw,qx,qy,qz have length {norm[row]:.4g}; give a unit quaternion "
            "(not angles), w first"
        )
    return q / norm
