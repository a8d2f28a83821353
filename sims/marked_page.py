"""Pages of the documentation with a measured part; what people wrote around it stays."""

from pathlib import Path

from ..models.files import atomic_path

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def write_measured(path: Path, text: str) -> None:
    """Write `text` between two marks of a page; without the marks, a page of it alone."""
    with atomic_path(path) as partial:
        old = path.read_text(encoding="utf-8") if path.exists() else f"{BEGIN}\n{END}\n"
        if BEGIN not in old or END not in old:
            old = f"{BEGIN}\n{END}\n"
        before, after = old.split(BEGIN)[0], old.split(END)[1]
        partial.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}", encoding="utf-8")
