"""The folder that a served vehicle leaves."""

from pathlib import Path

from ...models.config import typed_yaml
from ...models.files.atomic import atomic_files
from ...models.files.owned import FolderKind
from ..scenarios.scenario import Scenario
from .truth import TruthLog

VEHICLE = FolderKind("vehicle", ("scenario.yaml", "truth.nc"))
"""What `spinndrift vehicle` writes."""


def write_vehicle(truth: TruthLog, scenario: Scenario, folder: Path) -> None:
    """Write scenario and truth into a folder that is held (`run_folder`)."""
    with atomic_files(folder) as partial:
        (partial / "scenario.yaml").write_text(typed_yaml.dump(scenario), encoding="utf-8")
        truth.save(partial / "truth.nc", scenario.name, "spinndrift vehicle")
