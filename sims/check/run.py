"""All cases of a folder, one after the other; what is done stays done."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from ...models.errors import UserError
from ...models.files import atomic_path
from ..progress import Update
from .cases import Case
from .judging import judge
from .rivals import compete, pysindy

_DONE, _RIVALS = "judged.json", "rivals.json"
_KEPT = 25
"""Cases after which compiled programs are given back: a process can map only so many of them."""


def run_cases(
    cases: Sequence[Case],
    out: str | os.PathLike[str],
    alpha: float,
    progress: Update,
    rivals: bool = False,
) -> list[dict[str, Any]]:
    """Diagnose and judge the cases that are not judged yet; return all judgements.

    Each case has a folder in `out` with `diagnosis.json` and `judged.json`; the second is written
    last, so an interrupted case is done again. With `rivals` other methods are judged on the same
    files (`rivals.json`, and `rivals` in a judgement); what is there already is kept.

    Raises:
        UserError: a case can't be read, or was judged with another alpha; pysindy is not there.
    """
    found, fresh = [], 0
    if rivals:
        pysindy()  # now, not after the first case
    for number, case in enumerate(cases):
        folder = Path(out) / case.name
        at = folder / _DONE
        if not at.exists():

            def tell(fraction: float, remark: str = "", n: int = number, case: Case = case) -> None:
                progress((n + fraction) / len(cases), f"{case.name}: {remark}")

            fresh += 1
            if fresh % _KEPT == 0:
                jax.clear_caches()
            judged, finding = judge(case, alpha, tell)
            finding.diagnosis.save(folder / "diagnosis.json")
            _write(at, {"alpha": alpha, **judged.plain()})
        row = read_judgement(at)
        if row["alpha"] != alpha:
            raise UserError(
                f"{at}: was judged with alpha {row['alpha']:g}, not {alpha:g}; name another --out"
            )
        beside = folder / _RIVALS
        if rivals and not beside.exists():
            _write(beside, {name: rival.plain() for name, rival in compete(case).items()})
        row["rivals"] = json.loads(beside.read_text(encoding="utf-8")) if beside.exists() else {}
        found.append(row)
        progress((number + 1) / len(cases), case.name)
    return found


def _write(at: Path, value: dict[str, Any]) -> None:
    with atomic_path(at) as path:
        text = json.dumps(value, indent=2, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")


def read_judgement(path: Path) -> dict[str, Any]:
    """A judgement as written.

    Raises:
        UserError: the file is no such thing.
    """
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
        return {"alpha": float(row["alpha"]), **row}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: is no judgement; remove its folder to judge it again") from error
