"""From demands on six axes to the pulse widths of the motors, by frame, and the spool-up."""

from typing import NamedTuple

from ....models.config.errors import UserError
from ....systems.mavlink.codec import FRAME_THRUSTERS
from .parameters import Parameters

NEUTRAL = 1500


class Demands(NamedTuple):
    """Demands in [-1, 1]: roll right side down, pitch nose up, yaw right, then up, forward, right.

    The order is that of a motor's factors.
    """

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    throttle: float = 0.0
    forward: float = 0.0
    lateral: float = 0.0


class Frame(NamedTuple):
    """A frame: its name, and for each motor the factors of the six demands."""

    name: str
    factors: tuple[tuple[float, ...], ...]


_HORIZONTALS = (
    (0, 0, 1, 0, -1, 1),
    (0, 0, -1, 0, -1, -1),
    (0, 0, -1, 0, 1, 1),
    (0, 0, 1, 0, 1, -1),
)
FRAMES = {
    0: Frame(
        "BLUEROV1",
        (
            (0, 0, -1, 0, 1, 0),
            (0, 0, 1, 0, 1, 0),
            (-0.5, 0.5, 0, 0.45, 0, 0),
            (0.5, 0.5, 0, 0.45, 0, 0),
            (0, -1, 0, 1, 0, 0),
            (-0.25, 0, 0, 0, 0, 1),
        ),
    ),
    1: Frame("VECTORED", (*_HORIZONTALS, (1, 0, 0, -1, 0, 0), (-1, 0, 0, -1, 0, 0))),
    2: Frame(
        "VECTORED_6DOF",
        (
            *_HORIZONTALS,
            (1, -1, 0, -1, 0, 0),
            (-1, -1, 0, -1, 0, 0),
            (1, 1, 0, -1, 0, 0),
            (-1, 1, 0, -1, 0, 0),
        ),
    ),
}
"""FRAME_CONFIG. A motor's PWM above 1500 is a positive sum of demands times factors."""

_COUPLED = (-1, -1, 1, 1)  # the sense of forward thrust in which a horizontal is the rear one


def frame_for(thrusters: int) -> int:
    """FRAME_CONFIG of a vehicle with six or eight thrusters in ArduSub's order.

    Raises:
        UserError: it has another number of thrusters.
    """
    fitting = [frame for frame, count in FRAME_THRUSTERS.items() if count == thrusters]
    if not fitting:
        raise UserError(
            f"the vehicle has {thrusters} thrusters: the simulated autopilot flies six (frame "
            "VECTORED) or eight (VECTORED_6DOF)"
        )
    return fitting[0]


def mix(parameters: Parameters, frame: int, demands: Demands, most_throttle: float) -> list[int]:
    """Pulse widths (µs) of the frame's motors; the vertical demand is limited to `most_throttle`.

    On VECTORED_6DOF the verticals, and the horizontals, are each divided by their own maximum when
    it passes 1; elsewhere each motor is clipped by itself. On VECTORED the rear horizontals lose
    forward thrust while the verticals work (MOT_FV_CPLNG_K).
    """
    up = max(-most_throttle, min(most_throttle, demands.throttle))
    demands = demands._replace(throttle=up)
    factors = FRAMES[frame].factors
    if frame == 2:
        vertical = _groups(factors, demands, (0, 1, 3))
        level = _groups(factors, demands, (2, 4, 5))
        most = (max(1.0, *map(abs, vertical)), max(1.0, *map(abs, level)))
        sums = [v / most[0] + h / most[1] for v, h in zip(vertical, level, strict=True)]
    else:
        sums = _groups(factors, demands, range(6))
        if frame == 1:
            sums = _decoupled(factors, demands, sums, parameters["MOT_FV_CPLNG_K"])
    upper = parameters.integer("MOT_PWM_MAX") - NEUTRAL
    lower = NEUTRAL - parameters.integer("MOT_PWM_MIN")
    widths = []
    for i, value in enumerate(sums, 1):
        u = max(-1.0, min(1.0, parameters[f"MOT_{i}_DIRECTION"] * value))
        widths.append(int(NEUTRAL + u * (upper if u > 0 else lower)))
    return widths


def _groups(factors, demands: Demands, axes) -> list[float]:
    return [sum(motor[axis] * demands[axis] for axis in axes) for motor in factors]


def _decoupled(factors, demands: Demands, sums: list[float], coupling: float) -> list[float]:
    most = max(0.0, 1 - coupling * abs(demands.throttle))
    forward = demands.forward
    limited = max(-most, min(most, forward))
    out = list(sums)
    for i, sense in enumerate(_COUPLED):
        if forward and (forward < 0) == (sense < 0):
            out[i] += factors[i][4] * (limited - forward)
    return out


class Spool:
    """The stages after arming: motors at rest for MOT_SPOOL_TIME, then a rising limit on throttle.

    The limit ends as soon as it no longer cuts the demand, horizontal thrusters have none.
    """

    def __init__(self):
        self._spun = 0.0
        self._limit = 0.0
        self._free = False

    def step(self, dt: float, armed: bool, parameters: Parameters, throttle: float) -> float | None:
        """Limit of the vertical demand, None while the motors rest; `throttle` in [-1, 1]."""
        if not armed:
            self._spun, self._limit, self._free = 0.0, 0.0, False
            return None
        step = dt / max(parameters["MOT_SPOOL_TIME"], 0.05)
        if self._free:
            return 1.0
        if self._spun < 1.0 - 1e-9:
            self._spun += step
            return None
        self._limit += step
        if self._limit >= min((throttle + 1) / 2, 1.0) - 1e-9:
            self._free = True
            return 1.0
        return self._limit
