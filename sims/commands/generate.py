"""`spinndrift generate`: simulated training data."""

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import OmitArgPrefixes

from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ...training.data.generate import GenerateConfig
from ..progress import console, progress_bar


@dataclass(frozen=True)
class Settings(GenerateConfig):
    """Settings of the simulation."""

    def __post_init__(self) -> None:
        """No checks here: `sims.options` does them and names the options as they are given."""


@dataclass(frozen=True)
class Generate:
    """Simulate maneuvers of a vehicle under noise and disturbances, as a Recording.

    The defaults make the paper's sparse regime: ten maneuvers, 20 trajectories each, 10 s at 20 Hz.
    """

    EXAMPLES: ClassVar = (
        "spinndrift generate --trajectories 4 --out tank.nc",
        "spinndrift generate --maneuvers yaw-left --disturbances harbour --out harbour.nc",
    )

    out: Path = Path("generated.nc")
    """File to write (.nc)."""
    vehicle: str = "bluerov2_heavy"
    """Preset name or YAML file."""
    model: Path | None = None
    """Simulate this learned model (.spinn) instead of the preset with `--diffusion`."""
    disturbances: str = "still"
    """Named set of disturbances: still, calm, harbour, slack_tide, flood_tide."""
    config: Annotated[Settings, OmitArgPrefixes] = field(default_factory=Settings)

    def place(self) -> AbstractContextManager[Path]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ...models.files.owned import output_file
            from ...models.recordings.store import Recording

        return output_file(self.out, Recording.is_one, "recording of spinndrift")

    def run(self) -> None:
        """Simulate and write."""
        with interrupts_held():
            from ...models.disturbances import preset
            from ...models.files.checkpoint import load_model
            from ...models.recordings.store import Recording
            from ...models.recordings.summary import summarize
            from ...models.vehicles.places import absolute
            from ...models.vehicles.vehicle import load_vehicle
            from ...training.data.generate import generate

        if self.out.suffix != ".nc":
            raise UserError(f"--out {self.out}: a Recording is a NetCDF file; end the name in .nc")
        if not self.config.maneuvers:
            raise UserError("--maneuvers: give at least one; without the option all are simulated")
        vehicle = load_vehicle(self.vehicle)
        disturbance = preset(self.disturbances)
        dynamics = None if self.model is None else load_model(self.model, dtype=float)[0]
        with progress_bar("simulating"):
            recording = generate(
                GenerateConfig(**vars(self.config)), vehicle, (disturbance,), dynamics
            )
        recording = Recording(recording.dataset.assign_attrs(vehicle=absolute(self.vehicle)))
        recording.save(self.out)
        shown = console()
        shown.print(summarize(recording))
        shown.print(f"wrote {self.out}")
