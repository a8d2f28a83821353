"""What documentation and docstrings refer to exists: files, folders, modules, tests, anchors."""

import re
import subprocess
from pathlib import Path

import pytest

from helpers import ROOMS, ROOT

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_QUOTED = re.compile(r"`([^`\n]+)`")
_FOLDERS = (*ROOMS, "tests", "docs", "examples", "benchmarks", "src")
_PATH = re.compile(rf"(?<![\w./<-])(?:{'|'.join(_FOLDERS)})/[\w./-]*\w/?(?![\w<*])")
_NAME = re.compile(rf"(?<![\w./])(?:spinndrift\.)?(?:{'|'.join(ROOMS)})(?:\.(?!png\b)\w+)+")
_DEFINED = r"^\s*(?:def|class) {0}\b|\b{0}\s*[:=]|import [^\n]*\b{0}\b"
_FOREIGN = ("generate_data.py",)
"""Files of other projects."""


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    """Paths that git tracks."""
    if not (ROOT / ".git").exists():
        pytest.skip("needs a checkout")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    return listed.stdout.splitlines()


def pages(tracked: list[str]) -> list[Path]:
    """Pages of the documentation."""
    return [ROOT / name for name in tracked if name.endswith(".md")]


def sources(tracked: list[str]) -> list[Path]:
    """Python files outside of tests."""
    return [
        ROOT / name
        for name in tracked
        if name.endswith(".py") and name.split("/")[0] in (*ROOMS, "examples", "benchmarks")
    ]


def anchor(title: str) -> str:
    """The address of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")


def missing_name(name: str) -> bool:
    """Whether neither a module nor a definition in one has this dotted name."""
    parts = name.removeprefix("spinndrift.").split(".")
    for count in range(len(parts), 0, -1):
        folder = ROOT.joinpath(*parts[:count])
        module = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
        if module.is_file():
            text = module.read_text(encoding="utf-8")
            own = (re.compile(_DEFINED.format(re.escape(p)), re.M) for p in parts[count:])
            return not all(pattern.search(text) for pattern in own)
    return True


def test_links_of_pages_lead_to_files_and_headings(tracked: list[str]):
    for page in pages(tracked):
        for target in _LINK.findall(page.read_text(encoding="utf-8")):
            if "://" in target:
                continue
            path, _, place = target.partition("#")
            aim = (page.parent / path).resolve() if path else page
            assert aim.exists(), f"{page.name}: {target}"
            if place:
                titles = re.findall(r"^#+ (.+)$", aim.read_text(encoding="utf-8"), re.M)
                assert place in map(anchor, titles), f"{page.name}: {target}"


def test_paths_and_modules_in_pages_and_docstrings_exist(tracked: list[str]):
    for file in [*pages(tracked), *sources(tracked)]:
        text = file.read_text(encoding="utf-8")
        where = file.relative_to(ROOT)
        for path in _PATH.findall(text):
            assert (ROOT / path).exists(), f"{where}: {path}"
        for name in _NAME.findall(
            text if file.suffix == ".md" else " ".join(_QUOTED.findall(text))
        ):
            assert not missing_name(name), f"{where}: {name}"


def test_quoted_file_and_test_names_in_pages_exist(tracked: list[str]):
    files = {name.rpartition("/")[2] for name in tracked}
    tests = "\n".join(
        (ROOT / name).read_text() for name in tracked if name.startswith("tests/test")
    )
    for page in pages(tracked):
        for quoted in _QUOTED.findall(page.read_text(encoding="utf-8")):
            if re.fullmatch(r"[\w/]+\.py", quoted) and quoted not in _FOREIGN:
                assert quoted.rpartition("/")[2] in files, f"{page.name}: {quoted}"
            if re.fullmatch(r"test_\w+", quoted):
                assert f"def {quoted}(" in tests, f"{page.name}: {quoted}"
