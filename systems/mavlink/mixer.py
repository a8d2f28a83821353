"""ArduSub's mixer and its inverse: axis demands whose outputs give a wanted wrench.

The autopilot mixes six demands linearly into outputs, and thrust is not linear in the output: the
force of a T200 grows about with the square beyond a dead band. An axis demand in proportion to the
wrench therefore gives another wrench, in size and, where thrusters run at different speeds, in
direction. `AxisInverse` solves B f(A d) = F for the demands d.

Signs are those that were measured on ArduSub 4.5.6, each thruster driven alone, in body axes here
(forward, left, up).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.config.errors import UserError
from ...models.thruster_curves import NEUTRAL
from ...models.thrusters import Thrusters

FULL = 400.0
"""Pulse width (µs) from 1500 to a full demand."""
_HORIZONTALS = (
    (-1, -1, 0, 0, 0, -1),
    (-1, 1, 0, 0, 0, 1),
    (1, -1, 0, 0, 0, 1),
    (1, 1, 0, 0, 0, -1),
)
_FACTORS = {
    1: (*_HORIZONTALS, (0, 0, -1, 1, 0, 0), (0, 0, -1, -1, 0, 0)),
    2: (
        *_HORIZONTALS,
        (0, 0, -1, 1, 1, 0),
        (0, 0, -1, -1, 1, 0),
        (0, 0, -1, 1, -1, 0),
        (0, 0, -1, -1, -1, 0),
    ),
}
FRAMES = {1: "vectored", 2: "vectored_6dof"}
"""Names of FRAME_CONFIG's numbers that have a mixer here."""

_BLEND = 0.7 ** np.arange(4, 30)  # shares of a linear curve, which has no dead band, by rounds
_DAMPING = 10.0 ** np.arange(-8.0, 3.0, 2.0)  # tried together in each round


def mixer_factors(frame: int) -> Float[np.ndarray, "n 6"]:
    """A with u = A d: outputs in [−1, 1] from demands about B's axes.

    Raises:
        UserError: FRAME_CONFIG is a frame without a mixer here.
    """
    if frame not in _FACTORS:
        names = ", ".join(f"{number} ({name})" for number, name in FRAMES.items())
        raise UserError(
            f"FRAME_CONFIG is {frame}, a frame whose mixer is not known here; it may be {names}, "
            "or use actuation: thruster_passthrough"
        )
    return np.array(_FACTORS[frame], float)


class Demand(NamedTuple):
    """Axis demands and what they do."""

    demand: Float[Array, "6"]
    """Surge, sway, heave, roll, pitch, yaw about B, in [−1, 1]."""
    pwm: Float[Array, " n"]
    """Outputs of the autopilot (µs), as in SERVO_OUTPUT_RAW."""
    F_Bo_B: Float[Array, "6"]
    """The wrench that these outputs give (N, N·m)."""


class AxisInverse(eqx.Module):
    """Inverse of mixer and thrust curve for one vehicle.

    An axis that the frame cannot actuate (pitch of a vectored frame) is left out: its demand is
    zero. A wrench beyond the limits is scaled down and keeps its direction (`Thrusters.allocate`).
    """

    thrusters: Thrusters
    factors: Float[Array, "n 6"]
    least_squares: Float[Array, "6 n"]
    scale: Float[Array, "6"]
    coupling: float = eqx.field(static=True)
    frame: int = eqx.field(static=True)

    def __init__(self, thrusters: Thrusters, frame: int, coupling: float = 1.0):
        """For a vehicle's thrusters, FRAME_CONFIG and MOT_FV_CPLNG_K.

        Raises:
            UserError: the frame is not known, or has another number of thrusters.
        """
        A = mixer_factors(frame)
        count = thrusters.positions.shape[1]
        if len(A) != count:
            raise UserError(
                f"FRAME_CONFIG {frame} ({FRAMES[frame]}) has {len(A)} thrusters and the scenario's "
                f"vehicle {count}; name the vehicle that is connected (station: vehicle)"
            )
        B = np.asarray(thrusters.allocation, float)
        self.thrusters, self.frame, self.coupling = thrusters, frame, coupling
        self.factors = jnp.asarray(A)
        self.least_squares = jnp.asarray(np.linalg.pinv(A))
        reach = np.abs(B).sum(axis=1)
        actuated = np.abs(A).sum(axis=0) > 0
        self.scale = jnp.asarray(np.where(actuated, 1 / np.maximum(reach, 1e-9), 0.0))

    def outputs(self, demand: Float[Array, "6"]) -> Float[Array, " n"]:
        """Outputs u of the autopilot's mixer, in [−1, 1].

        With eight thrusters, verticals and horizontals are each divided by their largest output
        where that exceeds 1. With six, each is clipped, and the rear horizontals lose forward
        thrust while the verticals work (`coupling`).
        """
        u = self.factors @ demand
        if self.frame == 1:
            surge, most = demand[0], jnp.maximum(1 - self.coupling * jnp.abs(demand[2]), 0)
            cut = jnp.clip(surge, -most, most) - surge
            rear = jnp.sign(self.factors[:, 0]) * jnp.sign(surge) > 0
            return jnp.clip(u + jnp.where(rear, self.factors[:, 0] * cut, 0), -1, 1)
        for group in self.thrusters.groups:
            mine = np.isin(np.arange(len(u)), group)
            u = u / jnp.where(mine, jnp.maximum(jnp.max(jnp.abs(jnp.where(mine, u, 0))), 1), 1)
        return u

    def wrench(self, u: Float[Array, " n"], voltage: Array) -> Float[Array, "6"]:
        """The wrench of outputs u (before a motor's direction)."""
        return self.thrusters.wrench(self.thrusters.curve.force(NEUTRAL + FULL * u, voltage))

    def __call__(
        self, F_Bo_B: Float[Array, "6"], voltage: float | Array, limit: float | Array = 1.0
    ) -> Demand:
        """Demands for a wrench at the battery's present voltage (V).

        `limit` bounds surge, sway, heave and yaw: MANUAL_CONTROL reaches the pilot gain at most.
        """
        volts = jnp.asarray(voltage, float)
        force = self.thrusters.allocate(F_Bo_B, volts)
        F = self.thrusters.wrench(force)
        start = self.least_squares @ ((self.thrusters.curve.pwm(force, volts) - NEUTRAL) / FULL)

        full = self.thrusters.force_limits(volts)[1]

        def step(d: Array, blend: Array) -> tuple[Array, None]:
            def residual(d: Array) -> Array:
                u = self.outputs(d)
                linear = self.thrusters.wrench(full * u)
                return self.scale * ((1 - blend) * self.wrench(u, volts) + blend * linear - F)

            r, J = residual(d), jax.jacfwd(residual)(d)
            JJ, g = J.T @ J, J.T @ r
            size = jnp.trace(JJ) / 6 + 1e-12

            def damped(share: Array) -> Array:
                return d - jnp.linalg.solve(JJ + share * size * jnp.eye(6), g)

            tried = jnp.concatenate([d[None], jax.vmap(damped)(jnp.asarray(_DAMPING))])
            errors = jnp.sum(jax.vmap(residual)(tried) ** 2, axis=1)
            return tried[jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf))], None

        d, _ = jax.lax.scan(step, start, jnp.concatenate([jnp.asarray(_BLEND), jnp.zeros(4)]))
        free = jnp.asarray([True, True, True, False, False, True])
        over = jnp.max(jnp.where(free, jnp.abs(d) / limit, jnp.abs(d)))
        d = d / jnp.maximum(over, 1)
        u = self.outputs(d)
        pwm = NEUTRAL + FULL * self.thrusters.motor_directions * u
        return Demand(d, pwm, self.wrench(u, volts))
