"""Effects as settings: what a scenario's YAML says that a simulation has besides."""

from dataclasses import dataclass, field

from ..errors import UserError
from .base import Effect
from .library import KINDS


@dataclass(frozen=True)
class EffectConfig:
    """One effect by name: `{name: thruster_gain, where: "3", parameters: {gain: -0.5}}`.

    Attributes:
        name: that of a cause (`library.KINDS`).
        where: axis, thruster or frame; may be left out where there is one place, or `all`.
        parameters: by name, in the units that the effect's class states; zero if left out.
        options: further fields of the class (the `floor` and `walls` of `proximity`).
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
            UserError: a name is unknown or a value not admissible.
        """
        if self.name not in KINDS:
            known = ", ".join(sorted(KINDS))
            raise UserError(f"effects.name is {self.name!r}: take one of {known}")
        options = {k: tuple(v) if isinstance(v, list) else v for k, v in self.options.items()}
        try:
            return KINDS[self.name].of(self.where, options=options, **self.parameters)
        except TypeError as error:
            raise UserError(f"{self.name}.options: {error}") from error
