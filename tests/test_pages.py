"""Pages are one file, complete, escaped, and the same for the same content."""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure as Plot

from spinndrift.models.config.errors import UserError
from spinndrift.sims.reports.pages import Page, marked, shown

pytestmark = pytest.mark.smoke


def _plot(points: int = 20) -> Plot:
    plot = Plot(figsize=(4, 2))
    x = np.linspace(0, 1, points)
    plot.add_subplot().plot(x, np.sin(40 * x + 1e3 * x**2))
    return plot


def _page() -> Page:
    return (
        Page("A <dive>", "in **calm** water")
        .verdict("The goal was reached.", good=True)
        .tiles([("time", "31 s"), ("error", 0.25, "m, RMS")])
        .section("Path", "Seen from above.\n\nSecond paragraph, see [the replay](meshcat.html).")
        .figure(_plot(), "Planned and `flown`.", width="half")
        .figure(_plot(), width="half")
        .section("Numbers")
        .table([("time to goal", 31.25), ("reached", True), ("gap", None)], header=("what", "s"))
        .table({"a": 1, "b": float("nan")})
        .section("Files")
        .details("The scenario", "name: <x>\n")
        .section("More")
        .footer("version 1")
    )


def test_page_holds_everything_itself_and_escapes_text():
    html = _page().html()
    assert "A &lt;dive&gt;" in html
    assert "<dive>" not in html
    assert "name: &lt;x&gt;" in html
    assert "<strong>calm</strong>" in html
    assert '<a href="meshcat.html">the replay</a>' in html
    assert html.count("<p>") >= 2
    assert html.count('src="data:image/svg+xml;base64,') == 2
    assert not re.search(r'(src|href)="https?:', html)
    assert not re.search(r"url\(|@import", html)
    assert '<nav aria-label="Contents">' in html
    assert "31.25" in html
    assert "Planned and flown." in html  # the alternative text


def test_equal_content_gives_equal_bytes(tmp_path):
    first, second = (_page().write(tmp_path / name) for name in ("a.html", "b.html"))
    assert first.read_bytes() == second.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "b.html"]


def test_large_plots_become_pixels():
    cloud = Plot(figsize=(2, 2))
    cloud.add_subplot().plot(*np.random.default_rng(1).random((2, 12_000)), ".")
    html = Page("x").figure(cloud).figure(_plot(), pixels=True).html()
    assert html.count("data:image/png;base64,") == 2


def test_picture_files(tmp_path):
    _plot().savefig(tmp_path / "p.png")
    assert "data:image/png" in Page("x").figure(tmp_path / "p.png").html()
    with pytest.raises(UserError, match="no such picture"):
        Page("x").figure(tmp_path / "q.png")
    with pytest.raises(UserError, match=r"give \.svg"):
        Page("x").figure(tmp_path / "q.txt")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (True, "yes"),
        (-0.123456, "−0.1235"),
        (np.float64(2.0), "2"),
        ((1, 2.5), "1, 2.5"),
        ("a_b", "a_b"),
    ],
)
def test_shown(value, expected):
    assert shown(value) == expected


def test_marks_cannot_break_out():
    assert marked('<b> & "x"') == "&lt;b&gt; &amp; &#34;x&#34;"
    assert "<a" not in marked('[x](a"onclick=b)')
    assert "<a" not in marked("[x](javascript:alert%281%29)")
    assert marked("[x](a/b-1.html#c)") == '<a href="a/b-1.html#c">x</a>'
