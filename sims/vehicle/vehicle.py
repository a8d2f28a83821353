"""The vehicle as its links see it: an autopilot, its motion, its clock and its reboots."""

import uuid
from collections.abc import Mapping

from ...systems.mavlink.dialect import Message
from .autopilot.autopilot import Autopilot
from .autopilot.navigation import Motion
from .autopilot.parameters import Parameters
from .telemetry.messages import Place


class Vehicle:
    """An autopilot from boot to boot.

    `step` takes the time of the simulation; the autopilot's own begins anew with each boot. Its
    boot clock shows `clock` (s) at the boot, so that its 32 bits can be made to overflow at will.
    `serial_number` (16 bytes) is no other vehicle's.
    """

    def __init__(self, parameters: Mapping[str, float | int] | None = None, clock: float = 0.0):
        """Boot at time 0.

        Raises:
            UserError: there is no such parameter.
        """
        self.parameters = Parameters(parameters)
        self.time = 0.0
        self.boots = 0
        self.serial_number = uuid.uuid4().bytes
        self.origin: Place | None = None
        self.frozen_alt = 0.0
        self.broadcast: list[Message] = []
        self._clock = clock
        self._wants_reboot = False
        self._boot()

    def _boot(self) -> None:
        self.autopilot = Autopilot(self.parameters)
        self._booted_at = self.time
        self.origin, self.frozen_alt = None, 0.0
        self.boots += 1

    @property
    def motion(self) -> Motion:
        """What the autopilot knows of the motion."""
        return self.autopilot.motion

    @property
    def boot_us(self) -> int:
        """The boot clock (µs), without the limit of a message's field."""
        return round(1e6 * (self.autopilot.t + self._clock))

    def reboot(self) -> None:
        """Boot anew with the next step; parameters stay."""
        self._wants_reboot = True

    def step(self, time: float, motion: Motion) -> list[int]:
        """Advance the simulation's time; returns the servo outputs (µs)."""
        self.time = time
        if self._wants_reboot:
            self._wants_reboot, self._clock = False, 0.0
            self._boot()
        outputs = self.autopilot.step(time - self._booted_at, motion)
        if self.autopilot.aid.valid(self.autopilot.t):
            self.frozen_alt = motion.height
        return outputs
