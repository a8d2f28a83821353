"""Every cause by the name that a diagnosis must give it, and how it is drawn.

`drawn(rng, size)` of a class gives an effect with a random place and sign at `size` times the
realistic size (0.3, 1 and 3 are used; × 0.8 to 1.25).
"""

import numpy as np

from . import effects_actuation as actuation
from . import effects_body as body
from . import effects_disturbance as disturbance
from . import effects_environment as environment
from . import effects_measurement as measurement
from . import effects_unknown as unknown
from .effect import Effect

FAMILIES: dict[str, tuple[type, ...]] = {
    "actuation": (
        actuation.ThrusterLag,
        actuation.ActuationDelay,
        actuation.DeadZone,
        actuation.ThrustAsymmetry,
        actuation.ThrustCurve,
        actuation.ThrusterGain,
        actuation.ThrustScale,
        actuation.VoltageSag,
        actuation.LoadDroop,
        actuation.InflowThrustLoss,
    ),
    "body and water": (
        body.NetBuoyancy,
        body.CentreOfGravity,
        body.Payload,
        body.LinearDrag,
        body.QuadraticDrag,
        body.DragAsymmetry,
        body.DragCoupling,
        body.CubicDrag,
        body.Lift,
        body.AddedMassCoupling,
        body.Proximity,
    ),
    "environment": (
        environment.CurrentSteady,
        environment.CurrentVarying,
        environment.Waves,
        environment.Tether,
    ),
    "disturbance law": (
        disturbance.DisturbanceLevel,
        disturbance.DisturbanceColour,
        disturbance.DisturbanceImpacts,
        disturbance.DisturbanceStateDependence,
    ),
    "measurement": (
        measurement.DvlLeverArm,
        measurement.DvlMisalignment,
        measurement.DvlScale,
        measurement.GyroBias,
        measurement.ClockOffset,
        measurement.HeadingError,
    ),
}
CAUSES: dict[str, type] = {kind.cause: kind for kinds in FAMILIES.values() for kind in kinds}
FAMILY: dict[str, str] = {k.cause: family for family, kinds in FAMILIES.items() for k in kinds}
UNKNOWN: dict[str, type] = {
    "swirl": unknown.Swirl,
    "appendage": unknown.Appendage,
    "memory": unknown.Memory,
    "backlash": unknown.Backlash,
    "slew": unknown.Slew,
    "exchange": unknown.Exchange,
    "steps": unknown.Steps,
    "course": unknown.Course,
}


def draw_effect(name: str, rng: np.random.Generator, size: float = 1.0) -> Effect:
    """An effect of a cause (or of a kind of `UNKNOWN`) with random place, sign and size."""
    return (CAUSES | UNKNOWN)[name].drawn(rng, size)
