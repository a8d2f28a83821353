"""Steady force of one thruster as a function of PWM and supply voltage, and its inverse.

Every function is elementwise on arrays of one rank (scalars broadcast), so a curve does not depend
on the number of thrusters. Forces are in N along the thruster's axis, PWM in µs (1500 stopped,
above it forward), voltages in V, currents in A.
"""

import abc
import functools
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import RegularGridInterpolator

from .rigid_body import GRAVITY

NEUTRAL = 1500.0
"""PWM of a stopped thruster, µs."""
RESTING = 1e-6
"""Force (N) up to which a thruster counts as stopped. Within a dead band the force is proportional
to the pulse up to this value, so that it encodes the command for a curve with a narrower band."""


class ThrusterCurve(eqx.Module):
    """Force over PWM and voltage: strictly increasing, in the dead band by at most `RESTING`."""

    @abc.abstractmethod
    def force(
        self, pwm: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        """Steady force in N at `pwm` µs."""

    def steady(
        self, pwm: Float[np.ndarray, "*shape"], voltage: Float[np.ndarray, "*#shape"]
    ) -> Float[np.ndarray, "*shape"]:
        """`force` in NumPy, for checks of data that are to compile nothing."""
        return np.asarray(self.force(jnp.asarray(pwm), jnp.asarray(voltage)))

    @abc.abstractmethod
    def pwm(
        self, force: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        """PWM in µs that gives `force`, clipped at the ends of the curve; 1500 for no force."""

    @abc.abstractmethod
    def limits(
        self, voltage: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Largest reverse (negative) and forward force in N."""

    @abc.abstractmethod
    def loaded_voltage(
        self,
        pwm: Float[Array, "n *batch"],
        open_circuit: Float[Array, "*#batch"],
        resistance: Float[Array, ""],
    ) -> Float[Array, "*batch"]:
        """Voltage V = Voc - R ΣI(PWM, V) of a battery that feeds thrusters at these PWMs."""


@functools.cache
def _t200_table() -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(voltages, PWM knots, N) of the force and (voltages, PWM knots, A) of the current."""
    path = Path(__file__).with_name("vehicles") / "t200.csv"
    rows = np.genfromtxt(path, delimiter=",", skip_header=4, encoding="utf-8")

    def grid(column: int) -> tuple[np.ndarray, ...]:
        known = rows[np.isfinite(rows[:, column])]
        voltages = np.unique(known[:, 0])
        knots = np.union1d(np.unique(known[:, 1]), [NEUTRAL])
        parts = [known[known[:, 0] == voltage] for voltage in voltages]
        return voltages, knots, np.stack([np.interp(knots, p[:, 1], p[:, column]) for p in parts])

    voltages, knots, kilograms = grid(2)
    newtons = kilograms * GRAVITY
    away = knots - NEUTRAL
    for row in newtons:
        for sign in (-1, 1):
            band = (row == 0) & (sign * away > 0)
            row[band] = RESTING * away[band] / np.abs(away[band]).max(initial=0.0)
    return (voltages, knots, newtons), grid(3)


def _over(table: Array, x: Array) -> Array:
    """`table` with trailing axes of length 1, so that its axes precede those of `x`."""
    return table.reshape(table.shape + (1,) * x.ndim)


def _same_rank(voltage: Array, x: Array) -> Array:
    return voltage.reshape((1,) * x.ndim) if voltage.ndim == 0 else voltage


def _interpolate(x: Float[Array, "*shape"], knots: Array, values: Array) -> Float[Array, "*shape"]:
    """Piecewise linear and constant beyond the ends, as a sum of clipped ramps: no gathers.

    `values` (knots, …) broadcasts against x after its first axis.
    """
    start, width = _over(knots[:-1], x), _over(jnp.diff(knots), x)
    parts = jnp.clip((x[None] - start) / width, 0, 1)
    return values[0] + jnp.sum(jnp.diff(values, axis=0) * parts, axis=0)


class T200Curve(ThrusterCurve):
    """Blue Robotics T200, bilinear in PWM and voltage between the maker's bollard data.

    Source: Blue Robotics, T200 public performance data, September 2019 (R1 unit, Basic ESC),
    rounded in `vehicles/t200.csv`. Forward thrust exceeds reverse thrust by a quarter to a third;
    the dead band narrows from 1460–1540 µs at 10 V to 1476–1528 µs at 20 V. PWM is clamped to
    1100–1900 µs and voltage to 10–20 V (12–20 V for the current).
    """

    voltages: Float[Array, "V"]
    knots: Float[Array, "K"]
    forces: Float[Array, "V K"]
    current_voltages: Float[Array, "U"]
    current_knots: Float[Array, "L"]
    currents: Float[Array, "U L"]

    def __init__(self, dtype: jnp.dtype | type = float):
        force, current = _t200_table()
        self.voltages, self.knots, self.forces = (jnp.asarray(x, dtype) for x in force)
        self.current_voltages, self.current_knots, self.currents = (
            jnp.asarray(x, dtype) for x in current
        )

    def _column(self, voltage: Float[Array, "*shape"]) -> Float[Array, "K *shape"]:
        """Forces at the PWM knots for a voltage."""
        start = _over(self.voltages[:-1], voltage)
        parts = jnp.clip((voltage[None] - start) / _over(jnp.diff(self.voltages), voltage), 0, 1)
        rises = jnp.tensordot(jnp.diff(self.forces, axis=0).T, parts, 1)
        return _over(self.forces[0], voltage) + rises

    def _side(self) -> Float[Array, "segments"]:
        """-1 for the segments below 1500 µs, 1 above: sums run outwards, from a force of 0."""
        return jnp.where(self.knots[:-1] < NEUTRAL, -1, 1).astype(self.knots.dtype)

    def force(
        self, pwm: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        side = _over(self._side(), pwm)
        rise = jnp.diff(self._column(_same_rank(voltage, pwm)), axis=0)
        start = _over(jnp.where(self.knots[:-1] < NEUTRAL, -self.knots[1:], self.knots[:-1]), pwm)
        parts = jnp.clip((side * pwm[None] - start) / _over(jnp.diff(self.knots), pwm), 0, 1)
        return jnp.sum(side * rise * parts, axis=0)

    def steady(
        self, pwm: Float[np.ndarray, "*shape"], voltage: Float[np.ndarray, "*#shape"]
    ) -> Float[np.ndarray, "*shape"]:
        table = RegularGridInterpolator(
            (np.asarray(self.voltages), np.asarray(self.knots)), np.asarray(self.forces)
        )
        points = np.stack(np.broadcast_arrays(voltage, pwm), axis=-1)
        low, high = zip(*((axis[0], axis[-1]) for axis in table.grid), strict=True)
        return table(np.clip(points, low, high))

    def pwm(
        self, force: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        column = self._column(_same_rank(voltage, force))
        side, rise = _over(self._side(), force), jnp.diff(column, axis=0)
        start = jnp.where(side > 0, column[:-1], -column[1:])
        outward, rises = side * force[None], rise > 0
        ramp = jnp.clip((outward - start) / jnp.where(rises, rise, 1), 0, 1)
        parts = jnp.where(rises, ramp, (outward > 0).astype(force.dtype))
        return NEUTRAL + jnp.sum(side * _over(jnp.diff(self.knots), force) * parts, axis=0)

    def limits(
        self, voltage: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        column = self._column(voltage)
        return column[0], column[-1]

    def _currents(self, pwm: Float[Array, "*shape"]) -> Float[Array, "U *shape"]:
        """Currents at the tabulated voltages."""
        table = [_interpolate(pwm, self.current_knots, _over(row, pwm)) for row in self.currents]
        return jnp.stack(table)

    def current(
        self, pwm: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        """Current in A that one thruster draws."""
        V = _same_rank(voltage, pwm)
        return _interpolate(V, self.current_voltages, self._currents(pwm))

    def loaded_voltage(
        self,
        pwm: Float[Array, "n *batch"],
        open_circuit: Float[Array, "*#batch"],
        resistance: Float[Array, ""],
    ) -> Float[Array, "*batch"]:
        """Exact: V + R ΣI(PWM, V) is increasing and piecewise linear in V, so it is inverted."""
        sums = jnp.sum(self._currents(pwm), axis=1)
        source = _same_rank(open_circuit, sums[0])[None]
        nodes = _over(self.current_voltages, sums[0])
        loaded = nodes + resistance * sums
        parts = jnp.clip((source - loaded[:-1]) / jnp.diff(loaded, axis=0), 0, 1)
        inside = nodes[0] + jnp.sum(jnp.diff(nodes, axis=0) * parts, axis=0)
        below = jnp.minimum(source[0] - loaded[0], 0)
        return inside + below + jnp.maximum(source[0] - loaded[-1], 0)


class QuadraticCurve(ThrusterCurve):
    """ArduSub's simulated thruster: F = F_max u|u| with u = (PWM - 1500)/400 at any voltage.

    It is stopped within `dead_band` µs of 1500 (edges included), so the force jumps at the edge,
    and at or beyond 1000 and 2000 µs, which are invalid pulses (ArduPilot, SIM_Submarine.cpp). For
    forces between `RESTING` and the jump the inverse is the nearer of 1500 and the dead band's
    edge; it stays within 1100–1900 µs.
    """

    full_force: Float[Array, ""]
    dead_band: Float[Array, ""]

    def __init__(self, full_force: float, dead_band: float = 25.0, dtype: jnp.dtype | type = float):
        """`full_force` in N at 1900 µs; `dead_band` in µs.

        Raises:
            ValueError: `full_force` is not positive or `dead_band` not in [0, 400).
        """
        if not full_force > 0:
            raise ValueError(f"full_force must be positive, not {full_force} N")
        if not 0 <= dead_band < 400:
            raise ValueError(f"dead_band must lie in [0, 400) µs, not {dead_band}")
        self.full_force = jnp.asarray(full_force, dtype)
        self.dead_band = jnp.asarray(dead_band, dtype)

    def force(
        self, pwm: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        offset = pwm - NEUTRAL
        u = offset / 400
        turns = (jnp.abs(offset) > self.dead_band) & (jnp.abs(offset) < 500)
        rests = RESTING * offset / jnp.maximum(self.dead_band, 1e-9)
        rests = jnp.where(jnp.abs(offset) <= self.dead_band, rests, 0)
        return jnp.where(turns, self.full_force * u * jnp.abs(u), rests) + 0 * voltage

    def steady(
        self, pwm: Float[np.ndarray, "*shape"], voltage: Float[np.ndarray, "*#shape"]
    ) -> Float[np.ndarray, "*shape"]:
        u = (pwm - NEUTRAL) / 400
        turns = (400 * np.abs(u) > float(self.dead_band)) & (400 * np.abs(u) < 500)
        return np.where(turns, float(self.full_force) * u * np.abs(u), 0.0) + 0 * voltage

    def pwm(
        self, force: Float[Array, "*shape"], voltage: Float[Array, "*#shape"]
    ) -> Float[Array, "*shape"]:
        size = jnp.abs(force) / self.full_force
        some = size > 0
        u = jnp.where(some, jnp.sqrt(jnp.where(some, size, 1)), 0)
        jump = (self.dead_band / 400) ** 2
        share = jnp.abs(force) / RESTING
        rests = jnp.where(share <= 1, share * self.dead_band, 0)
        offset = jnp.clip(400 * u, self.dead_band, 400)
        offset = jnp.where(size < jump / 2, rests, offset)
        return NEUTRAL + jnp.sign(force) * offset + 0 * voltage

    def limits(
        self, voltage: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        full = self.full_force + jnp.zeros_like(voltage)
        return -full, full

    def loaded_voltage(
        self,
        pwm: Float[Array, "n *batch"],
        open_circuit: Float[Array, "*#batch"],
        resistance: Float[Array, ""],
    ) -> Float[Array, "*batch"]:
        """The open-circuit voltage: this thruster draws no current."""
        return open_circuit + jnp.zeros_like(pwm[0])
