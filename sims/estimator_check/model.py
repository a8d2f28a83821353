"""The default learned model of the check: the demo's."""

from pathlib import Path

from ...models.vehicles.vehicle import load_vehicle
from ...systems.logs.load import load_data
from ...training.config import TrainingConfig
from ..demo import EMBEDDED
from ..learning import learn
from ..progress import Update


def demo_model(folder: Path, progress: Update) -> Path:
    """The path of the model, which is trained in `folder` unless it exists.

    Raises:
        UserError: the folder holds another training.
    """
    path = folder / "model.spinn"
    if not (folder / "evaluation.json").exists():  # written last
        recording = load_data(EMBEDDED)
        vehicle = load_vehicle(recording.vehicle or "bluerov2_heavy")
        learn(recording, vehicle, TrainingConfig(), folder, resume=True, progress=progress)
    return path
