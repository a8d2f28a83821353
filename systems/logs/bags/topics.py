"""The topic map: what each topic of a bag tells of the vehicle, as typed YAML."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ....models.config import typed_yaml
from ....models.config.checks import Vector3, require
from ....models.config.errors import UserError
from .bag import Bag
from .foreign import NAVIGATION, points_down
from .messages import COMMANDS, Quantity

SUFFIX = ".topics.yaml"
"""A map beside its bag, `dive.topics.yaml` of `dive.bag`, is used without being named."""
Frames = Literal["ENU/FLU", "NED/FRD", "ENU/FRD", "NED/FLU"]
_DOWN = re.compile(r"(^|[_/])(ned|frd)$", re.I)
_WORLD = re.compile(
    r"(^|[_/])(map|odom|world|earth|local|local_origin|enu)(_ned|_enu)?$|^/?ned$", re.I
)
_FRAMES: dict[tuple[bool, bool], Frames] = {
    (False, False): "ENU/FLU",
    (False, True): "ENU/FRD",
    (True, False): "NED/FLU",
    (True, True): "NED/FRD",
}
"""By whether z of world and body is down."""
FARTHEST_M = 100.0
"""Largest distance of a sensor from Bo."""
_LARGEST_DELAY_S, _LARGEST_TURN = 10.0, 6.3


@dataclass(frozen=True)
class Topic:
    """One topic and what is taken from it.

    Attributes:
        topic: its name.
        type: its message type; empty takes that of the bag.
        gives: quantities taken from it.
        frame: world and body axes of its numbers.
        expressed: whether its velocity and rates are in the body's axes or in the world's.
        delay: s by which its stamps are later than what it tells.
        scale: factor of its numbers, for units other than SI or PWM from −1 to 1.
        offset: added to its scaled numbers.
        squared: its numbers n are speeds of a rotor, and n |n| is scaled.
        xyz: place (m) of the sensor in the body, as `<origin xyz rpy>` of a URDF's joint; None
            takes that of the bag's tf.
        rpy: roll, pitch, yaw (rad) of the sensor's axes in the body's; both after REP 103.
        channels: number of the element, from 1, that drives each thruster; 0 for none.
        directions: 1 or −1 of each thruster, as MOT_n_DIRECTION.
        thruster: of a topic with a single number, the thruster (from 1) that it drives.
    """

    topic: str
    gives: tuple[Quantity, ...]
    type: str = ""
    frame: Frames = "ENU/FLU"
    expressed: Literal["body", "world"] = "body"
    delay: float = 0.0
    scale: float = 1.0
    offset: float = 0.0
    squared: bool = False
    xyz: Vector3 | None = None
    rpy: Vector3 | None = None
    channels: tuple[int, ...] = ()
    directions: tuple[int, ...] = ()
    thruster: int = 0

    def __post_init__(self) -> None:
        late = abs(self.delay) <= _LARGEST_DELAY_S
        require(late, self, "delay", f"give seconds, at most {_LARGEST_DELAY_S:g}")
        require(self.scale != 0, self, "scale", "give a number other than 0")
        near = self.xyz is None or max(map(abs, self.xyz)) <= FARTHEST_M
        require(near, self, "xyz", f"give m in the body, at most {FARTHEST_M:g}")
        turn = self.rpy is None or max(map(abs, self.rpy)) <= _LARGEST_TURN
        require(turn, self, "rpy", "give roll, pitch, yaw in rad")
        require(0 <= self.thruster <= 32, self, "thruster", "give a number from 1 to 32")
        require(len(self.gives) > 0, self, "gives", "name what the topic tells, or leave it out")
        channels = all(0 <= c <= 32 for c in self.channels)
        require(channels, self, "channels", "give numbers from 1 to 32, or 0")
        require(
            all(abs(d) == 1 for d in self.directions), self, "directions", "give 1 or -1 of each"
        )

    @property
    def world_down(self) -> bool:
        """Whether the world's axes are north, east, down."""
        return self.frame.startswith("NED")

    @property
    def body_down(self) -> bool:
        """Whether the body's axes are forward, right, down."""
        return self.frame.endswith("FRD")

    @property
    def turn(self) -> Rotation:
        """R_BS, from the sensor's axes to the body's; the identity if it is not known."""
        return Rotation.from_euler("xyz", self.rpy or (0.0, 0.0, 0.0))

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """p_BoS_B (m); zero if it is not known."""
        return np.array(self.xyz or (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class TopicMap:
    """Every topic that is used; a quantity comes from one topic, or one of each thruster."""

    topics: tuple[Topic, ...]

    def __post_init__(self) -> None:
        driven = [one.thruster for one in self.topics if one.thruster]
        if len(set(driven)) < len(driven):
            raise UserError("give each `thruster` to one topic, not to several")
        given = [q for one in self.topics for q in one.gives if not one.thruster]
        given += {q for one in self.topics for q in one.gives if one.thruster}
        for quantity in given:
            if given.count(quantity) > 1:
                raise UserError(f"take {quantity} from one topic, not from several")
        if len([q for q in given if q in COMMANDS]) > 1:
            raise UserError(f"take one of {', '.join(COMMANDS)}, not several")

    def of(self, quantity: Quantity) -> Topic | None:
        """The topic that gives a quantity."""
        return next((one for one in self.topics if quantity in one.gives), None)


def load_map(path: Path, bag: Bag) -> TopicMap:
    """Read a topic map and check it against a bag.

    Raises:
        UserError: the file is no topic map, or names a topic, type or quantity that is not there.
    """
    found = typed_yaml.load(TopicMap, path)
    there = ", ".join(sorted(bag.topics)) or "none"
    for one in found.topics:
        if one.topic not in bag.topics:
            raise UserError(f"{path}: {one.topic} is no topic of {bag.path}; it has {there}")
        type_ = bag.topics[one.topic]
        if one.type not in ("", type_):
            raise UserError(f"{path}: {one.topic} is of type {type_}, not {one.type}; correct it")
        form = bag.forms.get(one.topic)
        if form is None and one.topic in bag.undefined:
            raise UserError(f"{path}: {one.topic} can't be taken: {bag.lacking()}")
        if form is None:
            raise UserError(
                f"{path}: {one.topic} is of type {type_}, which is not read; leave it out"
            )
        for quantity in one.gives:
            if quantity not in form.gives:
                raise UserError(
                    f"{path}: {one.topic} ({type_}) gives no {quantity}; "
                    f"it may give {', '.join(form.gives)}"
                )
        if not bag.counts[one.topic]:
            raise UserError(f"{path}: {one.topic} has no message in {bag.path}; leave it out")
    return found


def beside(path: Path) -> Path | None:
    """The topic map that lies beside a bag, if there is one."""
    at = path.resolve()
    found = at.parent / f"{at.name if at.is_dir() else at.stem}{SUFFIX}"
    return found if found.is_file() else None


def frames_of(type_: str, frame: str, child: str) -> tuple[Frames, Literal["body", "world"]]:
    """Axes of a topic's numbers by REP 103 and 105: the names of its frames.

    `frame_id` is the world of a pose and the body of an Imu, a wrench or most twists; names that
    end in _ned or _frd have z down, all others are ENU and FLU. A twist whose frame is a world
    (map, odom) is expressed there.
    """
    down = is_down(frame)
    if type_.startswith(("nav_msgs/msg/Odometry", "geometry_msgs/msg/Pose")):
        body_down = is_down(child) if child else down
        return _FRAMES[down, body_down], "body"
    if type_.endswith(NAVIGATION):
        return "NED/FRD", "body"
    frames: Frames = "NED/FRD" if down else "ENU/FLU"
    if type_.startswith("geometry_msgs/msg/Point"):
        return frames, "body"
    if points_down(type_):
        frames = "ENU/FRD"
    moving = type_.startswith(("geometry_msgs/msg/Twist", "geometry_msgs/msg/Vector3"))
    return frames, "world" if moving and is_world(frame) else "body"


def is_down(frame: str) -> bool:
    """Whether a frame's name says that its z is down."""
    return _DOWN.search(frame) is not None


def is_world(frame: str) -> bool:
    """Whether a frame's name is that of a world, after REP 105."""
    return _WORLD.search(frame) is not None
