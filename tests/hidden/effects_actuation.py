"""Causes between the command and the thrust. u is the commanded thrust, f the thrust, N."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .effect import Effect, Parameters, around, sign, value

FULL_THRUST = 40.0  # N; where the thrust curve is anchored
NOMINAL_VOLTS = 16.0
VOLTAGE_EXPONENT = 1.24  # thrust at full PWM ∝ V^1.24, from the maker's table between 10 and 16 V
AMPERES = 0.0625  # A/N^1.5; the maker's table at 16 V: I ≈ 0.0625 f^1.5


def _which(thruster: int | None) -> str:
    return "all" if thruster is None else str(thruster)


def _mask(thruster: int | None) -> np.ndarray:
    """1 for the thrusters (numbered from 1) concerned."""
    mask = np.ones(8)
    if thruster is not None:
        mask[:] = 0.0
        mask[thruster - 1] = 1.0
    return mask


@dataclass(frozen=True)
class _Thruster(Effect):
    """A cause in one thruster, 1 … 8, or in all (None)."""

    thruster: int | None = None

    @property
    def where(self) -> str:
        return _which(self.thruster)

    def _only(self, changed: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.where(_mask(self.thruster)[:, None] > 0, changed, u)


@dataclass(frozen=True)
class ThrusterLag(_Thruster):
    """Thrust follows the command at first order: τ ḟ = u − f (Fossen 2011, ch. 9; Yoerger 1990).

    Public simulators of the T200 use 0.15 to 0.20 s.
    """

    cause = "thruster_lag"
    tau: float = 0.0

    def parameters(self) -> Parameters:
        return {"time_constant": value(self.tau, "s")}

    def neutral(self) -> bool:
        return self.tau == 0

    def lag(self) -> np.ndarray:
        return self.tau * _mask(self.thruster)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ThrusterLag":
        return cls(tau=around(rng, 0.1 * size))


@dataclass(frozen=True)
class ActuationDelay(_Thruster):
    """Transport delay: f(t) = u(t − d). Start-up of the ESC was seen to take 0.11 s."""

    cause = "actuation_delay"
    seconds: float = 0.0

    def parameters(self) -> Parameters:
        return {"delay": value(self.seconds, "s")}

    def neutral(self) -> bool:
        return self.seconds == 0

    def delay(self) -> np.ndarray:
        return self.seconds * _mask(self.thruster)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ActuationDelay":
        return cls(seconds=around(rng, 0.06 * size))


@dataclass(frozen=True)
class DeadZone(_Thruster):
    """f = sgn(u) max(|u| − δ, 0) (Tao and Kokotović 1994, eq. 2.1, equal slopes).

    `jump`: the other kind met in practice, f = u beyond δ and 0 inside.
    """

    cause = "thruster_dead_zone"
    order = 1
    width: float = 0.0
    jump: bool = False

    def parameters(self) -> Parameters:
        return {"width": value(self.width, "N")}

    def neutral(self) -> bool:
        return self.width == 0

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        if self.jump:
            return self._only(np.where(np.abs(u) > self.width, u, 0.0), u)
        return self._only(np.sign(u) * np.maximum(np.abs(u) - self.width, 0.0), u)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DeadZone":
        return cls(width=around(rng, 1.0 * size))


@dataclass(frozen=True)
class ThrustCurve(_Thruster):
    """f = F sgn(u) |u/F|^n with F = 40 N: the curve bends but keeps its value at F."""

    cause = "thrust_curve"
    order = 2
    exponent: float = 1.0

    def parameters(self) -> Parameters:
        return {"exponent": value(self.exponent, "1")}

    def neutral(self) -> bool:
        return self.exponent == 1

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        bent = FULL_THRUST * np.sign(u) * (np.abs(u) / FULL_THRUST) ** self.exponent
        return self._only(bent, u)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ThrustCurve":
        return cls(exponent=1 + sign(rng) * around(rng, 0.1 * size))


@dataclass(frozen=True)
class ThrustAsymmetry(_Thruster):
    """Reverse thrust is weaker than believed: f = ρ u for u < 0 (T200: reverse 0.75–0.80 forward).

    Forward is PWM above 1500, u > 0.
    """

    cause = "thrust_asymmetry"
    order = 3
    reverse: float = 1.0

    def parameters(self) -> Parameters:
        return {"reverse_over_forward": value(self.reverse, "1")}

    def neutral(self) -> bool:
        return self.reverse == 1

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        return self._only(np.where(u < 0, self.reverse * u, u), u)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ThrustAsymmetry":
        return cls(reverse=1 - around(rng, 0.15 * size))


@dataclass(frozen=True)
class ThrusterGain(_Thruster):
    """One thruster gives k times its thrust: fouled or damaged, or with k = −1 wired backwards."""

    cause = "thruster_gain"
    order = 4
    gain: float = 1.0

    def parameters(self) -> Parameters:
        return {"gain": value(self.gain, "1")}

    def neutral(self) -> bool:
        return self.gain == 1

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        return self._only(self.gain * u, u)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ThrusterGain":
        thruster = int(rng.integers(1, 9))
        if size >= 1 and rng.uniform() < 0.2:
            return cls(thruster, gain=-1.0)
        return cls(thruster, gain=1 - around(rng, 0.25 * size))


@dataclass(frozen=True)
class ThrustScale(Effect):
    """All thrusters give s times their thrust, always."""

    cause = "thrust_scale"
    order = 5
    scale: float = 1.0

    @property
    def where(self) -> str:
        return "all"

    def parameters(self) -> Parameters:
        return {"scale": value(self.scale, "1")}

    def neutral(self) -> bool:
        return self.scale == 1

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        return self.scale * u

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "ThrustScale":
        return cls(scale=1 + sign(rng) * around(rng, 0.15 * size))


@dataclass(frozen=True)
class VoltageSag(Effect):
    """The battery empties from run to run: f = (V/16)^n u; the maker's table has n = 1.24.

    V is each run's open-circuit voltage. With `f1 … f8` it is in the column `voltage` unless the
    data are told to leave it out; with PWM it is left out, and the belief is a full 16 V.
    """

    cause = "voltage_sag"
    order = 6
    exponent: float = 0.0

    @property
    def where(self) -> str:
        return "all"

    def parameters(self) -> Parameters:
        return {"exponent": value(self.exponent, "1")}

    def neutral(self) -> bool:
        return self.exponent == 0

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        return (volts / NOMINAL_VOLTS) ** self.exponent * u

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "VoltageSag":
        return cls(exponent=around(rng, VOLTAGE_EXPONENT * size))


@dataclass(frozen=True)
class LoadDroop(Effect):
    """Thrusters share a battery: f = (1 − R Σ I/16)^1.24 u with I = 0.0625 |u|^1.5 (A, N).

    R is the resistance of pack and wiring, 20 to 50 mΩ; the current is the maker's at 16 V.
    """

    cause = "load_droop"
    order = 7
    resistance: float = 0.0

    @property
    def where(self) -> str:
        return "all"

    def parameters(self) -> Parameters:
        amperes = AMPERES * 8 * FULL_THRUST**1.5
        loss = VOLTAGE_EXPONENT * self.resistance * amperes / NOMINAL_VOLTS
        return {"resistance": value(self.resistance, "ohm"), "loss_at_40_N": value(loss, "1")}

    def neutral(self) -> bool:
        return self.resistance == 0

    def distort(self, u: np.ndarray, volts: np.ndarray) -> np.ndarray:
        current = AMPERES * np.sum(np.abs(u) ** 1.5, axis=0)
        left = np.maximum(1 - self.resistance * current / NOMINAL_VOLTS, 0.1)
        return left**VOLTAGE_EXPONENT * u

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "LoadDroop":
        return cls(resistance=around(rng, 0.05 * size))


@dataclass(frozen=True)
class InflowThrustLoss(_Thruster):
    """Thrust falls with the speed along its own direction: f = u − k √|u| v_a.

    Fossen 2011, eq. 9.8, T = T_nn |n|n − T_nu |n| u_a with |n| ∝ √|u|; v_a = e · (v_r + ω × r).
    """

    cause = "inflow_thrust_loss"
    order = 8
    coefficient: float = 0.0

    def parameters(self) -> Parameters:
        return {"coefficient": value(self.coefficient, "N^0.5 s/m")}

    def neutral(self) -> bool:
        return self.coefficient == 0

    def load(self, thrust: np.ndarray, axial: np.ndarray) -> np.ndarray:
        return self._only(thrust - self.coefficient * np.sqrt(np.abs(thrust)) * axial, thrust)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "InflowThrustLoss":
        return cls(coefficient=around(rng, 0.6 * size))
