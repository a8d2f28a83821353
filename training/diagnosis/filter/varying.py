"""Effects that act in a part of the data: an envelope multiplies their parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ....models.effects.base import Effect
from ....models.effects.extended import Extended
from ....models.effects.library import PART, Entry, Library, whole
from ..data.arrays import Data
from ..findings.result import When


@dataclass(frozen=True)
class Part:
    """A change of an effect's parameters at one place, in a part of the data.

    Attributes:
        name: of the effect and the number of the part: `thruster_gain#1`.
        where: place of the effect.
        envelope: factor of the change at every sample, 0 to 1 (M, R).
        final: the factor after the last sample of the session; 0 where the change has ended.
        when: the part of the data in words and numbers.
    """

    name: str
    where: str
    envelope: Float[np.ndarray, "M R"]
    final: float
    when: When


class Modulated(eqx.Module):
    """Values of an effect that an envelope multiplies and adds to its constant ones."""

    effect: str = eqx.field(static=True)
    values: Float[Array, "p *b"]
    envelope: Float[Array, "M R"]


def at_sample(model: Extended, changes: tuple[Modulated, ...], number: Array | int) -> Extended:
    """The model with its effects as they are at sample `number` of all pieces."""
    if not changes:
        return model
    effects = []
    for e in model.effects:
        values = e.values
        for change in changes:
            if change.effect == e.name:
                envelope = jnp.expand_dims(change.envelope[number], tuple(range(values.ndim - 1)))
                values = values + change.values * envelope.astype(values.dtype)
        effects.append(eqx.tree_at(lambda x: x.values, e, values))
    return replace(model, effects=tuple(effects))


class VaryingLibrary(Library):
    """A library with parts: their parameters follow those of the effects in θ."""

    def __init__(self, effects: Sequence[Effect], parts: Sequence[Part] = ()):
        super().__init__(effects)
        self.parts = tuple(parts)
        self._constant = len(self.entries)
        own = [(part, e) for part in self.parts for e in self._of(part)]
        self.entries += tuple(Entry(part.name, e.where, e.parameter) for part, e in own)
        self._index = {(e.cause, e.where, e.parameter.name): i for i, e in enumerate(self.entries)}

    def _of(self, part: Part) -> list[Entry]:
        name = whole(part.name)
        return [e for e in self.entries if e.cause == name and e.where == part.where]

    def hypotheses(self, single: bool | None = None) -> list[tuple[str, str]]:
        """Causes that act in all of the data."""
        return [h for h in super().hypotheses(single) if PART not in h[0]]

    def constant(self, cause: str, where: str) -> list[int]:
        """Indices in θ of the parameters that a part changes."""
        return self.at(whole(cause), where)

    def changes(
        self, theta: Float[Array | np.ndarray, "p *b"], pieces: Int[np.ndarray, " K"] | slice
    ) -> tuple[Modulated, ...]:
        """What the parts add to the effects of `filled`, at every sample of some pieces."""
        found = []
        for part in self.parts:
            name = whole(part.name)
            effect = next(e for e in self.effects if e.name == name)
            first = self.at(name, effect.places[0])[0]
            values = jnp.zeros((effect.values.shape[0], *theta.shape[1:]))
            rows = np.array(self.at(name, part.where)) - first
            values = values.at[rows].set(jnp.asarray(theta[self.at(part.name, part.where)]))
            found.append(Modulated(name, values, jnp.asarray(part.envelope[:, pieces])))
        return tuple(found)

    def used(self, theta: Float[np.ndarray, " p"]) -> tuple[Effect, ...]:
        """The effects that are not absent after the last sample of the session."""
        theta = theta.copy()
        for part in self.parts:
            theta[self.constant(part.name, part.where)] += (
                part.final * theta[self.at(part.name, part.where)]
            )
        return super().used(theta)


def changes_of(
    library: Library, theta: Any, pieces: Int[np.ndarray, " K"] | slice = slice(None)
) -> tuple[Modulated, ...]:
    """What parts of a library add to its effects; none for a library without parts."""
    return library.changes(theta, pieces) if isinstance(library, VaryingLibrary) else ()


def parts_of(library: Library) -> tuple[Part, ...]:
    """The parts of a library that has any."""
    return library.parts if isinstance(library, VaryingLibrary) else ()


def acting(library: Library, data: Data) -> Library:
    """The library for other data, in all of which its parts act."""
    every = np.ones((data.weight.shape[0] + 1, data.weight.shape[1]))
    parts = [replace(part, envelope=every, final=1.0) for part in parts_of(library)]
    return VaryingLibrary(library.effects, parts) if parts else library


def widened(
    library: Library, effects: Sequence[Effect] = (), parts: Sequence[Part] = ()
) -> Library:
    """A library with more effects or parts."""
    every, both = [*library.effects, *effects], [*parts_of(library), *parts]
    return VaryingLibrary(every, both) if both else Library(every)
