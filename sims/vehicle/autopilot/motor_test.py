"""DO_MOTOR_TEST: one motor at a time, as long as commands come at least twice a second."""

import math

from .outputs import Outputs
from .parameters import Parameters

_TIMEOUT, _COOLING, _RETRY = 0.5, 10.0, 2.0  # s
_PERCENT, _PWM = 0, 1
_BOARD_ORDER = 2
_CRITICAL, _WARNING, _INFO = 2, 4, 6


class MotorTest:
    """Whether a test runs. While one does, the mixer is off and outputs keep what they were told.

    A disarm in mid-test does not end it while commands go on: they are refused, and the outputs
    hold.
    """

    def __init__(self, parameters: Parameters):
        self._parameters = parameters
        self.running = False
        self.texts: list[tuple[int, str]] = []
        self._told = -math.inf
        self._failed = -math.inf
        self._refused = -math.inf

    def command(
        self, t: float, params: tuple[float | int, ...], armed: bool, outputs: Outputs, motors: int
    ) -> bool:
        """Take a command with its parameters 1 to 7; whether it is accepted."""
        self._told = t
        if not self.running and not self._begin(t, armed, outputs, motors):
            return False
        motor, kind, value, *_ = params
        if int(params[5]) != _BOARD_ORDER:
            self.texts.append((_WARNING, f"bad test type {params[5]:.2f}"))
            return False
        if kind == _PERCENT:
            low, high = self._parameters["RC3_MIN"], self._parameters["RC3_MAX"]
            value = low + max(0.0, min(100.0, value)) / 100 * (high - low)
        elif kind != _PWM:
            self.texts.append((_WARNING, f"bad throttle type {kind:.2f}"))
            return False
        if not armed or not 0 <= int(motor) < motors or not math.isfinite(value):
            return False
        outputs.set_motor(t, int(motor), int(value))
        return True

    def step(self, t: float) -> bool:
        """Whether the test has timed out now, which disarms."""
        if not self.running or t <= self._told + _TIMEOUT:
            return False
        self.running, self._failed = False, t
        self.texts.append((_INFO, "Motor test timed out!"))
        return True

    def _begin(self, t: float, armed: bool, outputs: Outputs, motors: int) -> bool:
        if t < self._refused + _RETRY:
            return False
        if t < self._failed + _COOLING:
            self.texts.append((_CRITICAL, "10 second cooldown required after motor test"))
        elif not armed:
            self.texts.append((_WARNING, "Arm motors before testing motors."))
        else:
            outputs.rest(t, motors)
            self.running = True
            return True
        self.texts.append((_WARNING, "motor test initialization failed!"))
        self._refused = t
        return False
