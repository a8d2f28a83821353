"""The ten feedforward maneuvers of the simulated and ocean data sets (Palmer et al., figure 3).

Each holds one wrench from rest. The paper gives no numbers; these are both directions of surge,
sway and heave, yaw, and three combinations that move every axis. Sizes are fractions of the largest
wrench of the thrusters along each direction.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...models.config.errors import UserError
from ...models.thrusters import Thrusters

MANEUVERS: dict[str, tuple[float, float, float, float, float, float]] = {
    "surge-forward": (1, 0, 0, 0, 0, 0),
    "surge-back": (-1, 0, 0, 0, 0, 0),
    "sway-left": (0, 1, 0, 0, 0, 0),
    "sway-right": (0, -1, 0, 0, 0, 0),
    "heave-up": (0, 0, 1, 0, 0, 0),
    "heave-down": (0, 0, -1, 0, 0, 0),
    "yaw-left": (0, 0, 0, 0, 0, 1),
    "surge-yaw-left": (1, 0, 0, 0, 0, 0.5),
    "surge-sway-heave": (0.7, -0.7, 0.7, 0, 0, 0),
    "heave-roll-pitch": (0, 0, 0.7, 0.1, 0.1, 0),
}
"""Direction of each wrench, in units of the largest one along each single axis.

Without roll and pitch moments only ratios of these axes' inertia, damping, restoring moment and
diffusion are identifiable."""


def maneuver_wrench(
    name: str, thrusters: Thrusters, effort: float
) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, " n"]]:
    """Wrench (N, N·m) and thruster forces (N) of a maneuver at a fraction of full effort.

    The direction is scaled to the largest wrench that respects every thruster's limits, then by
    `effort`; the allocated forces are returned with the wrench that they produce.

    Raises:
        UserError: the name is unknown, the thrusters actuate none of its axes, or `effort` is not
            in (0, 1].
    """
    if name not in MANEUVERS:
        raise UserError(f"maneuver '{name}' is unknown; take one of {', '.join(MANEUVERS)}")
    if not 0 < effort <= 1:
        raise UserError(f"effort is {effort:g}; give more than 0, at most 1")
    direction = np.asarray(MANEUVERS[name], float)
    axes = np.sign(direction)[:, None] * np.eye(6)
    wrench = np.array(
        [
            d * largest(thrusters, axis) if d else 0.0
            for d, axis in zip(direction, axes, strict=True)
        ]
    )
    wrench = np.abs(wrench) * np.sign(direction)
    if not wrench.any():
        axes = " and ".join(thrusters.unactuated)
        raise UserError(f"maneuver '{name}': the thrusters can't actuate {axes}; leave it out")
    most = largest(thrusters, wrench)
    forces = thrusters.allocate(jnp.asarray(effort * most * wrench, thrusters.allocation.dtype))
    return np.asarray(thrusters.wrench(forces), float), np.asarray(forces, float)


def largest(thrusters: Thrusters, direction: Float[np.ndarray, "6"]) -> float:
    """The largest s for which the thrusters can give s · direction."""
    huge = 1e4
    forces = thrusters.allocate(jnp.asarray(huge * direction, thrusters.allocation.dtype))
    given = np.asarray(thrusters.wrench(forces), float)
    return float(given @ direction / (direction @ direction))
