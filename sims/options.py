"""Checks of a command's numeric options, before anything is computed."""

import dataclasses
import itertools
import math
import re
from collections.abc import Sequence
from typing import Any, get_type_hints

from ..models.config.checks import range_of
from ..models.config.errors import UserError

_KINDS = {"FLOAT": "a number", "INT": "a whole number"}


def check_options(command: Any) -> None:
    """Check that the numbers of a command's options are finite and in the option's range.

    Raises:
        UserError: naming option, value and remedy.
    """
    hints = get_type_hints(type(command), include_extras=True)
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if dataclasses.is_dataclass(value):
            check_options(value)
            continue
        option = f"--{field.name.replace('_', '-')}"
        limit = range_of(hints[field.name])
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if limit is None:
                if not math.isfinite(number):
                    raise UserError(f"{option} {number:g}: give a finite number")
            elif not limit.holds(number):
                told = f"{number:.10g}" if isinstance(number, float) else str(number)
                shown = told if len(told) < 30 else f"{told[:20]}…"
                raise UserError(f"{option} {shown}: give a number {limit}")


def misread(given: Sequence[str], told: str) -> str:
    """One sentence from the option parser's error message `told` for the arguments `given`."""
    lines = _inside(told)
    lines = [re.sub(r" \(applied to [^)]*\)", "", line) for line in lines]  # `see` has it
    text = " ".join(lines).replace("{None}|", "")
    command = given[0] if given and not given[0].startswith("-") else "COMMAND"
    see = f"see spinndrift {command} --help"
    unknown = re.search(r"Unrecognized options?: *(\S+)", text)
    bare = next((i for i, word in enumerate(given) if word.startswith("--live=")), None)
    if unknown is not None and bare is not None and unknown[1] in given[bare + 1 : bare + 2]:
        return f"--live {unknown[1]}: give PORT or HOST:PORT; {see}"
    wrong = re.search(r"Error parsing (?:argument )?(--[\w-]+)", text)
    if wrong is not None:
        option = wrong[1]
        form = re.search(rf"helptext: *(?:-\w, )?{option} ([^a-z]*)", text)
        kinds = re.findall(r"FLOAT|INT", form[1]) if form else []
        many = {"FLOAT": f"{len(kinds)} numbers"} if len(kinds) > 1 else _KINDS
        wanted = f"give {many.get(kinds[0], kinds[0])}" if kinds else "give another value"
        at = [i for i, word in enumerate(given) if word == option][-1:]
        value = "".join(f" {given[i + 1]}" for i in at if i + 1 < len(given))
        return f"{option}{value}: {wanted}; {see}"
    groups = [" ".join(group) for filled, group in itertools.groupby(lines, bool) if filled]
    said = next((group for group in groups if re.search(r"[:.'{]", group)), text)  # not a title
    meant = re.search(r"Perhaps you meant: *(--[\w-]+)", text)
    hint = f"did you mean {meant[1]}? " if meant and meant[1] not in given else ""
    return f"{said.rstrip('.')}; {hint}{see}"


def _inside(told: str) -> list[str]:
    """Lines of a message without the box around it, whose sides may be missing; rules are empty."""
    plain = [re.sub(r"^\s*[│|+╭╰]?\s*|\s*[│|+╮╯]?\s*$", "", line) for line in told.splitlines()]
    return ["" if re.search(r"[─-]{4}$", line) else line for line in plain]
