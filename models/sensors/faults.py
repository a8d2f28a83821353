"""Faults of a sensor's output, by name and time.

A fault acts on a sensor's output: its reading, the valid mark and the time stamp. The sensor's own
errors and its saturation come before it. `docs/sensor-faults.md` lists all of them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..config.checks import check_numbers, require
from ..randomness import bernoulli, column
from .base import Sensor
from .compass import wrap

FaultName = Literal[
    "nan",
    "infinite",
    "constant",
    "offset",
    "drift",
    "scale",
    "noise",
    "frozen",
    "dropout",
    "latency",
    "frozen_stamp",
    "stamp_offset",
]
_LONGEST = 10.0  # longest latency (s); it bounds the number of stored readings
_SLACK = 1e-6  # rounding of a reading's number: times are whole periods


@dataclass(frozen=True)
class SensorFault:
    """One fault: `{sensor: dvl, fault: frozen, start: 5, duration: 20, components: [0]}`.

    It affects the readings measured from `start` on and before `start + duration`. Several faults
    of one sensor act one after the other, in their order.

    Attributes:
        sensor: the affected sensor.
        fault: kind of the fault.
        start: start of the fault (s).
        duration: duration of the fault (s); until the end if left out, a single reading if zero.
        components: affected components of the values, from 0; all if empty.
        size: size in the fault's unit (`docs/sensor-faults.md`); some have none.
        share: probability that a reading in this time is affected (1), independently of others.
    """

    sensor: str
    fault: FaultName
    start: float = 0.0
    duration: float | None = None
    components: tuple[int, ...] = ()
    size: float | None = None
    share: float = 1.0

    def __post_init__(self) -> None:
        """Check the kind's name and the numbers."""
        check_numbers(self)
        known = get_args(FaultName)
        require(self.fault in known, self, "fault", f"take one of {', '.join(known)}")
        require(self.start >= 0, self, "start", "give a time of zero or more")
        require(
            self.duration is None or self.duration >= 0,
            self,
            "duration",
            "give zero or more, or leave it out for a fault that stays",
        )
        require(0 <= self.share <= 1, self, "share", "give a probability from 0 to 1")
        kind = _KINDS[self.fault]
        require(
            not self.components or not kind.marks,
            self,
            "components",
            f"{self.fault} concerns the whole reading; leave them out",
        )
        if kind.size is None:
            require(self.size is None, self, "size", f"{self.fault} has none; leave it out")
            return
        require(self.size is not None, self, "size", f"{self.fault} needs one: give {kind.size}")
        low, high = kind.limits
        require(low <= (self.size or 0.0) <= high, self, "size", f"give {kind.size}")

    def check(self, sensors: Mapping[str, Sensor]) -> None:
        """Check that the fault makes sense for the sensor that it names.

        Raises:
            UserError: there is no such sensor, or it has no such component, mark or stamp.
        """
        known = ", ".join(sensors)
        require(self.sensor in sensors, self, "sensor", f"take one of {known}")
        sensor, n = sensors[self.sensor], sensors[self.sensor].value_size
        require(
            sensor.port_size > n or not _KINDS[self.fault].marks,
            self,
            "fault",
            f"the readings of {self.sensor} have neither valid mark nor stamp; take frozen or "
            "latency, or another sensor",
        )
        within = set(self.components) <= set(range(n))
        several = len(set(self.components)) < len(self.components)
        which = "0 is the only one" if n == 1 else f"take some of 0 to {n - 1}, each once"
        remedy = f"of the values of {self.sensor} {which}"
        require(within and not several, self, "components", remedy)
        turned = sensor.observes == "attitude" and self.fault in ("offset", "constant")
        require(
            not turned or abs(self.size or 0.0) <= math.pi,
            self,
            "size",
            f"angles of {self.sensor} are in radians: give -π to π (40° are 0.698)",
        )

    def readings(self, rate: float) -> tuple[float, float]:
        """Number of the first affected reading, and of the first one after the fault."""
        first = math.ceil(self.start * rate - _SLACK)
        if self.duration is None:
            return float(first), math.inf
        end = math.ceil((self.start + self.duration) * rate - _SLACK)
        return float(first), float(max(first + 1, end))

    def kept(self, rate: float) -> int:
        """Number of stored readings."""
        return _KINDS[self.fault].kept(self.size or 0.0, rate)

    def noise_size(self, sensor: Sensor) -> int:
        """Number of unit Gaussians that one reading takes."""
        return (sensor.value_size if self.fault == "noise" else 0) + (0 < self.share < 1)

    def show(
        self,
        sensor: Sensor,
        memory: Float[Array, "m *batch"],
        reading: Float[Array, "r *batch"],
        t: Float[Array, "*batch"],
        w: Float[Array, "w *batch"],
    ) -> tuple[Float[Array, "m *batch"], Float[Array, "r *batch"]]:
        """The memory after a reading [values, valid, stamp] measured at t, and the faulty reading.

        The memory, if there is any, is a flag that it is filled and the newest `kept` readings, all
        zero before the first.
        """
        n, batch = sensor.value_size, reading.shape[1:]
        first, end = self.readings(sensor.rate)
        number = jnp.round(t * sensor.rate)
        hit = (number >= first) & (number < end)
        if self.share < 1:
            hit = hit & (bernoulli(w[-1], self.share) if self.share > 0 else False)

        memory, ring = self._remember(memory, reading, hit, n)
        chosen = np.isin(np.arange(n), self.components or np.arange(n))
        look = _Look(self, sensor, reading, ring, t - self.start, w, bool(chosen.all()))
        values, valid, stamp = _KINDS[self.fault].act(look)
        if sensor.angle:
            values = _in_range(values)
        values = jnp.where(chosen.reshape((-1,) + (1,) * len(batch)), values, reading[:n])
        faulty = jnp.concatenate([values, valid[None], stamp[None]])
        return memory, jnp.where(hit, faulty, reading)

    def _remember(self, memory: Array, reading: Array, hit: Array, n: int) -> tuple[Array, Array]:
        """The memory with this reading added, and its readings, the newest first."""
        if not len(memory):
            return memory, reading[:0]
        batch = reading.shape[1:]
        old = memory[1:].reshape(-1, n + 2, *batch)
        new = jnp.where(memory[0] > 0, jnp.concatenate([reading[None], old[:-1]]), reading[None])
        # Latency delays all readings; a frozen sensor repeats the last good one.
        good = (~hit & (reading[n] > 0)) | (old[0, n] <= 0)
        ring = new if self.fault == "latency" else jnp.where(good, new, old)
        return jnp.concatenate([jnp.ones_like(memory[:1]), ring.reshape(-1, *batch)]), ring


@dataclass(frozen=True)
class FaultySensor:
    """The faults of one sensor as one function of its readings.

    Attributes:
        sensor: the sensor without faults.
        faults: faults of this sensor, in the order in which they act.
    """

    sensor: Sensor
    faults: tuple[SensorFault, ...]

    @property
    def memory_size(self) -> int:
        """Length of the faults' memory; all zero before the first reading."""
        return sum(self._memory_sizes)

    @property
    def _memory_sizes(self) -> list[int]:
        kept = [fault.kept(self.sensor.rate) for fault in self.faults]
        return [1 + k * (self.sensor.value_size + 2) if k else 0 for k in kept]

    @property
    def noise_size(self) -> int:
        """Number of unit Gaussians that one reading takes."""
        return sum(fault.noise_size(self.sensor) for fault in self.faults)

    def show(
        self,
        memory: Float[Array, "m *batch"],
        reading: Float[Array, "r *batch"],
        t: Float[Array, "*batch"],
        w: Float[Array, "w *batch"],
    ) -> tuple[Float[Array, "m *batch"], Float[Array, "r *batch"]]:
        """As `SensorFault.show`, for all faults."""
        kept, shown = [], reading
        places = pairwise(np.cumsum([0, *self._memory_sizes]))
        drawn = (fault.noise_size(self.sensor) for fault in self.faults)
        noises = pairwise(np.cumsum([0, *drawn]))
        for fault, (a, b), (c, d) in zip(self.faults, places, noises, strict=True):
            own, shown = fault.show(self.sensor, memory[a:b], shown, t, w[c:d])
            kept.append(own)
        return jnp.concatenate(kept), shown


# ------------------------------------------------------------------------------------- the kinds


class _Look(NamedTuple):
    """Inputs of a fault."""

    fault: SensorFault
    sensor: Sensor
    reading: Float[Array, "r *batch"]
    """[values, valid, stamp]."""
    ring: Float[Array, "k r *batch"]
    """Stored readings, the newest first."""
    elapsed: Float[Array, "*batch"]
    """Time since the fault's start (s)."""
    w: Float[Array, "w *batch"]
    whole: bool
    """Whether all values are affected."""

    @property
    def size(self) -> float:
        return self.fault.size or 0.0

    @property
    def parts(self) -> tuple[Array, Array, Array]:
        """Values, valid mark and stamp."""
        return self.reading[:-2], self.reading[-2], self.reading[-1]


_Parts = tuple[Array, Array, Array]


def _valued(change: Callable[[Array, _Look], Array]) -> Callable[[_Look], _Parts]:
    """A fault that changes the values alone."""

    def act(look: _Look) -> _Parts:
        values, valid, stamp = look.parts
        return change(values, look), valid, stamp

    return act


def _constant(look: _Look) -> _Parts:
    values, valid, stamp = look.parts
    return jnp.full_like(values, look.size), jnp.ones_like(valid) if look.whole else valid, stamp


def _noisy(values: Array, look: _Look) -> Array:
    """Additional white noise: together with the sensor's own its std is `size` times that."""
    std = column(look.sensor.noise_std, values) * math.sqrt(look.size**2 - 1)
    return values + std * look.w[: len(values)]


def _frozen(look: _Look) -> _Parts:
    _, valid, stamp = look.parts
    held = look.ring[0]
    return held[:-2], held[-2] if look.whole else valid, stamp


def _dropout(look: _Look) -> _Parts:
    values, valid, stamp = look.parts
    return jnp.zeros_like(values), jnp.zeros_like(valid), stamp


def _late(look: _Look) -> _Parts:
    """Linear interpolation between the two readings around the time `size` (s) ago."""
    _, valid, stamp = look.parts
    whole, part = _periods(look.size, look.sensor.rate)
    older = look.ring[whole]
    values, mark = older[:-2], older[-2]
    if part:
        change = look.ring[whole + 1][:-2] - values
        change = wrap(change) if look.sensor.angle else change
        values, mark = values + part * change, mark * look.ring[whole + 1][-2]
    return values, mark if look.whole else mark * valid, stamp


def _frozen_stamp(look: _Look) -> _Parts:
    values, valid, _ = look.parts
    return values, valid, look.ring[0][-1]


def _stamp_offset(look: _Look) -> _Parts:
    values, valid, stamp = look.parts
    return values, valid, stamp + look.size


def _periods(time: float, rate: float) -> tuple[int, float]:
    """A time in whole periods, and the remaining fraction (zero if it is rounding)."""
    whole = math.floor(time * rate + _SLACK)
    part = time * rate - whole
    return whole, part if part > _SLACK else 0.0


def _kept_late(size: float, rate: float) -> int:
    whole, part = _periods(size, rate)
    return whole + (2 if part else 1)


def _in_range(yaw: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """An angle wrapped to [−π, π); one in the range, or not finite, is returned unchanged."""
    outside: Bool[Array, "*shape"] = jnp.isfinite(yaw) & ((yaw < -math.pi) | (yaw >= math.pi))
    return jnp.where(outside, wrap(yaw), yaw)


class _Kind(NamedTuple):
    """Definition of a kind of fault."""

    act: Callable[[_Look], _Parts]
    size: str | None = None
    """Description of the size, for error messages."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    marks: bool = False
    """Whether it affects the valid mark or the stamp."""
    kept: Callable[[float, float], int] = lambda size, rate: 0
    """Number of readings that it stores, given its size and the sensor's rate."""


_UNIT = "in the unit of the values (m/s² and rad/s, m/s, m, rad)"
_ONE: Callable[[float, float], int] = lambda size, rate: 1  # noqa: E731
_KINDS: Mapping[str, _Kind] = {
    "nan": _Kind(_valued(lambda values, _: jnp.full_like(values, jnp.nan))),
    "infinite": _Kind(_valued(lambda values, _: jnp.full_like(values, jnp.inf))),
    "constant": _Kind(_constant, f"the value that is shown, {_UNIT}"),
    "offset": _Kind(_valued(lambda values, look: values + look.size), f"an offset, {_UNIT}"),
    "drift": _Kind(
        _valued(lambda values, look: values + look.size * look.elapsed), f"a rate a second, {_UNIT}"
    ),
    "scale": _Kind(_valued(lambda values, look: look.size * values), "a factor"),
    "noise": _Kind(_valued(_noisy), "a factor of 1 or more on the sensor's noise", (1.0, math.inf)),
    "frozen": _Kind(_frozen, kept=_ONE),
    "dropout": _Kind(_dropout, marks=True),
    "latency": _Kind(
        _late, f"a time (s) above zero, at most {_LONGEST:g}", (1e-3, _LONGEST), kept=_kept_late
    ),
    "frozen_stamp": _Kind(_frozen_stamp, marks=True, kept=_ONE),
    "stamp_offset": _Kind(_stamp_offset, "a time (s) that is added to the stamp", marks=True),
}
assert set(_KINDS) == set(get_args(FaultName))
