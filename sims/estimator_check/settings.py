"""Settings of the estimator's check: waters, plants, initial states, and sensor faults."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from ...models.config.errors import UserError
from ...models.files.checkpoint import load_model
from ...models.sensors import SensorFault
from ..scenarios.criteria import Safety
from ..scenarios.scenario import Scenario, load_scenario

TableName = Literal["consistency", "faults"]
_CALM, _HARBOUR = "trajectory_tracking_calm", "trajectory_tracking_harbour"
_WAVES = "{significant_height: 0.25, peak_period: 2.4, direction: 2.5, spreading: 10.0}"
_DEGREE = math.pi / 180
LEARNED = "learned"
_WATERS = {
    "calm": ("calm water", _CALM, ""),
    "harbour": ("harbour: current, waves, wake, coloured wrench", _HARBOUR, ""),
    LEARNED: ("learned model as the plant", _CALM, ""),
    "white": ("white process noise on the physics", _CALM,
              "station: {diffusion: [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]}"),
    "200_hz": ("plant at 200 Hz", _CALM, "station: {period: 0.005}"),
    "waves": ("waves of 0.25 m", _CALM, f"station: {{disturbances: [!JonswapWaves {_WAVES}]}}"),
    "pitch_90": ("start at 90° of pitch", _CALM, "station: {start: {rpy_deg: [0, 90, 45]}}"),
}  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """A scenario that is simulated with many seeds.

    Attributes:
        table: the table that it is a row of.
        name: of its file.
        words: its description in the table.
        row: of the whole table; each row has seeds of its own.
        scenario: its seed is replaced.
    """

    table: TableName
    name: str
    words: str
    row: int
    scenario: Scenario

    def seeds(self, runs: int) -> range:
        """Seeds of its runs. What is drawn once a run (offset of depth) is no other row's."""
        return range(self.row * runs, (self.row + 1) * runs)

    def __str__(self) -> str:
        """Its name."""
        return self.name


def chosen(only: Sequence[str]) -> list[str]:
    """Names of the settings that match a pattern or whose table does; all without a pattern.

    Raises:
        UserError: a pattern fits none.
    """
    table = dict.fromkeys(_WATERS, "consistency") | {name: "faults" for name, *_ in _faults(0.0)}

    def fit(pattern: str) -> list[str]:
        names = [n for n, t in table.items() if fnmatchcase(n, pattern) or t == pattern]
        if not names:
            raise UserError(
                f"--only {pattern}: fits none of consistency, faults, {', '.join(table)}"
            )
        return names

    found = {name for pattern in only or ("*",) for name in fit(pattern)}
    return [name for name in table if name in found]


def setting_files() -> tuple[str, ...]:
    """Paths of the scores of all settings, relative to the folder of a check."""
    faults = (f"faults/{name}.npz" for name, _, _ in _faults(0.0))
    return (*(f"consistency/{name}.npz" for name in _WATERS), *faults)


def consistency_settings(names: Sequence[str], seconds: float, model: Path | None) -> list[Setting]:
    """Healthy sensors in several waters; `model` is the learned plant, if that setting is chosen.

    Raises:
        UserError: the model can't be read.
    """
    found = []
    for row, (name, (words, base, text)) in enumerate(_WATERS.items()):
        if name not in names:
            continue
        scenario = _lasting(load_scenario(base, text), seconds)
        if name == LEARNED:
            assert model is not None
            vehicle = load_model(model, float)[1].get("vehicle") or scenario.station.vehicle
            station = replace(scenario.station, model=model.absolute(), vehicle=vehicle)
            scenario = replace(scenario, station=station)
        found.append(Setting("consistency", name, words, row, scenario))
    return found


def fault_settings(names: Sequence[str], seconds: float) -> list[Setting]:
    """Calm water with a fault from a third of the time on."""
    calm = _lasting(load_scenario(_CALM), seconds)
    found = []
    for row, (name, words, faults) in enumerate(_faults(seconds / 3)):
        if name in names:
            sensing = replace(calm.station.sensing, faults=tuple(faults))
            station = replace(calm.station, sensing=sensing)
            found.append(Setting("faults", name, words, row, replace(calm, station=station)))
    return found


def _lasting(scenario: Scenario, seconds: float) -> Scenario:
    """The scenario with a fixed duration: a spinning vehicle does not end it early."""
    return replace(scenario, duration=seconds, safety=Safety(spin_rate=1e3))


def _faults(t: float) -> list[tuple[str, str, list[SensorFault]]]:
    """Name, words and faults from t (s) on; faults without a duration last to the end."""
    one, short, long = 0.0, 1.0, 10.0

    def row(name: str, words: str, fault: Any, *given: Any, **more: Any) -> tuple:
        sensor: Any = name.split("_")[0]
        return name, words, [SensorFault(sensor, fault, t, *given, **more)]

    return [
        ("none", "none", []),
        row("imu_nan", "IMU: NaN, one sample", "nan", one),
        row("imu_nan_1s", "IMU: NaN for 1 s", "nan", short),
        row("imu_infinite", "IMU: infinite, one sample of one axis", "infinite", one, (1,)),
        row("imu_frozen", "IMU frozen for 1 s", "frozen", short),
        row("imu_spike", "IMU: one spike of 1000 m/s²", "offset", one, (0,), 1000.0),
        row("imu_spike_within", "IMU: one spike of 100 m/s², in range", "offset", one, (0,), 100.0),
        row("imu_gyro_spike", "IMU: one spike of 1000 rad/s", "offset", one, (5,), 1000.0),
        row("imu_gyro_spike_within", "IMU: one spike of 20 rad/s, in range", "offset", one, (5,),
            20.0),
        row("imu_noise", "IMU: 20 times the noise", "noise", size=20.0),
        row("compass_nan", "compass: NaN for 10 s", "nan", long),
        row("compass_frozen", "compass frozen for 10 s while turning", "frozen", long),
        row("compass_frozen_on", "compass frozen to the end while turning", "frozen"),
        row("compass_turned", "compass offset by 40°", "offset", size=40 * _DEGREE),
        row("compass_drift", "compass drifts by 2° a second", "drift", size=2 * _DEGREE),
        row("compass_latency", "compass: 0.5 s of hidden latency", "latency", size=0.5),
        row("compass_dropout", "compass: 90 % lost", "dropout", share=0.9),
        row("dvl_frozen", "DVL frozen for 10 s, time stamps advance", "frozen", long),
        row("dvl_frozen_on", "DVL frozen to the end, time stamps advance", "frozen"),
        row("dvl_frozen_axis", "DVL: one component frozen", "frozen", None, (0,)),
        row("dvl_zero", "DVL: zeros marked valid for 10 s", "constant", long, size=0.0),
        row("dvl_sentinel", "DVL: −32.768 m/s marked valid for 10 s", "constant", long,
            size=-32.768),
        row("dvl_scale", "DVL: one component times 1.5", "scale", None, (0,), 1.5),
        row("dvl_sign", "DVL: one component with the wrong sign", "scale", None, (0,), -1.0),
        row("dvl_spikes", "DVL: 2 m/s offset in 70 % of the readings", "offset", None, (0,), 2.0,
            share=0.7),
        row("dvl_noise", "DVL: 10 times the noise", "noise", size=10.0),
        row("dvl_dropout", "DVL: 90 % lost", "dropout", share=0.9),
        row("dvl_lost", "DVL: no valid reading for 10 s", "dropout", long),
        row("dvl_lost_on", "DVL: no valid reading to the end", "dropout"),
        row("dvl_latency", "DVL: 0.5 s of hidden latency", "latency", size=0.5),
        row("dvl_stamp", "DVL: time stamp of arrival, 0.15 s late", "stamp_offset", size=0.15),
        row("dvl_frozen_stamp", "DVL: time stamps frozen for 10 s", "frozen_stamp", long),
        row("depth_jump", "depth jumps by 0.5 m", "offset", size=0.5),
        row("depth_frozen", "depth frozen to the end", "frozen"),
        row("depth_drift", "depth drifts by 5 cm a second", "drift", size=0.05),
        row("depth_spikes", "depth: 1 m offset in 70 % of the readings", "offset", size=1.0,
            share=0.7),
        row("depth_latency", "depth: 0.5 s of hidden latency", "latency", size=0.5),
        row("depth_dropout", "depth: 90 % lost", "dropout", share=0.9),
        row("depth_frozen_stamp", "depth: time stamps frozen for 10 s", "frozen_stamp", long),
    ]  # fmt: skip
