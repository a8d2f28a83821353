"""Modes: which are refused, and the demands of those that fly.

MANUAL passes the sticks on. STABILIZE holds the attitude that they ask for, ALT_HOLD the depth as
well, SURFACE rises, POSHOLD also holds the horizontal position, ACRO turns the sticks into rates.
The loops are the autopilot's cascades (angle, rate; position, velocity, acceleration) with its
gains, without its shaping of the targets and without filters. GUIDED, CIRCLE, AUTO and
MOTOR_DETECT are always refused: nothing here flies them.
"""

import math
from dataclasses import dataclass

import numpy as np

from ....systems.mavlink import codec
from .channels import FORWARD, LATERAL, PITCH, ROLL, YAW, Channels
from .mixer import Demands
from .navigation import Aid, Motion
from .parameters import Parameters

STABILIZE, ACRO, ALT_HOLD, SURFACE, POSHOLD, MANUAL, SURFTRAK = 0, 1, 2, 9, 16, 19, 21
REQUIRES_POSITION = (3, 4, 7, SURFACE, POSHOLD)
_NOT_FLOWN = (3, 4, 7, 20)
_DEPTH_MODES = (ALT_HOLD, SURFACE, POSHOLD, SURFTRAK)
_USUAL_YAW_P = 3.375  # ACRO_YAW_P at which the yaw stick has its full range in MANUAL
_STOPPING = 0.25  # s after the yaw stick is let go before the heading is held
_LEAST_INPUT = 1e-3
_ACCZ = 0.2  # PSC_ACCZ_… are thousandths of throttle (0 … 1) per cm/s²; demands are in [-1, 1]


def refusal(mode: int, has_position: bool) -> str | None:
    """Why a mode is refused, None if it can be set."""
    if mode not in codec.MODES:
        return f"No such mode {mode}"
    name = codec.mode_name(mode)
    if mode in REQUIRES_POSITION and not has_position:
        return f"Mode change failed: {name} requires position"
    if mode in _NOT_FLOWN:
        return f"Flight mode change failed {name}"
    return None


@dataclass
class _Rate:
    """Rate loop of one axis: P, I with its limit, D on the error."""

    name: str
    integral: float = 0.0
    last: float | None = None

    def step(self, error: float, dt: float, p: Parameters) -> float:
        of = f"ATC_RAT_{self.name}_"
        most = p[of + "IMAX"]
        self.integral = max(-most, min(most, self.integral + p[of + "I"] * error * dt))
        slope = 0.0 if self.last is None else (error - self.last) / dt
        self.last = error
        return p[of + "P"] * error + self.integral + p[of + "D"] * slope


class Controller:
    """The state of the loops; `step` gives the demands of a mode."""

    def __init__(self, parameters: Parameters):
        self._parameters = parameters
        self.reset(None)

    def reset(self, motion: Motion | None) -> None:
        """Start the loops anew, on arming and when the mode changes."""
        self._rates = [_Rate("RLL"), _Rate("PIT"), _Rate("YAW")]
        self._heading = None if motion is None else _euler(motion)[2]
        self._turned = -math.inf
        self._height = None if motion is None else motion.height
        self._lift = 0.0
        self._place: np.ndarray | None = None

    def step(
        self,
        mode: int,
        dt: float,
        t: float,
        channels: Channels,
        gain: float,
        motion: Motion,
        aid: Aid,
    ) -> Demands:
        """Demands at time t; `dt` (s) since the last step."""
        p = self._parameters
        norm = [channels.norm(channel, p) for channel in (ROLL, PITCH, YAW)]
        forward, lateral = (channels.norm(channel, p) for channel in (FORWARD, LATERAL))
        throttle = channels.throttle(p)
        if mode == MANUAL:
            yaw = norm[2] * p["ACRO_YAW_P"] / _USUAL_YAW_P
            return Demands(norm[0], norm[1], yaw, throttle, forward, lateral)
        rates = codec.body_vector(*motion.omega_B)  # forward, right, down
        if mode == ACRO:
            most = math.radians(45 * p["ACRO_RP_P"])
            wanted = [most * norm[0], most * norm[1], self._yaw_rate(channels, gain)]
        else:
            wanted = self._attitude(norm, t, channels, gain, motion)
        roll, pitch, yaw = (
            loop.step(want - float(rate), dt, p)
            for loop, want, rate in zip(self._rates, wanted, rates, strict=True)
        )
        if mode in _DEPTH_MODES:
            throttle = self._depth(mode, throttle, gain, dt, motion)
        if mode == POSHOLD:
            forward, lateral = self._station(forward, lateral, motion, aid)
        return Demands(roll, pitch, yaw, throttle, forward, lateral)

    def _yaw_rate(self, channels: Channels, gain: float) -> float:
        """Yaw rate (rad/s) that the stick asks for, beyond its dead zone."""
        p = self._parameters
        us = channels.us[YAW - 1] - p["RC4_TRIM"]
        dead = p["RC4_DZ"] * gain
        span = (p["RC4_MAX"] if us > 0 else 2 * p["RC4_TRIM"] - p["RC4_MIN"]) - p["RC4_TRIM"]
        beyond = max(0.0, abs(us) - dead) / max(span - dead, 1.0)
        return math.radians(45 * p["ACRO_YAW_P"]) * math.copysign(min(beyond, 1.0), us)

    def _attitude(
        self, norm: list[float], t: float, channels: Channels, gain: float, motion: Motion
    ) -> list[float]:
        """Rates (rad/s) towards the attitude asked for; the heading is held without yaw input."""
        p = self._parameters
        most = math.radians(p["ANGLE_MAX"] / 100)
        tilt = math.hypot(norm[0], norm[1])
        shrink = min(1.0, 1.0 / tilt) if tilt > 0 else 1.0
        roll, pitch, heading = _euler(motion)
        wanted = [
            p[f"ATC_ANG_{name}_P"] * (most * value * shrink - now)
            for name, value, now in (("RLL", norm[0], roll), ("PIT", norm[1], pitch))
        ]
        rate = self._yaw_rate(channels, gain)
        if abs(rate) > _LEAST_INPUT:
            self._heading, self._turned = heading, t
        elif t - self._turned < _STOPPING or self._heading is None:
            self._heading, rate = heading, 0.0
        else:
            off = math.remainder(self._heading - heading, 2 * math.pi)
            limit = math.radians(p["ATC_RATE_Y_MAX"]) or math.inf
            rate = max(-limit, min(limit, p["ATC_ANG_YAW_P"] * off))
        return [*wanted, rate]

    def _depth(self, mode: int, stick: float, gain: float, dt: float, motion: Motion) -> float:
        """Vertical demand that follows the climb rate asked for, and holds the depth without."""
        p = self._parameters
        up = p["PILOT_SPEED_UP"] / 100
        down = p["PILOT_SPEED_DN"] / 100 or up
        dead = p["THR_DZ"] / 500 * gain
        climb = math.copysign(max(0.0, abs(stick) - dead) / max(1 - dead, 1e-3), stick)
        climb *= up if climb > 0 else down
        if mode == SURFACE:
            climb = up
        shallowest = p["SURFACE_DEPTH"] / 100
        target = motion.height if self._height is None else self._height
        target = min(target + climb * dt, max(shallowest, motion.height))
        self._height = max(motion.height - 2.0, min(motion.height + 2.0, target))
        wanted = p["PSC_POSZ_P"] * (self._height - motion.height) + climb
        wanted = max(-down, min(up, wanted))
        acceleration = p["PSC_VELZ_P"] * (wanted - motion.climb)  # m/s²
        self._lift += _ACCZ * p["PSC_ACCZ_I"] * acceleration * dt
        most = p["PSC_ACCZ_IMAX"] / 1000 * 2
        self._lift = max(-most, min(most, self._lift))
        return max(-1.0, min(1.0, _ACCZ * p["PSC_ACCZ_P"] * acceleration + self._lift))

    def _station(
        self, forward: float, lateral: float, motion: Motion, aid: Aid
    ) -> tuple[float, float]:
        """Horizontal demands: the sticks, or a return to where they were let go."""
        p = self._parameters
        if self._place is None or abs(forward) > 0.05 or abs(lateral) > 0.05:
            self._place = aid.p_W.copy()
            return forward, lateral
        speed = p["PSC_POSXY_P"] * (self._place - aid.p_W)
        pull = p["PSC_VELXY_P"] * (speed - aid.v_W) / 5.0
        yaw = codec.yaw_ned_to_enu(_euler(motion)[2])
        c, s = math.cos(float(yaw)), math.sin(float(yaw))
        ahead, left = c * pull[0] + s * pull[1], c * pull[1] - s * pull[0]
        return max(-1.0, min(1.0, ahead)), max(-1.0, min(1.0, -left))


def _euler(motion: Motion) -> tuple[float, float, float]:
    """Roll, pitch and heading (rad) of the autopilot's axes."""
    roll, pitch, yaw = codec.euler_from_attitude(motion.q_WB)
    return float(roll), float(pitch), float(yaw)
