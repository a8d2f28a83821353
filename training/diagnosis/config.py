"""Options of a diagnosis."""

from dataclasses import dataclass

from ...models.config.checks import check_numbers, require, require_rate
from .selection.search import Refit


@dataclass(frozen=True)
class DiagnoseConfig:
    """Options of a diagnosis.

    Attributes:
        alpha: rate of false alarms over all causes together.
        refit: what is fitted before the causes and stays free with them: `none` (every difference
            from the believed model is a cause), `scales` (one factor on all thrust), `linear`
            (added masses, drag, buoyancy), `command` (a factor on the wrench of each axis, drag,
            buoyancy: for commands of unknown scale; the inertia stays as believed) or `all` (these,
            the thrust curve and lever arms, the centre of buoyancy: `identify`). `auto` is `none`
            if left-out data bear out its verdict (`validation.claims`). Else `all` are fitted, and
            the diagnosis that forecasts better is taken.
        most: causes at most.
        horizon: length of the simulations for validation (s).
        seed: of bootstraps and simulated noise.

    Example:
        >>> DiagnoseConfig(alpha=0.001, refit="none").most
        6
    """

    alpha: float = 0.01
    refit: Refit = "auto"
    most: int = 6
    horizon: float = 4.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_numbers(self)
        require_rate(self.alpha, "DiagnoseConfig.alpha")
        require(self.most >= 1, self, "most", "give at least 1")
        require(self.horizon > 0, self, "horizon", "give a positive time")
