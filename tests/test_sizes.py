"""No file and no function is too long, unless a reason stands beside it."""

import ast
import re

import pytest

from helpers import module_files

FILE, FUNCTION = 400, 60  # lines
REASON = re.compile(r"#\s*long: \w+")
FILES = module_files()


def too_long(text: str) -> list[str]:
    """The file and its functions that are too long, without a comment `# long: why`.

    For a file it stands in the first line, for a function in the line of its `def`.
    """
    lines = text.splitlines()
    found = [f"file: {len(lines)}"] if len(lines) > FILE and not REASON.search(lines[0]) else []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            size = node.end_lineno - node.lineno + 1
            if size > FUNCTION and not REASON.search(lines[node.lineno - 1]):
                found.append(f"{node.name}: {size}")
    return found


def test_files_and_functions_are_short():
    long = {path: found for path in FILES.values() if (found := too_long(path.read_text("utf-8")))}
    assert not long


@pytest.mark.parametrize(
    ("size", "found"), [(59, []), (60, ["f: 61"]), (400, ["file: 401", "f: 401"])]
)
def test_what_is_too_long_is_found_unless_a_reason_is_given(size, found):
    body = "    x = 1\n" * size
    assert too_long(f"def f():\n{body}") == found
    if size < FILE:
        assert too_long(f"def f():  # long: a table\n{body}") == []
    told = too_long(f"# long: a table\n@decorated\ndef f():\n{body}")
    assert not [each for each in told if "file" in each]
