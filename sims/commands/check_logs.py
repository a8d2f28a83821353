"""`spinndrift check logs`: what the import and the checks make of every log of some folders."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar


@dataclass(frozen=True)
class CheckLogs:
    """Import every log, recording and CSV folder below some folders, and tell what came out.

    A log that is refused is a result like any other. docs/real-logs.md is such a page.
    """

    folders: Positional[tuple[Path, ...]]
    """Folders that are searched."""
    docs: Path | None = None
    """Markdown file to write the tables into, such as docs/real-logs.md."""

    @contextmanager
    def place(self) -> Iterator[None]:
        """Check and lock the output."""
        with interrupts_held():
            from ..reports.marked_page import held_page

        if not self.folders:
            raise UserError("check logs: name one or more folders")
        if self.docs is None:
            yield
            return
        if self.docs.suffix != ".md":
            raise UserError(f"--docs {self.docs}: end the name in .md")
        with held_page(self.docs):
            yield

    def run(self) -> None:
        """Import all, report."""
        with interrupts_held():
            from ..log_check import check_logs, find_logs, page_text
            from ..reports.marked_page import write_measured

        logs = find_logs(self.folders)
        with progress_bar(f"{len(logs)} logs") as update:
            found = check_logs(logs, update)
        shown = console()
        for one in found:
            shown.print(f"{one.place}: {one.outcome}", markup=False, soft_wrap=True)
            for finding in one.findings:
                shown.print(f"  {finding}", markup=False, soft_wrap=True)
        if self.docs is not None:
            command = f"spinndrift check logs {' '.join(map(str, self.folders))} --docs {self.docs}"
            write_measured(self.docs, page_text(found, command))
            shown.print(f"wrote {self.docs}")
