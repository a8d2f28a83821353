"""The fields of `diagnosis.json` as tables of a page, from the dataclasses that are written.

python -m spinndrift.sims.reports.diagnosis_fields docs/diagnosis-json.md
"""

import sys
from pathlib import Path
from typing import Any

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...training.diagnosis.findings.result import schema

BEGIN, END = "<!-- fields: begin -->", "<!-- fields: end -->"
_WORDS = {"string": "text", "integer": "integer", "null": "null"}


def tables() -> str:
    """A table of fields for each object, the whole first."""
    rules = schema()
    first = rules["$ref"].split("/")[-1]
    parts = []
    for name in (first, *(n for n in rules["$defs"] if n != first)):
        rule = rules["$defs"][name]
        parts += [f"## {name}", "", rule["description"], ""]
        parts += ["| field | is | holds |", "|---|---|---|"]
        for field, of in rule["properties"].items():
            holds = of["description"].removesuffix(".")
            parts.append(f"| `{field}` | {_is(of)} | {holds[:1].upper() + holds[1:]}. |")
        parts.append("")
    return "\n".join(parts)


def _is(rule: dict[str, Any]) -> str:
    """The type of a rule of the schema, in words."""
    if "$ref" in rule:
        name = rule["$ref"].split("/")[-1]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in rule:
        return " or ".join(_is(r) for r in rule["anyOf"])
    if "enum" in rule:
        return ", ".join(f"`{word}`" for word in rule["enum"])
    if isinstance(rule["type"], list):
        return "number"
    if rule["type"] == "array":
        count = f"{rule['minItems']} × " if "minItems" in rule else "list of "
        return count + _is(rule["items"])
    if rule["type"] == "object":
        return f"by name: {_is(rule['additionalProperties'])}"
    return _WORDS[rule["type"]]


def page(old: str) -> str:
    """A page with the tables in place of the text between its two marks.

    Raises:
        UserError: the page lacks them.
    """
    if BEGIN not in old or END not in old:
        raise UserError(f"page: the marks {BEGIN} and {END} are missing; add them")
    before, after = old.split(BEGIN)[0], old.split(END)[1]
    return f"{before}{BEGIN}\n\n{tables()}\n{END}{after}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    text = page(path.read_text(encoding="utf-8"))
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")
