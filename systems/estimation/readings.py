"""Readings of the sensors besides the IMU: their values' places, and whether they can be used."""

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models.sensors import Sensor

_STUCK_TOGETHER = 2  # repeats of all values of a sensor with several


def sizes(aids: Sequence[Sensor]) -> tuple[int, ...]:
    """Numbers of values in the sensors' readings."""
    return tuple(each.value_size for each in aids)


def parts(aids: Sequence[Sensor]) -> list[slice]:
    """The sensors' places in their joined values."""
    return [slice(b - n, b) for n, b in zip(sizes(aids), accumulate(sizes(aids)), strict=True)]


def noises(aids: Sequence[Sensor], dtype: jnp.dtype) -> Float[Array, "m"]:
    """Standard deviations of all values' white noise."""
    return jnp.concatenate([jnp.asarray(each.noise_std, dtype) for each in aids])


def each_value(per_sensor: Array, aids: Sequence[Sensor]) -> Array:
    """A number or mark of each sensor, repeated for its values."""
    counts = sizes(aids)
    return jnp.repeat(per_sensor, jnp.array(counts), total_repeat_length=sum(counts))


def offset_places(aids: Sequence[Sensor], errors: int) -> tuple[np.ndarray, np.ndarray]:
    """The places of all offsets and of their drifts among the components of δ."""
    m = sum(sizes(aids))
    return np.arange(errors - 2 * m, errors - m), np.arange(errors - m, errors)


def offsets(aids: Sequence[Sensor], size: int) -> list[slice]:
    """The places of the sensors' offsets among their `size` errors: before their drifts."""
    first = size - 2 * sum(sizes(aids))
    return [slice(first + part.start, first + part.stop) for part in parts(aids)]


class Shown(NamedTuple):
    """The sensors' last readings, their values joined."""

    values: Float[Array, "m"]
    stamps: Float[Array, "n"]
    repeats: Float[Array, "m"]
    """Number of readings for which each value has been the same."""

    @classmethod
    def start(cls, aids: Sequence[Sensor], dtype: jnp.dtype) -> "Shown":
        """Before the first reading."""
        never, m = jnp.full(len(aids), -jnp.inf, dtype), sum(sizes(aids))
        return cls(jnp.full(m, jnp.inf, dtype), never, jnp.zeros(m, dtype))

    def stuck(self, aids: Sequence[Sensor]) -> Bool[Array, "n"]:
        """Whether a sensor repeats the same values bit for bit in new readings."""
        found = []
        for each, part in zip(aids, parts(aids), strict=True):
            repeats = self.repeats[part]
            mark = repeats.max() >= each.stuck_after
            if each.value_size > 1:
                mark = mark | (repeats.min() >= _STUCK_TOGETHER)
            if each.observes == "velocity":  # lost bottom lock, reported as a zero velocity
                mark = mark | jnp.all(self.values[part] == 0)
            found.append(mark)
        return jnp.stack(found)

    def with_readings(
        self,
        aids: Sequence[Sensor],
        values: Float[Array, "m"],
        valid: Bool[Array, "n"],
        stamps: Float[Array, "n"],
    ) -> tuple["Shown", Bool[Array, "n"]]:
        """The memory with the present readings, and which of them are usable."""
        new = valid & (stamps != self.stamps) & jnp.isfinite(stamps)
        fresh = each_value(new, aids)
        again = jnp.where(values == self.values, self.repeats + 1, 0)
        after = Shown(
            jnp.where(fresh, values, self.values),
            jnp.where(new, stamps, self.stamps),
            jnp.where(fresh, again, self.repeats),
        )
        finite = jnp.stack([jnp.isfinite(values[part]).all() for part in parts(aids)])
        in_range = [
            jnp.sum(values[part] ** 2) <= each.largest**2
            for each, part in zip(aids, parts(aids), strict=True)
        ]
        usable = valid & finite & jnp.isfinite(stamps) & ~after.stuck(aids)
        return after, usable & jnp.stack(in_range)
