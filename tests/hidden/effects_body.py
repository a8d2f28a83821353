"""Causes in the body and the water around it; d(ν) = d₁ν + d₂|ν|ν is an axis' nominal drag."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .effect import (
    Effect,
    Latent,
    Moment,
    Parameters,
    Vehicle,
    around,
    one_axis,
    sign,
    value,
)
from .rotations import cross, skew
from .vehicle import AXES, GRAVITY, WATER


def _units(axis: int, power: int) -> str:
    """Unit of a coefficient of speed to a power."""
    if axis < 3:
        return "N s/m" if power == 1 else f"N s^{power}/m^{power}"
    return "N m s/rad" if power == 1 else f"N m s^{power}/rad^{power}"


@dataclass(frozen=True)
class NetBuoyancy(Effect):
    """Buoyancy less weight is wrong by Δ: a force Δ upwards (Fossen 2011, ch. 4.1).

    At `height` above Bo: none, or that of the centre of buoyancy.
    """

    cause = "net_buoyancy"
    force: float = 0.0
    height: float = 0.0

    @property
    def where(self) -> str:
        return "heave"

    def parameters(self) -> Parameters:
        return {"force": value(self.force, "N")}

    def neutral(self) -> bool:
        return self.force == 0

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        arm = np.zeros_like(now.up)
        arm[2] = self.height
        push = self.force * now.up
        return np.concatenate([push, cross(arm, push)])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "NetBuoyancy":
        force = sign(rng) * around(rng, 1.5 * size)
        return cls(force, float(rng.choice([0.0, Vehicle().r_b[2]])))


@dataclass(frozen=True)
class CentreOfGravity(Effect):
    """The centre of mass sits off Bo by r_g (Fossen 2011, eqs. 3.44 and 4.6).

    Moment r_g × W and coupling m S(r_g) in M_RB. A shift of the centre of buoyancy by −r_g W/B
    gives the same moment: only W r_g − B r_b shows at rest.
    """

    cause = "centre_of_gravity"
    axis: int = 0
    offset: float = 0.0

    @property
    def where(self) -> str:
        return "xyz"[self.axis]

    def parameters(self) -> Parameters:
        return {"offset": value(self.offset, "m")}

    def neutral(self) -> bool:
        return self.offset == 0

    def alter(self, vehicle: Vehicle) -> Vehicle:
        return vehicle.but(r_g=vehicle.r_g + self.offset * np.eye(3)[self.axis])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "CentreOfGravity":
        return cls(int(rng.integers(3)), sign(rng) * around(rng, 0.004 * size))


@dataclass(frozen=True)
class Payload(Effect):
    """A sphere of mass m and density ρ_p fixed at r: mass, added mass ½ρV, weight and buoyancy.

    Fossen 2011, ch. 3.3 (rigid bodies add), Newman 1977, table 4.3 (sphere: half the displaced
    mass).
    """

    cause = "payload"
    mass: float = 0.0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    density: float = 2700.0

    @property
    def where(self) -> str:
        return "body"

    def parameters(self) -> Parameters:
        told = {"mass": value(self.mass, "kg")}
        told |= {a: value(r, "m") for a, r in zip("xyz", self.position, strict=True)}
        volume = self.mass / self.density
        told["weight_in_water"] = value((self.mass - WATER * volume) * GRAVITY, "N")
        told["added_mass"] = value(0.5 * WATER * volume, "kg")
        for axis, r in zip("xy", self.position, strict=False):
            told[f"weight_times_{axis}"] = value(told["weight_in_water"]["value"] * r, "N m")
        return told

    def neutral(self) -> bool:
        return self.mass == 0

    def alter(self, vehicle: Vehicle) -> Vehicle:
        r, volume = np.array(self.position), self.mass / self.density
        total = vehicle.mass + self.mass
        r_g = (vehicle.mass * vehicle.r_g + self.mass * r) / total
        a, b = skew(vehicle.r_g - r_g), skew(r - r_g)
        inertia = vehicle.inertia - vehicle.mass * a @ a - self.mass * b @ b
        weight = vehicle.weight + self.mass * GRAVITY
        # `weight` acts at r_g; where the nominal weight is not m g, keep the moment right.
        moment = vehicle.weight * vehicle.r_g + self.mass * GRAVITY * r
        lift = WATER * volume * GRAVITY
        buoyancy = vehicle.buoyancy + lift
        r_b = (vehicle.buoyancy * vehicle.r_b + lift * r) / buoyancy
        r_b = r_b - (moment - weight * r_g) / buoyancy
        m = 0.5 * WATER * volume
        s = skew(r)
        added = vehicle.added_mass.copy()
        added[:3, :3] += m * np.eye(3)
        added[:3, 3:] -= m * s
        added[3:, :3] += m * s
        added[3:, 3:] -= m * s @ s
        return vehicle.but(
            mass=total,
            r_g=r_g,
            inertia=inertia,
            weight=weight,
            buoyancy=buoyancy,
            r_b=r_b,
            added_mass=added,
        )

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Payload":
        place = (sign(rng) * rng.uniform(0.05, 0.18), sign(rng) * rng.uniform(0.05, 0.18), -0.12)
        return cls(around(rng, 0.3 * size), place)


@dataclass(frozen=True)
class _Axis(Effect):
    """A cause on one axis, 0 … 5."""

    axis: int = 0
    coefficient: float = 0.0

    @property
    def where(self) -> str:
        return AXES[self.axis]

    def neutral(self) -> bool:
        return self.coefficient == 0


@dataclass(frozen=True)
class LinearDrag(_Axis):
    """The linear coefficient is larger by Δ: F = −Δ ν_r (Fossen 2011, eq. 6.57)."""

    cause = "linear_drag"

    def parameters(self) -> Parameters:
        return {"change": value(self.coefficient, _units(self.axis, 1))}

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        return one_axis(self.axis, -self.coefficient * now.nu_r[self.axis])

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "LinearDrag":
        axis = int(rng.integers(6))
        return cls(axis, around(rng, (6.0 if axis < 3 else 0.5) * size))


@dataclass(frozen=True)
class QuadraticDrag(_Axis):
    """The quadratic coefficient is larger by Δ: F = −Δ |ν_r| ν_r (Fossen 2011, eq. 6.58)."""

    cause = "quadratic_drag"

    def parameters(self) -> Parameters:
        return {"change": value(self.coefficient, _units(self.axis, 2))}

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        v = now.nu_r[self.axis]
        return one_axis(self.axis, -self.coefficient * np.abs(v) * v)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "QuadraticDrag":
        axis, s = int(rng.integers(6)), sign(rng)
        part = around(rng, 0.3 * size)
        return cls(axis, max(s * part, -0.9) * float(Vehicle().quadratic[axis]))


@dataclass(frozen=True)
class DragAsymmetry(_Axis):
    """Drag depends on the direction of motion: quadratic part × (1 + a) forward, (1 − a) backward.

    F = −a d₂ ν_r², with d₂ the nominal coefficient; the body is blunter on one side.
    """

    cause = "drag_asymmetry"

    def parameters(self) -> Parameters:
        return {"asymmetry": value(self.coefficient, "1")}

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        d = self.coefficient * now.vehicle.quadratic[self.axis]
        return one_axis(self.axis, -d * now.nu_r[self.axis] ** 2)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DragAsymmetry":
        return cls(int(rng.integers(3)), sign(rng) * around(rng, 0.15 * size))


@dataclass(frozen=True)
class DragCoupling(Effect):
    """Drag of a translation acts off Bo by a lever ℓ: off-diagonal damping (Fossen 2011, eq. 6.61).

    The drag d of the speed at the lever's end, v_a + (ω × ℓ)_a, gives moment ℓ × F on the other
    axis. `axis` is the translation, `towards` the lever's direction in B.
    """

    cause = "drag_coupling"
    axis: int = 0
    towards: int = 2
    lever: float = 0.0

    def _moment_axis(self) -> int:
        return 3 + (3 - self.axis - self.towards)

    @property
    def where(self) -> str:
        return f"{AXES[self._moment_axis()]}_from_{AXES[self.axis]}"

    def parameters(self) -> Parameters:
        turn = np.cross(np.eye(3)[self.towards], np.eye(3)[self.axis])[self._moment_axis() - 3]
        d = turn * self.lever * Vehicle().quadratic[self.axis]
        return {"lever": value(self.lever, "m"), "coefficient": value(d, "N m s^2/m^2")}

    def neutral(self) -> bool:
        return self.lever == 0

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        a, d = self.axis, now.vehicle
        lever = self.lever * np.eye(3)[self.towards][:, None]
        at_bo = now.nu_r[a]
        speed = at_bo + cross(now.nu_r[3:], lever)[a]

        def drag(v: np.ndarray) -> np.ndarray:
            return -(d.linear[a] + d.quadratic[a] * np.abs(v)) * v

        force = np.zeros((3, speed.size))
        force[a] = drag(speed)
        wrench = np.concatenate([force, cross(lever, force)])
        wrench[a] -= drag(at_bo)
        return wrench

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "DragCoupling":
        axis, towards = [(0, 2), (1, 0), (1, 2), (2, 0)][rng.integers(4)]
        return cls(axis, towards, sign(rng) * around(rng, 0.03 * size))


@dataclass(frozen=True)
class CubicDrag(_Axis):
    """A third power of speed: F = −d₃ ν_r³ (as Taylor's series of odd drag goes on; Abkowitz)."""

    cause = "cubic_drag"

    def parameters(self) -> Parameters:
        return {"coefficient": value(self.coefficient, _units(self.axis, 3))}

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        return one_axis(self.axis, -self.coefficient * now.nu_r[self.axis] ** 3)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "CubicDrag":
        axis = int(rng.integers(6))
        return cls(axis, around(rng, 0.5 * size * float(Vehicle().quadratic[axis])))


@dataclass(frozen=True)
class Lift(Effect):
    """The hull lifts across the flow: Z = k u_r² on heave, or on sway (Prestero 2001, ch. 4.4)."""

    cause = "lift"
    axis: int = 2
    coefficient: float = 0.0

    @property
    def where(self) -> str:
        return AXES[self.axis]

    def parameters(self) -> Parameters:
        return {"coefficient": value(self.coefficient, "N s^2/m^2")}

    def neutral(self) -> bool:
        return self.coefficient == 0

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        return one_axis(self.axis, self.coefficient * now.nu_r[0] ** 2)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Lift":
        return cls(2, sign(rng) * around(rng, 8.0 * size))


@dataclass(frozen=True)
class AddedMassCoupling(Effect):
    """Off-diagonal added mass m_ij = m_ji, in M_A and C_A (Fossen 2011, eqs. 6.40–6.43)."""

    cause = "added_mass_coupling"
    first: int = 1
    second: int = 5
    mass: float = 0.0

    @property
    def where(self) -> str:
        return f"{AXES[self.first]}_{AXES[self.second]}"

    def parameters(self) -> Parameters:
        return {"added_mass": value(self.mass, "kg m")}

    def neutral(self) -> bool:
        return self.mass == 0

    def alter(self, vehicle: Vehicle) -> Vehicle:
        added = vehicle.added_mass.copy()
        added[self.first, self.second] += self.mass
        added[self.second, self.first] += self.mass
        if np.linalg.eigvalsh(vehicle.rigid_mass() + added)[0] <= 0:
            raise ValueError(f"{self.where}: added mass {self.mass} leaves M without inverse")
        return vehicle.but(added_mass=added)

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "AddedMassCoupling | MunkMoment":
        if rng.uniform() < 0.3:
            return MunkMoment(1 + sign(rng) * around(rng, 0.3 * size))
        first, second = [(1, 5), (0, 4), (2, 4), (1, 3)][rng.integers(4)]
        return AddedMassCoupling(first, second, sign(rng) * around(rng, 0.4 * size))


@dataclass(frozen=True)
class MunkMoment(Effect):
    """The moment −k v_r × (M_A ν_r) of potential flow is k times the ideal (Munk 1924).

    Vortices behind a real hull take part of it away; ideal flow has k = 1.
    """

    cause = "added_mass_coupling"
    scale: float = 1.0

    @property
    def where(self) -> str:
        return "munk"

    def parameters(self) -> Parameters:
        return {"scale": value(self.scale, "1")}

    def neutral(self) -> bool:
        return self.scale == 1

    def alter(self, vehicle: Vehicle) -> Vehicle:
        return vehicle.but(munk=vehicle.munk * self.scale)


@dataclass(frozen=True)
class Proximity(Effect):
    """Drag grows towards a boundary: (1 + a e^(−h/L)) d(ν_r) on every axis, h the clearance of Bo.

    An exponential stands for the blockage between hull and wall; of measured cases only the decay
    over about one hull length is common. Place: bottom at z, surface (z = 0), wall at x (in W).
    """

    cause = "proximity"
    boundary: str = "bottom"
    place: float = -6.0
    gain: float = 0.0
    length: float = 0.5

    @property
    def where(self) -> str:
        return self.boundary

    def parameters(self) -> Parameters:
        told = {"gain": value(self.gain, "1"), "length": value(self.length, "m")}
        return told | {"place": value(self.place, "m")}

    def neutral(self) -> bool:
        return self.gain == 0

    def clearance(self, p: np.ndarray) -> np.ndarray:
        h = {"bottom": p[2] - self.place, "surface": -p[2], "wall": self.place - p[0]}
        return np.maximum(h[self.boundary], 0.1)

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray:
        d, v = now.vehicle, now.nu_r
        drag = (d.linear[:, None] + d.quadratic[:, None] * np.abs(v)) * v
        return -self.gain * np.exp(-self.clearance(now.p) / self.length) * drag

    @classmethod
    def drawn(cls, rng: Any, size: float) -> "Proximity":
        boundary, place = [("bottom", -5.0), ("surface", 0.0), ("wall", 1.5)][rng.integers(3)]
        return cls(boundary, place, around(rng, 1.5 * size), rng.uniform(0.4, 0.8))
