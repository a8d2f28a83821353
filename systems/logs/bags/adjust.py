"""What the numbers of a bag tell of a proposed map: units, signs, and a body with z down."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ....models.recordings.resample import rotations
from .bag import Bag, Column
from .depths import is_reversed, unit_of
from .messages import PRESSURE
from .mounting import Mounts, mounted
from .quantities import attitude_of
from .topics import Frames, Topic, TopicMap

_DOWN = -5.0
"""m/s² along z of a specific force that points down."""
_UPSIDE_DOWN = -0.5
"""Cosine of the tilt from which on a vehicle counts as upside down."""


def adjusted(
    proposed: TopicMap, columns: Mapping[str, Column], bag: Bag, mounts: Mounts
) -> TopicMap:
    """The proposal with mountings, units and signs; the bag's notes say each."""
    used, told = mounted(proposed, columns, mounts, proposed=True)
    for sentence in told:
        bag.note(sentence)
    used = TopicMap(tuple(_measured(one, columns[one.topic], bag) for one in used.topics))
    return _with_gravity(_upright(used, columns, bag), columns, bag)


def _measured(one: Topic, column: Column, bag: Bag) -> Topic:
    if "depth" in one.gives and column.type == PRESSURE:
        unit = unit_of(column.x[0])
        if unit is not None and unit[:2] != (1.0, 0.0):
            scale, offset, name = unit
            bag.note(
                f"{one.topic}: its pressures are taken as {name}, by their size "
                f"(`scale: {scale:g}`, `offset: {offset:g}` in a topic map)."
            )
            return replace(one, scale=scale, offset=offset)
    if "depth" in one.gives and column.type != PRESSURE and is_reversed(column.x[0]):
        bag.note(f"{one.topic}: its negative numbers are taken as heights, positive up.")
        return replace(one, scale=-1.0)
    if "height" in one.gives and "position" in column.form.gives and not one.world_down:
        named = "depth" in one.topic.lower()
        if named and is_reversed(-column.x[column.form.gives["height"]][0]):
            bag.note(f"{one.topic}: its z is taken as a depth, positive down.")
            return replace(one, frame="NED/FRD")
    return one


def _upright(used: TopicMap, columns: Mapping[str, Column], bag: Bag) -> TopicMap:
    """The map with FRD for a body that would else be upside down in NED.

    Simulators and drivers with NED worlds name the body `base_link` without more.
    """
    one = used.of("attitude")
    if one is None or one.frame != "NED/FLU" or not is_upside_down(one, columns[one.topic]):
        return used
    body = _body(columns[one.topic])
    bag.note(
        f"{one.topic}: its body ({body or 'unnamed'}) is taken as FRD, since it would be upside "
        "down as FLU."
    )
    down: Mapping[Frames, Frames] = {"NED/FLU": "NED/FRD", "ENU/FLU": "ENU/FRD"}
    return TopicMap(
        tuple(
            replace(t, frame=down.get(t.frame, t.frame))
            if _body(columns[t.topic]) == body and t.rpy is None
            else t
            for t in used.topics
        )
    )


def _with_gravity(used: TopicMap, columns: Mapping[str, Column], bag: Bag) -> TopicMap:
    """The map with FRD for an accelerometer with z down beside a body in NED/FRD.

    Elsewhere z down may as well be an acceleration of the other sign: that is a finding.
    """
    attitude = used.of("attitude")
    one = used.of("acceleration")
    if one is None or attitude is None or attitude.frame != "NED/FRD":
        return used
    column = columns[one.topic]
    if one.frame != "ENU/FLU" or one.rpy is not None or "attitude" in one.gives:
        return used
    z = column.x[column.form.gives["acceleration"]][2]
    if not np.nanmedian(z) < _DOWN:
        return used
    bag.note(f"{one.topic}: it is taken as FRD, as the vehicle, since its specific force says so.")
    return TopicMap(tuple(replace(t, frame="ENU/FRD") if t is one else t for t in used.topics))


def is_upside_down(one: Topic, column: Column) -> bool:
    """Whether most attitudes of a topic, by its axes, are upside down."""
    q = attitude_of(column.x[column.form.gives["attitude"]], one)
    q = q[:, np.isfinite(q).all(axis=0)]
    return q.size > 0 and bool(np.median(rotations(q).as_matrix()[:, 2, 2]) < _UPSIDE_DOWN)


def _body(column: Column) -> str:
    return column.child or column.frame
