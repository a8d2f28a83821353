"""What the autopilot knows of its motion: own sensors, and a horizontal position from outside.

Frames here are the project's (W: east, north, up; B: forward, left, up).
"""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ....systems.mavlink import codec
from .parameters import Parameters

EXTERNAL = 6  # EK3_SRC1_…: external navigation
_SETTLING = 35.0  # s after boot before displacements alone give a position: gyro biases settle
_FUSING = 3.0  # s after boot
_FASTEST, _FARTHEST = 100.0, 1e6  # m/s, m: beyond, a message is damaged
_STALE = 1.0  # s without aid after which there is no position


def _rest() -> Float[np.ndarray, "4"]:
    return np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Motion:
    """Estimates and readings of one instant.

    Attributes:
        q_WB: attitude estimate.
        omega_B: angular rate (rad/s), as the gyroscopes have it.
        f_B: specific force (m/s²), as the accelerometers have it.
        height: estimate of z in W (m), negative under water.
        climb: its rate (m/s).
        pressure: at the depth sensor (Pa above the surface's).
        voltage: of the battery under load (V).
        current: of the battery (A).
        leak: whether the hull's leak sensor is wet.
        age: time since this instant (s): the physics has larger steps than the autopilot.
    """

    q_WB: Float[np.ndarray, "4"] = field(default_factory=_rest)
    omega_B: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    f_B: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, 9.80665]))
    height: float = 0.0
    climb: float = 0.0
    pressure: float = 0.0
    voltage: float = 16.0
    current: float = 0.0
    leak: bool = False
    age: float = 0.0


def rotated(q_WB: Float[np.ndarray, "4"], v_B: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A vector of B in W: v + 2 u × (u × v + w v) for q = (w, u)."""
    w, *u = q_WB.tolist()
    v = v_B.tolist()
    a = [c + w * x for c, x in zip(_cross(u, v), v, strict=True)]
    return np.array([x + 2 * c for x, c in zip(v, _cross(u, a), strict=True)])


def _cross(a: list[float], b: list[float]) -> list[float]:
    """The cross product; NumPy's takes fifty times as long for one vector."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _near(v: np.ndarray, most: float) -> bool:
    """Whether all components are finite and within ± `most`."""
    return bool((np.abs(v) <= most).all())


class Aid:
    """Horizontal position and velocity from messages of a DVL or of another navigation.

    Displacements give a position from `_SETTLING` s after boot, positions at once, velocities alone
    never. The position begins at zero where aiding starts, but for external positions.
    """

    def __init__(self, parameters: Parameters):
        self._parameters = parameters
        p = parameters
        self._on = (
            p.integer("VISO_TYPE") > 0
            and p.integer("EK3_SRC1_POSXY") == EXTERNAL
            and p.integer("EK3_SRC1_VELXY") == EXTERNAL
        )
        self._p_BoD_B = codec.body_vector(*(p[f"VISO_POS_{axis}"] for axis in "XYZ"))
        self.texts: list[str] = []
        self.p_W = np.zeros(2)
        self.v_W = np.zeros(2)
        self._last = -math.inf
        self._aiding = self._fusing = False

    def valid(self, t: float) -> bool:
        """Whether there is a horizontal position at time t."""
        return self._aiding and t - self._last < _STALE

    def displaced(
        self, t: float, dt: float, dp_B: Float[np.ndarray, "3"], confidence: float, motion: Motion
    ) -> None:
        """Take VISION_POSITION_DELTA: the sensor's displacement (m) in B's axes over `dt` s.

        The sensor is at VISO_POS_X, _Y, _Z. Without confidence (in per cent) it is not used.
        """
        known = _near(dp_B, _FASTEST * max(dt, 0.0)) and 0 < dt < 10 and confidence > 0
        if not self._on or not known or t < _FUSING:
            return
        if not self._fusing:
            self._fusing = True
            self._tell("fusing odometry")
        if not self._aiding:
            if t < _SETTLING:
                return
            self._start(np.zeros(2))
        elif t - self._last >= _STALE:
            self._tell("started relative aiding")
        moved = rotated(motion.q_WB, dp_B - np.cross(motion.omega_B, self._p_BoD_B) * dt)[:2]
        self.p_W = self.p_W + moved
        self.v_W = moved / dt
        self._last = t

    def placed(
        self, t: float, p_W: Float[np.ndarray, "3"], v_W: Float[np.ndarray, "3"] | None
    ) -> None:
        """Take ODOMETRY or VISION_POSITION_ESTIMATE: position (m) and velocity (m/s) in W."""
        known = _near(p_W, _FARTHEST) and (v_W is None or _near(v_W, _FASTEST))
        if not self._on or not known or t < _FUSING:
            return
        if not self._aiding:
            self._start(p_W[:2])
        if v_W is not None:
            self.v_W = v_W[:2].copy()
        elif self._last > -math.inf and t > self._last:
            v = (p_W[:2] - self.p_W) / (t - self._last)
            self.v_W = np.clip(v, -_FASTEST, _FASTEST)
        self.p_W, self._last = p_W[:2].copy(), t

    def _start(self, p_W: Float[np.ndarray, "2"]) -> None:
        self._aiding = True
        self.p_W = p_W.copy()
        self._tell("started relative aiding")

    def _tell(self, what: str) -> None:
        self.texts.append(f"EKF3 IMU0 {what}")
