"""What a diagnosis says of its data."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class DataFinding:
    """A finding of the checks that ran on the data before the diagnosis.

    Attributes:
        word: its kind, as in docs/checks.md.
        severity: severe (accepted by name), cut (left out or set apart) or note.
        place: file, stretch, seconds, column or parameter.
        text: what it is.
        remedy: what helps, if anything.
    """

    word: str
    severity: Literal["severe", "cut", "note"]
    place: str
    text: str
    remedy: str


@dataclass(frozen=True)
class DataSummary:
    """The data that were used, their faults, and what is not identifiable from them.

    Attributes:
        scenarios: names.
        runs: how many were used.
        seconds: total time that is predicted (s).
        step: mean time between samples (s).
        command: kind of commands: thruster_force, pwm or F_Bo_B.
        problems: faults of the data, a sentence each.
        limits: what is not identifiable from these data, a sentence each.
        noise: estimated levels: standard deviations of the records, mean over axes (`position_m`,
            `attitude_rad`, `velocity_m_s` in m/s, `rate_rad_s` in rad/s), the slip of an
            estimator's pose (`slip_position` in m/√s, `slip_attitude` in rad/√s) where it slips,
            and the diffusion of the disturbance (`diffusion_surge`, sway, heave in N√s; roll,
            pitch, yaw in N·m√s).
        findings: of the checks that every command runs on its data.
    """

    scenarios: list[str]
    runs: int
    seconds: float
    step: float
    command: str
    problems: list[str]
    limits: list[str]
    noise: dict[str, float]
    findings: list[DataFinding] = field(default_factory=list)
