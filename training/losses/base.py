"""Interface of training objectives.

An objective has a frozen dataclass of settings with `build(model, windows) -> Objective`; that
class is a member of the union `kinds.ObjectiveConfig`, so that YAML names it by its tag.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...models.dynamics import Dynamics
from ...models.effects.recorded_rollout import Commands
from ..data.windows import Hidden, Windows


class Batch(NamedTuple):
    """Windows as arrays on the device: poses and twists at t_0 … t_T, wrenches of the T steps.

    `place` numbers the windows: the noise of a window depends on its place, not on the other
    windows, so that a batch split over devices has the same noise as on one device. `commands`
    are for models with effects, which act on single thrusters and have memory. The wrench changes
    by `rise` over a step.
    """

    X: Float[Array, "N 7 W"]
    V: Float[Array, "N 6 W"]
    F: Float[Array, "T 6 W"]
    place: Int[Array, " W"]
    commands: Commands | None = None
    hidden: Hidden | None = None
    rise: Float[Array, "T 6 W"] | None = None

    @classmethod
    def of(cls, windows: Windows) -> "Batch":
        """All windows as one batch."""
        w = windows
        arrays = (w.X, w.V, w.F, w.commands, w.hidden, w.rise)
        X, V, F, commands, hidden, rise = jax.tree.map(jnp.asarray, arrays)
        return cls(X, V, F, jnp.arange(len(w)), commands, hidden, rise)

    def take(self, indices: Int[Array, " B"]) -> "Batch":
        """The windows of some indices, with new places."""
        arrays = (self.X, self.V, self.F, self.commands, self.hidden, self.rise)
        X, V, F, commands, hidden, rise = jax.tree.map(lambda a: a[:, :, indices], arrays)
        return Batch(X, V, F, jnp.arange(indices.size), commands, hidden, rise)

    @property
    def spread(self) -> Float[Array, "6 6 W"] | None:
        """Of the first twists that were not recorded (`predict`)."""
        return None if self.hidden is None else jnp.asarray(self.hidden.spread)

    def shown(
        self, X: Float[Array, "T 7 P W"], V: Float[Array, "T 6 P W"]
    ) -> tuple[Float[Array, "T 7 P W"], Float[Array, "T 6 P W"]]:
        """Predicted motions as far as they were recorded: other channels are set to this batch's.

        No difference of motions is then in channels that nobody has measured.
        """
        if self.hidden is None:
            return X, V
        seen = jnp.asarray(self.hidden.seen)[:, :, None] > 0
        place = jnp.where(seen[:, :3], X[:, 4:], self.X[1:, 4:, None])
        return (
            jnp.concatenate([X[:, :4], place], axis=1),
            jnp.where(seen[:, 3:], V, self.V[1:, :, None]),
        )


class Objective(eqx.Module):
    """A loss and its constants; its array fields are data (bandwidths) and are not trained."""

    name: ClassVar[str]
    mean_of_windows: ClassVar[bool] = True
    """Whether the loss of a batch is the mean of the losses of its groups of windows."""

    @abc.abstractmethod
    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """The mean loss over the batch and its parts by name.

        All randomness comes from `key`; that of a window also depends on its place.
        """

    def group_size(self) -> int:
        """Number of windows of equal scenario and start in each group of a batch.

        Batches hold whole groups, one after the other (`training.data.groups`); 1 means no groups.
        """
        return 1

    def refit(self, model: Dynamics, windows: Windows) -> "Objective":
        """The objective with its data-driven constants refitted to the errors of `model`."""
        del model, windows
        return self
