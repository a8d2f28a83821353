"""The results of a benchmark, as a page of the documentation."""

import platform
from collections.abc import Sequence
from pathlib import Path

from ..reports.marked_page import write_measured
from .cases import Case
from .tables import Row, tables


def write_page(path: Path, rows: Sequence[Row], cases: Sequence[Case]) -> None:
    """Write the tables into the measured part of a page."""
    write_measured(path, _text(rows, cases))


def _text(rows: Sequence[Row], cases: Sequence[Case]) -> str:
    kinds: dict[str, int] = {}
    for case in cases:
        kinds[case.truth.kind] = kinds.get(case.truth.kind, 0) + 1
    counted = ", ".join(f"{n} {kind}" for kind, n in kinds.items())
    head = f"{len(rows)} cases ({counted}), on {platform.machine()}.\n\n"
    return head + "\n".join(table.markdown() for table in tables(rows))
