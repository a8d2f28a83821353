"""What kind of vehicle a log is of, and whether its frame fits its outputs."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ...models.recordings.checks.commands import command_findings
from ...models.recordings.checks.finding import Finding
from ...models.recordings.outputs import in_words, outputs_of
from ...models.recordings.schema import PWM_RISE
from ...models.recordings.store import Recording
from ...models.vehicles.vehicle import load_vehicle
from ..mavlink.codec import FRAME_THRUSTERS, NEUTRAL_US

_FRAMES = {
    0: ("BLUEROV1", 6),
    1: ("VECTORED", 6),
    2: ("VECTORED_6DOF", 8),
    3: ("VECTORED_6DOF_90DEG", 8),
    4: ("SIMPLEROV_3", 3),
    5: ("SIMPLEROV_4", 4),
    6: ("SIMPLEROV_5", 5),
    7: ("CUSTOM", 8),
}
"""Name and number of motors by FRAME_CONFIG (ArduPilot, AP_Motors6DOF)."""
_KINDS = {
    1: "a fixed-wing aeroplane", 2: "a quadrotor", 3: "a coaxial helicopter", 4: "a helicopter",
    10: "a rover", 11: "a boat", 13: "a hexarotor", 14: "an octorotor", 15: "a tricopter",
}  # fmt: skip
_MAKERS = {12: "PX4"}
_SUBMARINE, _ARDUPILOT = 12, 3
_FIRMWARE = re.compile(r"(Ardu(?:Copter|Plane|Rover)|APM:(?:Copter|Plane|Rover)|PX4|Rover|Blimp)\b")
_OURS = ("ArduSub", "APM:Sub")
_SAID = re.compile(r"Frame: *(\w+)")
_MOVES_US = 20.0


def kind_findings(kind: int, maker: int) -> list[Finding]:
    """What a heartbeat's MAV_TYPE and MAV_AUTOPILOT say; -1 is unknown."""
    said = []
    if maker not in (_ARDUPILOT, -1):
        said.append(
            f"its autopilot is {_MAKERS.get(maker, 'not ArduPilot')} (MAV_AUTOPILOT {maker})"
        )
    if kind not in (_SUBMARINE, -1):
        said.append(f"it is {_KINDS.get(kind, 'no submarine')} (MAV_TYPE {kind})")
    return [_not_a_submarine("HEARTBEAT", said)] if said else []


def firmware_findings(place: str, texts: Iterable[str], maker: int = -1) -> list[Finding]:
    """What the autopilot's messages say of its firmware; `maker` as in `kind_findings`.

    A message of ArduPilot's may begin with PX4: up to 3.5 it names the board's drivers in this way
    ("PX4: 8d505a02 NuttX: 1a99ba58"). With a heartbeat of ArduPilot it does not tell the firmware.
    """
    texts = list(texts)
    if any(text.strip().startswith(_OURS) for text in texts):
        return []
    if maker == _ARDUPILOT:
        texts = [text for text in texts if not text.strip().startswith(tuple(_MAKERS.values()))]
    for text in texts:
        found = _FIRMWARE.match(text.strip())
        if found is not None:
            return [_not_a_submarine(place, [f"its firmware is {text.strip()}"])]
    return []


def frame_said(texts: Iterable[str]) -> int | None:
    """FRAME_CONFIG of the frame that the autopilot named last, as in "Frame: VECTORED".

    It does so at each start; parameters, too, count as they were last.
    """
    numbers = {name: number for number, (name, _) in _FRAMES.items()}
    for text in reversed(list(texts)):
        found = _SAID.match(text.strip())
        if found is not None and found[1] in numbers:
            return numbers[found[1]]
    return None


def frame_in_words(frame: int) -> str:
    """The message with which the autopilot names a frame; its number, if that is unknown."""
    return f"Frame: {_FRAMES[frame][0] if frame in _FRAMES else frame}"


def _not_a_submarine(place: str, said: list[str]) -> Finding:
    return Finding(
        "not-a-submarine",
        place,
        f"the log is not ArduSub's: {' and '.join(said)}",
        "give a log of ArduSub, or its data as CSV (docs/recording.md)",
    )


def outvoted(frame: int | None, said: int | None, motors: Mapping[int, int]) -> bool:
    """Whether parameter and functions of outputs agree, and the frame that was named does not.

    `motors` are those that functions assign to output channels (from 1); none without functions.
    """
    if frame not in _FRAMES or said not in _FRAMES:
        return False
    count = _FRAMES[frame][1]
    return set(motors.values()) == set(range(1, count + 1)) and _FRAMES[said][1] != count


def frame_findings(
    frame: int | None,
    source: str,
    said: int | None,
    motors: Mapping[int, int],
    outputs_us: Float[np.ndarray, "32 n"],
    named: bool,
) -> list[Finding]:
    """Contradictions of a log's frame; `motors` are those of the output channels (from 1).

    `source` is where the log has the frame, `said` the frame that the autopilot named, `named`
    whether the user named a vehicle.
    """
    if frame not in _FRAMES:
        return []
    name, count = _FRAMES[frame]
    extra = [c for c, motor in sorted(motors.items()) if motor > count and moves(outputs_us[c - 1])]
    if extra:
        which = ", ".join(str(c) for c in extra)
        return [
            Finding(
                "frame-contradiction",
                source,
                f"frame {name} has {count} thrusters, and outputs {which} drive more of them",
                "correct FRAME_CONFIG or SERVOn_FUNCTION in the log's parameters",
            )
        ]
    if said is not None and said != frame and not outvoted(frame, said, motors):
        return [
            Finding(
                "frame-contradiction",
                source,
                f"the parameter is frame {name}, and the autopilot started as {_FRAMES[said][0]}",
                "correct FRAME_CONFIG and start the autopilot anew before the next dive",
            )
        ]
    if frame not in FRAME_THRUSTERS and not named:
        return [
            Finding(
                "frame-without-preset",
                source,
                f"no preset has the thrusters of frame {name}",
                "name the vehicle (--vehicle FILE)",
            )
        ]
    return []


def moves(pulses: np.ndarray) -> bool:
    """Whether an output is driven: its pulses are not always the same."""
    known = pulses[pulses > 0]
    return known.size > 0 and bool(np.ptp(known) > _MOVES_US)


def settled(
    recording: Recording,
    turned: Collection[int],
    since: Sequence[tuple[float, tuple[int, ...]]] = (),
) -> tuple[Recording, list[Finding]]:
    """Decide by the motion whether outputs with SERVOn_REVERSED are mirrored.

    `turned` are the thrusters (from 1) whose PWM was mirrored for it, and where the parameters
    changed, `since` are those that were from each time (s) on. ArduSub's mixer writes
    pulses that the parameter does not touch, pass-through and other firmware do. Where the
    mirrored outputs together contradict the motion and the recorded ones do not, these are
    restored; else each of which the motion says so.
    """
    if not turned:
        return recording, []
    against = set(turned)
    severe = _severe(recording)
    if not severe or _severe(_unmirrored(recording, turned, since)):
        reversed_ = [f.place for f in severe if f.word == "thruster-reversed"]
        against &= {int(place.rsplit("pwm", 1)[1]) for place in reversed_}
    found, outputs = [], outputs_of(recording.dataset)
    for k in sorted(turned):
        told = (
            "but the motion says that it is not"
            if k in against
            else "and its PWM is mirrored about 1500"
        )
        n = outputs[k - 1] if outputs else "n"
        found.append(
            Finding(
                "output-reversed",
                f"SERVO{n}_REVERSED of thruster {k}",
                f"the output of {in_words(k, outputs)} is set to be reversed, {told}",
            )
        )
    return _unmirrored(recording, against, since), found


def _severe(recording: Recording) -> list[Finding]:
    """What in the commands would stop a command."""
    found = command_findings(recording, load_vehicle(recording.vehicle))
    return [f for f in found if f.severity == "severe"]


def _unmirrored(
    recording: Recording,
    thrusters: Collection[int],
    since: Sequence[tuple[float, tuple[int, ...]]],
) -> Recording:
    """The recording with the PWM of some thrusters (from 1) mirrored back where it was mirrored."""
    dataset = recording.dataset
    centres = {"pwm": 2 * NEUTRAL_US, PWM_RISE: 0.0}
    values = {name: dataset[name].to_numpy().copy() for name in centres if name in dataset}
    starts = dataset["start_time"].to_numpy()
    for j, k in np.argwhere(recording.lengths > 0).tolist():
        own = [mirrored for t, mirrored in since if t <= starts[j, k] + recording.dt]
        columns = [n - 1 for n in thrusters if not own or n in own[-1]]
        for name, x in values.items():
            x[j, k][:, columns] = centres[name] - x[j, k][:, columns]
    return Recording(dataset.assign({n: dataset[n].copy(data=x) for n, x in values.items()}))
