"""Groups of regressors for unmodelled structure, and the description of a match."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models.effects.following import FOLLOWERS
from ....models.effects.unknown import MOTION, Unknown, powers
from ....models.se3 import AXES, TWIST
from ..data.arrays import Data
from ..filter.problem import DiagnosisProblem, Evaluation
from .structures import Group, Matched, Screen

_TENTHS = tuple(round(0.1 * k, 1) for k in range(5, 16))
NODES = {
    0.4: (0.0, 0.35, 1.0, 2.0),
    1.2: (0.0, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0),
    4.0: (0.0, 0.2, 0.35, *_TENTHS, 1.7, 2.0, 2.5, 3.0),
}
"""Time constants (s) of a memory, and frequencies (Hz) for each, densest where vehicles and loads
that hang on them resonate."""
FOLLOWED = {"play": (0.0075, 0.015, 0.03, 0.06, 0.12), "slew": (0.2, 0.4, 0.8, 1.6, 3.2)}
"""Backlash (±) and rate limits (1/s) that are tried, in shares of the largest force."""
STEPS = tuple(float(s) for s in np.geomspace(0.025, 0.4, 37))
"""Steps of the thrust, of all thrusters, likewise: what sends or executes the commands has a
resolution. Nodes are close, as all multiples up to the largest force must fit."""
_TOLD = 2.0
"""Standard errors from which on a term of unmodelled structure is named."""
_CORRELATED, _MOST_CORRELATED = 0.1, 2
"""Correlation of neighbouring innovations from which memories of other velocities are tried on an
axis, and number of such axes at most."""


def groups(
    problem: DiagnosisProblem,
    evaluation: Evaluation,
    quiet: Sequence[str] = (),
    of_commands: bool = False,
) -> Iterator[Group]:
    """All groups that are tried, or those of the way from commands to forces alone.

    Dependence on motion of `quiet` axes is not identifiable.
    """
    d = problem.data
    level = d.command != "F_Bo_B"
    if level and d.u.any():
        yield _of_exchange(problem)
        largest = _largest_force(d)
        for where in ("thrusters", *(str(k + 1) for k in range(d.u.shape[1]))):
            for kind, numbers in FOLLOWED.items():
                yield _of_follower(problem, kind, where, [n * largest for n in numbers])
        yield _of_follower(problem, "steps", "thrusters", [n * largest for n in STEPS])
    if of_commands:
        return
    nodes = [(time, f) for time, frequencies in NODES.items() for f in frequencies]
    moving = [i for i, axis in enumerate(AXES) if axis not in quiet]
    for i in _correlated(evaluation):
        for j in moving:
            if j != i and i in moving:
                yield _memory(problem, i, j, nodes)
    for i in moving:
        axis = AXES[i]
        yield _memory(problem, i, i, nodes)
        yield _of_state(problem, Unknown.neutral(kind="motion", acts_on=axis, numbers=_ALL_MOTION))
        for kind in ("pose", "course"):
            yield _of_state(problem, Unknown.neutral(kind=kind, acts_on=axis))
    for k in range(d.u.shape[1] if level else 0):
        yield _of_thruster(problem, k)
    z = d.X[:-1, 6][d.weight > 0]
    numbers = (float(z.mean()), float(z.std() + 1e-3))
    yield _of_state(problem, Unknown.neutral(kind="depth", acts_on="W", numbers=numbers))
    for i in moving:
        yield _of_state(problem, Unknown.neutral(kind="damping", acts_on=AXES[i], numbers=numbers))
    bumps = _bumps(d.X[:-1, 4][d.weight > 0], d.X[:-1, 5][d.weight > 0])
    if len(bumps) > 9 and not d.latent:
        for kind in ("place", "flow"):
            yield _of_state(problem, Unknown.neutral(kind=kind, acts_on="W", numbers=bumps))


def _largest_force(d: Data) -> float:
    """Of a thruster (N), but for the largest hundredth where any acts."""
    force = np.abs(d.u).max(axis=1)[d.weight > 0]
    return float(np.quantile(force[force > 0], 0.99)) if force.any() else 1.0


_ALL_MOTION = tuple(float(i) for i in range(len(MOTION)))
_VARIABLES = {
    "motion": TWIST, "pose": ("heading", "roll", "pitch"), "course": ("heading", *TWIST),
    "depth": ("z",), "place": ("x", "y"), "flow": ("x", "y"), "damping": ("z",),
}  # fmt: skip
_SYMBOLS = {"heading": "ψ", "roll": "φ", "pitch": "θ"}


def _of_state(problem: DiagnosisProblem, effect: Unknown) -> Group:
    d, k = problem.data, len(effect.values)

    def columns(kept: np.ndarray) -> np.ndarray:
        X, V = (jnp.asarray(a[:-1][..., kept].swapaxes(0, 1)) for a in (d.X, d.V))
        phi = np.moveaxis(np.asarray(effect.of_state(X, V)), 1, 0)  # (N, k, R)
        if effect.acts_on != "W":
            return phi[:, None]
        count, found = phi.shape[1], np.zeros((len(phi), 3, k, len(kept)))
        for number in range(k):
            way, row = divmod(number, count)
            if effect.kind == "depth":
                row, way = divmod(number, 3)
            found[:, way, number] = phi[:, row]
        return found

    action = {"place": "force", "depth": "force", "flow": "flow"}.get(effect.kind, "wrench")
    return Group(effect, action, _VARIABLES[effect.kind], columns, (tuple(range(k)),))


def _of_thruster(problem: DiagnosisProblem, k: int) -> Group:
    effect = Unknown.neutral(kind="thruster", acts_on=str(k + 1))

    def columns(kept: np.ndarray) -> np.ndarray:
        return np.moveaxis(np.asarray(powers(jnp.asarray(problem.data.u[:, k][:, kept]))), 0, 1)[
            :, None
        ]

    return Group(effect, "thruster", (f"f{k + 1}",), columns, (tuple(range(len(effect.values))),))


def _of_exchange(problem: DiagnosisProblem) -> Group:
    """Two thrusters with exchanged commands, one pair a node."""
    model, d = problem.model, problem.data
    count = d.u.shape[1]
    pairs = tuple(itertools.combinations(range(count), 2))
    effect = Unknown.neutral(kind="exchange", acts_on="thrusters", numbers=(1.0, 2.0))

    def columns(kept: np.ndarray) -> np.ndarray:
        B = np.asarray(model.allocate(jnp.eye(count)))
        between = np.array([B[:, j] - B[:, i] for i, j in pairs])  # (k, 6)
        u = d.u[..., kept]
        apart = np.stack([u[:, i] - u[:, j] for i, j in pairs], axis=1)  # (N, k, R)
        return between.T[None, :, :, None] * apart[:, None]

    nodes = tuple((k,) for k in range(len(pairs)))
    variables = tuple(f"f{k + 1}" for k in range(count))
    labels = tuple((i + 1.0, j + 1.0) for i, j in pairs)
    return Group(effect, "thrusters", variables, columns, nodes, labels)


def _of_follower(
    problem: DiagnosisProblem, kind: str, where: str, numbers: Sequence[float]
) -> Group:
    """Backlash, rate limit or steps of one thruster or of all, one value a node."""
    model, d = problem.model, problem.data
    count, single = d.u.shape[1], where != "thrusters"
    effect = Unknown.neutral(kind=kind, acts_on=where, numbers=(numbers[0],), thrusters=count)
    of = [int(where) - 1] if single else list(range(count))

    def columns(kept: np.ndarray) -> np.ndarray:
        given = (d.past[..., kept][:, of], d.past_steps(kept), d.u[..., kept][:, of])
        behind = followed_by(kind, *given, d.own_steps(kept), numbers)
        acting = np.moveaxis(behind, 2, 0)  # (n, k, N, R)
        if not single:
            acting = np.asarray(model.allocate(jnp.asarray(acting)))
        return np.moveaxis(acting, (0, 1), (1, 2))

    variables = tuple(f"f{k + 1}" for k in of)
    nodes = tuple((k,) for k in range(len(numbers)))
    action = "thruster" if single else "thrusters"
    return Group(effect, action, variables, columns, nodes, tuple((n,) for n in numbers))


def followed_by(
    kind: str,
    past: Float[np.ndarray, "P n R"],
    past_step: Float[np.ndarray, "P _"],
    u: Float[np.ndarray, "N n R"],
    step: Float[np.ndarray, "N _"],
    numbers: Sequence[float],
) -> Float[np.ndarray, "k N n R"]:
    """Followed commands minus commands u; the past commands set the follower's initial state."""
    commands, held = np.concatenate([past, u]), np.concatenate([past_step, step])
    found = _followed(kind, jnp.asarray(commands), jnp.asarray(held), jnp.asarray(numbers))
    return np.asarray(found)[:, len(past) :]


@eqx.filter_jit
def _followed(kind: str, commands: Array, held: Array, numbers: Array) -> Array:
    """Differences (k, N, n, R) of means over each step, from steady state at the first command."""
    numbers = numbers[:, None, None]

    def follow(before: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        command, h = given
        after, mean = FOLLOWERS[kind](before, command[None], h[None, None], numbers)
        return after, mean - command[None]

    start = jnp.repeat(commands[:1], len(numbers), axis=0)
    return jnp.moveaxis(jax.lax.scan(follow, start, (commands, held))[1], 1, 0)


def _correlated(evaluation: Evaluation) -> list[int]:
    """Axes with the most correlated neighbouring innovations, above `_CORRELATED`."""
    correlation = evaluation.correlation[6:]
    first = np.argsort(-correlation)[:_MOST_CORRELATED]
    return [int(i) for i in first if correlation[i] > _CORRELATED]


def _memory(
    problem: DiagnosisProblem, axis: int, of: int, nodes: Sequence[tuple[float, float]]
) -> Group:
    """A wrench on an axis with memory of a component of the twist."""
    effect = Unknown.neutral(kind="memory", acts_on=AXES[axis], numbers=(*nodes[0], float(of)))

    def columns(kept: np.ndarray) -> np.ndarray:
        v = problem.data.V[:-1, of][:, kept]
        rates = np.array([complex(-1 / t, 2 * np.pi * f) for t, f in nodes])[:, None]
        z, found = np.zeros((len(nodes), len(kept)), complex), []
        for x, h in zip(v, problem.data.step[:, kept], strict=True):
            turn = np.exp(rates * h)
            gain = (turn - 1) / rates
            after = turn * z + gain * x
            mean = (z + after) / 2
            both = np.stack([mean.real, mean.imag], axis=1).reshape(2 * len(nodes), -1)
            found.append(np.concatenate([x[None], both]))
            z = after
        return np.array(found)[:, None]

    # at f = 0 the imaginary part is zero
    columns_of = [
        (0, 1 + 2 * i) if f == 0 else (0, 1 + 2 * i, 2 + 2 * i) for i, (_, f) in enumerate(nodes)
    ]
    return Group(effect, "wrench", (TWIST[of],), columns, tuple(columns_of), tuple(nodes))


def _bumps(x: np.ndarray, y: np.ndarray, most: int = 16) -> tuple[float, ...]:
    """Width and centres of bumps where the vehicle was, a width apart."""
    width = 0.4
    while True:
        cells, counts = np.unique(
            np.round(np.stack([x, y]) / width).astype(int), axis=1, return_counts=True
        )
        centres = cells[:, counts > 0.002 * len(x)] * width
        if centres.shape[1] <= most:
            return (width, *(float(c) for c in centres.T.ravel()))
        width *= 1.2


_FINER = (1.4, 1.18, 1.08)
_FINER_STEPS = (1.03, 1.012, 1.005, 1.002, 1.0008)
"""Factors of successive refinements between nodes."""


def refined(screen: Screen, found: Matched, rng: np.random.Generator) -> Unknown:
    """The effect of a match, with parameters refined between nodes, or few terms of the motion."""
    effect = found.group.effect
    if effect.kind == "memory":
        axis, of = AXES.index(effect.acts_on), effect.remembered
        T, f = found.group.labels[found.node]
        for spread in _FINER:
            # a decaying oscillation determines its frequency to a fraction of 1 / T
            step = (spread - 1) * max(f, 0.2)
            frequencies = [g for g in (f - step, f, f + step) if g >= 0.03] if f else [0.0]
            times = (T / spread, T, T * spread)
            finer = _memory(screen.problem, axis, of, [(t, g) for g in frequencies for t in times])
            again = screen.match(finer, 0.01, rng, draws=0)
            T, f = finer.labels[again.node]
        return Unknown.neutral(kind="memory", acts_on=effect.acts_on, numbers=(T, f, float(of)))
    if effect.kind == "exchange":
        return replace(effect, numbers=found.group.labels[found.node])
    if effect.kind in FOLLOWERS:
        (number,) = found.group.labels[found.node]
        for spread in _FINER_STEPS if effect.kind == "steps" else _FINER:
            numbers = (number / spread, number, number * spread)
            finer = _of_follower(screen.problem, effect.kind, effect.acts_on, numbers)
            number = numbers[screen.match(finer, 0.01, rng, draws=0).node]
        return replace(effect, numbers=(number,))
    if effect.kind == "motion":
        chosen = screen.sparse(found.group)
        return Unknown.neutral(kind="motion", acts_on=effect.acts_on, numbers=chosen)
    return effect


def described(
    effect: Unknown,
    weights: Float[np.ndarray, " k"],
    errors: Float[np.ndarray, " k"],
    problem: DiagnosisProblem,
) -> dict[str, Any]:
    """Variables, one sentence, lag, frequency and region of what was matched.

    Terms are named whose weights differ from zero by their standard errors, the clearest first.
    """
    d, clear = problem.data, np.abs(weights) / np.maximum(errors, 1e-300)
    order = [i for i in np.argsort(-clear) if clear[i] > _TOLD] or [int(np.argmax(clear))]
    terms = [effect.terms[i] for i in order]
    lag = frequency = None
    where = effect.acts_on
    variables: Sequence[str] = _VARIABLES.get(effect.kind, ())
    if effect.kind == "memory":
        lag, frequency = effect.numbers[:2]
        variables = (effect.terms[0],)
        rings = f" and rings at {frequency:.2f} Hz" if frequency else ""
        description = f"a wrench on {where} that remembers {variables[0]} for {lag:.2g} s{rings}"
    elif effect.kind in ("motion", "pose", "course"):
        description = f"a wrench on {where} in " + ", ".join(terms)
        variables = [n for n in variables if any(_SYMBOLS.get(n, n) in _factors(t) for t in terms)]
    elif effect.kind == "thruster":
        variables = (f"f{where}",)
        description = f"the force of thruster {where} against its command, in {', '.join(terms)}"
    elif effect.kind == "exchange":
        i, j = (int(k) for k in effect.numbers)
        variables = (f"f{i}", f"f{j}")
        description = (
            f"thrusters {i} and {j} that take each other's command, by their wires or columns"
        )
    elif effect.kind in FOLLOWERS:
        single = where != "thrusters"
        variables = (f"f{where}",) if single else tuple(f"f{k + 1}" for k in range(d.u.shape[1]))
        who = f"thruster {where} following its" if single else "thrusters that follow their"
        how = {
            "play": "with backlash of {:.2g} N",
            "slew": "by {:.2g} N/s at most",
            "steps": "in steps of {:.2g} N",
        }
        description = f"{who} commands {how[effect.kind].format(effect.numbers[0])}"
    elif effect.kind == "damping":
        variables = ("z", TWIST[AXES.index(where)])
        description = f"damping of {where} that depends on depth, in {', '.join(terms)}"
    elif effect.kind == "depth":
        description = f"a force in W that depends on depth: {', '.join(terms)}"
    else:
        what = "moving water" if effect.kind == "flow" else "a force"
        count = len(weights) // 2
        size = np.hypot(weights[:count], weights[count:])
        x, y = np.array(effect.numbers[1:]).reshape(-1, 2)[int(np.argmax(size))]
        description = (
            f"{what} that depends on the place in W (x, y), largest near ({x:.1f}, {y:.1f}) m"
        )
    return {
        "acts_on": where, "variables": list(variables), "description": description, "lag": lag,
        "frequency": frequency or None, "region": _region(variables, d),
    }  # fmt: skip


def _factors(term: str) -> set[str]:
    """The letters of a term: `|u|u` has u, `sin 2ψ·r` has ψ and r."""
    return set(term.replace("sin", "").replace("cos", ""))


def _region(variables: Sequence[str], d: Data) -> dict[str, tuple[float, float]]:
    """Where the data lie: the 2nd and 98th percentiles of each variable."""
    heading = np.arctan2(
        2 * (d.X[:-1, 0] * d.X[:-1, 3] + d.X[:-1, 1] * d.X[:-1, 2]),
        1 - 2 * (d.X[:-1, 2] ** 2 + d.X[:-1, 3] ** 2),
    )
    seen = {n: d.V[:-1, i] for i, n in enumerate(TWIST)}
    seen |= {"x": d.X[:-1, 4], "y": d.X[:-1, 5], "z": d.X[:-1, 6], "heading": heading}
    seen |= {f"f{k + 1}": d.u[:, k] for k in range(d.u.shape[1])}
    region = {}
    for name in variables:
        if name in seen:
            low, high = np.percentile(seen[name][d.weight > 0], (2, 98))
            region[name] = (float(low), float(high))
    return region
