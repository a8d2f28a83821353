"""Causes in the instruments: they act on what is recorded, and so on a closed loop too."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .effect import Effect, Parameters, Signals, around, sign, value
from .rotations import conjugate, cross, exponential, heading, product, to_world


@dataclass(frozen=True)
class DvlLeverArm(Effect):
    """The log believes the DVL at Bo, but it sits ℓ away: v_m = v + ω × ℓ."""

    cause = "dvl_lever_arm"
    order = 20
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    @property
    def where(self) -> str:
        return "xyz"[int(np.argmax(np.abs([self.x, self.y, self.z])))]

    def parameters(self) -> Parameters:
        return {"x": value(self.x, "m"), "y": value(self.y, "m"), "z": value(self.z, "m")}

    def neutral(self) -> bool:
        return self.x == self.y == self.z == 0

    def measure(self, signals: Signals) -> Signals:
        lever = np.array([self.x, self.y, self.z]).reshape(3, 1, 1)
        return replace(signals, v=signals.v + cross(signals.w, lever + np.zeros_like(signals.v)))

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DvlLeverArm":
        d = rng.standard_normal(3)
        x, y, z = around(rng, 0.06 * size) * d / np.linalg.norm(d)
        return cls(float(x), float(y), float(z))


@dataclass(frozen=True)
class DvlMisalignment(Effect):
    """The DVL is turned by ψ about an axis of B, unknown to the log: v_m = R(ψ)ᵀ v."""

    cause = "dvl_misalignment"
    order = 21
    axis: int = 2
    angle: float = 0.0

    @property
    def where(self) -> str:
        return ("roll", "pitch", "yaw")[self.axis]

    def parameters(self) -> Parameters:
        return {"angle": value(self.angle, "rad")}

    def neutral(self) -> bool:
        return self.angle == 0

    def measure(self, signals: Signals) -> Signals:
        q = conjugate(exponential(self.angle * np.eye(3)[self.axis].reshape(3, 1, 1)))
        return replace(signals, v=to_world(q, signals.v))

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DvlMisalignment":
        axis = 2 if rng.uniform() < 0.7 else int(rng.integers(2))
        return cls(axis, sign(rng) * around(rng, np.deg2rad(2.0) * size))


@dataclass(frozen=True)
class DvlScale(Effect):
    """All DVL speeds are too large by s (wrong speed of sound): v_m = (1 + s) v."""

    cause = "dvl_scale"
    order = 22
    error: float = 0.0

    @property
    def where(self) -> str:
        return "dvl"

    def parameters(self) -> Parameters:
        return {"scale": value(1 + self.error, "1")}

    def neutral(self) -> bool:
        return self.error == 0

    def measure(self, signals: Signals) -> Signals:
        return replace(signals, v=(1 + self.error) * signals.v)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DvlScale":
        return cls(sign(rng) * around(rng, 0.02 * size))


@dataclass(frozen=True)
class GyroBias(Effect):
    """Rates carry a constant b: ω_m = ω + b. The attitude comes from elsewhere and is right."""

    cause = "gyro_bias"
    order = 23
    axis: int = 2
    bias: float = 0.0

    @property
    def where(self) -> str:
        return ("roll", "pitch", "yaw")[self.axis]

    def parameters(self) -> Parameters:
        return {"bias": value(self.bias, "rad/s")}

    def neutral(self) -> bool:
        return self.bias == 0

    def measure(self, signals: Signals) -> Signals:
        b = self.bias * np.eye(3)[self.axis].reshape(3, 1, 1)
        return replace(signals, w=signals.w + b)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "GyroBias":
        return cls(int(rng.integers(3)), sign(rng) * around(rng, 0.005 * size))


@dataclass(frozen=True)
class ClockOffset(Effect):
    """One instrument's samples are d late: they show t − d. Negative: they run ahead.

    `channel`: linear (DVL), angular (gyro), twist (both), pose. Commands late against everything
    else are `actuation_delay`.
    """

    cause = "clock_offset"
    channel: str = "twist"
    seconds: float = 0.0

    @property
    def where(self) -> str:
        return self.channel

    def parameters(self) -> Parameters:
        return {"offset": value(self.seconds, "s")}

    def neutral(self) -> bool:
        return self.seconds == 0

    def shift(self) -> dict[str, float]:
        names = ("linear", "angular") if self.channel == "twist" else (self.channel,)
        return dict.fromkeys(names, self.seconds)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ClockOffset":
        channel = str(rng.choice(["linear", "twist", "pose"]))
        return cls(channel, around(rng, 0.02 * size))


@dataclass(frozen=True)
class HeadingError(Effect):
    """The compass errs with heading: ψ_m = ψ + A + B sin ψ + C cos ψ (compass deviation).

    Constant and semicircular coefficients of the magnetic compass (Handbook of Magnetic Compass
    Adjustment). The attitude is turned about the vertical; the position is not.
    """

    cause = "heading_error"
    order = 24
    constant: float = 0.0
    sine: float = 0.0
    cosine: float = 0.0

    @property
    def where(self) -> str:
        return "heading"

    def parameters(self) -> Parameters:
        told = {"constant": self.constant, "sine": self.sine, "cosine": self.cosine}
        return {name: value(number, "rad") for name, number in told.items()}

    def neutral(self) -> bool:
        return self.constant == self.sine == self.cosine == 0

    def measure(self, signals: Signals) -> Signals:
        psi = heading(signals.q)
        error = self.constant + self.sine * np.sin(psi) + self.cosine * np.cos(psi)
        turn = np.zeros_like(signals.w)
        turn[2] = error
        return replace(signals, q=product(exponential(turn), signals.q))

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "HeadingError":
        a, angle = around(rng, np.deg2rad(3.0) * size), rng.uniform(-np.pi, np.pi)
        return cls(0.0, float(a * np.sin(angle)), float(a * np.cos(angle)))
