"""All cases of a folder, one after the other; what is done stays done."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...models.errors import UserError
from ...models.files import atomic_path
from ..progress import Update
from .cases import Case
from .judging import judge

_DONE = "judged.json"


def run_cases(
    cases: Sequence[Case], out: str | os.PathLike[str], alpha: float, progress: Update
) -> list[dict[str, Any]]:
    """Diagnose and judge the cases that are not judged yet; return all judgements.

    Each case has a folder in `out` with `diagnosis.json` and `judged.json`; the second is written
    last, so an interrupted case is done again.

    Raises:
        UserError: a case can't be read, or was judged with another alpha.
    """
    found = []
    for number, case in enumerate(cases):
        folder = Path(out) / case.name
        at = folder / _DONE
        if not at.exists():

            def tell(fraction: float, remark: str = "", n: int = number, case: Case = case) -> None:
                progress((n + fraction) / len(cases), f"{case.name}: {remark}")

            judged, finding = judge(case, alpha, tell)
            finding.diagnosis.save(folder / "diagnosis.json")
            with atomic_path(at) as path:
                text = json.dumps({"alpha": alpha, **judged.plain()}, indent=2, ensure_ascii=False)
                path.write_text(text + "\n", encoding="utf-8")
        row = read_judgement(at)
        if row["alpha"] != alpha:
            raise UserError(
                f"{at}: was judged with alpha {row['alpha']:g}, not {alpha:g}; name another --out"
            )
        found.append(row)
        progress((number + 1) / len(cases), case.name)
    return found


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
