import dataclasses
from pathlib import Path

import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.sims.reports.diagnosis_fields import page, tables
from spinndrift.training.diagnosis.findings import result

PAGE = Path(__file__).resolve().parents[1] / "docs" / "diagnosis-json.md"


def test_every_field_of_the_schema_is_described():
    for name, rule in result.schema()["$defs"].items():
        kind = getattr(result, name)
        fields = [f.name for f in dataclasses.fields(kind)]
        assert list(result.described(kind)) == fields, name
        assert all(part["description"] for part in rule["properties"].values()), name


def test_descriptions_carry_units():
    told = result.schema()["$defs"]
    for name, field, word in (
        ("Support", "heldout_gain", "nats"), ("Support", "p_value", "1e-300"),
        ("ModelGain", "log_score", "nats a sample"), ("ModelGain", "position_rmse", "(m)"),
        ("AxisResidual", "variance_ratio", "dimensionless"), ("DataSummary", "step", "(s)"),
        ("AxisResidual", "mean", "standard errors"),
    ):  # fmt: skip
        assert word in told[name]["properties"][field]["description"]


@pytest.mark.skipif(not PAGE.is_file(), reason="needs the checkout's docs")
def test_the_page_has_the_tables_of_the_code():
    text = PAGE.read_text(encoding="utf-8")
    assert tables() in text
    assert page(text) == text, "run python -m spinndrift.sims.reports.diagnosis_fields"


def test_a_page_without_marks_is_refused():
    with pytest.raises(UserError, match="marks"):
        page("nothing")
