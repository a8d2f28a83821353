"""Report pages: sections of text, figures and tables in one self-contained HTML file.

    Page("A dive").verdict("The goal was reached.", good=True)
        .section("Path", "Seen from above.").figure(fig, "Planned and flown.")
        .table([("time to goal", 31.2, "s")]).write("report.html")

Text is plain, with three marks: `code`, **strong** and [label](target); a blank line starts a
paragraph. Everything else is escaped.
"""

import base64
import io
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import jinja2
import matplotlib
from markupsafe import Markup, escape
from matplotlib.figure import Figure as Plot

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path

_TEMPLATES = Path(__file__).resolve().parent / "templates"
_LARGE_SVG = 600_000  # bytes; above it a PNG is smaller and opens faster
_PIXELS = 200  # dpi of PNGs: twice the displayed size
_MARKS = (
    (re.compile(r"`([^`]+)`"), r"<code>\1</code>"),
    (re.compile(r"\*\*([^*]+)\*\*"), r"<strong>\1</strong>"),
    (re.compile(r"\[([^\]]+)\]\(((?:https?://)?[\w.,/#?=%~+-]+)\)"), r'<a href="\2">\1</a>'),
)


@dataclass(frozen=True)
class Text:
    """Paragraphs of marked text."""

    text: str
    kind: str = "text"

    @property
    def paragraphs(self) -> list[Markup]:
        """One piece of HTML per paragraph."""
        return [marked(part) for part in re.split(r"\n\s*\n", self.text.strip()) if part]


@dataclass(frozen=True)
class Figure:
    """A picture inside the page, with its caption."""

    source: str
    caption: str = ""
    alt: str = ""
    width: Literal["full", "half"] = "full"
    kind: str = "figure"

    @property
    def words(self) -> Markup:
        """The caption as HTML."""
        return marked(self.caption)


@dataclass(frozen=True)
class Table:
    """Rows of cells; numbers are right-aligned. With `fold`, its title, it opens on a click."""

    rows: Sequence[Sequence[object]]
    header: Sequence[str] = ()
    caption: str = ""
    width: Literal["full", "half"] = "full"
    fold: str = ""
    kind: str = "table"

    @property
    def cells(self) -> list[list[tuple[Markup, bool]]]:
        """(HTML, is a number) of every cell."""
        return [[(marked(shown(cell)), _is_number(cell)) for cell in row] for row in self.rows]

    @property
    def words(self) -> Markup:
        """The caption as HTML."""
        return marked(self.caption)


@dataclass(frozen=True)
class Tiles:
    """Key figures side by side: (label, value, remark)."""

    tiles: Sequence[tuple[str, str, str]]
    kind: str = "tiles"


@dataclass(frozen=True)
class Details:
    """Preformatted text that opens on a click."""

    summary: str
    text: str
    kind: str = "details"


Item = Text | Figure | Table | Tiles | Details


@dataclass
class Section:
    """A titled part of a page."""

    title: str
    items: list[Item] = field(default_factory=list)

    @property
    def anchor(self) -> str:
        """Its address inside the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


class Page:
    """Builds a page from top to bottom; every method returns the page.

    Content added before the first `section` is placed under the title.
    """

    def __init__(self, title: str, subtitle: str = ""):
        self.title, self.subtitle = title, subtitle
        self.sections: list[Section] = [Section("")]
        self._verdict: tuple[Markup, str] | None = None
        self._footer: list[Markup] = []

    def verdict(self, text: str, good: bool | None = None) -> "Page":
        """Set the one-line result; `good` colours it green or red, None leaves it grey."""
        mood = {True: "good", False: "bad", None: "neutral"}[good]
        self._verdict = (marked(text), mood)
        return self

    def section(self, title: str, text: str = "") -> "Page":
        """Begin a section; later content is added to it."""
        self.sections.append(Section(title))
        return self.text(text) if text else self

    def text(self, text: str) -> "Page":
        """Add paragraphs."""
        return self._add(Text(text))

    def figure(
        self,
        picture: Plot | str | os.PathLike[str],
        caption: str = "",
        alt: str = "",
        width: Literal["full", "half"] = "full",
        pixels: bool | None = None,
    ) -> "Page":
        """Embed a matplotlib figure, or a picture file (.svg, .png, .jpg), in the page.

        A plot is embedded as SVG, or as PNG of twice its size if that is the smaller file; `pixels`
        forces the choice. Two neighbours of half width are placed side by side.

        Raises:
            UserError: the file is missing or of another kind.
        """
        source = _plot(picture, pixels) if isinstance(picture, Plot) else _file(Path(picture))
        return self._add(Figure(source, caption, alt or _plain(caption), width))

    def table(
        self,
        rows: Mapping[str, object] | Iterable[Sequence[object]],
        header: Sequence[str] = (),
        caption: str = "",
        width: Literal["full", "half"] = "full",
        fold: str = "",
    ) -> "Page":
        """Add a table of rows, or of a mapping's keys and values, closed under a title `fold`."""
        pairs = rows.items() if isinstance(rows, Mapping) else rows
        return self._add(Table([tuple(row) for row in pairs], tuple(header), caption, width, fold))

    def tiles(self, tiles: Iterable[Sequence[object]]) -> "Page":
        """Add key figures: (label, value) or (label, value, remark)."""
        filled = ((*map(shown, tile), "")[:3] for tile in tiles)
        return self._add(Tiles([(label, value, remark) for label, value, remark in filled]))

    def details(self, summary: str, text: str) -> "Page":
        """Add preformatted text that opens on a click."""
        return self._add(Details(summary, text.rstrip("\n")))

    def footer(self, *lines: str) -> "Page":
        """Add lines at the end of the page, such as versions."""
        self._footer += [marked(line) for line in lines]
        return self

    def _add(self, item: Item) -> "Page":
        self.sections[-1].items.append(item)
        return self

    def html(self) -> str:
        """The page as text."""
        environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(_TEMPLATES),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        return environment.get_template("page.html").render(
            title=self.title,
            subtitle=marked(self.subtitle),
            verdict=self._verdict,
            sections=self.sections,
            footer=self._footer,
        )

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the page atomically."""
        with atomic_path(path) as partial:
            partial.write_text(self.html(), encoding="utf-8")
        return Path(path)


def marked(text: str) -> Markup:
    """Escape a line of text and turn its marks into HTML."""
    html = str(escape(text))
    for pattern, replacement in _MARKS:
        html = pattern.sub(replacement, html)
    return Markup(html)


def shown(value: object) -> str:
    """A value as text for a table: four digits, a dash for a missing value."""
    match value:
        case None:
            return "–"
        case bool():
            return "yes" if value else "no"
        case str():
            return value
        case int():
            return str(value)
    if isinstance(value, list | tuple):
        return ", ".join(map(shown, value))
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        return str(value)
    return "–" if math.isnan(number) else f"{number:.4g}".replace("-", "−")


def _is_number(value: object) -> bool:
    return hasattr(value, "__float__") and not isinstance(value, bool | str)


def _plain(text: str) -> str:
    return re.sub(r"[`*]", "", text)


def _plot(plot: Plot, pixels: bool | None) -> str:
    # Fixed ids and no date: the same data give the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": "spinndrift", "svg.fonttype": "path"}):
        if not pixels:
            out = io.BytesIO()
            plot.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
            if pixels is False or out.tell() <= _LARGE_SVG:
                return _uri("image/svg+xml", out.getvalue())
        out = io.BytesIO()
        plot.savefig(out, format="png", dpi=_PIXELS, metadata={"Software": None})
        return _uri("image/png", out.getvalue())


def _file(path: Path) -> str:
    kinds = {".svg": "image/svg+xml", ".png": "image/png", ".jpg": "image/jpeg"}
    if path.suffix.lower() not in kinds:
        raise UserError(f"{path}: no picture a page can hold; give .svg, .png or .jpg")
    if not path.is_file():
        raise UserError(f"{path}: there is no such picture; check the path")
    return _uri(kinds[path.suffix.lower()], path.read_bytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
