"""From the topics of a bag to signals, which then go the way of every log."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ....models.config.errors import UserError
from ....models.recordings.checks.finding import Finding
from ....models.vehicles.vehicle import load_vehicle
from ..depth import in_water
from ..log_bytes import Progress, no_progress
from ..signals import (
    Parameter,
    Series,
    Signals,
    Spans,
    parameters_of,
    sampled_spans,
    series,
    undelayed,
    witnessed_spans,
)
from ..streams import UNAIDED, missing_states
from ..wiring import PRESETS, Wiring, direction_findings, thruster_outputs, wiring
from .axes import axes_findings, velocity_axes
from .bag import Bag, Column, open_bag
from .clocks import Clock
from .depths import checked, depth, may_be_the_hulls
from .left_out import left_out
from .messages import COMMANDS, SAMPLED, Quantity
from .mounting import mounted, read_mounts
from .propose import listed, propose
from .quantities import Quantities, derivative, turning
from .topics import Topic, TopicMap, beside, load_map

_TURNED, _MOVED_M = 0.2, 0.1
"""rad and m of a motion that a field shows if anybody fills it."""
_HOW = "name one in a topic map (`spinndrift import BAG --topics`)"


def read_bag(
    path: Path,
    topics: Path | None = None,
    vehicle: str | None = None,
    density: float | None = None,
    progress: Progress = no_progress,
) -> Signals:
    """Read a bag by a topic map: `topics`, the one beside the bag, or else the proposed one.

    `vehicle` and `density` are those of `import_log`.

    Raises:
        UserError: the bag or the map can't be read, or attitude or commands are not in the bag.
    """
    with open_bag(path) as bag:
        topics = topics or beside(path)
        given = None if topics is None else load_map(topics, bag)
        told = [] if topics is None else [f"Topics by {topics.name}."]
        try:
            used = propose(bag) if given is None else given
            columns = bag.read([one.topic for one in used.topics], progress)
            if given is not None:
                used, mounts = mounted(used, columns, read_mounts(bag))
                told += mounts
            found = _signals(bag, used, columns, vehicle, density, given is None)
        except UserError as error:
            raise UserError(f"{path}: {error}") from error
        return replace(found, notes=(*bag.notes, *told, *found.notes))


def _signals(
    bag: Bag,
    used: TopicMap,
    columns: Mapping[str, Column],
    vehicle: str | None,
    density: float | None,
    proposed: bool,
) -> Signals:
    taken, attitude = _reference(bag, used, columns)
    first, last = float(attitude.t[0]), float(attitude.t[-1])
    parameters, strange = _parameters(taken)
    known = {p.name: p.value for p in parameters}
    outputs, command, wired, wire_notes, frame = _outputs(
        bag, taken, parameters, (first, last), vehicle
    )
    place = _place(taken, attitude)
    if proposed:
        taken = _by_motion(taken, attitude, place)
    position, velocity, motion_notes = _motion(taken, attitude, proposed)
    rates = taken.rates(attitude)
    if rates is None:
        rates = turning(attitude)
        motion_notes.append(f"{attitude.source}: body rates are differences of the attitude.")
    _check_turning(attitude, rates)
    rates, force, delays = _undelayed(taken, rates, known)
    if _same(taken.topic("parameters"), taken.topic("position")):
        position, velocity = in_water(position, velocity, known, density)
    below, reversed_ = checked(taken, depth(taken, attitude, known, density), position, proposed)
    spans = {"wiring": wired.spans, **_states(taken), **_aiding(taken, velocity)}
    voltage = _voltage(taken)
    batteries = [one.topic for one in (taken.topic("voltage"),) if one is not None]
    findings = [*frame, *axes_findings(taken, attitude, place, force), *reversed_]
    findings += missing_states(spans, voltage, batteries, "mavros_msgs/State")
    findings += [*left_out(columns), *taken.clock.findings, *direction_findings(wired)]
    return Signals(
        attitude=attitude,
        rates=rates,
        outputs=outputs,
        command=command,
        held=columns[outputs.source].type not in SAMPLED,
        position=position,
        velocity=velocity,
        specific_force=force,
        pressure_depth=below.depth,
        voltage=voltage,
        rc=_rc(taken),
        spans=spans,
        cuts=(*((t, "step back of the clock") for t in taken.clock.cuts), *wired.cuts),
        notes=(*taken.told, *strange, *wire_notes, *motion_notes, *delays, *below.told),
        findings=tuple(findings),
        **_wired(wired, command, columns[outputs.source]),
    )


def _reference(
    bag: Bag, used: TopicMap, columns: Mapping[str, Column]
) -> tuple[Quantities, Series]:
    """The quantities on the clock of the attitude, and the attitude."""
    reference = used.of("attitude")
    if reference is None or reference.topic not in columns:
        raise UserError(f"no topic tells the attitude ({listed(bag)}); {_HOW}")
    taken = Quantities(columns, used, Clock(columns[reference.topic]))
    attitude = taken.attitude()
    if attitude is None or not np.isfinite(attitude.x).all():
        raise UserError(
            f"{reference.topic}: its quaternions are not of unit length; take the attitude from "
            "another topic (`--topics`)"
        )
    return taken, attitude


def _wired(wired: Wiring, command: str, column: Column) -> dict[str, Any]:
    """What the wiring says of the outputs: numbers of outputs are an autopilot's alone."""
    if command != "pwm":
        return {"vehicle": wired.vehicle}
    outputs = {} if column.type in SAMPLED else {"channels": ()}
    return wired.of_signals() | outputs


def _undelayed(
    taken: Quantities, rates: Series, known: Mapping[str, float]
) -> tuple[Series, Series | None, list[str]]:
    """Body rates and specific force without the delays of the autopilot's own filters."""
    autopilot, force = taken.topic("parameters"), taken.acceleration()
    delays: list[str] = []
    if _same(autopilot, taken.topic("rates")):
        rates, delays = undelayed(rates, known, "INS_GYRO_FILTER")
    if force is not None and _same(autopilot, taken.topic("acceleration")):
        force, delay = undelayed(force, known, "INS_ACCEL_FILTER")
        delays += delay
    return rates, force, delays


def _place(taken: Quantities, attitude: Series) -> Series | None:
    """Position in W, or the height alone: what velocities are compared with."""
    place = taken.position(attitude)
    if place is not None:
        return place
    height = taken.height() or _height_by_depth(taken, attitude)
    if height is None:
        return None
    unknown = np.full((2, height.t.size), np.nan)
    return replace(height, x=np.concatenate([unknown, height.x[None]]))


def _height_by_depth(taken: Quantities, attitude: Series) -> Series | None:
    below = None if may_be_the_hulls(taken) else depth(taken, attitude, {}, None)
    return None if below is None else replace(below, x=-below.x)


def _check_turning(attitude: Series, rates: Series) -> None:
    """Refuse a quaternion that nobody fills."""
    turned = np.abs(np.cumsum(rates.x[:, 1:] * np.diff(rates.t), axis=1))
    if not np.ptp(attitude.x, axis=1).any() and turned.max(initial=0.0) > _TURNED:
        raise UserError(
            f"{attitude.source}: its quaternion never changes, while {rates.source} turns; take "
            "the attitude from another topic (`--topics`)"
        )


def _by_motion(taken: Quantities, attitude: Series, place: Series | None) -> Quantities:
    """The quantities, with a twist in the world's axes if only that fits the positions.

    Some simulators publish so, against nav_msgs/Odometry. An instrument's velocity may have z down
    too: its own axes are seldom said. Other contradictions are findings.
    """
    found, given = velocity_axes(taken, attitude, place), taken.topic("velocity")
    if found is None or given is None:
        return taken
    one = found[0]
    instrument = "attitude" not in taken.columns[one.topic].form.gives
    if one.frame != given.frame and not (instrument and one.expressed == given.expressed):
        return taken
    taken.note(
        f"{one.topic}: its twist is expressed in the {one.expressed}, as the positions tell."
        if one.frame == given.frame
        else f"{one.topic}: its velocities are taken in {one.frame}, as the positions tell."
    )
    others = [one if t.topic == one.topic else t for t in taken.map.topics]
    return replace(taken, map=TopicMap(tuple(others)))


def _same(one: Topic | None, other: Topic | None) -> bool:
    """Whether two topics are of one node, so that its parameters hold for both."""
    spaces = [None if t is None else t.topic.strip("/").split("/")[0] for t in (one, other)]
    return spaces[0] is not None and spaces[0] == spaces[1]


def _parameters(taken: Quantities) -> tuple[list[Parameter], list[str]]:
    found = taken.taken("parameters")
    if found is None:
        return [], []
    one, t, values = found
    names = [name.encode("ascii", "replace") for name in taken.columns[one.topic].text]
    return parameters_of(t, np.array(names, object), values[0])


def _outputs(
    bag: Bag,
    taken: Quantities,
    parameters: Sequence[Parameter],
    span: tuple[float, float],
    vehicle: str | None,
) -> tuple[Series, str, Wiring, list[str], list[Finding]]:
    """What drives the thrusters, its name in a recording, the vehicle's thrusters, sentences."""
    quantity: Quantity | None = next((q for q in COMMANDS if taken.topic(q) is not None), None)
    found = None if quantity is None else taken.taken(quantity)
    if quantity is None or found is None:
        raise UserError(
            f"no topic tells what the thrusters did ({listed(bag)}); record mavros_msgs/RCOut or "
            f"the commands of the thrusters, or {_HOW}; numbers within ±1 need `scale` and "
            "`offset` there, speeds of rotors `scale` and `squared`"
        )
    one, t, x = found
    if quantity == "wrench":
        wired = wiring(parameters, *span, vehicle)
        return _there(taken.wrench(), one), "F_Bo_B", wired, [], []
    if quantity == "forces":
        wired = wiring(parameters, *span, vehicle or _by_count(one, x.shape[0]))
        count = len(load_vehicle(wired.vehicle).propulsion.mounts)
        if count != x.shape[0]:
            raise UserError(
                f"{one.topic}: {x.shape[0]} forces, and {wired.vehicle} has {count} thrusters; "
                "name the vehicle (--vehicle), or `channels` in the topic map"
            )
        signs = np.array(one.directions or (1,) * count)
        x = x * signs[:count, None] if signs.size >= count else x
        return _there(series(t, x, one.topic, "thrust"), one), "thruster_force", wired, [], []
    bare = taken.columns[one.topic].type.startswith("std_msgs")
    named = vehicle
    counted = bare or bool(one.channels) or one.thruster > 0
    if vehicle is None and counted and not any(p.name == "FRAME_CONFIG" for p in parameters):
        named = _by_count(one, x.shape[0])
    channels = np.zeros((32, t.size))
    rows = min(x.shape[0], 32)
    channels[:rows] = np.nan_to_num(x[:rows])
    directed = [*parameters, *_directions(one, span[0])]
    wired = wiring(directed, *span, named, pulses=channels)
    outputs, notes = thruster_outputs(t, channels, wired, one.topic)
    found = _there(outputs, one), "pwm", wired, [*wired.notes, *notes]
    return *found, wired.frame_findings(channels, vehicle is not None)


def _there(found: Series | None, topic: Topic) -> Series:
    if found is None:
        raise UserError(
            f"{topic.topic}: hardly a message of it can be used as a command of the thrusters; "
            "record it while the vehicle moves, or take another topic (`--topics`)"
        )
    return found


def _directions(topic: Topic, t: float) -> list[Parameter]:
    return [Parameter(t, f"MOT_{n}_DIRECTION", float(d)) for n, d in enumerate(topic.directions, 1)]


def _by_count(topic: Topic, count: int) -> str:
    """The preset with so many thrusters.

    Raises:
        UserError: there is none.
    """
    if count not in PRESETS:
        raise UserError(
            f"{topic.topic}: drives {count} thrusters, and no preset has as many; name the vehicle "
            "(--vehicle), or the thrusters' `channels` in the topic map"
        )
    return PRESETS[count]


def _motion(
    taken: Quantities, attitude: Series, proposed: bool
) -> tuple[Series | None, Series | None, list[str]]:
    """Position and velocity in W; what one of them lacks is derived from the other topics."""
    position, velocity = taken.position(attitude), taken.velocity(attitude)
    told = []
    if position is not None and velocity is not None:
        if _moves(velocity) and not np.ptp(position.x, axis=1).any():
            told = [f"{position.source}: its position never changes, and was left out."]
            position = None
        elif not velocity.x.any() and np.ptp(position.x, axis=1).max() > _MOVED_M:
            velocity = None
    if position is not None and velocity is not None:
        return position, velocity, []
    if position is not None:
        said = f"{position.source}: velocities are differences of the positions."
        return position, derivative(position), [said]
    z = taken.height()
    if z is None and not (proposed and may_be_the_hulls(taken)):
        below = depth(taken, attitude, {}, None)
        z = None if below is None else replace(below, x=-below.x)
    if velocity is not None:
        told += [] if z is None else [f"{velocity.source}: the height is that of {z.source}."]
        height = np.full(velocity.t.size, np.nan) if z is None else _within(velocity.t, z)
        lacking = np.full(velocity.t.size, np.nan)
        p = np.stack([lacking, lacking, height])
        return Series(velocity.t, p, velocity.source), velocity, told
    if z is None:
        return None, None, []
    lacking = np.full((2, z.t.size), np.nan)
    climb = derivative(z)
    v = np.concatenate([np.full((2, climb.t.size), np.nan), climb.x[None]])
    return (
        replace(z, x=np.concatenate([lacking, z.x[None]])),
        replace(climb, x=v),
        [f"{z.source}: climb is the difference of heights."],
    )


def _moves(velocity: Series) -> bool:
    way = np.cumsum(np.nan_to_num(velocity.x[:, 1:]) * np.diff(velocity.t), axis=1)
    return float(np.abs(way).max(initial=0.0)) > _MOVED_M


def _within(t: np.ndarray, one: Series) -> np.ndarray:
    return np.interp(t, one.t, one.x)


def _states(taken: Quantities) -> dict[str, Spans]:
    found = taken.taken("state")
    if found is None:
        return {}
    one, t, armed = found
    order = np.argsort(t, kind="stable")
    modes = taken.columns[one.topic].text
    return {
        "mode": sampled_spans(t[order], [modes[i] for i in order]),
        "armed": sampled_spans(t[order], ["" if armed[0, i] else "disarmed" for i in order]),
    }


def _aiding(taken: Quantities, velocity: Series | None) -> dict[str, Spans]:
    if velocity is not None and not np.isfinite(velocity.x[0]).any():
        return {"aiding": Spans(np.array([-np.inf]), np.array([np.inf]), (UNAIDED,))}
    found = taken.taken("aiding")
    if found is None:
        return {}
    _, t, aided = found
    order = np.argsort(t, kind="stable")
    labels = ["" if aided[0, i] else UNAIDED for i in order]
    return {"aiding": witnessed_spans(t[order], labels)}


def _voltage(taken: Quantities) -> Series | None:
    found = taken.taken("voltage")
    if found is None:
        return None
    one, t, x = found
    known = x[0] > 0
    return series(t[known], x[0, known], one.topic, "voltage")


def _rc(taken: Quantities) -> Series | None:
    found = taken.taken("rc")
    return None if found is None else series(found[1], found[2], found[0].topic, "channel")
