"""What a check found, as a page of the documentation; what people wrote there stays."""

import platform
from collections.abc import Sequence
from pathlib import Path

from ...models.files import atomic_path
from .cases import Case
from .tables import Row, tables

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def write_page(path: Path, rows: Sequence[Row], cases: Sequence[Case]) -> None:
    """Write the tables between two marks of a page; without the marks, a page of tables alone."""
    with atomic_path(path) as partial:
        old = path.read_text(encoding="utf-8") if path.exists() else f"{BEGIN}\n{END}\n"
        if BEGIN not in old or END not in old:
            old = f"{BEGIN}\n{END}\n"
        before, after = old.split(BEGIN)[0], old.split(END)[1]
        partial.write_text(
            f"{before}{BEGIN}\n\n{_text(rows, cases)}\n{END}{after}", encoding="utf-8"
        )


def _text(rows: Sequence[Row], cases: Sequence[Case]) -> str:
    kinds: dict[str, int] = {}
    for case in cases:
        kinds[case.truth.kind] = kinds.get(case.truth.kind, 0) + 1
    counted = ", ".join(f"{n} {kind}" for kind, n in kinds.items())
    head = f"{len(rows)} cases ({counted}), on {platform.machine()}.\n\n"
    return head + "\n".join(table.markdown() for table in tables(rows))
