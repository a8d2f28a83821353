"""The folder that a served vehicle leaves."""

from collections.abc import Mapping
from pathlib import Path

from ...models.config import typed_yaml
from ...models.files.atomic import atomic_files
from ...models.files.owned import FolderKind
from ..scenarios.scenario import Scenario
from .truth import TruthLog

_PARAMETERS = "vehicle.parm"
VEHICLE = FolderKind("vehicle", ("scenario.yaml", "truth.nc", _PARAMETERS))
"""What `spinndrift vehicle` writes; the parameters are for a real ArduSub."""


def write_parameters(parameters: Mapping[str, float], folder: Path) -> Path:
    """Write parameters as ArduSub's `--defaults` reads them, into a folder that is held."""
    with atomic_files(folder) as partial:
        lines = "".join(f"{name} {value:g}\n" for name, value in parameters.items())
        (partial / _PARAMETERS).write_text(lines, encoding="utf-8")
    return folder / _PARAMETERS


def write_vehicle(truth: TruthLog, scenario: Scenario, folder: Path) -> None:
    """Write scenario and truth into a folder that is held (`run_folder`)."""
    with atomic_files(folder) as partial:
        (partial / "scenario.yaml").write_text(typed_yaml.dump(scenario), encoding="utf-8")
        truth.save(partial / "truth.nc", scenario.name, "spinndrift vehicle")
