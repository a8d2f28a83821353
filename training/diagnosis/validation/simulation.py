"""Simulations of recorded runs, window by window, without noise and with it."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ....models import se3
from ....models.effects.base import Effect
from ....models.effects.extended import FOR_EVER, Extended, Random
from ....models.effects.inertia import Inertia, times
from ...compile_options import LOOP_EMITTERS, jit_with
from ..filter.along_records import AlongRecords, Records, State, Step, scan
from ..filter.innovations import difference
from ..filter.problem import DiagnosisProblem
from ..filter.varying import Modulated, changes_of
from .blackbox import BlackBox

_LONGEST = 0.02
"""Longest substep of simulated samples (s). A Runge–Kutta method of fourth order is stable up to
2.8 / λ (Hairer and Wanner 1996, section IV.2), and drag ends a turn of 2.7 rad/s of a plain
BlueROV2 at λ = 140 1/s."""
SAMPLES = 39
"""Simulations with noise of each piece."""


@dataclass(frozen=True)
class Contender:
    """A model to judge: θ of each piece (p, R), fitted without it; perhaps a learned correction."""

    theta: Float[np.ndarray, "p R"]
    black_box: BlackBox | None = None
    law_gain: Float[np.ndarray, " R"] | float = 0.0
    """Held-out nats by piece that disturbance laws win in addition."""
    random_effects: tuple[Effect, ...] = ()
    """Effects of these laws; simulations start in their stationary state."""
    white_share: Float[np.ndarray, "6"] = field(default_factory=lambda: np.ones(6))
    """Share of the estimated diffusion that is not due to them (`white_part`)."""


class Simulated(NamedTuple):
    """Recorded less simulated, window after window.

    Attributes:
        errors: pose seen from the simulated body, and twist; lane 0 is simulated without noise, the
            others with that of the disturbance and of the records (N, 12, S, K).
        pieces: indices of the pieces that are simulated (K,).
        every: steps of a window, each simulated from the record at its start.
    """

    errors: Float[np.ndarray, "N 12 S K"]
    pieces: Int[np.ndarray, " K"]
    every: int


def simulate(
    problem: DiagnosisProblem,
    contender: Contender,
    levels: tuple[Float[np.ndarray, "12 K"], Float[np.ndarray, "6 K"], Float[np.ndarray, "6 K"]],
    pieces: Int[np.ndarray, " K"],
    horizon: float,
    seed: int,
    kinds: set[tuple[str, str]],
    samples: int = SAMPLES,
) -> Simulated:
    """Simulations of some pieces over `horizon` s at most, with effects of these causes and places.

    `levels` are the noise of the records, the diffusion and the slip of the poses. One simulation
    has no noise; `samples` further ones have it.
    """
    data = problem.data
    every = max(1, min(round(horizon / data.dt), int(data.weight.sum(axis=0).min())))
    theta = contender.theta[:, None, pieces]
    effects, changes = problem.library.filled(theta), changes_of(problem.library, theta, pieces)
    used = tuple(e for e in effects if any((e.name, where) in kinds for where in e.places))
    box = contender.black_box
    if box is not None:
        box = eqx.tree_at(lambda b: b.weights, box, box.weights[..., pieces])
    e = _errors(
        problem.model, used, contender.random_effects, Records.of(data, pieces), box,
        (jnp.asarray(levels[0]), jnp.asarray(levels[1]), jnp.asarray(levels[2])),
        jax.random.key(seed), every,
        math.ceil(data.longest / _LONGEST - 1e-6), 1 + samples, changes, data.reckoned,
    )  # fmt: skip
    return Simulated(np.asarray(e), pieces, every)


class _Noise(eqx.Module):
    """Noise of records, diffusion, and laws of the disturbance by lane; all zero in lane 0."""

    laws: Extended
    on: Float[Array, "1 S 1"]
    record: Float[Array, "12 S R"]
    b: Float[Array, "6 S R"]
    slip: Float[Array, "6 S R"]

    @property
    def size(self) -> int:
        """Unit Gaussians of a step: b dW, two readings, each law twice, slip."""
        return 24 + 2 * self.laws.noise_size

    def slipped(self, X: Array, dW: Float[Array, "6 S R"]) -> Array:
        """The pose after its slip."""
        return se3.retract(X, self.slip * dW)

    def read(self, X: Array, V: Array, w: Float[Array, "12 S R"]) -> tuple[Array, Array]:
        """A record of pose and twist."""
        n = self.record * w
        return se3.retract(jnp.broadcast_to(X, (7, *n.shape[1:])), n[:6]), V + n[6:]

    def after_laws(
        self, state: State, given: Step, restarts: Array, w: Float[Array, "w S R"]
    ) -> tuple[Random, Float[Array, "6 S R"]]:
        """Random states after a step, and their wrench; stationary where windows start."""
        laws, size = self.laws, self.laws.noise_size
        w = w * self.on
        fresh, _ = laws.step_random_state(state.random, state.X, state.V, w[:size], FOR_EVER)
        now = tuple(jnp.where(restarts, a, b) for a, b in zip(fresh, state.random, strict=True))
        move = jax.vmap(laws.step_random_state, -1, -1)  # each column has its own step
        length = jnp.broadcast_to(given.length[0, 0], w.shape[-1:])
        return move(now, state.X, state.V, w[size - 6 :], length)

    def diffused(self, inertia: Inertia, V: Array, dW: Float[Array, "6 S R"]) -> Array:
        """The twist after M⁻¹ b dW."""
        M = inertia.inverse
        M = M.reshape(M.shape + (1,) * (4 - M.ndim))
        b = self.laws.scaled_diffusion(V, self.b) if self.laws.effects else self.b
        return V + jnp.sum(M * (b * dW)[None], axis=1)


@jit_with(LOOP_EMITTERS)
def _errors(
    model: Extended,
    effects: tuple[Effect, ...],
    random_effects: tuple[Effect, ...],
    records: Records,
    box: BlackBox | None,
    levels: tuple[Float[Array, "12 R"], Float[Array, "6 R"], Float[Array, "6 R"]],
    key: Array,
    every: int,
    count: int,
    lanes: int,
    changes: tuple[Modulated, ...] = (),
    reckoned: tuple[int, ...] = (),
) -> Float[Array, "N 12 S R"]:
    """Recorded less simulated: lane 0 without noise, the others with it and that of the records."""
    whole = AlongRecords.of(model.with_effects(effects), count, changes, reckoned)
    S, R, dtype = lanes, records.V.shape[2], records.V.dtype
    on = (jnp.arange(S)[None, :, None] > 0).astype(dtype)
    laws = model.with_effects(random_effects)
    noise = _Noise(laws, on, *(level[:, None] * on for level in levels))

    def in_all(u: Array) -> Array:
        return jnp.broadcast_to(u, (len(u), S, R))

    def simulated(state: State, given: Step) -> tuple[State, Float[Array, "12 S R"]]:
        w = jax.random.normal(jax.random.fold_in(key, given.number), (noise.size, S, R), dtype)
        along, restarts, push = whole.at(given.number), given.number % every == 0, None
        state = along.restart(state, *noise.read(given.X, given.V, w[:12]), restarts)
        if box is not None:
            commands = in_all(given.command), in_all(given.before)
            lacking = box.acceleration(state.X, state.V, *commands)
            push = times(along.inertia.matrix, lacking)
        if random_effects:
            # laws leave six of w for b dW
            random, wrench = noise.after_laws(state, given, restarts, w[24:-6])
            state = state._replace(random=random)
            push = wrench if push is None else push + wrench
        state = along.step(state, given, push)
        root = jnp.sqrt(given.length)
        V = noise.diffused(along.inertia, state.V, root * w[12:18])
        state = state._replace(X=noise.slipped(state.X, root * w[-6:]), V=V)
        read = noise.read(*whole.at(given.number + 1).observe(state), w[18:30])
        e = difference(*read, given.X_next, given.V_next)
        return state, e.astype(jnp.float32)

    records = records.in_lanes()
    start = whole.at(0).init(records, S)
    random = laws.simulation_state(in_all(records.u[0]))[1]
    return scan(simulated, start._replace(random=random), records)
