"""A simulated vehicle with its plant and its ports, in virtual time."""

from dataclasses import replace

import numpy as np

from ..scenarios.scenario import Scenario
from .autopilot.mixer import frame_for
from .config import VehicleServer
from .endpoint import dvl_messages
from .plant import DvlReading, Plant
from .ports import Ports
from .truth import TruthLog
from .vehicle import Vehicle

TICK = 0.0025  # s: the autopilot's loop
_MOST_MERIT = 0.4  # m/s: figure of merit of a reading without confidence


class Simulation:
    """What happens in a scenario's water, tick by tick, and what goes over the links."""

    def __init__(
        self, scenario: Scenario, ports: int, record: bool = True, plant: Plant | None = None
    ):
        """Build plant and vehicle; this compiles, unless a plant of the scenario is given.

        `record` is whether to log the truth.

        Raises:
            UserError: the scenario names what can't be read, or an unknown parameter.
        """
        self.settings = scenario.vehicle_server or VehicleServer()
        own = dict(self.settings.parameters)
        Vehicle(own)  # these two before the plant, whose building takes long
        frame_for(len(scenario.station.load_vehicle().propulsion.mounts))
        self.plant = plant or Plant(scenario.station)
        parameters = self.plant.parameters() | own
        self.vehicle = Vehicle(parameters, self.settings.clock)
        self.ports = Ports(self.vehicle, ports)
        self.truth = TruthLog(self.plant, scenario.log.rate, self._seen)
        self._record = record
        self.time = 0.0
        self._ticks = 0
        self._motion = self._known()
        self._reboots = sorted(self.settings.reboots)

    def receive(self, port: int, data: bytes) -> None:
        """Take bytes that arrived at a port."""
        self.ports.receive(port, data)

    def step(self) -> list[list[bytes]]:
        """Advance one tick; the packets that go out, port by port."""
        self._ticks += 1
        self.time = self._ticks * TICK
        if self._reboots and self.time >= self._reboots[0]:
            self._reboots.pop(0)
            self.vehicle.reboot()
        period = self.plant.config.period
        while self.plant.time + period <= self.time + 1e-9:
            if self._record:
                self.truth.sample(self.plant.time)
            self.plant.step(self.vehicle.autopilot.outputs.us)
            self._motion = self._known()
        age = max(0.0, self.time - self.plant.time)
        self.vehicle.step(self.time, replace(self._motion, age=age))
        reading = self.plant.dvl() if self.settings.dvl else None
        if reading is not None:
            self._tell_dvl(reading)
        return self.ports.step()

    def _seen(self) -> dict[str, np.ndarray]:
        """Pulse widths, the pilot's channels, voltage, and the autopilot's state."""
        autopilot = self.vehicle.autopilot
        state = [
            autopilot.mode,
            autopilot.armed,
            autopilot.failsafes.any,
            autopilot.pilot.gain,
            self.vehicle.boots,
        ]
        return {
            "pwm": np.array(autopilot.outputs.us[: self.plant.thrusters], float),
            "rc": np.array(autopilot.channels.us, float),
            "voltage": np.array([autopilot.motion.voltage]),
            "autopilot_state": np.array(state, float),
        }

    def _known(self):
        leak = self.settings.leak
        wet = leak is not None and self.time >= leak
        return self.plant.motion(self.vehicle.parameters, wet)

    def _tell_dvl(self, reading: DvlReading) -> None:
        at = round(self.vehicle.boot_us - 1e6 * (self.time - reading.time))
        turned = self._motion.omega_B * reading.dt
        confidence = 100 * (1 - min(max(reading.merit, 0.0), _MOST_MERIT) / _MOST_MERIT)
        moved = reading.v_B * reading.dt
        if at > 0 and np.isfinite(moved).all():
            self.ports.dvl(
                dvl_messages(at, reading.dt, moved, turned, confidence, reading.altitude)
            )
