"""The demo's diagnosis: of the part of a recording that training sees, kept on disk, resumed."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..models.config import typed_yaml
from ..models.config.errors import UserError
from ..models.files.checkpoint import load_model
from ..models.recordings.store import Recording
from ..models.vehicles.vehicle import Vehicle
from ..training.config import WindowConfig
from ..training.data.provenance import recording_fingerprint
from ..training.diagnosis import pipeline
from ..training.diagnosis.findings.result import Diagnosis
from ..training.diagnosis.findings.stored import read_diagnosis
from ..training.smoothing.complete import not_completed_by
from .diagnosis_folder import DIAGNOSIS, write_diagnosis
from .learning import Start, split_recording

_MODEL = Path("extended") / "model.spinn"
_CLAIMS = ("explained", "partly_explained")
"""Verdicts that claim something of the extended model."""


@dataclass(frozen=True)
class Diagnosed:
    """What a diagnosis gives the training that follows.

    Attributes:
        diagnosis: None where the data were refused.
        start: the extended model to learn on top of; None to learn from the preset.
        why: the reason for learning from the preset, a sentence; empty with a `start`.
        kept: whether an earlier command made it.
    """

    diagnosis: Diagnosis | None
    start: Start | None
    why: str
    kept: bool = False


def diagnosed(
    recording: Recording,
    vehicle: Vehicle,
    source: Path,
    windows: WindowConfig,
    out: Path,
    progress: Callable[[float, str], None],
) -> Diagnosed:
    """Diagnose what a preset gets wrong on the training part of a recording.

    Validation and held-out windows are not seen. The files of `spinndrift diagnose` are written
    into `out`, and read again if they are of the same data and vehicle.
    """
    part, _, _ = split_recording(recording, windows)
    key = recording_fingerprint(part, typed_yaml.dump(vehicle))
    diagnosis, kept = _stored(out, key), True
    if diagnosis is None:
        kept = False
        try:
            finding = pipeline.diagnose(part, vehicle, progress=progress)
        except UserError as error:
            for name in DIAGNOSIS.files:  # of other data
                (out / name).unlink(missing_ok=True)
            return Diagnosed(None, None, f"The diagnosis refuses these data: {error}.")
        diagnosis = finding.diagnosis
        about = {"source": str(source), "dt": recording.dt, "diagnosed": key}
        named = recording.vehicle or vehicle.name
        write_diagnosis(out, finding, part, source.name, {"vehicle": named, **about})
    start = Start(Start.read(out / _MODEL)[0].model, name="extended")
    why = _why_not(diagnosis, recording, start)
    return Diagnosed(diagnosis, None if why else start, why, kept)


def _stored(out: Path, key: str) -> Diagnosis | None:
    """The diagnosis in a folder, if it is of these data."""
    try:
        _, metadata = load_model(out / _MODEL)
        return read_diagnosis(out / "diagnosis.json") if metadata.get("diagnosed") == key else None
    except UserError:
        return None


def _why_not(diagnosis: Diagnosis, recording: Recording, start: Start) -> str:
    """Why nothing is learned on top of the extended model; empty if it is."""
    if diagnosis.verdict == "adequate":
        return "The diagnosis finds the preset adequate, so it is itself what training starts from."
    if diagnosis.verdict not in _CLAIMS:
        return "The diagnosis can name nothing that makes the preset right."
    if recording.missing and (why := not_completed_by(start.model)):
        lacking = ", ".join(name for names in recording.missing.values() for name in names)
        return f"The recording lacks {lacking}. The extended model can't infer them: {why}."
    return ""
