"""What a training step makes small: the interface that every method of training implements.

A method is a frozen dataclass of settings with `build(model, windows) -> Objective`; the settings'
class stands in the union `objectives.ObjectiveConfig`, so YAML names it by its tag.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...models.dynamics import Dynamics
from ...models.effects.recorded_rollout import Commands
from ..data.windows import Windows


class Batch(NamedTuple):
    """Windows as arrays on the device: poses and twists at t_0 … t_T, wrenches of the T steps.

    `place` numbers the windows: what is drawn for a window depends on its place, not on which
    others are at hand, so a batch shared among devices sees the noise that one device would.
    `commands` are there for models with effects, which act on single thrusters and remember.
    """

    X: Float[Array, "N 7 W"]
    V: Float[Array, "N 6 W"]
    F: Float[Array, "T 6 W"]
    place: Int[Array, " W"]
    commands: Commands | None = None

    @classmethod
    def of(cls, windows: Windows) -> "Batch":
        """All windows as one batch."""
        arrays = (windows.X, windows.V, windows.F)
        X, V, F, commands = jax.tree.map(jnp.asarray, (*arrays, windows.commands))
        return cls(X, V, F, jnp.arange(len(windows)), commands)

    def take(self, indices: Int[Array, " B"]) -> "Batch":
        """The windows of some indices, in places of their own."""
        arrays = (self.X, self.V, self.F, self.commands)
        X, V, F, commands = jax.tree.map(lambda a: a[:, :, indices], arrays)
        return Batch(X, V, F, jnp.arange(indices.size), commands)


class Objective(eqx.Module):
    """A loss with what it needs to know; its array fields are data (bandwidths), never trained."""

    name: ClassVar[str]
    mean_of_windows: ClassVar[bool] = True
    """Whether the loss of a batch is the mean of the losses of its groups of windows."""

    @abc.abstractmethod
    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """The mean loss over the batch and its parts by name.

        All randomness comes from `key`, and what is drawn for a window from its place too.
        """

    def group_size(self) -> int:
        """How many windows of equal scenario and start stand side by side in a batch.

        Batches hold whole groups, one after the other (`training.data.groups`); 1 is any window.
        """
        return 1

    def refit(self, model: Dynamics, windows: Windows) -> "Objective":
        """The objective with its data-driven constants fitted anew to what `model` now misses."""
        del model, windows
        return self
