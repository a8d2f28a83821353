"""Depth of a bag: by pressure in any usual unit, or as a number; and whether it is the water's."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ....models.recordings.checks.finding import Finding
from ...mavlink import codec
from ..pressure import Followed, followed
from ..signals import Series
from .messages import PRESSURE
from .quantities import Quantities

FIRST_BAROMETER = "/imu/static_pressure"
"""End of mavros' topic of SCALED_PRESSURE: on a BlueROV2 the barometer in the hull."""
_UNITS = ((1.0, "Pa"), (100.0, "hPa"), (1e3, "kPa"), (1e5, "bar"))
"""Units of pressure in Pa, and their names."""
_LAKE_PA, _AIR_PA, _DEEP_PA = 6e4, 101325.0, 5e5
"""Less than the pressure of the air on the highest lakes, that at sea level, and that of 40 m of
water: in other units than Pa the least pressure of a bag lies between the first and the last."""
_DIVES_PA = 1e6
"""Larger than the changes of pressure in the part of a dive that is looked at: 100 m of water."""
_MOVES_PA, _SURFACE_PA = 1e3, (-3e3, 5e4)
"""Change that a pressure above the air's has at least to count as one, and where its least is."""
_BELOW_M = 0.3
"""A depth that reaches this far above the surface, and mostly is there, has the other sign."""


def unit_of(pressures: Float[np.ndarray, " n"]) -> tuple[float, float, str] | None:
    """Scale and offset that make pressures absolute ones in Pa, and the unit; None if unknown.

    It is the smallest unit in which the least of them is that of the air or of shallow water, and
    in which they change as in a dive; or else they are in Pa above the pressure of the air.
    """
    known = pressures[np.isfinite(pressures)]
    if not known.size:
        return None
    least, most = np.quantile(known, (0.01, 0.99)).tolist()
    if least >= _LAKE_PA:
        return 1.0, 0.0, "Pa"
    for pascal, name in _UNITS[1:]:
        if _LAKE_PA <= least * pascal <= _DEEP_PA and (most - least) * pascal < _DIVES_PA:
            return pascal, 0.0, name
    if _SURFACE_PA[0] < least < _SURFACE_PA[1] and most - least > _MOVES_PA:
        return 1.0, _AIR_PA, "Pa above the air's"
    return None


def is_reversed(depths: Float[np.ndarray, " n"]) -> bool:
    """Whether numbers named a depth are heights: mostly negative, and clearly so."""
    known = depths[np.isfinite(depths)]
    return known.size > 0 and bool(np.median(known) < 0 and known.min() < -_BELOW_M)


def depth(
    taken: Quantities, attitude: Series, known: Mapping[str, float], density: float | None
) -> Series | None:
    """Depth of Bo (m, positive down); `known` are the autopilot's parameters."""
    topic = taken.topic("depth")
    found = taken.taken("depth")
    if topic is None or found is None:
        return None
    if taken.columns[topic.topic].type != PRESSURE:
        return taken.depth(attitude)
    pascal = found[2][0][np.isfinite(found[2][0])]
    if not pascal.size or np.median(pascal) < _LAKE_PA:
        taken.note(
            f"{topic.topic}: its pressures are not absolute ones in Pa, so they were left out; "
            "give `scale` and `offset` (Pa) in a topic map."
        )
        return None
    names = ("BARO2_GND_PRESS", "BARO1_GND_PRESS")
    surface = next((known[n] / 100.0 for n in names if known.get(n)), 0.0)
    surface = surface if 800 < surface < 1200 else codec.SURFACE_PRESSURE_HPA
    gradient = codec.pascal_per_metre(known.get("BARO_SPEC_GRAV", 1.0), density)
    return taken.depth(attitude, 1.0 / gradient, -100.0 * surface)


def may_be_the_hulls(taken: Quantities) -> bool:
    """Whether the depth is of mavros' SCALED_PRESSURE, the autopilot's first barometer."""
    topic = taken.topic("depth")
    return topic is not None and topic.topic.endswith(FIRST_BAROMETER)


def checked(
    taken: Quantities, depth: Series | None, position: Series | None, proposed: bool
) -> tuple[Followed, list[Finding]]:
    """The depth, unless it does not follow the height, or nothing tells that it is the water's.

    A height that rises where the depth grows is a finding: one of them has its axis reversed.
    """
    topic = taken.topic("depth")
    pressed = topic is not None and taken.columns[topic.topic].type == PRESSURE
    found = followed(depth, position, pressed)
    if depth is not None and position is not None and found.opposite:
        return Followed(None, sure=True), [_reversed(depth, position)]
    if found.findings:
        return replace(found, findings=()), list(found.findings)
    if found.depth is None or found.sure or not (proposed and may_be_the_hulls(taken)):
        return found, []
    said = (
        f"{found.depth.source} may be of the barometer in the hull, and no height tells: it was "
        "left out; name it in a topic map (`--topics`) if it is the water's."
    )
    return Followed(None, (said,)), []


def _reversed(depth: Series, position: Series) -> Finding:
    return Finding(
        "wrong-frame",
        f"{position.source}, {depth.source}",
        "the height grows where the depth does, so one of them has z the other way",
        "correct `frame` of the pose (NED/FRD) or `scale` of the depth (-1) in the topic map",
    )
