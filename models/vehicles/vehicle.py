"""Parameters of a vehicle: hull, hydrodynamics, thrusters, battery; and the shipped presets.

All coefficients are about Bo in B (forward, left, up). Added mass and damping are diagonal, and are
the positive magnitudes of the SNAME derivatives (X_u̇ and so on, which are negative); a diagonal is
the same in forward-left-up and in forward-starboard-down axes.
"""

import os
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..config.checks import Vector3, Vector6, check_numbers, require
from ..config.errors import FieldError, UserError
from ..config.typed_yaml import load
from ..rigid_body import FossenDynamics, spatial_inertia
from ..thruster_curves import QuadraticCurve, T200Curve
from ..thrusters import MOST, Thrusters
from .plausibility import (
    DENSITY,
    LAG,
    check_battery,
    check_mount,
    check_upright,
    check_vehicle,
)

_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class T200:
    """Blue Robotics T200 (see `thruster_curves.T200Curve`)."""

    def build(self, dtype: jnp.dtype | type) -> T200Curve:
        return T200Curve(dtype)


@dataclass(frozen=True)
class Quadratic:
    """F = `full_force` u|u|, in N at full command; `dead_band` in µs on either side of 1500."""

    full_force: float
    dead_band: float = 25.0

    def __post_init__(self):
        check_numbers(self)
        require(self.full_force > 0, self, "full_force", "give a positive force (N)")
        require(0 <= self.dead_band < 400, self, "dead_band", "give 0 to below 400 µs")

    def build(self, dtype: jnp.dtype | type) -> QuadraticCurve:
        return QuadraticCurve(self.full_force, self.dead_band, dtype)


@dataclass(frozen=True)
class Mount:
    """Position of a thruster (m from Bo) and its force in B per newton of the curve above 1500.

    The length of `direction` is 1, or its thrust over that of the curve.

    `motor` is ArduSub's MOT_n_DIRECTION: -1 where PWM above 1500 turns the propeller backwards.
    """

    position: Vector3
    direction: Vector3
    motor: float = 1.0

    def __post_init__(self):
        check_numbers(self)
        check_mount(self)


@dataclass(frozen=True)
class Propulsion:
    """Thrusters in the autopilot's order; lag (s); open-circuit voltage (V), resistance (Ω)."""

    mounts: tuple[Mount, ...]
    curve: T200 | Quadratic = field(default_factory=T200)
    time_constant: Annotated[float, LAG] = 0.0
    start_delay: Annotated[float, LAG] = 0.0
    voltage: float = 16.0
    resistance: float = 0.0

    def __post_init__(self):
        check_numbers(self)
        check_battery(self)


@dataclass(frozen=True)
class Vehicle:
    """All parameters of a vehicle model; SI units, B forward-left-up, Bo the origin.

    `sources` gives the source of each entry by its path, such as `propulsion.mounts`; [E] marks an
    engineering estimate. The file of every shipped preset has one for every number.

    Example:
        >>> lighter = dataclasses.replace(load_vehicle("bluerov2_heavy"), mass=11.0)
        >>> float(lighter.dynamics().rigid_inertia[0, 0])
        11.0
    """

    name: str
    description: str
    size: Vector3
    mass: float
    inertia: Vector3
    weight: float
    buoyancy: float
    center_of_mass: Vector3
    center_of_buoyancy: Vector3
    added_mass: Vector6
    linear_damping: Vector6
    quadratic_damping: Vector6
    water_density: Annotated[float, DENSITY]
    propulsion: Propulsion
    sources: dict[str, str] = field(default_factory=dict)

    def __post_init__(self):
        check_numbers(self)
        for name in ("mass", "weight", "buoyancy"):
            require(getattr(self, name) > 0, self, name, "give a positive number")
        for name in ("size", "inertia"):
            require(min(getattr(self, name)) > 0, self, name, "give three positive numbers")
        for name in ("added_mass", "linear_damping", "quadratic_damping"):
            require(
                min(getattr(self, name)) >= 0,
                self,
                name,
                "give positive magnitudes, not derivatives",
            )
        a, b, c = sorted(self.inertia)
        require(a + b >= c, self, "inertia", "no body has one moment above the other two together")
        mounts, path = len(self.propulsion.mounts), ("propulsion", "mounts")
        if not 1 <= mounts <= MOST:
            remedy = f"give 1 to {MOST}, in the autopilot's order"
            raise FieldError("Vehicle", path, f"has {mounts} thrusters: {remedy}.")
        check_vehicle(self)
        try:
            self.thrusters()
        except ValueError as error:
            raise FieldError("Vehicle", path, f"can't be used: {error}") from error
        check_upright(self)

    @property
    def top_heavy(self) -> bool:
        """Whether the centre of buoyancy is below the centre of mass: unstable in roll, pitch."""
        return self.center_of_buoyancy[2] < self.center_of_mass[2]

    @property
    def unactuated(self) -> tuple[str, ...]:
        """Axes that its thrusters can't act on independently of the others."""
        return self.thrusters().unactuated

    def limitation(self) -> str:
        """A sentence on the axes that its thrusters can't actuate; empty if there is none."""
        axes = " and ".join(self.unactuated)
        return f"The thrusters of {self.name} can't actuate {axes}." if axes else ""

    def instability(self) -> str:
        """A sentence on the axes that its buoyancy does not restore; empty if there is none."""
        if not self.top_heavy:
            return ""
        return (
            f"{self.name} is unstable in roll and pitch: its centre of buoyancy is below its "
            "centre of mass (z is up)."
        )

    def dynamics(
        self, diffusion: Float[np.ndarray, "6"] | None = None, dtype: jnp.dtype | type = float
    ) -> FossenDynamics:
        """Fossen's model with constant coefficients; `diffusion` b in N√s and N·m√s (0 if None)."""
        return FossenDynamics(
            rigid_inertia=spatial_inertia(
                self.mass, np.array(self.center_of_mass), np.diag(self.inertia)
            ),
            added_mass=np.diag(self.added_mass),
            linear_drag=np.diag(self.linear_damping),
            quadratic_drag=np.diag(self.quadratic_damping),
            weight=self.weight,
            buoyancy=self.buoyancy,
            p_BoBcm_B=np.array(self.center_of_mass),
            p_BoCb_B=np.array(self.center_of_buoyancy),
            diffusion=diffusion,
            dtype=dtype,
        )

    def thrusters(self, dtype: jnp.dtype | type = float) -> Thrusters:
        """The thrusters with their curve, lag and battery."""
        p = self.propulsion
        return Thrusters(
            np.array([mount.position for mount in p.mounts]).T,
            np.array([mount.direction for mount in p.mounts]).T,
            p.curve.build(dtype),
            motor_directions=np.array([mount.motor for mount in p.mounts]),
            time_constant=p.time_constant,
            start_delay=p.start_delay,
            nominal_voltage=p.voltage,
            resistance=p.resistance,
            dtype=dtype,
        )


def vehicle_names() -> tuple[str, ...]:
    """Names of the shipped presets."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_vehicle(name_or_path: str | Path) -> Vehicle:
    """Read a preset by its name, or a vehicle's YAML file by its path (anything with a suffix).

    Raises:
        UserError: there is no such preset or file, or its content is not a vehicle.

    Example:
        >>> load_vehicle("bluerov2_heavy").mass
        13.5
    """
    if isinstance(name_or_path, Path) or Path(name_or_path).suffix:
        if not os.path.exists(name_or_path):  # the name may come from data: name its kind
            raise UserError(
                f"vehicle `{name_or_path}`: there is no such file; name a preset or the path of a "
                ".yaml file"
            )
        return load(Vehicle, name_or_path)
    if name_or_path not in vehicle_names():
        raise UserError(
            f"vehicle `{name_or_path}` is no preset; take one of {', '.join(vehicle_names())}, or "
            "the path of a .yaml file"
        )
    return _preset(str(name_or_path))


@lru_cache
def _preset(name: str) -> Vehicle:
    return load(Vehicle, _FOLDER / f"{name}.yaml")
