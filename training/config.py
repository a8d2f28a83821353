"""Settings of a training run, as YAML (`models.config.typed_yaml`) and on the command line."""

from dataclasses import dataclass, field
from typing import Literal

from ..models.config.checks import check_numbers, require
from ..models.spinn import SpinnConfig
from .losses.kinds import ObjectiveConfig
from .losses.matching import Fdm


@dataclass(frozen=True)
class WindowConfig:
    """How recordings are cut into windows and what is held out."""

    length_s: float = 4.0
    stride_s: float = 0.5
    """Time between the starts of training windows; held-out windows don't overlap."""
    normalise: Literal["heading", "identity", "none"] = "heading"
    held_out: float = 0.25
    by: Literal["auto", "time", "run"] = "auto"
    gap_s: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(self)
        for name in ("length_s", "stride_s"):
            require(getattr(self, name) > 0, self, name, "give a time above 0 s")
        require(0 < self.held_out < 1, self, "held_out", "give a fraction between 0 and 1")


@dataclass(frozen=True)
class PretrainConfig:
    """Fit of the coefficient networks to the preset before training."""

    steps: int = 400
    batch: int = 64
    learning_rate: float = 2e-2
    speed: float = 1.0
    """Standard deviation of sampled velocities (m/s and rad/s)."""
    tolerance: float = 0.01
    """Mean squared relative error below which the fit is skipped."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.steps >= 0, self, "steps", "give zero or more")
        require(self.batch >= 1, self, "batch", "give at least 1")
        for name in ("learning_rate", "speed"):
            require(getattr(self, name) > 0, self, name, "give a positive number")


@dataclass(frozen=True)
class DriftConfig:
    """Least squares on the output biases before the law is trained (`training.fitting.drift`)."""

    iterations: int = 12
    """Largest number of solver steps in each of two passes; 0 skips the fit."""
    length_s: float = 1.0
    """Duration (s) of the pieces whose noise-free motion is compared."""
    pieces: int = 256
    """Largest number of pieces that are fitted."""
    prior: float = 1e-4
    """Weight of the squared change of a raw bias (a change of 1 about doubles a coefficient) and of
    the relative change of the potential's bound and net buoyancy, relative to the mean squared
    error in units of the model's typical error."""
    innovations: Literal["auto", "always", "never"] = "auto"
    """Whether constants and b are fitted to one-step innovations instead
    (`training.fitting.likelihood`): efficient for exactly known states, biased by measurement
    noise. `auto` does it if the correlation of the remaining innovations is below `white`."""
    white: float = 0.1
    """Largest correlation of neighbouring innovations, on any axis, that counts as white.
    Measurement noise of a tenth of an innovation's variance makes it -0.08."""
    most_steps: int = 50000
    """Largest number of one-step innovations used, spread evenly over all."""
    prior_sd: float = 3.0
    """Prior standard deviation of raw biases about the preset's in that fit; 3 is a factor of ten
    in a coefficient. 0 stands for no prior."""

    def __post_init__(self) -> None:
        check_numbers(self)
        kinds = ("auto", "always", "never")
        require(self.innovations in kinds, self, "innovations", f"use one of {kinds}")
        require(self.white > 0, self, "white", "give a positive number")
        require(self.most_steps >= 1, self, "most_steps", "give at least 1")
        require(self.prior_sd >= 0, self, "prior_sd", "give zero or more")
        require(self.iterations >= 0, self, "iterations", "give zero or more")
        require(self.length_s > 0, self, "length_s", "give a time above 0 s")
        require(self.pieces >= 1, self, "pieces", "give at least 1")
        require(self.prior >= 0, self, "prior", "give zero or more")


@dataclass(frozen=True)
class TrainingConfig:
    """One training run; the defaults suit a few minutes of data of one vehicle on two cores.

    Example:
        >>> TrainingConfig(steps=1000, seed=1).batch
        16
    """

    objective: ObjectiveConfig = field(default_factory=Fdm)
    model: SpinnConfig = field(default_factory=lambda: SpinnConfig(constant_mass=True))
    windows: WindowConfig = field(default_factory=WindowConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    drift: DriftConfig = field(default_factory=DriftConfig)
    steps: int = 400
    batch: int = 16
    """Windows per step."""
    learning_rate: float = 3e-3
    """Adam's peak rate; the paper's is 1e-4, constant."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """After the warm-up: cosine decay to 1 % of the peak, or constant."""
    warm_up: int = 50
    """Steps of linear rise to the peak rate."""
    clip: float = 1.0
    """Norm to which a step's gradient is clipped; 0 disables clipping."""
    head_decay: float = 30.0
    """Decoupled decay (Loshchilov and Hutter 2019) of the networks' output weights: coefficients
    stay as constant in velocity as the data allow."""
    refit_at: tuple[float, ...] = (0.3,)
    """Fractions of the run at which bandwidths are refitted to the remaining errors."""
    seed: int = 0
    validate_every: int = 50
    patience: int = 0
    """Validations without improvement after which training stops; 0 disables early stopping."""
    checkpoint_every: int = 100
    max_recoveries: int = 8
    """Non-finite steps that are recovered from before the run fails."""

    def __post_init__(self) -> None:
        check_numbers(self)
        for name in ("steps", "batch", "validate_every", "checkpoint_every"):
            require(getattr(self, name) >= 1, self, name, "give at least 1")
        for name in ("warm_up", "clip", "head_decay", "patience", "max_recoveries", "seed"):
            require(getattr(self, name) >= 0, self, name, "give zero or more")
        require(self.learning_rate > 0, self, "learning_rate", "give a positive number")
        decay = self.learning_rate * self.head_decay
        require(decay <= 1, self, "head_decay", "give at most 1 / learning_rate")
        for fraction in self.refit_at:
            require(0 < fraction < 1, self, "refit_at", "give fractions between 0 and 1")
