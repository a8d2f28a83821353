"""The pilot's channels: sixteen pulse widths that overrides write and modes read.

Channels count from 1: pitch, roll, throttle, yaw, forward, lateral, then two of the camera. There
is no radio receiver, so a channel whose override is released or has lapsed keeps its last value.
"""

import math

from .parameters import Parameters

COUNT = 16
PITCH, ROLL, THROTTLE, YAW, FORWARD, LATERAL = range(1, 7)
IGNORE = 65535
_RELEASE_HIGH = 65534  # in channels 9 to 16


class Channels:
    """Overrides and the values that they leave."""

    def __init__(self):
        self.us = [1500] * 8 + [0] * 8
        self._override = [0] * COUNT
        self._since = [-math.inf] * COUNT
        self._new = False

    def override(self, channel: int, us: int, t: float) -> None:
        """Write the override of one channel; 0 releases it."""
        self._override[channel - 1], self._since[channel - 1] = us, t
        self._new = True

    def override_all(self, values: list[int], t: float) -> None:
        """Write RC_CHANNELS_OVERRIDE: the words for ignore and release differ above channel 8."""
        for channel, us in enumerate(values[:COUNT], 1):
            if us == IGNORE or (channel > 8 and us == 0):
                continue
            self.override(channel, 0 if channel > 8 and us == _RELEASE_HIGH else us, t)

    def update(self, t: float, parameters: Parameters) -> bool:
        """Take over the overrides that were written since the last call; False without any."""
        if not self._new:
            return False
        self._new = False
        lasting = parameters["RC_OVERRIDE_TIME"]  # s; negative for ever, zero never
        for i in range(COUNT):
            valid = lasting < 0 or t - self._since[i] < lasting
            if self._override[i] and valid:
                self.us[i] = self._override[i]
        return True

    def neutral(self, parameters: Parameters) -> None:
        """Set the six axes to neutral; overrides that arrive later are taken again."""
        for channel in (PITCH, ROLL, YAW, FORWARD, LATERAL):
            self.us[channel - 1] = parameters.integer(f"RC{channel}_TRIM")
        low, high = parameters["RC3_MIN"], parameters["RC3_MAX"]
        self.us[THROTTLE - 1] = round((low + high) / 2)

    def norm(self, channel: int, parameters: Parameters) -> float:
        """Deflection in [-1, 1] about the trim, linear on either side, without a dead zone."""
        low, trim, high = (parameters[f"RC{channel}_{end}"] for end in ("MIN", "TRIM", "MAX"))
        us = self.us[channel - 1]
        span = trim - low if us < trim else high - trim
        if span <= 0:
            return 0.0
        sign = -1.0 if parameters[f"RC{channel}_REVERSED"] else 1.0
        return sign * max(-1.0, min(1.0, (us - trim) / span))

    def throttle(self, parameters: Parameters) -> float:
        """Vertical demand in [-1, 1], up, about the middle of channel 3.

        RC3_TRIM is its lower end on this version and is not its neutral.
        """
        low, high = parameters["RC3_MIN"], parameters["RC3_MAX"]
        if high <= low:
            return 0.0
        up = 2 * (self.us[THROTTLE - 1] - low) / (high - low) - 1
        return max(-1.0, min(1.0, -up if parameters["RC3_REVERSED"] else up))
