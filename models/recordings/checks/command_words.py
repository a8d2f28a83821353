"""Sentences of the findings on commands and motion, each with its place and remedy."""

from collections.abc import Sequence

import numpy as np

from ...se3 import AXES, WRENCH
from ..outputs import in_words
from ..store import Recording
from .finding import Finding
from .hypotheses import Driven

_ORDERS = {
    "in ArduSub's order of RC channels (pitch, roll, heave, yaw, surge, sway)": (4, 3, 2, 5, 0, 1),
    "torque first (K,M,N,X,Y,Z), as Drake's spatial forces": (3, 4, 5, 0, 1, 2),
}
_RIGHT_DOWN = np.array([1, -1, -1, 1, -1, -1])


def no_commands(recording: Recording) -> Finding:
    """No command ever differs from zero."""
    rates = recording.dataset["V_WB_B"].to_numpy()[recording.mask][:, 3:]
    turned = bool(np.nanmax(np.abs(rates), initial=0.0) > 0.2)
    told = "the vehicle was turned by hand or drifted" if turned else "nothing was driven"
    return Finding(
        "no-commands",
        ", ".join(recording.commands),
        f"no command ever differs from zero: {told}, and nothing tells how it answers thrusters",
        "record a dive with the thrusters driven",
    )


def no_answer(data: Driven, silent: Sequence[int]) -> Finding:
    """The motion follows no command, of these axes for sure."""
    axes = ", ".join(AXES[i] for i in silent)
    times = min(data.given[i] / max(data.needed[i], 1e-12) for i in silent)
    return Finding(
        "no-answer",
        axes,
        f"the motion follows no command, though those of {axes} are {times:.1g} times the force "
        "that the motion shows: a bench test, thrusters without power, or commands of another run",
        "give a dive, with the commands that made it",
    )


def silent(data: Driven, axis: int) -> Finding:
    """An axis does not answer its command."""
    times = data.given[axis] / max(data.needed[axis], 1e-12)
    return Finding(
        "axis-silent",
        AXES[axis],
        f"{AXES[axis]} never or hardly answers its command, which is {times:.1g} times the force "
        "that the motion shows",
        f"check the thrusters that act in {AXES[axis]}",
    )


def exchanged_columns(moved: Sequence[tuple[int, int, int]]) -> Finding:
    """Columns of a wrench that drive other axes: (axis, column, sign) of each."""
    names = [n for n, order in _ORDERS.items() if all(order[j] == i for i, j, _ in moved)]
    parts = [f"`{WRENCH[j]}` drives {AXES[i]}{' backwards' * (s < 0)}" for i, j, s in moved]
    look = f": columns X…N stand {names[0]}" if names else ""
    return Finding(
        "columns-exchanged",
        "columns X,Y,Z,K,M,N",
        f"the motion says that {', '.join(parts)}{look}",
        "give X,Y,Z,K,M,N in this order, forces first",
    )


def reversed_axes(data: Driven, moved: Sequence[tuple[int, int, int]], wrench: bool) -> Finding:
    """Axes whose command has the other sign."""
    axes = [i for i, _, _ in moved]
    right_down = [i for i in data.axes if _RIGHT_DOWN[i] < 0]
    frd = wrench and set(axes) == set(right_down)
    told = ": they look like forward-right-down" if frd else ""
    names = ", ".join(WRENCH[i] if wrench else AXES[i] for i in axes)
    return Finding(
        "axis-reversed",
        f"column{'s' * (len(axes) > 1)} {names}" if wrench else names,
        f"the motion goes against the command of {', '.join(AXES[i] for i in axes)}{told}",
        "give forward, left and up as positive, or `frames: NED/FRD` for all of the files"
        if wrench
        else "check the directions of the thrusters (MOT_n_DIRECTION) and the vehicle's file",
    )


def reversed_thruster(data: Driven, k: int) -> Finding:
    """Thruster k (from 0) pushes the other way."""
    output = data.outputs[k] if data.outputs else 0
    causes = (
        f"SERVO{output}_REVERSED or MOT_{k + 1}_DIRECTION"
        if output
        else f"MOT_{k + 1}_DIRECTION, or SERVOn_REVERSED of the output n that drives it"
    )
    return Finding(
        "thruster-reversed",
        f"column {data.columns[k]}",
        f"{in_words(k + 1, data.outputs)} pushes the other way: {causes}",
        f"correct the parameter, or the sign of {data.columns[k]}",
    )


def exchanged_thrusters(data: Driven, a: int, b: int) -> Finding:
    """Thrusters a and b (from 0) are exchanged."""
    one, other = (in_words(k + 1, data.outputs) for k in (a, b))
    remedy = "give the columns in the order of the vehicle's file"
    if data.outputs and data.outputs[a] and data.outputs[b]:
        numbers = sorted((data.outputs[a], data.outputs[b]))
        functions = " and ".join(f"SERVO{n}_FUNCTION" for n in numbers)
        remedy = f"check the wiring against {functions}, or {remedy}"
    return Finding(
        "thruster-exchanged",
        f"columns {data.columns[a]}, {data.columns[b]}",
        f"{one} and {other} look exchanged",
        remedy,
    )


def dead_thruster(data: Driven, k: int) -> Finding:
    """Thruster k (from 0) has no effect."""
    return Finding(
        "thruster-dead",
        f"column {data.columns[k]}",
        f"{in_words(k + 1, data.outputs)} has no effect on the motion",
        "check its power and propeller",
    )


def turned_heading(degrees: float) -> Finding:
    """The recorded heading is off by so much (positive: to the left of the true one)."""
    side = "left" if degrees > 0 else "right"
    large = abs(degrees) > 45
    return Finding(
        "heading-wrong" if large else "heading-offset",
        "surge, sway",
        f"the motion goes {abs(degrees):.0f}° beside the commands: the recorded heading points "
        f"about {abs(degrees):.0f}° to the {side} of the vehicle's bow",
        "calibrate the compass, or check its orientation (COMPASS_ORIENT, AHRS_ORIENTATION)",
    )


_MIRRORS = {
    0.0: "the motion along y has the other sign",
    45.0: "x and y look exchanged (north and east)",
    90.0: "the motion along x has the other sign",
    135.0: "x and y look exchanged, and both have the other sign",
}


def mirrored(degrees: float) -> Finding:
    """The horizontal motion is a mirror image, the mirror along this direction from x to y."""
    how = _MIRRORS.get(degrees, f"it is mirrored at {degrees:.0f}° from x")
    return Finding(
        "plane-mirrored",
        "x, y, u, v",
        f"the horizontal motion answers the commands only as a mirror image: {how}",
        "give x east, y north, z up with the heading from x towards y, or all as NED",
    )


def shifted(axes: Sequence[int], seconds: float) -> Finding:
    """Motion along axes that is shifted against its commands (positive: later)."""
    how = "after" if seconds > 0 else "before"
    return Finding(
        "command-lag",
        f"commands of {', '.join(AXES[i] for i in axes)}",
        f"the motion comes {abs(seconds):.1f} s {how} its command",
        "align the clocks of commands and motion",
    )


def shifted_apart(seconds: float) -> Finding:
    """Velocities that answer commands later than rates do (positive), or earlier."""
    how = "after" if seconds > 0 else "before"
    return Finding(
        "velocity-lag",
        "u,v,w",
        f"u,v,w answer the commands {abs(seconds):.1f} s {how} p,q,r",
        "correct the delay of the velocity's sensor, or align the clocks of the instruments",
    )
