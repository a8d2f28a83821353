"""Settings (.yaml): vehicles, scenarios, studies, training, methods, answers of cases."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from spinndrift.models.config import typed_yaml
from spinndrift.models.vehicles.vehicle import Vehicle, load_vehicle
from spinndrift.sims.diagnosis_benchmark.cases import HiddenCause, Truth
from spinndrift.sims.scenarios.scenario import load_scenario, scenario_names
from spinndrift.sims.study.config import StudyConfig
from spinndrift.training.config import TrainingConfig
from spinndrift.training.methods import METHODS, method_config

from .harness import Kind
from .mutate import Rng, bytes_spoiled, encoded, pick, text_spoiled, yaml_spoiled

_TEXTS = (
    "duration: 5\nstation: {disturbance_set: calm, period: 0.01, seed: 3}\n",
    "station: {effects: [{name: thruster_gain, where: '3', parameters: {gain: -0.5}}]}\n",
    "log: {rate: 10, samples: false}\nsafety: {}\n",
)
"""What `--scenario-text` may say."""


@cache
def _sound() -> dict[str, tuple[str, ...]]:
    """Text of sound files by what they are."""
    vehicle = typed_yaml.dump(load_vehicle("bluerov2_heavy"))
    truth = Truth(
        "single", "explained", causes=(HiddenCause("thruster_lag", "all", {"time_constant": 0.1}),)
    )
    return {
        "vehicle": (vehicle,),
        "scenario": tuple(typed_yaml.dump(load_scenario(name)) for name in scenario_names()),
        "overlay": _TEXTS,
        "study": (typed_yaml.dump(StudyConfig()),),
        "training": tuple(typed_yaml.dump(method.config) for method in METHODS.values()),
        "method": ("steps: 3\nmodel: {width: 4}\nobjective: !Fdm {samples: 4}\nseed: 1\n",),
        "truth": (typed_yaml.dump(truth),),
    }


def _load_overlay(path: Path) -> None:
    load_scenario("pylon_crossing_calm", path.read_text(encoding="utf-8", errors="replace"))


_READERS: dict[str, Callable[[Path], Any]] = {
    "vehicle": lambda path: typed_yaml.load(Vehicle, path),
    "scenario": load_scenario,
    "overlay": _load_overlay,
    "study": lambda path: typed_yaml.load(StudyConfig, path),
    "training": lambda path: typed_yaml.load(TrainingConfig, path),
    "method": lambda path: method_config("fdm-geodesic", path),
    "truth": lambda path: typed_yaml.load(Truth, path),
}


def _spoil(rng: Rng, folder: Path) -> Path:
    form = pick(rng, sorted(_READERS))
    text = pick(rng, _sound()[form])
    if rng.random() < 0.7:
        text = yaml_spoiled(rng, text)
    if rng.random() < 0.5:
        text = text_spoiled(rng, text)
    data = encoded(rng, text)
    if rng.random() < 0.05:
        data = bytes_spoiled(rng, data)
    path = folder / f"{form}.yaml"
    path.write_bytes(data)
    return path


def _read(path: Path) -> None:
    _READERS[path.stem](path)


YAML = Kind("yaml", _spoil, _read)
