"""The servo outputs: what each of sixteen carries, by its SERVOn_FUNCTION.

Functions 33 to 40 and 82 to 85 are the mixer's motors; 1 and 51 to 66 pass a pilot's channel
through, armed or not and without a limit; 0 keeps what it was last told, by DO_SET_SERVO say.
"""

import math

from .channels import Channels
from .mixer import NEUTRAL
from .parameters import Parameters

COUNT = 16
MOTORS = (*range(33, 41), *range(82, 86))
_SAME, _FIRST_INPUT, _LAST_INPUT = 1, 51, 66
_REREAD = 1.0  # s between looks at the functions


class Outputs:
    """Pulse widths of the outputs; a changed function acts within a second."""

    def __init__(self, parameters: Parameters):
        self.us = [0] * COUNT
        self._parameters = parameters
        self._functions: list[int] = []
        self._read_at = -math.inf

    def step(self, t: float, channels: Channels, motors: list[int]) -> None:
        """Refresh motors and pass-through."""
        self._reread(t)
        for i, function in enumerate(self._functions):
            if function in MOTORS:
                motor = MOTORS.index(function)
                if motor < len(motors):
                    self.us[i] = motors[motor]
            elif function == _SAME:
                self.us[i] = channels.us[i]
            elif _FIRST_INPUT <= function <= _LAST_INPUT:
                self.us[i] = channels.us[function - _FIRST_INPUT]

    def set_motor(self, t: float, motor: int, us: int) -> None:
        """Write the outputs of one motor (from 0), as the motor test does."""
        self._reread(t)
        for i, function in enumerate(self._functions):
            if function == MOTORS[motor]:
                self.us[i] = us & 0xFFFF

    def rest(self, t: float, motors: int) -> None:
        """Set all motors to neutral."""
        for motor in range(motors):
            self.set_motor(t, motor, NEUTRAL)

    def set_servo(self, t: float, number: int, us: int) -> bool:
        """Write one output (from 1); False if its function has another owner."""
        self._reread(t)
        if not 1 <= number <= COUNT:
            return False
        function = self._functions[number - 1]
        free = function in (0, _SAME) or _FIRST_INPUT <= function <= _LAST_INPUT
        if free:
            self.us[number - 1] = us & 0xFFFF
        return free

    def _reread(self, t: float) -> None:
        if t - self._read_at >= _REREAD:
            self._read_at = t
            read = self._parameters.integer
            self._functions = [read(f"SERVO{n}_FUNCTION") for n in range(1, COUNT + 1)]
