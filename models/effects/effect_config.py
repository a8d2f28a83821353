"""Configuration of effects in a scenario's YAML."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ..config.errors import UserError
from .base import Effect
from .library import KINDS


@dataclass(frozen=True)
class EffectConfig:
    """One effect by name: `{name: thruster_gain, where: "3", parameters: {gain: -0.5}}`.

    Attributes:
        name: name of a cause (`library.KINDS`).
        where: axis, thruster or frame; may be left out where there is one place, or `all`.
        parameters: by name, in the units that the effect's class states; zero if left out.
        options: further fields of the class (the `floor` and `walls` of `proximity`).

    Example:
        >>> half = EffectConfig("thruster_gain", where="3", parameters={"gain": -0.5})
        >>> station = StationConfig(effects=(half,))  # thruster 3 pushes half as much
    """

    name: str
    where: str | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    options: dict[str, float | list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check names and values."""
        self.build()

    def build(self) -> Effect:
        """The effect, in JAX's own precision.

        Raises:
            UserError: a name is unknown, a value not admissible, or no parameter is given.
        """
        if self.name not in KINDS:
            known = ", ".join(sorted(KINDS))
            raise UserError(f"effects.name is {self.name!r}: take one of {known}")
        kind = KINDS[self.name]
        for parameter in self.parameters:
            kind.index(self.place, parameter)
        effect = kind.of(self.where, options=self._options(kind), **self.parameters)
        if not self.parameters:
            names = ", ".join(p.name for p in kind.parameters)
            raise UserError(
                f"{self.name} has no parameters, so it changes nothing: give one of {names}"
            )
        return effect

    @property
    def place(self) -> str:
        """Where it acts."""
        return self.where or KINDS[self.name].places_with(1)[0]

    def _options(self, kind: type[Effect]) -> dict[str, Any]:
        known = {f.name: f.default for f in fields(kind) if f.name != "values"}
        for name, value in self.options.items():
            if name not in known:
                has = f"take one of {', '.join(known)}" if known else "it has none; leave it out"
                raise UserError(f"{self.name}.options has no {name!r}: {has}")
            usual = np.asarray(known[name])
            if np.shape(value) != usual.shape or not np.all(np.isfinite(value)):
                wanted = f"{usual.size} finite numbers" if usual.shape else "a finite number"
                raise UserError(f"{self.name}.options.{name} is {value}: give {wanted}")
            if isinstance(known[name], int) and not _counts(value):
                raise UserError(f"{self.name}.options.{name} is {value}: give 1, 2, 3, …")
        return {k: tuple(v) if isinstance(v, list) else v for k, v in self.options.items()}


def _counts(value: float | list[float]) -> bool:
    number = np.asarray(value)
    return bool(np.all((number >= 1) & (number == np.round(number))))


def check_distinct(effects: Iterable[EffectConfig]) -> None:
    """Refuse two effects of one name at one place.

    Raises:
        UserError: there are two; the message names them.
    """
    seen: set[tuple[str, str]] = set()
    for effect in effects:
        here = effect.name, effect.place
        if here in seen:
            raise UserError(
                f"effects: {here[0]} ({here[1]}) is there twice; give all its parameters in one"
            )
        seen.add(here)
