"""Settings of the model predictive path integral planner."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from ...models.config.checks import Vector6, check_numbers, require
from .plan import PlanLayout

_SUBSTEPS = 2


@dataclass(frozen=True)
class MppiConfig:
    """Sampling, risk and the wrench's cost of `systems.planning.mppi_core.MppiPlanner`.

    Six numbers are for x, y, z, roll, pitch, yaw.

    Attributes:
        horizon: number of steps.
        dt: length of a step (s).
        substeps: of the model in a step; null takes those a learned model was trained with, and 2
            for physics. Some learned models diverge with a single one.
        period: time between calls (s), a multiple of `dt`: the warm start shifts by it.
        sequences: control sequences sampled in a call.
        realisations: noise paths of each sequence, an even number (pairs of opposite sign); 1
            plans with the model's drift alone.
            `sequences` × `realisations` is the number of rollouts.
        terminal_time: the last state's running cost counts for this many seconds more: for what
            follows the horizon, besides the task's own terminal cost.
        effort_weight: cost rate of the wrench beyond the one that holds the vehicle in the wanted
            state, as a fraction of each axis' limit (0 gives the paper's cost).
        rate_weight: the same for the rate of change of the wrench (1/s).
        noise: standard deviation of the sampled wrenches as a fraction of each axis' limit.
        knots: numbers of spline pieces over the horizon; the sequences are divided among them, so
            that both slow and fast corrections are sampled.
        smallest_noise: the sequences' amplitudes fall from 1 to this, geometrically.
        wrench_fraction: part of the thrusters' feasible wrenches that a plan may use; the rest is
            left to the tracking controller.
        effective_samples: the temperature is set so that this many sequences carry the weight.
        margin: clearance (m) below which a soft cost begins.
        margin_weight: cost rate at a clearance of zero.
        risk: measure of the costs of a sequence's realisations: their mean, the mean of the worst
            `cvar_part` of them (CVaR), or the worst.
        cvar_part: part of the realisations that `cvar` counts.
        collision_risk: α of the chance constraint P(g ∈ G) ≥ 1 − α over the horizon; None leaves
            the constraint out.
        risk_weight: cost of a violation: per unit of probability above α, and per metre of missing
            clearance.
        clearance_std: least standard deviation (m) of the clearance; covers errors that are not in
            the model's noise (state estimate, obstacle positions).
        tracked: the noise paths follow the plan under the tracking controller's gains, as the
            vehicle does; false lets them diverge in open loop over the horizon.
        hold_attitude: sequences are sampled in addition to the tracking controller's feedback
            towards the wanted attitude; false samples the whole wrench.
        shown_paths: sampled paths in the output for reports.
        threads: the sequences are rolled out in so many parts, each in a thread of its own.

    Example:
        >>> controller = load_scenario("pylon_crossing_calm").controller
        >>> quick = dataclasses.replace(controller, planner=MppiConfig(sequences=200, horizon=40))
    """

    horizon: int = 80
    dt: float = 0.05
    substeps: int | None = None
    period: float = 0.2
    sequences: int = 250
    realisations: int = 4
    terminal_time: float = 2.0
    effort_weight: float = 0.5
    rate_weight: float = 0.02
    noise: Vector6 = (0.35, 0.35, 0.2, 0.01, 0.02, 0.04)
    knots: tuple[int, ...] = (2, 4, 10)
    smallest_noise: float = 0.1
    wrench_fraction: float = 0.8
    effective_samples: float = 12.0
    margin: float = 0.3
    margin_weight: float = 20.0
    risk: Literal["mean", "cvar", "worst"] = "mean"
    cvar_part: float = 0.5
    collision_risk: float | None = 0.05
    risk_weight: float = 300.0
    clearance_std: float = 0.08
    tracked: bool = True
    hold_attitude: bool = True
    shown_paths: int = 48
    threads: int = 2

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("horizon", "sequences", "realisations", "shown_paths", "threads"):
            require(getattr(self, name) >= 1, self, name, "give a whole number of 1 or more")
        for name in ("dt", "period", "margin", "clearance_std"):
            require(getattr(self, name) > 0, self, name, "give a number above zero")
        for name in ("terminal_time", "effort_weight", "rate_weight", "margin_weight"):
            require(getattr(self, name) >= 0, self, name, "give zero or more")
        for name in ("wrench_fraction", "smallest_noise", "cvar_part"):
            require(0 < getattr(self, name) <= 1, self, name, "give a part in (0, 1]")
        require(self.risk_weight >= 0, self, "risk_weight", "give zero or more")
        risk = self.collision_risk
        remedy = "give a probability in (0, 1), or null"
        require(risk is None or 0 < risk < 1, self, "collision_risk", remedy)
        self._check_sampling()

    def _check_sampling(self) -> None:
        """Check how sequences and their realisations are drawn and stepped."""
        whole = "give a whole number of 1 or more, or null"
        require(self.substeps is None or self.substeps >= 1, self, "substeps", whole)
        even = self.realisations == 1 or self.realisations % 2 == 0
        require(even, self, "realisations", "give 1 or an even number")
        require(min(self.noise) >= 0, self, "noise", "give six numbers of zero or more")
        some = bool(self.knots) and min(self.knots) >= 1
        require(some, self, "knots", "give counts of 1 or more")
        pieces = max(self.knots) <= self.horizon
        require(pieces, self, "knots", "give no more pieces than `horizon`")
        samples = self.effective_samples
        require(samples > 0, self, "effective_samples", "give a number above zero")
        fewer = samples < self.sequences
        require(fewer, self, "effective_samples", "give fewer than `sequences`")
        require(self.threads <= self.sequences, self, "threads", "give no more than `sequences`")
        shift = self.period / self.dt
        multiple = abs(shift - round(shift)) < 1e-6 and round(shift) >= 1
        require(multiple, self, "period", f"give a multiple of dt = {self.dt}")

    def with_substeps_of(self, metadata: Mapping[str, Any]) -> "MppiConfig":
        """These settings with the steps that a checkpoint's metadata names, unless given here."""
        dt, substeps = metadata.get("dt"), metadata.get("substeps")
        if self.substeps is not None or not dt or not substeps:
            return self
        return replace(self, substeps=max(1, math.ceil(self.dt / dt * substeps - 1e-6)))

    @property
    def steps_of_model(self) -> int:
        """Steps of the model per step of the plan."""
        return _SUBSTEPS if self.substeps is None else self.substeps

    @property
    def shift(self) -> int:
        """Steps by which the plan moves between two calls."""
        return round(self.period / self.dt)

    @property
    def layout(self) -> PlanLayout:
        """Layout of the plans."""
        return PlanLayout(self.horizon, self.dt)
