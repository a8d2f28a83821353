"""Three ways to command a wrench: MANUAL_CONTROL, RC overrides, thruster by thruster.

All of them are exact: they invert mixer, pilot gain, motor directions, dead band and thrust curve
at the battery's present voltage, so SERVO_OUTPUT_RAW shows the outputs that `Command.pwm` foresees.

| way | needs | when commands stop |
|---|---|---|
| `manual_control` | mode MANUAL; reaches the pilot gain only (JS_GAIN_DEFAULT) | pilot failsafe |
| `rc_override` | mode MANUAL | pilot failsafe |
| `thruster_passthrough` | SERVOn_FUNCTION borrowed; runs disarmed too | 7 and 8 go on |
"""

import abc
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import integrate
from ...models.config.errors import UserError
from ...models.thrusters import Thrusters
from ..compiled.jit import VectorFunction
from .codec import (
    NEUTRAL_US,
    manual_control_fields,
    rc_override_fields,
    rc_override_passthrough,
)
from .config import Way
from .dialect import Message, mavlink
from .link import Peer
from .mixer import AxisInverse

_RCIN_1 = 51  # SERVOn_FUNCTION that passes RC channel 1 through
_MOST_CHANNELS = 8  # of overrides, without the extension that old autopilots ignore
_ACRO_YAW_P = 3.375  # at this ACRO_YAW_P the mode MANUAL passes yaw through unscaled


class Command(NamedTuple):
    """The message for a wrench, and what it does."""

    message: Message
    pwm: Float[np.ndarray, " n"]
    """Outputs that the vehicle will show (µs)."""
    F_Bo_B: Float[np.ndarray, "6"]
    """The wrench of these outputs (N, N·m)."""


class Actuation(abc.ABC):
    """A way to command; holds constants only."""

    borrowed: Mapping[str, float] = {}
    """Parameters that have to be changed while it is in use."""

    @abc.abstractmethod
    def command(
        self, vehicle: Peer, F_Bo_B: Float[np.ndarray, "6"], voltage: float, gain: float
    ) -> Command:
        """The message that gives a wrench at a battery voltage (V) and a pilot gain.

        A wrench beyond the limits is scaled down.
        """

    @abc.abstractmethod
    def neutral(self, vehicle: Peer) -> Message:
        """The message that stops all thrusters."""


class _ByAxes(Actuation):
    """Through the autopilot's mixer."""

    def __init__(self, thrusters: Thrusters, parameters: Mapping[str, float]):
        """For a vehicle's thrusters and the parameters of the autopilot.

        Raises:
            UserError: the frame is not known or does not fit the thrusters.
        """
        frame = int(parameters.get("FRAME_CONFIG", 2))
        inverse = AxisInverse(
            integrate.cast(thrusters, jnp.float64), frame, parameters.get("MOT_FV_CPLNG_K", 1.0)
        )
        n = thrusters.positions.shape[1]
        self._yaw = parameters.get("ACRO_YAW_P", _ACRO_YAW_P) / _ACRO_YAW_P
        if self._yaw <= 0:
            raise UserError("ACRO_YAW_P is not positive: MANUAL has no yaw; set 3.375")

        def solve(F_Bo_B: Array, voltage: Array, limit: Array) -> tuple[Array, ...]:
            return tuple(inverse(F_Bo_B, voltage[0], limit[0]))

        self._solve = VectorFunction(solve, [6, 1, 1], [6, n, 6])

    def _demand(self, F: np.ndarray, voltage: float, limit: float) -> tuple[np.ndarray, ...]:
        """Demand as it is sent, outputs, wrench."""
        demand, pwm, given = self._solve(F, np.array([voltage]), np.array([limit]))
        sent = np.array(demand)
        sent[5] /= self._yaw
        return sent, np.asarray(pwm), np.asarray(given)


class ManualControl(_ByAxes):
    """MANUAL_CONTROL in the mode MANUAL; roll and pitch are not scaled by the pilot gain."""

    def __init__(self, thrusters: Thrusters, parameters: Mapping[str, float]):
        """As `_ByAxes`; heave is scaled by JS_THR_GAIN too."""
        super().__init__(thrusters, parameters)
        self._lift = parameters.get("JS_THR_GAIN", 1.0)
        if self._lift <= 0:
            raise UserError("JS_THR_GAIN is not positive: MANUAL has no heave; set 1")

    def command(
        self, vehicle: Peer, F_Bo_B: Float[np.ndarray, "6"], voltage: float, gain: float
    ) -> Command:
        """As `Actuation.command`."""
        limit = gain * min(1.0, self._yaw, self._lift)
        demand, pwm, given = self._demand(F_Bo_B, voltage, limit)
        demand[2] /= self._lift
        return Command(_manual(vehicle, manual_control_fields(*demand, gain=gain)), pwm, given)

    def neutral(self, vehicle: Peer) -> Message:
        """As `Actuation.neutral`."""
        return _manual(vehicle, manual_control_fields())


class RcOverride(_ByAxes):
    """RC_CHANNELS_OVERRIDE of channels 1 to 6 in the mode MANUAL."""

    def command(
        self, vehicle: Peer, F_Bo_B: Float[np.ndarray, "6"], voltage: float, gain: float
    ) -> Command:
        """As `Actuation.command`; the pilot gain does not matter."""
        del gain
        demand, pwm, given = self._demand(F_Bo_B, voltage, min(1.0, self._yaw))
        return Command(_overrides(vehicle, rc_override_fields(demand)), pwm, given)

    def neutral(self, vehicle: Peer) -> Message:
        """As `Actuation.neutral`."""
        return _overrides(vehicle, rc_override_fields(np.zeros(6)))


class ThrusterPassthrough(Actuation):
    """RC_CHANNELS_OVERRIDE with SERVOn_FUNCTION RCINn: each thruster's pulse width by itself.

    The mixer, and with it MOT_n_DIRECTION, is out of the way: directions are applied here. So are
    the autopilot's stops: arming, disarming and failsafes do not hold thrusters 7 and 8.
    """

    def __init__(self, thrusters: Thrusters):
        """For a vehicle's thrusters, on outputs 1 to n.

        Raises:
            UserError: there are more thrusters than override channels.
        """
        n = thrusters.positions.shape[1]
        if n > _MOST_CHANNELS:
            raise UserError(
                f"actuation: thruster_passthrough commands {_MOST_CHANNELS} thrusters at most, and "
                f"the vehicle has {n}; take manual_control"
            )
        model = integrate.cast(thrusters, jnp.float64)
        self._n = n
        self.borrowed = {f"SERVO{i}_FUNCTION": float(_RCIN_1 + i - 1) for i in range(1, n + 1)}

        def solve(F_Bo_B: Array, voltage: Array) -> tuple[Array, Array]:
            pwm = model.pwm(model.allocate(F_Bo_B, voltage[0]), voltage[0])
            return pwm, model.wrench(model.force(pwm, voltage[0]))

        self._solve = VectorFunction(solve, [6, 1], [n, 6])

    def command(
        self, vehicle: Peer, F_Bo_B: Float[np.ndarray, "6"], voltage: float, gain: float
    ) -> Command:
        """As `Actuation.command`; the pilot gain does not matter."""
        del gain
        pwm, given = self._solve(F_Bo_B, np.array([voltage]))
        pwm = np.asarray(pwm)
        return Command(_overrides(vehicle, rc_override_passthrough(pwm)), pwm, np.asarray(given))

    def neutral(self, vehicle: Peer) -> Message:
        """As `Actuation.neutral`."""
        return _overrides(vehicle, rc_override_passthrough(np.full(self._n, NEUTRAL_US)))


def make_actuation(way: Way, thrusters: Thrusters, parameters: Mapping[str, float]) -> Actuation:
    """The actuation for a vehicle's thrusters and the autopilot's parameters.

    Raises:
        UserError: the vehicle's frame does not fit, or it has too many thrusters for the way.
    """
    if way == "thruster_passthrough":
        return ThrusterPassthrough(thrusters)
    return (ManualControl if way == "manual_control" else RcOverride)(thrusters, parameters)


def as_wired(
    thrusters: Thrusters, parameters: Mapping[str, float]
) -> tuple[Thrusters, Float[np.ndarray, " n"]]:
    """Thrusters with the vehicle's MOT_n_DIRECTION, and -1 where that differs from theirs, else 1.

    A direction that the vehicle does not tell is theirs.
    """
    own = np.asarray(thrusters.motor_directions, float)
    told = [parameters.get(f"MOT_{n}_DIRECTION", s) for n, s in enumerate(own.tolist(), 1)]
    mirrored = np.where(np.array(told) < 0, -1.0, 1.0) * own
    signs = jnp.asarray(mirrored * own, thrusters.motor_directions.dtype)
    return eqx.tree_at(lambda t: t.motor_directions, thrusters, signs), mirrored


def _manual(vehicle: Peer, fields: Mapping[str, int]) -> Message:
    sticks = {name: fields[name] for name in "xyzr"}
    return mavlink.MAVLink_manual_control_message(
        vehicle.system, **sticks, buttons=0, s=fields["s"], t=fields["t"]
    )


def _overrides(vehicle: Peer, channels: Mapping[str, int]) -> Message:
    return mavlink.MAVLink_rc_channels_override_message(
        vehicle.system, vehicle.component, **channels
    )
