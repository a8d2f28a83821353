"""Configuration of a study: true vehicle, initial belief, regimes of data, sizes."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypeVar, get_args

from ...models.config.checks import Vector6, check_numbers, require
from ...models.config.errors import UserError
from ...training.config import TrainingConfig
from ...training.data.generate import GenerateConfig
from ...training.data.maneuvers import MANEUVERS
from ...training.evaluation.law_metrics import GroundMetric

T = TypeVar("T")
Regime = Literal["rich", "sparse"]
Scale = Literal["full", "small", "tiny"]
REGIMES: tuple[Regime, ...] = ("rich", "sparse")


@dataclass(frozen=True)
class TruthConfig:
    """The law to be learned: a preset with a constant diagonal diffusion b (N√s, N·m√s).

    With the default b and efforts every scenario's law stays within the logarithm's domain about
    its mean for ten seconds, as the paper's geodesic kernel requires.
    """

    vehicle: str = "bluerov2_heavy"
    diffusion: Vector6 = (1.0, 1.0, 1.0, 0.05, 0.05, 0.05)
    substeps: int = 10
    """Integration steps per sample."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(min(self.diffusion) > 0, self, "diffusion", "give six positive numbers")
        require(self.substeps >= 1, self, "substeps", "give at least 1")


@dataclass(frozen=True)
class RegimeConfig:
    """The trajectories that a model learns from; all start at rest and upright."""

    maneuvers: tuple[str, ...] = tuple(MANEUVERS)
    trajectories: int = 20
    """Trajectories of each maneuver."""
    duration: float = 10.0
    """Duration of each (s), and of the motions on which laws are compared."""
    rate: float = 20.0
    """Samples per second."""
    effort: float = 0.3
    """Share of the largest wrench in each maneuver's direction."""

    def generate_config(self, truth: TruthConfig, seed: int) -> GenerateConfig:
        """The simulation of one seed's trajectories."""
        return GenerateConfig(
            maneuvers=self.maneuvers,
            trajectories=self.trajectories,
            duration=self.duration,
            rate=self.rate,
            substeps=truth.substeps,
            effort=self.effort,
            diffusion=truth.diffusion,
            seed=seed,
        )


@dataclass(frozen=True)
class SizeConfig:
    """Training settings common to all methods of a study; null keeps the method's own."""

    substeps: int | None = 3
    """Integration steps per sample: with two of 25 ms the learned yaw inertia is 10 % too small."""
    steps: int | None = 600
    batch: int | None = None
    samples: int | None = None
    """Predicted motions per window, for objectives that use them."""
    width: int | None = None
    depth: int | None = None
    pretrain_steps: int | None = None
    drift_iterations: int | None = None
    """0 starts from the belief, whose coefficients have not been fitted to data."""
    learning_rate: float | None = None
    head_decay: float | None = None
    refit_at: tuple[float, ...] | None = None
    length_s: float | None = None
    """Length of each window (s)."""
    stride_s: float | None = None

    def apply(self, config: TrainingConfig, seed: int) -> TrainingConfig:
        """A method's settings at this size."""
        steps = _given(self.steps, config.steps)
        drift = config.drift
        if self.length_s is not None:
            drift = replace(drift, length_s=min(drift.length_s, self.length_s))
        return replace(
            config,
            objective=_changed(
                config.objective, {"samples": self.samples, "substeps": self.substeps}
            ),
            model=_changed(config.model, {"width": self.width, "depth": self.depth}),
            windows=_changed(
                config.windows, {"length_s": self.length_s, "stride_s": self.stride_s}
            ),
            pretrain=_changed(config.pretrain, {"steps": self.pretrain_steps}),
            drift=_changed(drift, {"iterations": self.drift_iterations}),
            learning_rate=_given(self.learning_rate, config.learning_rate),
            head_decay=_given(self.head_decay, config.head_decay),
            refit_at=_given(self.refit_at, config.refit_at),
            steps=steps,
            batch=_given(self.batch, config.batch),
            warm_up=min(config.warm_up, steps // 4),
            validate_every=min(config.validate_every, max(1, steps // 4)),
            checkpoint_every=min(config.checkpoint_every, max(1, steps // 4)),
            seed=seed,
        )


def _given(value: T | None, own: T) -> T:
    """A study's value, or the method's own if it is None."""
    return own if value is None else value


def _changed(part: Any, values: dict[str, Any]) -> Any:
    """The dataclass `part` with the given values of its fields, except those that are None."""
    known = {field.name for field in fields(part)}
    return replace(part, **{k: v for k, v in values.items() if v is not None and k in known})


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of the comparison of learned laws with the true one."""

    samples: int = 350
    """Motions per scenario, from the true and from the learned law."""
    times: int = 50
    """Evenly spaced times of the horizon at which laws are compared."""
    metric: GroundMetric = field(default_factory=GroundMetric)
    shown: tuple[str, ...] = ("surge-forward", "surge-yaw-left", "surge-sway-heave")
    """Scenarios whose laws are plotted (those that the regime has)."""
    shown_samples: int = 750

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.samples >= 20, self, "samples", "give at least 20")
        for name in ("times", "shown_samples"):
            require(getattr(self, name) >= 1, self, name, "give at least 1")


@dataclass(frozen=True)
class StudyConfig:
    """All settings of an ablation study, except the part of it that is run."""

    truth: TruthConfig = field(default_factory=TruthConfig)
    belief: str = "bluerov2_heavy_ng"
    """The preset (or YAML file) on which networks are pre-trained; not the true one."""
    rich: RegimeConfig = field(
        default_factory=lambda: RegimeConfig(maneuvers=("surge-forward",), trajectories=100)
    )
    sparse: RegimeConfig = field(default_factory=RegimeConfig)
    size: SizeConfig = field(default_factory=SizeConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    validation: float = 0.15
    """Share of the trajectories held out of training, on which a run's best step is selected."""

    def __post_init__(self) -> None:
        require(0 < self.validation < 1, self, "validation", "give a fraction between 0 and 1")
        for name in REGIMES:
            for maneuver in self.regime(name).maneuvers:
                if maneuver not in MANEUVERS:
                    raise UserError(
                        f"StudyConfig.{name}.maneuvers: '{maneuver}' is unknown; take some of "
                        f"{', '.join(MANEUVERS)}"
                    )
            self.regime(name).generate_config(self.truth, 0)

    def regime(self, name: Regime) -> RegimeConfig:
        """The data of a regime."""
        return self.rich if name == "rich" else self.sparse


def from_belief(study: StudyConfig) -> StudyConfig:
    """The study whose methods start from the belief alone, without a fit of its coefficients.

    The start is farther from the truth, so training takes 10/3 of the steps, a larger learning rate
    with less decay, and refits of the bandwidths on the way.
    """
    steps = study.size.steps
    size = replace(
        study.size,
        steps=None if steps is None else steps * 10 // 3,
        drift_iterations=0,
        learning_rate=5e-3,
        head_decay=20.0,
        refit_at=(0.1, 0.25, 0.5),
    )
    return replace(study, size=size)


def asked_for(study: StudyConfig) -> str:
    """The command-line options of these settings; `--config` if no others give them."""
    for scale in get_args(Scale):
        option = "" if scale == "full" else f" --scale {scale}"
        if study == scaled(scale):
            return option
        if study == from_belief(scaled(scale)):
            return f"{option} --start belief"
    return " --config study.yaml"


def scaled(scale: Scale) -> StudyConfig:
    """The study in full, small (minutes per run) or tiny (a test of the code)."""
    if scale == "full":
        return StudyConfig()
    if scale == "small":
        return StudyConfig(
            size=SizeConfig(steps=150, samples=8),
            evaluation=EvaluationConfig(samples=120, times=20, shown_samples=200),
        )
    tiny = RegimeConfig(("surge-forward", "yaw-left"), trajectories=4, duration=2.0, rate=10.0)
    return StudyConfig(
        truth=TruthConfig(substeps=5),
        rich=replace(tiny, maneuvers=("surge-forward",), trajectories=6),
        sparse=tiny,
        size=SizeConfig(
            substeps=1,
            steps=8,
            batch=4,
            samples=4,
            width=4,
            depth=1,
            pretrain_steps=0,
            drift_iterations=0,
            length_s=1.0,
            stride_s=0.5,
        ),
        evaluation=EvaluationConfig(samples=39, times=4, shown_samples=39),
    )
