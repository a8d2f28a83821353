"""A diagnosis on disk: a folder whose files are written atomically together."""

import json
from pathlib import Path
from typing import Any

from ..models.files.atomic import atomic_files
from ..models.files.checkpoint import save_model
from ..models.files.owned import FolderKind
from ..models.recordings.store import Recording
from ..training.diagnosis.findings.result import schema
from .reports import diagnosis_report
from .reports.findings import add_findings

DIAGNOSIS = FolderKind(
    "diagnosis", ("diagnosis.json", "diagnosis.schema.json", "extended/model.spinn", "report.html")
)
"""What `spinndrift diagnose` writes."""


def write_diagnosis(
    folder: Path, finding: Any, recording: Recording, source: str, metadata: dict[str, Any]
) -> None:
    """Write a `pipeline.Finding` into a folder that is held (`run_folder`), all files at once.

    `metadata` is that of `extended/model.spinn`, the model with the causes in it; `source` names
    the data on the page, `recording` has the findings of their checks.
    """
    page = diagnosis_report.diagnosis_page(finding, f"Diagnosis of {source}")
    add_findings(page, recording)
    with atomic_files(folder) as partial:
        finding.diagnosis.save(partial / "diagnosis.json")
        text = json.dumps(schema(), indent=2) + "\n"
        (partial / "diagnosis.schema.json").write_text(text, encoding="utf-8")
        save_model(partial / "extended" / "model.spinn", finding.extended, metadata)
        page.write(partial / "report.html")
