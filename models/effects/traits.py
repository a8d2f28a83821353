"""What a diagnosis knows of an effect, declared on its class."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from ..dynamics import Dynamics

Group = Literal["scales", "linear", "command", "all"]
"""Coefficients that are fitted together before causes are sought (`--refit`)."""
Need = Literal["thrust", "pwm", "voltage", "velocity"]
"""What a recording may lack: commands of single thrusters, pulses, supply voltage, velocity."""


class Region(NamedTuple):
    """What the options of an effect depend on: where a vehicle was (m in W), and mean step (s)."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    step: float

    def with_other(self, other: "Region") -> "Region":
        """The least region that holds both."""
        (a, b, c), (d, e, f) = self.low, other.low
        (g, h, i), (j, k, m) = self.high, other.high
        low, high = (min(a, d), min(b, e), min(c, f)), (max(g, j), max(h, k), max(i, m))
        return Region(low, high, self.step)


class Traits:
    """Base of `Effect`: how a diagnosis treats it, and what it is to the believed model.

    Attributes:
        simpler: causes that explain the same data with less, preferred unless clearly worse.
        echoes: causes with similar signatures, which may appear as each other's residue.
        essential: parameters of which at least one must differ from zero for this cause.
        absorber: whether it fits slow structure of any origin, and is therefore ranked last.
        random: whether it is drawn anew for each run: a law of the disturbance, no constant cause.
        slow: whether it is random and correlated over many samples, so that causes imitate it.
        observed: whether the records themselves show it, so that it is read off and not fitted.
        timing: whether its parameters are lags or delays, which short steps only resolve.
        at_rest: whether it is identifiable without commands, though actuation or body.
        passive: whether the believed coefficient plus the change may not be negative.
        needs: what a recording must have for it to be identifiable.
        refits: coefficients that it belongs to; of an effect with a place `all`, only this place.
        refit_only: whether it is fitted as a coefficient alone, and never named as a cause.
        refit_needs: what a recording must have for it to be one of all coefficients.
        replaces: effects that are no coefficients where this one is.
    """

    simpler: ClassVar[tuple[str, ...]] = ()
    echoes: ClassVar[tuple[str, ...]] = ()
    essential: ClassVar[tuple[str, ...]] = ()
    absorber: ClassVar[bool] = False
    random: ClassVar[bool] = False
    slow: ClassVar[bool] = False
    observed: ClassVar[bool] = False
    timing: ClassVar[bool] = False
    at_rest: ClassVar[bool] = False
    passive: ClassVar[bool] = False
    needs: ClassVar[frozenset[Need]] = frozenset()
    refits: ClassVar[tuple[Group, ...]] = ()
    refit_only: ClassVar[bool] = False
    refit_needs: ClassVar[frozenset[Need]] = frozenset()
    replaces: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def options_for(cls, region: Region) -> Mapping[str, Any]:
        """Further fields that suit the data."""
        del region
        return {}

    @classmethod
    def believed(cls, base: Dynamics, place: str) -> float:
        """The believed model's own coefficient that the effect changes; 0 where it has none."""
        del base, place
        return 0.0

    @classmethod
    def refit_prior(cls, base: Dynamics, place: str) -> tuple[float, float] | None:
        """Prior standard deviation of a coefficient, and its least change; None: as declared."""
        del base, place
        return None

    def pose_delay(self) -> np.ndarray:
        """Delay of recorded poses against twists, by axis (s); the mean over a batch."""
        return np.zeros(6)
