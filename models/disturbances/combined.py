"""Several disturbances as one, and named sets of them."""

from collections.abc import Iterator
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..config.checks import require
from ..config.errors import UserError
from ..dynamics import Flow
from ..randomness import Scalar
from .base import Disturbance
from .current import GaussMarkovCurrent
from .ornstein_uhlenbeck import OrnsteinUhlenbeckWrench
from .surface import Surface
from .tether import Tether
from .wake import ShipWake
from .waves import JonswapWaves
from .white import WhiteWrench

Kind = (
    WhiteWrench
    | OrnsteinUhlenbeckWrench
    | GaussMarkovCurrent
    | JonswapWaves
    | ShipWake
    | Tether
    | Surface
)
"""The kinds that a scenario can name by a tag."""


@dataclass(frozen=True)
class Combined(Disturbance):
    """The sum of its members: states and noises are concatenated, wrenches and flows added.

    Every member's `wrench` receives the flow of all members together.

    Attributes:
        members: the disturbances; may be empty.
    """

    members: tuple[Kind, ...] = ()

    def __post_init__(self) -> None:
        """Check that every member is a disturbance."""
        ok = all(isinstance(member, Disturbance) for member in self.members)
        require(ok, self, "members", "give disturbances such as WhiteWrench")

    @property
    def state_size(self) -> int:
        """Sum over the members."""
        return sum(member.state_size for member in self.members)

    @property
    def noise_size(self) -> int:
        """Sum over the members."""
        return sum(member.noise_size for member in self.members)

    @property
    def initial_noise_size(self) -> int:
        """Sum over the members."""
        return sum(member.initial_noise_size for member in self.members)

    def _states(self, state: Array) -> Iterator[tuple[Kind, Array]]:
        start = 0
        for member in self.members:
            yield member, state[start : start + member.state_size]
            start += member.state_size

    def initial(self, w: Float[Array, "w *batch"]) -> Float[Array, "s *batch"]:
        """Concatenate the members' initial states."""
        parts, start = [w[:0]], 0
        for member in self.members:
            parts.append(member.initial(w[start : start + member.initial_noise_size]))
            start += member.initial_noise_size
        return jnp.concatenate(parts)

    def advance(
        self,
        state: Float[Array, "s *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        dt: Scalar,
        w: Float[Array, "w *batch"],
    ) -> Float[Array, "s *batch"]:
        """Advance every member with its share of the noise."""
        parts, start = [state[:0]], 0
        for member, own in self._states(state):
            noise = w[start : start + member.noise_size]
            parts.append(member.advance(own, X_WB, V_WB_B, t, dt, noise))
            start += member.noise_size
        return jnp.concatenate(parts)

    def wrench(
        self,
        state: Float[Array, "s *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        flow: Flow | None = None,
    ) -> Float[Array, "6 *batch"]:
        """Add the members' wrenches; `flow` replaces the members' own flow if given."""
        if flow is None:
            flow = self.flow(state, X_WB, t)
        total = jnp.zeros_like(V_WB_B)
        for member, own in self._states(state):
            total = total + member.wrench(own, X_WB, V_WB_B, t, flow)
        return total

    def flow(
        self, state: Float[Array, "s *batch"], X_WB: Float[Array, "7 *batch"], t: Scalar
    ) -> Flow:
        """Add the members' velocities and accelerations."""
        v_WC_W, a_WC_W = Flow(jnp.zeros_like(X_WB[4:]), jnp.zeros_like(X_WB[4:]))
        for member, own in self._states(state):
            part = member.flow(own, X_WB, t)
            v_WC_W, a_WC_W = v_WC_W + part.v_WC_W, a_WC_W + part.a_WC_W
        return Flow(v_WC_W, a_WC_W)


_PUSHES = OrnsteinUhlenbeckWrench(
    std=(1.0, 1.0, 1.0, 0.1, 0.1, 0.1), time_constant=(3.0, 3.0, 3.0, 1.5, 1.5, 1.5)
)
_SEA = JonswapWaves(significant_height=0.25, peak_period=2.4, direction=2.5, spreading=10.0)
_WAKE = ShipWake(height=0.3, period=3.0, latest_start=60.0, direction=2.0)
_PRESETS = {
    "still": Combined(),
    "calm": Combined((WhiteWrench((0.3, 0.3, 0.3, 0.03, 0.03, 0.03)),)),
    "harbour": Combined(
        (GaussMarkovCurrent(mean_speed=0.25, std_speed=0.1), _SEA, _WAKE, WhiteWrench(), _PUSHES)
    ),
    "slack_tide": Combined(
        (
            GaussMarkovCurrent(mean_speed=0.03, std_speed=0.05, std_direction=1.5),
            _SEA,
            _WAKE,
            WhiteWrench(),
            _PUSHES,
        )
    ),
    "flood_tide": Combined(
        (GaussMarkovCurrent(mean_speed=0.4, std_speed=0.06), _SEA, _WAKE, WhiteWrench(), _PUSHES)
    ),
}


def preset_names() -> tuple[str, ...]:
    """Names that `preset` knows."""
    return tuple(_PRESETS)


def preset(name: str) -> Combined:
    """Return a named set of disturbances.

    `still` is still water without noise and `calm` a small white wrench. `harbour` follows the
    field conditions of the method's paper (slack to flood tide in a bay: wind waves, ship wake,
    a current that varies between 0 and 0.5 m/s), with Hs = 0.25 m waves, one wake of 0.3 m in
    the first minute and a random wrench; `slack_tide` and `flood_tide` are its two extremes.

    Raises:
        UserError: if there is no such set.
    """
    if name not in _PRESETS:
        raise UserError(f"disturbance set {name!r} is unknown: choose {', '.join(_PRESETS)}.")
    return _PRESETS[name]
