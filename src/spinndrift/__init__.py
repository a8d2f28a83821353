"""Learned stochastic dynamics and control for underwater vehicles, composed as Drake diagrams.

The names of `__all__` are public. Each has an example in its docstring (`help(spinndrift.fit)`),
which leaves out the imports: `from spinndrift import ...`, NumPy as `np`, `jax`, `dataclasses`. A
name's module is imported when the name is first used, so that no room imports another through here.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .models.config.errors import UserError as UserError
    from .models.effects.effect_config import EffectConfig as EffectConfig
    from .models.files.checkpoint import load_model as load_model
    from .models.files.checkpoint import save_model as save_model
    from .models.recordings.build import Trajectory as Trajectory
    from .models.recordings.csv import write_csv as write_csv
    from .models.recordings.store import Recording as Recording
    from .models.rigid_body import FossenDynamics as FossenDynamics
    from .models.spinn import Spinn as Spinn
    from .models.vehicles.vehicle import Vehicle as Vehicle
    from .models.vehicles.vehicle import load_vehicle as load_vehicle
    from .sims.run.loop import simulate as simulate
    from .sims.scenarios.scenario import Scenario as Scenario
    from .sims.scenarios.scenario import load_scenario as load_scenario
    from .systems.closed_loop import (
        build_diagram as build_diagram,
    )
    from .systems.closed_loop import (
        logged as logged,
    )
    from .systems.closed_loop import (
        seeded as seeded,
    )
    from .systems.compiled.simulator import CompiledSimulator as CompiledSimulator
    from .systems.controllers.kinds import MppiImpedance as MppiImpedance
    from .systems.controllers.kinds import Own as Own
    from .systems.logs.load import load_data as load_data
    from .systems.own import OwnFilter as OwnFilter
    from .systems.planning.mppi_config import MppiConfig as MppiConfig
    from .systems.station.config import StationConfig as StationConfig
    from .systems.station.simulated import make_station as make_station
    from .training.config import TrainingConfig as TrainingConfig
    from .training.data.generate import GenerateConfig as GenerateConfig
    from .training.data.generate import generate as generate
    from .training.data.windows import make_windows as make_windows
    from .training.diagnosis.pipeline import DiagnoseConfig as DiagnoseConfig
    from .training.diagnosis.pipeline import diagnose as diagnose
    from .training.evaluation.evaluate import evaluate as evaluate
    from .training.fitting.fit import fit as fit

_HOME = {
    "models.config.errors": "UserError",
    "models.effects.effect_config": "EffectConfig",
    "models.files.checkpoint": "load_model save_model",
    "models.recordings.build": "Trajectory",
    "models.recordings.csv": "write_csv",
    "models.recordings.store": "Recording",
    "models.rigid_body": "FossenDynamics",
    "models.spinn": "Spinn",
    "models.vehicles.vehicle": "Vehicle load_vehicle",
    "sims.run.loop": "simulate",
    "sims.scenarios.scenario": "Scenario load_scenario",
    "systems.closed_loop": "build_diagram logged seeded",
    "systems.compiled.simulator": "CompiledSimulator",
    "systems.controllers.kinds": "MppiImpedance Own",
    "systems.logs.load": "load_data",
    "systems.own": "OwnFilter",
    "systems.planning.mppi_config": "MppiConfig",
    "systems.station.config": "StationConfig",
    "systems.station.simulated": "make_station",
    "training.config": "TrainingConfig",
    "training.data.generate": "GenerateConfig generate",
    "training.data.windows": "make_windows",
    "training.diagnosis.pipeline": "DiagnoseConfig diagnose",
    "training.evaluation.evaluate": "evaluate",
    "training.fitting.fit": "fit",
}
_MODULES = {name: module for module, names in _HOME.items() for name in names.split()}
__all__ = [*_MODULES]  # pyright: ignore[reportUnsupportedDunderAll]

try:
    __version__ = version("spinndrift")
except PackageNotFoundError:  # a source tree on the path, never installed
    __version__ = "0+unknown"


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'spinndrift' has no attribute {name!r}")
    return getattr(import_module(f"spinndrift.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*_MODULES, "__version__"])
