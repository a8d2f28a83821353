"""The findings of the checks of the data: on the terminal and on pages."""

from rich.console import Console

from ...models.recordings.checks.finding import findings_of
from ...models.recordings.store import Recording
from .pages import Page

_WHAT = {"severe": "accepted", "cut": "left out or set apart", "note": "noted"}


def print_findings(shown: Console, recording: Recording) -> None:
    """One line each; nothing without findings."""
    for finding in findings_of(recording.dataset):
        shown.print(f"found {finding}", markup=False, soft_wrap=True)


def add_findings(page: Page, recording: Recording) -> Page:
    """A section with all findings, or with the sentence that there is none."""
    found = findings_of(recording.dataset)
    page.section("Checks of the data")
    if not found:
        return page.text("The checks of commands, motion and streams found nothing.")
    rows = [(f.word, _WHAT[f.severity], f.place or "–", f.text, f.remedy or "–") for f in found]
    return page.table(rows, ("finding", "what was done", "where", "what is wrong", "remedy"))
