"""Outputs of the checks: a folder, a page of the docs, and what was given up."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console

if TYPE_CHECKING:
    from ...models.files.owned import FolderKind
    from ..fanout import Failed


@contextmanager
def held_outputs(out: Path, kind: "FolderKind", docs: Path | None) -> Iterator[None]:
    """Check and lock the folder, and the page if there is one."""
    with interrupts_held():
        from ...models.files.owned import run_folder
        from ..reports.marked_page import held_page

    with ExitStack() as held:
        if docs is not None:
            held.enter_context(held_page(docs))
        held.enter_context(run_folder(out, kind))
        yield


def check_page(docs: Path | None) -> None:
    """Refuse a page that is not Markdown."""
    if docs is not None and docs.suffix != ".md":
        raise UserError(f"--docs {docs}: end the name in .md")


def refuse_given_up(failed: Sequence["Failed"], what: str) -> None:
    """Tell which tasks were given up, if any, and end with an error."""
    for one in failed:
        console().print(f"{one.task} was given up: {one.reason}")
    if failed:
        raise UserError(
            f"{len(failed)} {what} were given up (see above); the same command tries them again"
        )
