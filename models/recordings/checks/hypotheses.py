"""Hypotheses on the commands, and how much of each the motion accounts for."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...vehicles.vehicle import Vehicle
from .response import LAGS_S, AxisResponse

EVIDENCE = 12.0
"""Nats by which a named hypothesis is more likely than the recorded order: 6e-6 by chance, some
hundred hypotheses together 1e-3."""
MOST = 0.5
"""Share that a named hypothesis accounts for, and most of the rest that it leaves."""
_EARLIEST, _LATEST = -0.15, 0.45
"""s of lag that thrusters and clocks have."""
_LEAST_MASS = 0.1
"""Share of the vehicle's mass that a named hypothesis must show."""
PLAUSIBLE = np.flatnonzero((LAGS_S > _EARLIEST) & (LAGS_S < _LATEST)).tolist()
CAUSAL = [lag for lag in PLAUSIBLE if LAGS_S[lag] > -0.05]
"""Lags of hypotheses: before its command a motion only is where the command answers the motion."""
ALL = list(range(LAGS_S.size))
LEAST_COUNT = 20.0
"""Independent windows below which nothing is said of an axis."""
MAIN = 0.7
"""Share of the largest lever on an axis from which on a thruster mainly drives it."""
_HARDLY, _SURE = 10.0, 0.9
"""Commanded force over the force that the motion shows, above which no vehicle's numbers explain
it; the largest share of a force that a command is expected to make up."""


@dataclass(frozen=True)
class Driven:
    """Responses by axis, the vehicle's weights (6, m) and the names of the columns."""

    axes: dict[int, AxisResponse]
    weights: Float[np.ndarray, "6 m"]
    columns: tuple[str, ...]
    needed: dict[int, float]
    """Root mean square of the force (N, N·m) that the motion shows with the vehicle's numbers."""
    given: dict[int, float]
    """Root mean square of the commanded force."""

    mass: dict[int, float]
    """The vehicle's mass or moment of inertia by axis; 0 if it is not known."""

    judged: tuple[int, ...] = ()
    """Columns of thrusters that gave enough thrust to be judged."""
    outputs: tuple[int, ...] = ()
    """Output of the autopilot that drives each thruster; empty if it is not known."""

    def shares(
        self, weights: np.ndarray, lag: int | Sequence[int], strict: bool = False
    ) -> dict[int, np.ndarray]:
        """Shares by axis for hypotheses of weights (6, m, *H), at one lag or by lag (L, *H).

        `strict` takes a share for nothing if its mass is: a controller that opposes the motion
        looks like drag with the other sign, but not like a mass.
        """
        found = {}
        for i, r in self.axes.items():
            share, mass = r.fit(weights[i], lag)
            found[i] = np.where(mass > _LEAST_MASS * self.mass[i], share, 0.0) if strict else share
        return found

    def evidence(self, shares: dict[int, np.ndarray]) -> np.ndarray:
        """Nats of hypotheses against no relation at all."""
        return sum(
            (-0.5 * self.axes[i].count * np.log1p(-s) for i, s in shares.items()), np.zeros(())
        )

    def best(
        self, weights: np.ndarray, lags: Sequence[int], strict: bool = False
    ) -> tuple[np.ndarray, dict, np.ndarray]:
        """Evidence, shares and lag (an index) of each hypothesis at its most likely lag."""
        shares = self.shares(weights, lags, strict)
        nats = np.broadcast_to(self.evidence(shares), (len(lags), *weights.shape[2:]))
        at = nats.argmax(axis=0)
        picked = {i: np.take_along_axis(s, at[None], 0)[0] for i, s in shares.items()}
        return nats.max(axis=0), picked, np.asarray(lags)[at]

    def nats(self, axis: int) -> float:
        """Evidence for any relation of an axis' motion to its command, of either sign, any lag."""
        r = self.axes[axis]
        shares = r.fit(np.stack([self.weights[axis], -self.weights[axis]], axis=-1), ALL)[0]
        return float(-0.5 * r.count * np.log1p(-np.max(shares)))

    def expected(self, axis: int) -> float:
        """Evidence that an axis gives whose motion follows its command.

        Of a command that makes up a share ρ² of the force shown, n windows give -n/2 log(1 - ρ²).
        """
        share = min(self._times(axis) ** 2, _SURE)
        return float(-0.5 * self.axes[axis].count * np.log1p(-share))

    def answered(self, axis: int) -> bool:
        """Whether the motion of an axis follows its command."""
        return self.nats(axis) > EVIDENCE and self.given[axis] < _HARDLY * self.needed[axis]

    def unanswered(self, axis: int) -> bool:
        """Whether the motion of an axis follows its command not at all, or hardly."""
        if self._times(axis) > _HARDLY:
            return True
        return bool(self.expected(axis) > 3 * EVIDENCE and self.nats(axis) < EVIDENCE)

    def _times(self, axis: int) -> float:
        return self.given[axis] / max(self.needed[axis], 1e-12)


def driven_by(
    axes: dict[int, AxisResponse],
    weights: Float[np.ndarray, "6 m"],
    names: tuple[str, ...],
    vehicle: Vehicle | None,
) -> Driven:
    """Responses with the sizes of the commanded forces, and of those that the motion shows."""
    zero = int(np.argmin(np.abs(LAGS_S)))
    given, needed, masses = {}, {}, {}
    for i, r in axes.items():
        given[i] = float(np.sqrt(max(weights[i] @ r.CC[zero] @ weights[i], 0.0) / r.windows))
        if given[i] < 1e-6:  # what rounding leaves of an axis that thrusters can't actuate
            given[i] = 0.0
        if vehicle is None:
            needed[i], masses[i] = np.inf, 0.0
            continue
        rigid = (vehicle.mass,) * 3 + vehicle.inertia
        c = np.array([
            rigid[i] + vehicle.added_mass[i],
            vehicle.linear_damping[i],
            vehicle.quadratic_damping[i],
        ])  # fmt: skip
        masses[i] = float(c[0])
        needed[i] = float(np.sqrt(max(c @ r.RR @ c, 0.0) / r.windows))
    return Driven(axes, weights, names, needed, given, masses)


def named(usual: float, share: float, count: float) -> bool:
    """Whether a hypothesis on one axis is clearly better than the recorded order."""
    rest = (1 - share) / (1 - usual)
    return share >= MOST and rest < MOST and bool(-0.5 * count * np.log(rest) > EVIDENCE)
