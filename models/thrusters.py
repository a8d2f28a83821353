"""The thrusters: geometry, conversion of PWM and force, allocation of a wrench, and lag.

Their number and order are those of the vehicle's file. `directions` is the force in B (forward,
left, up) for one newton at PWM above 1500. Arrays are component first: forces (n, *batch).
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .se3 import AXES
from .thruster_curves import NEUTRAL, ThrusterCurve

REST = 0.1
"""Below this force (N) a thruster counts as stopped for the start delay."""
MOST = 64
"""More thrusters than this in a file are taken for an error of the file."""
_PRIORITY = (0, 1, 2, 5, 3, 4)
"""Axes in the order in which they are actuated: of two that depend on each other the later one is
not; roll and pitch are last because buoyancy restores them."""


def allocation_matrix(
    positions: Float[np.ndarray, "3 n"], directions: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, "6 n"]:
    """B with F_Bo_B = B f: columns [d; p × d] (Fossen 2011, ch. 12.3)."""
    return np.concatenate([directions, np.cross(positions, directions, axis=0)])


class Thrusters(eqx.Module):
    """Thrusters fixed to the body, all of one kind.

    `unactuated` names the axes along or about which they can't act independently of the others.
    `allocate` meets the other axes exactly and disregards these: it is the least-squares solution
    in the limit of no weight on them.

    `bias` is each group's null-space vector, `biased` the thrusters where it is not zero: a
    static field, so that XLA is given no large arrays of constants to fold.

    `motor_directions` are ArduSub's MOT_n_DIRECTION: -1 where PWM above 1500 turns the propeller
    backwards, so that the thruster gives its reverse thrust; there the autopilot's mixer mirrors
    its output about 1500, and so does `pwm`.
    """

    positions: Float[Array, "3 n"]
    directions: Float[Array, "3 n"]
    motor_directions: Float[Array, "n"]
    curve: ThrusterCurve
    time_constant: Float[Array, ""]
    start_delay: Float[Array, ""]
    nominal_voltage: Float[Array, ""]
    resistance: Float[Array, ""]
    allocation: Float[Array, "6 n"]
    inverse: Float[Array, "n 6"]
    bias: Float[Array, "n"]
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    biased: tuple[int, ...] = eqx.field(static=True)
    unactuated: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        positions: Float[np.ndarray, "3 n"],
        directions: Float[np.ndarray, "3 n"],
        curve: ThrusterCurve,
        *,
        motor_directions: Float[np.ndarray, "n"] | None = None,
        effort: Float[np.ndarray, "n"] | None = None,
        time_constant: float = 0.0,
        start_delay: float = 0.0,
        nominal_voltage: float = 16.0,
        resistance: float = 0.0,
        dtype: jnp.dtype | type = float,
    ):
        """Positions in m from Bo; times in s; battery's open-circuit voltage in V, resistance in Ω.

        `effort` (positive) weights the squared forces that `allocate` minimises.

        Raises:
            ValueError: an array has the wrong size, the thrusters actuate no axis, or a value is
                out of range.
        """
        p, d = np.asarray(positions, float), np.asarray(directions, float)
        n = p.shape[-1]
        s = np.ones(n) if motor_directions is None else np.asarray(motor_directions, float)
        w = np.ones(n) if effort is None else np.asarray(effort, float)
        _check_layout(p, d, s, w)
        if not (time_constant >= 0 and start_delay >= 0):
            raise ValueError(
                f"time_constant {time_constant} and start_delay {start_delay} must be ≥ 0 s"
            )
        if not (resistance >= 0 and nominal_voltage > 0):
            raise ValueError(
                f"battery: resistance {resistance} Ω must be ≥ 0 and voltage {nominal_voltage} V "
                "positive"
            )
        B = allocation_matrix(p, d)
        actuated = _independent(B)
        if not actuated:
            raise ValueError("the thrusters give no wrench; check their positions and directions")
        self.unactuated = tuple(AXES[i] for i in range(6) if i not in actuated)
        upright = np.abs(d[2]) > np.hypot(d[0], d[1])
        groups = [np.flatnonzero(~upright), np.flatnonzero(upright)]
        self.groups = tuple(tuple(int(i) for i in group) for group in groups)
        bias = np.zeros(n)
        for group in filter(None, self.groups):
            bias[list(group)] = _null_vector(B[:, list(group)])
        self.positions, self.directions = jnp.asarray(p, dtype), jnp.asarray(d, dtype)
        self.motor_directions = jnp.asarray(s, dtype)
        self.curve = curve
        self.time_constant = jnp.asarray(time_constant, dtype)
        self.start_delay = jnp.asarray(start_delay, dtype)
        self.nominal_voltage = jnp.asarray(nominal_voltage, dtype)
        self.resistance = jnp.asarray(resistance, dtype)
        self.allocation = jnp.asarray(B, dtype)
        A, inverse = B[actuated], np.zeros((n, 6))
        inverse[:, actuated] = (A / w).T @ np.linalg.inv((A / w) @ A.T)
        self.inverse = jnp.asarray(inverse, dtype)
        self.bias = jnp.asarray(bias, dtype)
        self.biased = tuple(int(i) for i in np.flatnonzero(bias))

    # ------------------------------------------------------------------------------ PWM and force

    def _voltage(self, voltage: ArrayLike | None, rank: int) -> Array:
        """The nominal voltage for None; a batch gets a leading axis for the thrusters."""
        if voltage is None:
            return self.nominal_voltage
        V = jnp.asarray(voltage, self.nominal_voltage.dtype)
        return V[None] if V.ndim == rank - 1 and V.ndim > 0 else V

    def force(
        self, pwm: Float[Array, "n *batch"], voltage: ArrayLike | None = None
    ) -> Float[Array, "n *batch"]:
        """Steady forces in N at `pwm` µs; `voltage` in V, a number or one for each batch entry."""
        return self.curve.force(self._mirror(pwm), self._voltage(voltage, pwm.ndim))

    def pwm(
        self, force: Float[Array, "n *batch"], voltage: ArrayLike | None = None
    ) -> Float[Array, "n *batch"]:
        """PWM in µs whose steady force is `force`, clipped to 1100–1900 µs."""
        return self._mirror(self.curve.pwm(force, self._voltage(voltage, force.ndim)))

    def _mirror(self, pwm: Float[Array, "n *batch"]) -> Float[Array, "n *batch"]:
        return NEUTRAL + _column(self.motor_directions, pwm) * (pwm - NEUTRAL)

    def force_limits(
        self, voltage: ArrayLike | None = None
    ) -> tuple[Float[Array, "n *batch"], Float[Array, "n *batch"]]:
        """Largest reverse (negative) and forward force in N of each thruster."""
        V = self._voltage(voltage, 0)
        shape = (len(self.motor_directions), *V.shape)
        low, high = self.curve.limits(V)
        return jnp.broadcast_to(low[None], shape), jnp.broadcast_to(high[None], shape)

    def loaded_voltage(
        self, pwm: Float[Array, "n *batch"], open_circuit: ArrayLike | None = None
    ) -> Float[Array, "*batch"]:
        """Battery voltage V = Voc - R ΣI(PWM, V) under the thrusters' current.

        `open_circuit` defaults to the nominal voltage: a number or one for each batch entry.
        """
        V = self._voltage(open_circuit, 0)
        return self.curve.loaded_voltage(self._mirror(pwm), V, self.resistance)

    # -------------------------------------------------------------------------- wrench and forces

    def wrench(self, forces: Float[Array, "n *batch"]) -> Float[Array, "6 *batch"]:
        """F_Bo_B = B f in N and N·m."""
        return jnp.tensordot(self.allocation, forces, 1)

    def allocate(
        self,
        F_Bo_B: Float[Array, "6 *batch"],
        voltage: ArrayLike | None = None,
        scale: Literal["common", "groups"] = "common",
    ) -> Float[Array, "n *batch"]:
        """Forces in N within the limits that give `F_Bo_B`, or as much of it as is feasible.

        The forces of least `effort` (weighted pseudo-inverse; Fossen 2011, ch. 12.3), plus, where a
        limit is active, the smallest null-space bias of the horizontals and of the verticals, which
        leaves the wrench unchanged: forward thrust exceeds reverse thrust, and the bias moves load
        to the thrusters that run forward. A wrench that is still infeasible is scaled down:
        `common` by one factor, which keeps its direction, `groups` horizontals and verticals each
        by their own, as ArduSub's mixer does: heave, roll and pitch then keep their authority at
        full speed, and the direction changes.
        """
        force = jnp.tensordot(self.inverse, F_Bo_B, 1)
        low, high = self.curve.limits(self._voltage(voltage, force.ndim))
        low, high = jnp.broadcast_to(low, force.shape), jnp.broadcast_to(high, force.shape)
        if scale == "common":
            factors = [self._fitting_scale(force, low, high, group) for group in self.groups]
            force = force * jnp.min(jnp.stack(factors), axis=0)[None]
        else:
            planar, upright = self.groups
            in_plane = _column(np.array([1, 1, 0, 0, 0, 1], bool), force)
            factor = self._fitting_scale(force, low, high, planar)[None]
            # the verticals balance the moments of the horizontals' actual forces
            force = jnp.tensordot(self.inverse, F_Bo_B * jnp.where(in_plane, factor, 1), 1)
            factor = self._fitting_scale(force, low, high, upright)[None]
            vertical = np.isin(np.arange(len(force)), upright)
            force = force * jnp.where(_column(vertical, force), factor, 1)
        for group in self.groups:
            index = np.intersect1d(group, self.biased)
            if index.size:
                n, part = _column(self.bias[index], force), force[index]
                ends = (low[index] - part) / n, (high[index] - part) / n
                least = jnp.max(jnp.minimum(*ends), axis=0)
                most = jnp.min(jnp.maximum(*ends), axis=0)
                force = force.at[index].add(n * jnp.clip(0, least, most)[None])
        return jnp.clip(force, low, high)

    def _fitting_scale(
        self, force: Array, low: Array, high: Array, group: tuple[int, ...]
    ) -> Array:
        """Largest s ≤ 1 for which s f + c n is within the limits for some bias c.

        With g = f/n and limits l, h divided likewise, s g_i + c ≤ h_i and s g_j + c ≥ l_j for all
        pairs: s (g_i - g_j) ≤ h_i - l_j. A thruster without bias (n = 0) bounds s by itself.
        """
        scale = jnp.ones(force.shape[1:], force.dtype)
        index = np.intersect1d(group, self.biased)
        if index.size:
            n = _column(self.bias[index], force)
            g, a, b = force[index] / n, low[index] / n, high[index] / n
            a, b = jnp.minimum(a, b), jnp.maximum(a, b)
            gap, room = g[:, None] - g[None], b[:, None] - a[None]
            pairs = jnp.where(gap > 0, room / jnp.where(gap > 0, gap, 1), 1)
            scale = jnp.minimum(scale, jnp.min(pairs, axis=(0, 1)))
        index = np.setdiff1d(group, self.biased).astype(int)
        if index.size:
            f = force[index]
            bound = jnp.where(f > 0, high[index], low[index])
            alone = jnp.where(f != 0, bound / jnp.where(f != 0, f, 1), 1)
            scale = jnp.minimum(scale, jnp.min(alone, axis=0))
        return scale

    # ---------------------------------------------------------------------------------------- lag

    def lag(
        self, force: Float[Array, "n *batch"], command: Float[Array, "n *batch"], dt: ArrayLike
    ) -> Float[Array, "n *batch"]:
        """Force after `dt` s of τ df/dt = command - force, exact while the command is held."""
        dt = jnp.asarray(dt, force.dtype)
        at_once = self.time_constant <= 0
        decay = jnp.exp(-dt / jnp.where(at_once, 1, self.time_constant))
        return command + (force - command) * jnp.where(at_once, 0, decay)

    def lag_from_rest(
        self,
        force: Float[Array, "n *batch"],
        waited: Float[Array, "n *batch"],
        command: Float[Array, "n *batch"],
        dt: ArrayLike,
    ) -> tuple[Float[Array, "n *batch"], Float[Array, "n *batch"]]:
        """`lag` with the delay of a sensorless motor drive that starts a propeller from rest.

        `waited` (s, initially zero) is the time since a stopped thruster got a command; the force
        stays constant until it reaches `start_delay`. A running thruster, also one that passes
        through zero to reverse, is not delayed again until it has been stopped without a command.
        Returns the new force and the new `waited`.
        """
        dt = jnp.asarray(dt, force.dtype)
        rests = jnp.abs(force) < REST
        waited = jnp.where(rests & (command == 0), 0, jnp.where(rests, waited, self.start_delay))
        starts = rests & (command != 0)
        left = jnp.where(starts, jnp.clip(self.start_delay - waited, 0, dt), 0)
        waited = jnp.where(starts, jnp.minimum(waited + dt, self.start_delay), waited)
        at_once = self.time_constant <= 0
        decay = jnp.exp(-(dt - left) / jnp.where(at_once, 1, self.time_constant))
        decay = jnp.where(at_once, jnp.where(left < dt, 0, 1), decay)
        return command + (force - command) * decay, waited


def _column(values: Array | np.ndarray, x: Array) -> Array:
    """One value for each entry of the first axis of `x`."""
    return jnp.asarray(values).reshape((-1,) + (1,) * (x.ndim - 1))


def _check_layout(p: np.ndarray, d: np.ndarray, s: np.ndarray, w: np.ndarray) -> None:
    """Refuse positions, directions, motor directions and efforts that are no thrusters."""
    n = p.shape[-1]
    if p.shape != (3, n) or d.shape != (3, n) or s.shape != (n,) or w.shape != (n,):
        raise ValueError(
            "positions and directions must be (3, n), motor_directions and effort (n,); got "
            f"{p.shape}, {d.shape}, {s.shape}, {w.shape}"
        )
    if not np.all(np.abs(s) == 1):
        raise ValueError(f"motor_directions must be 1 or -1 each, not {s.tolist()}")
    if not np.all(w > 0):
        raise ValueError(f"effort must be positive, not {w.tolist()}")


def _independent(B: Float[np.ndarray, "6 n"]) -> list[int]:
    """Rows of B, by `_PRIORITY`, that do not depend linearly on those before; sorted."""
    kept: list[int] = []
    for i in _PRIORITY:
        tried, least = B[[*kept, i]], 1e-6 * float(np.abs(B).max(initial=0.0))
        if np.linalg.matrix_rank(tried, tol=least) > len(kept) and least > 0:
            kept.append(i)
    return sorted(kept)


def _null_vector(B: Float[np.ndarray, "6 k"]) -> Float[np.ndarray, "k"]:
    """Basis of the null space of B, largest entry 1, if it has dimension one; else zeros."""
    _, values, rows = np.linalg.svd(B)
    values = np.concatenate([values, np.zeros(B.shape[1])])[: B.shape[1]]
    if np.sum(values < 1e-9 * values[0]) != 1:
        return np.zeros(B.shape[1])
    vector = rows[-1]
    vector = np.where(np.abs(vector) < 1e-9 * np.abs(vector).max(), 0, vector)
    return vector / vector[np.argmax(np.abs(vector))]
