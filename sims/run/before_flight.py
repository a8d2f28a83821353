"""Before a flight: checks of scenario and vehicle, and the rates that it grants."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ...models.config.errors import UserError
from ...models.sensors import Dvl
from ...systems.mavlink import telemetry
from ...systems.mavlink.codec import low_pass_delays
from ...systems.mavlink.config import Mavlink
from ...systems.mavlink.driver import Driver
from ...systems.mavlink.interface import RESOLUTION, unread
from ...systems.mavlink.link import Received
from ...systems.mavlink.preflight import Finding
from ..scenarios.scenario import Scenario
from .way import check_free, check_positioned, find_passage, no_safe_plan

_RATES = (200.0, 100.0, 50.0, 40.0, 20.0)  # Hz that the filter may have; their ticks fit the loop's
_FEW = 5  # values
_NEARLY_ALL = 0.98  # share of the inertial samples that come in time
_LATENCY = 0.05
"""Deviation (s) of the other sensors' latencies: an autopilot averages a pressure sensor over up to
0.1 s and sends the mean once more that long."""
_EKF3_PERIOD = 0.012  # s: EKF_TARGET_DT of ArduPilot's EKF3
_NEVER = 1e6
_PATIENCE = 30.0  # s for what passes by itself after the vehicle's start
_PASSING = {"attitude", "inertial sensors", "depth sensor", "link", *telemetry.IMUS}
_PASSING |= {"depth", "compass", "dvl"}

Tell = Callable[[str], None]


def checked_link(scenario: Scenario) -> Mavlink:
    """The scenario's link.

    Raises:
        UserError: it has none, or a sensor that no vehicle has, an obstacle at the start, no safe
            plan, or something that needs a position where there is none.
    """
    link = scenario.link()
    for name in unread(scenario.station.sensing.sensors):
        raise UserError(
            f"station.sensing.more.{name}: no message of a vehicle measures it; leave it out"
        )
    check_positioned(scenario)
    check_free(scenario)
    passage = find_passage(scenario)
    if passage is not None and not passage.safe:
        raise UserError(f"success: {no_safe_plan(scenario, passage)}")
    return link


def preflight(driver: Driver, scenario: Scenario, say: Tell = lambda text: None) -> list[Finding]:
    """The driver's checks, and whether each sensor of the scenario is there.

    Raises:
        UserError: a check failed; the sentence names all that did.
    """
    end = time.monotonic() + _PATIENCE
    while True:
        checks = [*driver.preflight(), *_sensors(driver, scenario)]
        failed = {check.name for check in checks if not check.passed}
        if not failed or failed - _PASSING or time.monotonic() > end:
            break
    for check in checks:
        say(f"{'ok    ' if check.passed else 'FAILED'} {check.name}: {check.words}")
    failed = [f"{check.name}: {check.words}" for check in checks if not check.passed]
    if failed:
        raise UserError(f"pre-flight failed, nothing was armed: {'; '.join(failed)}")
    return checks


def _sensors(driver: Driver, scenario: Scenario) -> Iterator[Finding]:
    """Freshness of the sensors that the station has besides the IMU."""
    now = time.monotonic()
    sensing, link = scenario.station.sensing, driver.link
    found = {"depth": telemetry.depth(link, driver.parameters, 1025.0)} if sensing.depth else {}
    if sensing.compass:
        found["compass"] = telemetry.heading(link)
    for name, reading in found.items():
        age = math.inf if reading is None else now - reading.arrival
        yield Finding(name, age < 1.0, _aged(age))
    if isinstance(sensing.dvl, Dvl):
        age, valid = driver.dvl_state()
        words = _aged(age) if valid else f"{_aged(age)}, no bottom lock"
        remedy = "; check the DVL, or fly without: station: {sensing: {dvl: null}}"
        yield Finding("dvl", valid and age < 1.5, words + ("" if valid and age < 1.5 else remedy))


def _aged(age: float) -> str:
    return "no reading came" if math.isinf(age) else f"last reading {age:.1f} s ago"


def as_granted(scenario: Scenario, driver: Driver, say: Tell = lambda text: None) -> Scenario:
    """The scenario with rate and latency of the vehicle's inertial samples, and its noises.

    The filter's rate is the highest it may have up to that granted, at least 20 Hz; the samples are
    instantaneous, and late by what nearly all of them are. Noises that are larger at rest than
    configured are those of the filter, and biases drift as the autopilot's own filter assumes. When
    an autopilot's other readings were true is known to about a tenth of a second. Without a sensor
    of horizontal motion the fence, which needs a position, is off.
    """
    rates = driver.link.statistics().rates
    granted = max((rates.get(name, 0.0) for name in telemetry.IMUS), default=0.0)
    sensing = scenario.station.sensing
    outputs = sensing.ekf.output_rate
    fit = [r for r in _RATES if abs(r / outputs - round(r / outputs)) < 1e-9]
    rate = next((r for r in fit if r <= 1.1 * granted), fit[-1] if fit else sensing.imu.rate)
    # resolution of the samples, and as much dither
    rounding = (RESOLUTION / math.sqrt(6) * math.sqrt(2 / rate)).tolist()
    imu = replace(
        sensing.imu,
        rate=rate,
        integrating=False,
        accelerometer_density=math.hypot(sensing.imu.accelerometer_density, rounding[0]),
        gyroscope_density=math.hypot(sensing.imu.gyroscope_density, rounding[3]),
    )
    depth, noise = sensing.depth, resting_noise(driver, scenario)
    if depth is not None and noise.get("depth", 0.0) > 1.5 * depth.noise:
        say(f"depth scatters by {noise['depth']:.3f} m at rest; the filter is told")
        depth = replace(depth, noise=noise["depth"])
    imu = replace(
        imu,
        accelerometer_density=max(imu.accelerometer_density, noise.get("force", 0.0)),
        gyroscope_density=max(imu.gyroscope_density, noise.get("rate", 0.0)),
        accelerometer_walk=max(imu.accelerometer_walk, _walk(driver, "EK3_ABIAS_P_NSE")),
        gyroscope_walk=max(imu.gyroscope_walk, _walk(driver, "EK3_GBIAS_P_NSE")),
    )
    late = [each.latencies[1] for each in sensing.sensors.values() if each.late]
    ekf = replace(
        sensing.ekf,
        horizon=max([sensing.ekf.horizon, *(t + 2.5 / rate for t in late)]),
        imu_latency=_imu_latency(driver, scenario, 1 / rate, noise.get("delay", 0.0)),
        latency_std=max(sensing.ekf.latency_std, _LATENCY),
        timing_std=max(sensing.ekf.timing_std, 1 / rate / math.sqrt(3)),  # a sample to either side
    )
    link = scenario.vehicle_link
    if not scenario.positioned and link is not None:
        say(
            "no sensor of horizontal motion: the vehicle does not know where it is; depth and "
            "attitude are held, it drifts, and the fence is off"
        )
        safety = replace(link.safety, fence=(_NEVER, _NEVER))
        scenario = replace(scenario, vehicle_link=replace(link, safety=safety))
    sensing = replace(sensing, imu=imu, ekf=ekf, depth=depth)
    return replace(scenario, station=replace(scenario.station, sensing=sensing))


def _walk(driver: Driver, name: str) -> float:
    """Random walk of a bias (its unit/√s) that the autopilot's EKF3 assumes by a parameter.

    A bias changes by white noise of the parameter times the filter's period in each of its steps.
    """
    return driver.parameters.get(name, 0.0) * math.sqrt(_EKF3_PERIOD)


def _imu_latency(driver: Driver, scenario: Scenario, period: float, delay: float) -> float:
    """Time (s) after which inertial samples around it have come, for a `delay` of their messages.

    Those of a period are on either side, and the autopilot's low-passes delay them. It is at most
    what the other sensors' readings can wait.
    """
    filtered = max(low_pass_delays(driver.parameters))
    sensors = scenario.station.sensing.sensors.values()
    aids = [each for each in sensors if each.observes is not None]
    waits = [1 / each.rate + each.latencies[0] - period for each in aids]
    return max(0.0, min([delay + period + filtered, *waits]))


def resting_noise(driver: Driver, scenario: Scenario, seconds: float = 2.0) -> dict[str, float]:
    """Noise of a vehicle at rest: std of `depth` (m), densities of `force` and `rate`.

    From differences of successive values, which slow motion hardly changes. And the `delay` (s)
    that few messages with inertial samples exceed.
    """
    sensor, times, delays = scenario.station.sensing.depth, [], []
    values: dict[str, list] = {"depth": [], "imu": []}

    def read(found: Received) -> None:
        name = found.message.get_type()
        if name == telemetry.IMUS[0]:
            sample = telemetry.inertial(driver.link, found)
            times.append(found.arrival)
            delays.append(found.arrival - sample.taken)
            values["imu"].append(sample.value)
        elif name.startswith("SCALED_PRESSURE") and sensor is not None:
            depth = telemetry.depth(driver.link, driver.parameters, sensor.assumed_density)
            if depth is not None and [float(depth.value[0])] != values["depth"][-1:]:
                values["depth"].append(float(depth.value[0]))

    with driver.link.reading(read):
        time.sleep(seconds)
    found: dict[str, float] = {}
    if len(values["depth"]) > _FEW:
        found["depth"] = float(np.std(np.diff(values["depth"])) / math.sqrt(2))
    if len(times) > _FEW:
        steps: Any = np.diff(np.array(values["imu"], float), axis=0)
        std = steps.std(axis=0) / math.sqrt(2)
        scale = math.sqrt(2 * (times[-1] - times[0]) / (len(times) - 1))
        found["delay"] = float(np.quantile(delays, _NEARLY_ALL))
        found |= {"force": float(std[:3].max() * scale), "rate": float(std[3:].max() * scale)}
    return found
