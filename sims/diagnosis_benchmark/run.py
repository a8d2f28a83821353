"""All cases of a folder, sequentially or distributed over processes; finished ones are kept."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.owned import FolderKind, check_folder, claim
from ..compile_cache import give_back_programs, keep_compiled
from ..fanout import Failed, check_workers, run_here, run_on_cluster
from ..progress import Update
from .cases import Case
from .judging import judge
from .rivals import compete, pysindy

_DONE, _RIVALS = "judged.json", "rivals.json"
CHECK = FolderKind("check", ("diagnosis.md",), edited=("diagnosis.md",))
"""Files that a check writes in addition to the folders of its cases."""
_CASE = FolderKind("judged case", ("diagnosis.json", _DONE, _RIVALS))


@dataclass(frozen=True)
class JudgeCase:
    """The remaining work on a case; results are written to disk.

    A case has a folder in `out` with `diagnosis.json` and `judged.json`; the second is written
    last, so an interrupted case is repeated. With `rivals` other methods are judged on the same
    files (`rivals.json`); existing results are kept.
    """

    out: str
    alpha: float
    rivals: bool

    def left(self, case: Case) -> tuple[bool, bool]:
        """Whether the diagnosis and whether the rivals are still to be judged."""
        folder = Path(self.out) / case.name
        own = not (folder / _DONE).exists()
        return own, self.rivals and not (folder / _RIVALS).exists()

    def __call__(self, case: Case, progress: Update = lambda fraction, remark="", /: None) -> None:
        """Diagnose and judge.

        Raises:
            UserError: the case can't be read.
        """
        jax.config.update("jax_enable_x64", True)  # a worker does not run the CLI's start-up
        keep_compiled()
        give_back_programs()
        folder = Path(self.out) / case.name
        own, rivals_file = self.left(case)
        claim(folder, _CASE)
        if own:
            judged, finding = judge(
                case, self.alpha, lambda f, remark="": progress(f, f"{case.name}: {remark}")
            )
            finding.diagnosis.save(folder / "diagnosis.json")
            _write(folder / _DONE, {"alpha": self.alpha, **judged.plain()})
        if rivals_file:
            _write(folder / _RIVALS, {name: one.plain() for name, one in compete(case).items()})


def run_cases(
    cases: Sequence[Case],
    out: str | os.PathLike[str],
    alpha: float,
    progress: Update,
    rivals: bool = False,
    workers: int = 0,
) -> tuple[list[dict[str, Any]], list[Failed]]:
    """Diagnose and judge the cases that are not judged yet; all judgements, and failed cases.

    In this process one by one, or with `workers` in as many processes of this machine. `rivals` in
    a judgement has the rivals' results, if there are any.

    Raises:
        UserError: a case can't be read, or was judged with another alpha; pysindy is not installed.
    """
    check_workers(None, workers)
    if rivals:
        pysindy()  # fails now, not after the first case
    work = JudgeCase(str(Path(out).absolute()), alpha, rivals)
    for case in cases:  # fails on foreign files now, not after the last case
        check_folder(Path(work.out) / case.name, _CASE)
        _judgement(work, case)
    left = [case for case in cases if any(work.left(case))]
    if workers == 0:
        failed = run_here(work, left, progress) if left else []
    else:
        failed = run_on_cluster(work, left, progress, workers=workers) if left else []
    progress(1.0, "")
    return [row for case in cases if (row := _judgement(work, case)) is not None], failed


def _judgement(work: JudgeCase, case: Case) -> dict[str, Any] | None:
    """The stored judgement of a case, if any."""
    at = Path(work.out) / case.name / _DONE
    if not at.exists():
        return None
    row = read_judgement(at)
    if row["alpha"] != work.alpha:
        raise UserError(
            f"{at}: was judged with alpha {row['alpha']:g}, not {work.alpha:g}; name another --out"
        )
    rivals_file = at.with_name(_RIVALS)
    row["rivals"] = (
        json.loads(rivals_file.read_text(encoding="utf-8")) if rivals_file.exists() else {}
    )
    return row


def _write(at: Path, value: dict[str, Any]) -> None:
    with atomic_path(at) as path:
        text = json.dumps(value, indent=2, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")


def read_judgement(path: Path) -> dict[str, Any]:
    """A judgement as written.

    Raises:
        UserError: the file is not a judgement.
    """
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
        return {"alpha": float(row["alpha"]), **row}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: is no judgement; remove its folder to judge it again") from error
