"""Quantities of a bag's topics as series in W and B, in SI units, on one clock."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ....models.frames import frd_to_flu, ned_to_enu
from ....models.recordings.resample import linear, rotations, slerp
from ..signals import Series, series
from .bag import Column
from .clocks import Clock
from .messages import Quantity
from .topics import Topic, TopicMap

_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
_HALF_WIDTH_S = 0.05
"""Least half width of a central difference: a wider one attenuates, 1 Hz by 2 % at 50 ms."""


@dataclass(frozen=True)
class Quantities:
    """What the map takes from the columns of a bag."""

    columns: Mapping[str, Column]
    map: TopicMap
    clock: Clock
    notes: list[str] = field(default_factory=list)

    @property
    def told(self) -> tuple[str, ...]:
        """All sentences for the report."""
        return (*self.clock.notes, *self.notes)

    def note(self, sentence: str) -> None:
        """Add a sentence for the report, once."""
        if sentence not in self.notes:
            self.notes.append(sentence)

    def topic(self, quantity: Quantity) -> Topic | None:
        """The topic of a quantity, if its messages are there."""
        one = self.map.of(quantity)
        return one if one is not None and one.topic in self.columns else None

    def taken(self, quantity: Quantity) -> tuple[Topic, np.ndarray, np.ndarray] | None:
        """Topic, times (s) and numbers (k, n) of a quantity, scaled; None if it is not there."""
        one = self.topic(quantity)
        if one is not None and one.thruster:
            return self._thrusters(quantity, one)
        return None if one is None else self._numbers(quantity, one)

    def _thrusters(self, quantity: Quantity, first: Topic) -> tuple[Topic, np.ndarray, np.ndarray]:
        """The commands of thrusters with a topic each, held to all their times; 0 without one."""
        parts = [
            self._numbers(quantity, one)
            for one in self.map.topics
            if quantity in one.gives and one.topic in self.columns
        ]
        sorted_ = [(one, *_in_order(t, x[0])) for one, t, x in parts]
        t = np.unique(np.concatenate([t for _, t, _ in sorted_]))
        t = t[t >= max(own[0] for _, own, _ in sorted_)]
        held = np.zeros((max(one.thruster for one, _, _ in sorted_), t.size))
        for one, own, x in sorted_:
            held[one.thruster - 1] = x[np.searchsorted(own, t, side="right") - 1]
        return first, t, held

    def _numbers(self, quantity: Quantity, one: Topic) -> tuple[Topic, np.ndarray, np.ndarray]:
        column = self.columns[one.topic]
        t, told = self.clock.times(column)
        for sentence in told:
            self.note(sentence)
        x = column.x[column.form.gives[quantity]]
        if quantity in ("pwm", "forces") and one.channels:
            x = _chosen(x, one.channels, 0.0)
        if one.squared:
            x = x * np.abs(x)
        bare = quantity not in ("attitude", "state", "aiding", "parameters")
        return one, t - one.delay, x * one.scale + one.offset if bare else x

    def attitude(self) -> Series | None:
        """q_WB."""
        found = self.taken("attitude")
        if found is None:
            return None
        one, t, q = found
        return series(t, attitude_of(q, one), one.topic, "attitude")

    def position(self, attitude: Series) -> Series | None:
        """p_WB (m)."""
        found = self.taken("position")
        if found is None:
            return None
        one, t, p = found
        p_WS = ned_to_enu(p) if one.world_down else p
        return series(t, p_WS - _arm(one, t, attitude), one.topic, "position")

    def velocity(self, attitude: Series, topic: Topic | None = None) -> Series | None:
        """Velocity of Bo in W (m/s), turned by the message's own attitude if it has one.

        `topic` has other axes than the map's.
        """
        found = self.taken("velocity")
        if found is None:
            return None
        one, t, v = found
        mapped, one = one, one if topic is None else topic
        R_WB = rotations(self._own_attitude(mapped, t, attitude))
        if one.expressed == "world":
            v_W = ned_to_enu(v) if one.world_down else v
        else:
            v_W = R_WB.apply(_in_body(v, one).T).T
        if one.place.any():
            rates = self.rates(attitude)
            w = turning(attitude) if rates is None else rates
            v_W -= R_WB.apply(np.cross(linear(t, w.t, w.x).T, one.place)).T
        return series(t, v_W, one.topic, "velocity")

    def _own_attitude(self, one: Topic, t: np.ndarray, attitude: Series) -> np.ndarray:
        """The attitude of a topic's messages, or that of the vehicle where nobody fills them."""
        column = self.columns[one.topic]
        own = column.form.gives.get("attitude")
        q = None if own is None else attitude_of(column.x[own], one)
        if q is None or not np.isfinite(q).all() or not np.ptp(q, axis=1).any():
            return slerp(t, attitude.t, attitude.x)
        return q

    def rates(self, attitude: Series, topic: Topic | None = None) -> Series | None:
        """ω of B in W, in B (rad/s); the source begins with IMU if it is a bare gyro.

        `topic` has other axes than the map's.
        """
        found = self.taken("rates")
        if found is None:
            return None
        one, t, w = found
        one = one if topic is None else topic
        if one.expressed == "world":
            w_W = ned_to_enu(w) if one.world_down else w
            w = rotations(slerp(t, attitude.t, attitude.x)).inv().apply(w_W.T).T
        else:
            w = _in_body(w, one)
        gyro = self.columns[one.topic].type.endswith("/Imu") and "attitude" not in one.gives
        return series(t, w, f"IMU {one.topic}" if gyro else one.topic, "rate")

    def acceleration(self) -> Series | None:
        """Specific force in B (m/s²)."""
        found = self.taken("acceleration")
        if found is None:
            return None
        one, t, a = found
        return series(t, _in_body(a, one), one.topic, "specific force")

    def wrench(self) -> Series | None:
        """F_Bo_B (N, N·m), as commanded."""
        found = self.taken("wrench")
        if found is None or found[2].shape[0] != 6:
            return None
        one, t, F = found
        f, torque = _in_body(F[:3], one), _in_body(F[3:], one)
        torque = torque + np.cross(one.place, f, axisb=0).T
        return series(t, np.concatenate([f, torque]), one.topic, "force")

    def depth(self, attitude: Series, scale: float = 1.0, offset: float = 0.0) -> Series | None:
        """Depth of Bo (m, positive down): scale × (number + offset), less that of the sensor."""
        found = self.taken("depth")
        if found is None:
            return None
        one, t, x = found
        down = scale * (x[0] + offset) + _arm(one, t, attitude)[2]
        return series(t, down, one.topic, "depth")

    def height(self) -> Series | None:
        """Z of Bo (m, up)."""
        found = self.taken("height")
        if found is None:
            return None
        one, t, x = found
        return series(t, -x[0] if one.world_down else x[0], one.topic, "position")


def _in_order(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(t, kind="stable")
    return t[order], x[order]


def _chosen(x: np.ndarray, channels: tuple[int, ...], absent: float) -> np.ndarray:
    """Rows of the numbered elements; `absent` for 0 and for elements that are not there."""
    there = [x[c - 1] if 0 < c <= x.shape[0] else np.full(x.shape[1], absent) for c in channels]
    return np.stack(there)


def _in_body(v: Float[np.ndarray, "3 n"], topic: Topic) -> Float[np.ndarray, "3 n"]:
    """A vector in B from one in the topic's axes, by their names and its mounting."""
    flu = frd_to_flu(v) if topic.body_down else v
    return flu if topic.rpy is None else topic.turn.apply(flu.T).T


def _arm(topic: Topic, t: np.ndarray, attitude: Series) -> np.ndarray:
    """p_BoS_W (m) of the topic's sensor at some times."""
    if not topic.place.any():
        return np.zeros((3, t.size))
    return rotations(slerp(t, attitude.t, attitude.x)).apply(topic.place).T


def attitude_of(q: Float[np.ndarray, "4 n"], topic: Topic) -> Float[np.ndarray, "4 n"]:
    """q_WB from a quaternion between the topic's axes; NaN where it is none."""
    norm = np.linalg.norm(q, axis=0)
    known = np.isfinite(norm) & (np.abs(norm - 1) < 0.1)
    R = rotations(np.where(known, q, np.array([[1.0], [0.0], [0.0], [0.0]])))
    R = (_NED if topic.world_down else Rotation.identity()) * R
    R = R * (_FRD if topic.body_down else Rotation.identity()) * topic.turn.inv()
    return np.where(known, R.as_quat(scalar_first=True).T, np.nan)


def derivative(one: Series) -> Series:
    """Central differences of a series, over at least ±50 ms and one of its steps."""
    t, half = _middles(one)
    x = (linear(t + half, one.t, one.x) - linear(t - half, one.t, one.x)) / (2 * half)
    return Series(t, x, f"{one.source}, differentiated")


def turning(attitude: Series) -> Series:
    """ω in B by central differences of the attitude: R(t + h) = R(t − h) exp(2 h ω)."""
    t, half = _middles(attitude)
    before, after = (
        rotations(slerp(t + side * half, attitude.t, attitude.x)) for side in (-1.0, 1.0)
    )
    turned = (before.inv() * after).as_rotvec().T
    return Series(t, turned / (2 * half), f"{attitude.source}, differentiated")


def _middles(one: Series) -> tuple[np.ndarray, float]:
    half = max(_HALF_WIDTH_S, float(np.median(np.diff(one.t))))
    inside = one.t[(one.t >= one.t[0] + half) & (one.t <= one.t[-1] - half)]
    return (inside, half) if inside.size > 1 else (one.t, half)
