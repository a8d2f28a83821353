"""The true vehicle: a BlueROV2 Heavy in numbers, each with its source.

Its nominal numbers are those that a user believes who takes the default preset, so that data
without an effect come from the believed vehicle exactly.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from .rotations import skew

GRAVITY = 9.80665
WATER = 1025.0  # kg/m³, sea water
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
_S = np.sqrt(0.5)


def _mounts() -> tuple[np.ndarray, np.ndarray]:
    """Positions (von Benzon et al. 2022, Table A1) and thrust directions for PWM above 1500.

    ArduSub's VECTORED_6DOF (AP_Motors6DOF.cpp): 1, 2 front right and left, 3, 4 rear, at 45°;
    5–8 vertical likewise. The sources are in forward-right-down; y and z change sign.
    """
    frd = [
        [0.156, 0.111, 0.085],
        [0.156, -0.111, 0.085],
        [-0.156, 0.111, 0.085],
        [-0.156, -0.111, 0.085],
        [0.12, 0.218, 0.0],
        [0.12, -0.218, 0.0],
        [-0.12, 0.218, 0.0],
        [-0.12, -0.218, 0.0],
    ]
    push = [[-_S, _S, 0], [-_S, -_S, 0], [_S, _S, 0], [_S, -_S, 0]] + [[0, 0, 1]] * 4
    flip = np.array([[1.0], [-1.0], [-1.0]])
    return flip * np.array(frd).T, flip * np.array(push, float).T


@dataclass(frozen=True)
class Vehicle:
    """SI units, about Bo, in B. Damping and added mass are positive magnitudes (Fossen's −X_u …).

    Mass and inertia, added mass: von Benzon et al. 2022, J. Mar. Sci. Eng. 10(12), 1898, Table A1.
    Centre of buoyancy and linear damping: Wu 2018, MSc thesis, Flinders University.
    Quadratic damping: bluerov2_ignition's model.sdf (surge, heave, rotations); sway is surge by
    the ratio of projected areas 0.1131/0.0877 of von Benzon et al.
    Weight is mass × 9.80665; buoyancy 2 N more, as pilots ballast (1 to 4 N).
    """

    mass: float = 13.5
    inertia: np.ndarray = field(default_factory=lambda: np.diag([0.26, 0.23, 0.37]))
    r_g: np.ndarray = field(default_factory=lambda: np.zeros(3))
    weight: float = 132.39
    buoyancy: float = 134.39
    r_b: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 0.02]))
    added_mass: np.ndarray = field(
        default_factory=lambda: np.diag([6.36, 7.12, 18.68, 0.189, 0.135, 0.222])
    )
    linear: np.ndarray = field(
        default_factory=lambda: np.array([4.03, 6.22, 5.18, 0.07, 0.07, 0.07])
    )
    quadratic: np.ndarray = field(
        default_factory=lambda: np.array([58.42, 75.3, 124.82, 4.0, 4.0, 4.0])
    )
    munk: float = 1.0
    """Factor on the destabilising moment v × (M_A ν) of potential flow."""
    positions: np.ndarray = field(default_factory=lambda: _mounts()[0])
    directions: np.ndarray = field(default_factory=lambda: _mounts()[1])

    def rigid_mass(self) -> np.ndarray:
        """M_RB about Bo; `inertia` is about the centre of mass (Fossen 2011, eq. 3.44)."""
        s = skew(self.r_g)
        m = np.zeros((6, 6))
        m[:3, :3] = self.mass * np.eye(3)
        m[:3, 3:] = -self.mass * s
        m[3:, :3] = self.mass * s
        m[3:, 3:] = self.inertia - self.mass * s @ s
        return m

    def allocation(self) -> np.ndarray:
        """T of τ = T f: columns (e, r × e) (Fossen 2011, ch. 12.3)."""
        return np.vstack([self.directions, np.cross(self.positions.T, self.directions.T).T])

    def but(self, **changes) -> "Vehicle":
        return replace(self, **changes)

    def off(self, rng: np.random.Generator) -> "Vehicle":
        """The vehicle that a believer in `self` is wrong about by factors in nearly everything."""

        def factor(most: float, *shape: int) -> np.ndarray:
            return most ** rng.uniform(-1, 1, shape)

        mass = float(factor(1.2))
        heavier = self.mass * (mass - 1) * GRAVITY  # ballast: as much more buoyancy
        return self.but(
            mass=self.mass * mass,
            weight=self.weight + heavier,
            buoyancy=self.buoyancy + heavier,
            inertia=self.inertia * mass * factor(1.4),
            added_mass=self.added_mass * factor(1.8, 6),
            linear=self.linear * factor(2.0, 6),
            quadratic=self.quadratic * factor(2.5, 6),
            r_b=self.r_b * factor(1.6),
            directions=self.directions * factor(1.7),
        )

    def over_inertia(self) -> dict[str, dict[str, float]]:
        """What motion tells of it, by axis: coefficients over inertia."""
        inertia = np.diag(self.rigid_mass() + self.added_mass)
        found = {"quadratic_drag": self.quadratic, "linear_drag": self.linear}
        pushes = np.abs(self.allocation()).sum(axis=1)
        found["thrust"] = pushes
        return {
            name: dict(zip(AXES, (values / inertia).tolist(), strict=True))
            for name, values in found.items()
        }
