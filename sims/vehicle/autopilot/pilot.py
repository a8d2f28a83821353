"""MANUAL_CONTROL: a joystick's axes and buttons as overrides of the channels."""

from typing import NamedTuple

from .channels import FORWARD, LATERAL, PITCH, ROLL, THROTTLE, YAW, Channels
from .parameters import Parameters

NONE, SHIFT, ARM_TOGGLE, ARM, DISARM = range(5)
MODE_BUTTONS = {5: 19, 6: 0, 7: 2, 8: 16, 9: 3, 10: 7, 11: 4, 12: 1, 13: 21}
"""Mode that a button's function sets."""
_GAIN_TOGGLE, _GAIN_UP, _GAIN_DOWN = 41, 42, 43
_TRIMS = {44: (1, 10), 45: (1, -10), 46: (0, 10), 47: (0, -10)}  # (pitch or roll, µs)
_HOLD, _ROLL_PITCH = 48, 49
_FULL = 400  # µs
_MOST_TRIM = 200  # µs


class Sticks(NamedTuple):
    """Fields of MANUAL_CONTROL that the vehicle reads."""

    x: int = 0
    y: int = 0
    z: int = 500
    r: int = 0
    buttons: int = 0
    buttons2: int = 0
    s: int = 0
    t: int = 0


class Pilot:
    """The pilot's gain, trims and held inputs.

    x, y, z, r are scaled by the gain; s (pitch) and t (roll) are µs as they are. A field has no
    range of its own: the pulse width is clipped to 1100 … 1900, so 32767 is full on any axis.
    """

    def __init__(self, parameters: Parameters):
        self._parameters = parameters
        self.gain = max(0.1, min(1.0, self._default_gain()))
        self.holding = False
        self.roll_pitch = False
        self.texts: list[str] = []
        self._trim = [0, 0]  # pitch, roll
        self._held = (0, 0, 0)  # x, y, z about neutral
        self._last = (0, 0, 500)
        self._centred = True  # sticks were back in the middle since inputs were held
        self._pressed = 0
        self._low_gain = False

    def _default_gain(self) -> float:
        p = self._parameters
        low, high, default = p["JS_GAIN_MIN"], p["JS_GAIN_MAX"], p["JS_GAIN_DEFAULT"]
        steps = max(1, p.integer("JS_GAIN_STEPS"))
        if steps == 1 or low - 0.01 < default < high + 0.01:
            return max(low, min(high, default))
        return low + (steps // 2 - 1) * (high - low) / (steps - 1)

    def fly(self, sticks: Sticks, channels: Channels, t: float, armed: bool) -> list[int]:
        """Write the overrides; returns functions of the buttons pressed: arming and modes."""
        p = self._parameters
        actions = self._press(sticks.buttons | sticks.buttons2 << 16, armed)
        scale = 0.4 * self.gain
        lift = 0.8 * self.gain * p["JS_THR_GAIN"]
        if self.roll_pitch:
            self._trim = [int(-sticks.x * scale), int(sticks.y * scale)]
        x, y, z = sticks.x, sticks.y, sticks.z
        held = self._held
        if not self._centred:
            self._centred = abs(z - 500) < 50 and abs(y) < 50 and abs(x) < 50
            x, y, z = 0, 0, 500
        surge, sway, heave = x + held[0], y + held[1], z + held[2]
        if self.roll_pitch:
            surge, sway = held[0], held[1]
        for channel, us in (
            (PITCH, sticks.s + self._trim[0] + 1500),
            (ROLL, sticks.t + self._trim[1] + 1500),
            (THROTTLE, heave * lift + int(1500 - 500 * lift)),
            (YAW, sticks.r * scale + 1500),
            (FORWARD, surge * scale + 1500),
            (LATERAL, sway * scale + 1500),
        ):
            whole = int(us + 1e-6) if us > 0 else int(us)
            channels.override(channel, max(1500 - _FULL, min(1500 + _FULL, whole)), t)
        self._last = (sticks.x, sticks.y, sticks.z)
        return actions

    def clear_hold(self) -> None:
        """Forget held inputs, as disarming does."""
        self._held, self.holding = (0, 0, 0), False

    def clear_trim(self) -> None:
        """Forget the trims of pitch and roll."""
        self._trim = [0, 0]

    def _press(self, buttons: int, armed: bool) -> list[int]:
        """Act on the buttons' functions; a held button acts once, but for arming and modes."""
        p = self._parameters
        down = [i for i in range(32) if buttons >> i & 1]
        shift = any(p.integer(f"BTN{i}_FUNCTION") == SHIFT for i in down)
        kind = "SFUNCTION" if shift else "FUNCTION"
        actions = []
        for i in down:
            function = p.integer(f"BTN{i}_{kind}")
            new = not self._pressed >> i & 1
            if function in (ARM_TOGGLE, ARM, DISARM) or function in MODE_BUTTONS:
                actions.append(function)
            elif function in _TRIMS:
                axis, us = _TRIMS[function]
                self._trim[axis] = max(-_MOST_TRIM, min(_MOST_TRIM, self._trim[axis] + us))
            elif new:
                self._press_once(function, armed)
        self._pressed = buttons
        return actions

    def _press_once(self, function: int, armed: bool) -> None:
        p = self._parameters
        if function == _GAIN_TOGGLE:
            self._low_gain = not self._low_gain
            self.gain = 0.5 if self._low_gain else 1.0
            self.texts.append(f"#Gain: {100 * self.gain:.0f}%")
        elif function in (_GAIN_UP, _GAIN_DOWN):
            low = max(0.1, min(0.8, p["JS_GAIN_MIN"]))
            high = max(low, min(1.0, p["JS_GAIN_MAX"]))
            steps = max(1, min(10, p.integer("JS_GAIN_STEPS")))
            if steps == 1:
                changed = p["JS_GAIN_DEFAULT"]
            else:
                step = (high - low) / (steps - 1)
                changed = self.gain + (step if function == _GAIN_UP else -step)
            self.gain = max(low, min(high, changed))
            self.texts.append(f"#Gain is {100 * self.gain:.0f}%")
        elif function == _HOLD and armed:
            x, y, z = self._last
            near = [x, y, z - 500]
            self._held = tuple(v if abs(v) > 50 else 0 for v in near)  # pyright: ignore
            was, self.holding = self.holding, any(self._held)
            if self.holding:
                self.texts.append("#Input Hold Set")
            elif was:
                self.texts.append("#Input Hold Disabled")
            self._centred = not self.holding
        elif function == _ROLL_PITCH:
            self.roll_pitch = not self.roll_pitch
