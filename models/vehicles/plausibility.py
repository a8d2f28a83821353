"""Numbers of a vehicle that contradict each other or physics: a wrong unit, sign or axis.

Bounds are what no vehicle meets, not what is usual: each leaves room for coarse models and excludes
the units that are mistaken for SI. A mistake within a bound shows in the fit to data, not here.
"""

from typing import Any

import numpy as np

from ..config.checks import Within, require
from ..config.errors import FieldError
from ..rigid_body import GRAVITY

DENSITY = Within(900.0, 1300.0)
"""kg/m³. Water at 100 °C has 958, the Dead Sea 1240; g/cm³ are outside."""
LAG = Within(0.0, 10.0)
"""s. The largest propellers speed up within seconds; ms are outside from 11 on."""
DIRECTION = Within(0.01, 10.0)
"""Thrust over that of the common curve. Thrusters of one vehicle differ by less than 100 and 10
times; zero is no thruster, and angles in degrees are outside."""
_WEIGHT = 2.0
"""Weight is m g to 0.3 % anywhere on Earth; the factor leaves room for enclosed water that a model
counts in one of them only. A weight in kg (0.102) or lbf (0.225) is outside, a mass in lb (0.454)
too."""
_BUOYANCY = 4.0
"""Buoyancy over weight, either way. Thrusters of a vehicle that swims carry a fraction of it, and
the heaviest crawlers weigh three times their buoyancy; kg (0.102) and lbf (0.225) are outside."""
_VOLUME = (1e-3, 2.0)
"""Displaced volume over that of the box of `size`. It is at most 1, twice if the box leaves parts
out; open frames and winged gliders have some 0.05. Inches (1.6e-5 of it), cm and mm are outside."""
_REACH = 3.0
"""Distance of a part from Bo, in diagonals of the box. All parts are in the box, and Bo is a point
of the vehicle, or near it; mm and cm are outside."""
_LEAST_CURRENT = 1.0
"""A. A battery that gives less in a short circuit turns no propeller; mΩ are outside."""


def check_mount(mount: Any) -> None:
    """Refuse a thruster's direction and motor that are none.

    Raises:
        UserError: with the field and the remedy.
    """
    require(
        DIRECTION.holds(float(np.linalg.norm(mount.direction))),
        mount,
        "direction",
        "give a unit vector; another length, from 0.01 to 10, multiplies the thrust",
    )
    require(abs(mount.motor) == 1, mount, "motor", "give 1, or -1 (MOT_n_DIRECTION)")


def check_battery(propulsion: Any) -> None:
    """Refuse a battery that can't feed a thruster.

    Raises:
        UserError: with the field and the remedy.
    """
    require(propulsion.voltage > 0, propulsion, "voltage", "give a positive voltage (V)")
    most = propulsion.voltage / _LEAST_CURRENT
    require(
        0 <= propulsion.resistance <= most,
        propulsion,
        "resistance",
        f"a battery of {propulsion.voltage:g} V gives no current that turns a propeller above "
        f"{most:g} Ω; give ohms of zero or more, not milliohms",
    )


def check_vehicle(vehicle: Any) -> None:
    """Refuse forces, lengths and inertias that can't be those of one vehicle in water.

    Raises:
        UserError: with the field and the remedy.
    """
    _check_forces(vehicle)
    _check_lengths(vehicle)
    _check_inertia(vehicle)


def _check_forces(vehicle: Any) -> None:
    usual = vehicle.mass * GRAVITY
    require(
        usual / _WEIGHT <= vehicle.weight <= usual * _WEIGHT,
        vehicle,
        "weight",
        f"a mass of {vehicle.mass:g} kg weighs {usual:.4g} N; give the weight in N, and `mass` in "
        "kg",
    )
    require(
        vehicle.weight / _BUOYANCY <= vehicle.buoyancy <= vehicle.weight * _BUOYANCY,
        vehicle,
        "buoyancy",
        f"a vehicle of {vehicle.weight:g} N can't swim with it; give the buoyancy in N",
    )


def _check_lengths(vehicle: Any) -> None:
    volume = vehicle.buoyancy / (vehicle.water_density * GRAVITY)
    box, (least, most) = float(np.prod(vehicle.size)), _VOLUME
    require(
        least * box <= volume <= most * box,
        vehicle,
        "size",
        f"a box of {box:.3g} m³ is not that of a vehicle whose buoyancy displaces {volume:.3g} m³; "
        "give length, width and height in m",
    )
    diagonal = float(np.linalg.norm(vehicle.size))
    places: dict[tuple[str | int, ...], tuple[float, ...]]
    places = {(name,): getattr(vehicle, name) for name in ("center_of_mass", "center_of_buoyancy")}
    for k, mount in enumerate(vehicle.propulsion.mounts):
        places["propulsion", "mounts", k, "position"] = mount.position
    for path, position in places.items():
        away = float(np.linalg.norm(position))
        if away > _REACH * diagonal:
            _refuse(
                path,
                f"is {position!r}: that is {away:.3g} m from Bo, and the diagonal of `size` is "
                f"{diagonal:.3g} m; give metres",
            )
    apart = np.subtract(vehicle.center_of_buoyancy, vehicle.center_of_mass)
    require(
        float(np.linalg.norm(apart)) <= diagonal,
        vehicle,
        "center_of_buoyancy",
        f"it is {np.linalg.norm(apart):.3g} m from the centre of mass, and the diagonal of `size` "
        f"is {diagonal:.3g} m; give metres",
    )


def _check_inertia(vehicle: Any) -> None:
    """No part is farther from the centre of mass than the diagonal: I ≤ m d²."""
    most = vehicle.mass * float(np.dot(vehicle.size, vehicle.size))
    require(
        max(vehicle.inertia) <= most,
        vehicle,
        "inertia",
        f"no body of this mass and size has moments above {most:.3g} kg·m²; give kg·m²",
    )


def check_upright(vehicle: Any) -> None:
    """Refuse a vehicle that turns over, as nothing it has holds it upright.

    With the centre of buoyancy below that of mass roll and pitch are unstable. Thrusters can
    stabilise them; where they act on one of them not, no such vehicle was ever sailed, and the sign
    is that of an axis which points down.

    Raises:
        UserError: with the field and the remedy.
    """
    falls = [axis for axis in ("roll", "pitch") if axis in vehicle.unactuated]
    if falls and vehicle.top_heavy:
        _refuse(
            ("center_of_buoyancy",),
            f"is {vehicle.center_of_buoyancy!r}: it is below the centre of mass, and the thrusters "
            f"can't hold {' and '.join(falls)}, so the vehicle turns over; z is up, so check the "
            "sign",
        )


def _refuse(path: tuple[str | int, ...], told: str) -> None:
    raise FieldError("Vehicle", path, f"{told}.")
