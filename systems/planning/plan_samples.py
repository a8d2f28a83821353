"""The sample vector: sampled paths and their weights, for reports and replays."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Samples(NamedTuple):
    """Positions (m, W) at t0 + (k + 1) dt of some sampled paths, and the paths' weights."""

    t0: Float[Array, ""]
    p_WB: Float[Array, "horizon 3 paths"]
    weights: Float[Array, " paths"]


@dataclass(frozen=True)
class SampleLayout:
    """Layout of samples in a flat vector: t0, then horizon × 3 × paths positions, then weights.

    Attributes:
        horizon: steps of a path.
        dt: length of a step (s).
        paths: number of paths.
    """

    horizon: int
    dt: float
    paths: int

    @property
    def size(self) -> int:
        """Length of the vector."""
        return 1 + (3 * self.horizon + 1) * self.paths

    def pack(
        self,
        t0: Float[Array, ""],
        p_WB: Float[Array, "horizon 3 paths"],
        weights: Float[Array, " paths"],
    ) -> Float[Array, " size"]:
        """The flat vector; a number that is not finite becomes 0."""
        vector = jnp.concatenate([t0.reshape(1), p_WB.ravel(), weights])
        return jnp.where(jnp.isfinite(vector), vector, 0)

    def unpack(self, vector: Float[Array, " size"]) -> Samples:
        """The samples of a flat vector."""
        split = 1 + 3 * self.horizon * self.paths
        paths = vector[1:split].reshape(self.horizon, 3, self.paths)
        return Samples(vector[0], paths, vector[split:])
