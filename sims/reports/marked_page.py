"""Pages of the documentation with a generated part between two marks; other text is kept."""

from contextlib import AbstractContextManager
from pathlib import Path

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.owned import output_file

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def has_marks(path: Path) -> bool:
    """Whether a page has the two marks between which `write_measured` writes."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    return BEGIN in text and END in text.split(BEGIN, 1)[1]


def held_page(path: Path) -> AbstractContextManager[Path]:
    """Hold the page of an option `--docs` (`models.files.owned`).

    Raises:
        UserError: it is another file, or it can't be written.
    """
    return output_file(path, has_marks, f"page with the marks {BEGIN} and {END}", "--docs")


def write_measured(path: Path, text: str) -> None:
    """Write `text` between the two marks of a page; create a page if there is none.

    Raises:
        UserError: the page lacks the marks.
    """
    if path.exists() and not has_marks(path):
        raise UserError(f"{path}: lacks the marks {BEGIN} and {END}; add them or name a new page")
    old = path.read_text(encoding="utf-8") if path.exists() else f"{BEGIN}\n{END}\n"
    before, after = old.split(BEGIN)[0], old.split(END)[1]
    with atomic_path(path) as partial:
        partial.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}", encoding="utf-8")
