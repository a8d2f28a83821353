"""Validation of models on held-out data: scores, simulations, coverage of bands.

All of a model (parameters, diffusion, measurement noise) is fitted without the scenario that it is
judged on; of a single scenario runs are left out in turn, of a single run blocks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ....models.effects.library import whole
from ....models.effects.noise import DisturbanceImpacts, DisturbanceStateDependence
from ....models.se3 import AXES
from ...evaluation.metrics import BANDS, order_statistics
from ..data.arrays import Data
from ..disturbance.laws import Law
from ..filter.innovations import predict
from ..filter.kalman import log_density, make_filter, with_states
from ..filter.noise import estimate
from ..filter.problem import DiagnosisProblem
from ..filter.transition import Transition
from ..findings import result
from .blackbox import arguments
from .simulation import SAMPLES, Contender, Simulated, simulate

GROUPS = {"position": slice(0, 3), "rotation": slice(3, 6), "velocity": slice(6, 9)}
HORIZONS = (0.5, 1.0, 2.0, 4.0)
_PIECES = 60
_DRAWS = 400


class Judged(NamedTuple):
    """Sums over pieces of one fold each; the bootstrap draws folds.

    Attributes:
        score: log density of the innovations by piece (nats) (R,).
        square: squared errors by horizon, group and fold, with their number.
        energy, inside: likewise energy scores, and shares in the bands.
        simulated: the simulations that these were taken from.
    """

    score: Float[np.ndarray, " R"]
    square: Float[np.ndarray, "h g F"]
    energy: Float[np.ndarray, "h F"]
    inside: Float[np.ndarray, "b h F"]
    count: Float[np.ndarray, "h F"]
    simulated: Simulated


class Scores(NamedTuple):
    """Scores of each piece, with noise estimated without it.

    Attributes:
        density: log density of the innovations (nats) (R,).
        record, diffusion, slip: noise of the records, of the disturbance, and slip of the poses
            (12, R), (6, R), (6, R).
        latent: filtered velocities that were not measured, or lost, in all records of the twist;
            None where all were measured. The `record` of an axis that was not measured is the
            standard deviation of the filter.
    """

    density: Float[np.ndarray, " R"]
    record: Float[np.ndarray, "12 R"]
    diffusion: Float[np.ndarray, "6 R"]
    slip: Float[np.ndarray, "6 R"]
    latent: Float[np.ndarray, "M 6 R"] | None = None


def scores(problem: DiagnosisProblem, contender: Contender, estimated: bool) -> Scores:
    """One-step log scores of a model on each piece, fitted without it."""
    data, theta = problem.data, contender.theta
    p = predict(problem.model, problem.library, theta, data)
    error, jacobian = np.asarray(p.error), np.asarray(p.jacobian)
    if contender.black_box is not None:
        h = data.step[:, None]
        a = np.asarray(contender.black_box.acceleration(*arguments(data))).swapaxes(0, 1) * h
        error = error - np.concatenate([a * h / 2, a], axis=1) * data.used[:, None]
    mass = problem.mass(theta.mean(axis=1))
    density = np.zeros(len(data.fold))
    record = np.zeros((12, len(density)))
    diffusion, slip = np.zeros((2, 6, len(density)))
    own_V = data.V.copy() if data.latent or data.spread is not None else None
    spread = data.spread
    for label in np.unique(data.fold):
        own = data.fold == label
        rest = data.weight * (~own if not own.all() else 1)
        steps = Transition.along(jacobian, rest, p.late, p.latent)
        given = mass, data.dt, None, estimated, data.known
        noise = estimate(error, rest, steps, *given)
        record[:, own], diffusion[:, own] = noise.record[:, None], noise.diffusion[:, None]
        slip[:, own] = noise.slip[:, None]
        latent = None if p.latent is None else p.latent.of(own)
        given = np.linalg.inv(mass), data.dt, data.step[:, own], jacobian[..., own], latent
        kalman = make_filter(noise, steps, *given, None if spread is None else spread[..., own])
        z, states = with_states(error[:, :, own], jacobian[..., own], kalman, latent)
        density[own] = log_density(z, kalman, data.weight[:, own])
        if own_V is not None:
            at = 6 + np.array(data.latent, int)
            start = np.asarray(p.start[1])[..., own] - states[:, 6:]
            for i in data.latent:
                own_V[:-1, i, own] = start[:, i]
            if spread is not None:
                lost = spread[:-1, :, own] > 0
                own_V[:-1, :, own] = np.where(lost, start, own_V[:-1, :, own])
            record[at[:, None], own] = kalman.state[at, None]
    return Scores(density, record, diffusion, slip, own_V)


def judge(
    problem: DiagnosisProblem,
    contender: Contender,
    horizon: float,
    seed: int,
    in_use: Sequence[int],
    estimated: bool,
) -> Judged:
    """Score a model's innovations, and simulate it over `horizon` s from recorded states.

    Effects that own none of the parameters `in_use` are left out of the simulations; contenders
    with the same ones share a compiled program. `estimated` (the records are states of a filter) is
    the same for all folds and contenders.
    """
    data = problem.data
    density, record, diffusion, slip, V = scores(problem, contender, estimated)
    kept = _spread(data.fold, _PIECES)
    levels = record[:, kept], diffusion[:, kept] * contender.white_share[:, None], slip[:, kept]
    filtered, kinds = _with_velocities(problem, V), _kinds(problem, contender, in_use)
    simulated = simulate(filtered, contender, levels, kept, horizon, seed, kinds)
    return _judged(simulated, density + contender.law_gain, data, horizon)


def forecast_square(
    problem: DiagnosisProblem,
    contender: Contender,
    horizon: float,
    in_use: Sequence[int],
    estimated: bool,
) -> Float[np.ndarray, "h g F"]:
    """The squared errors of `judge` alone: forecasts without noise.

    Only where velocities are filtered are the innovations scored as well, for windows start there.
    """
    data, kept = problem.data, _spread(problem.data.fold, _PIECES)
    if data.latent or data.spread is not None:
        problem = _with_velocities(problem, scores(problem, contender, estimated).latent)
    record, diffusion, slip = (np.zeros((rows, len(kept))) for rows in (12, 6, 6))
    none = record, diffusion, slip
    kinds = _kinds(problem, contender, in_use)
    return _square(simulate(problem, contender, none, kept, horizon, 0, kinds, 0), data, horizon)


def _with_velocities(
    problem: DiagnosisProblem, V: Float[np.ndarray, "M 6 R"] | None
) -> DiagnosisProblem:
    """With filtered velocities, if there are any."""
    return problem if V is None else replace(problem, data=replace(problem.data, V=V))


def _kinds(
    problem: DiagnosisProblem, contender: Contender, in_use: Sequence[int]
) -> set[tuple[str, str]]:
    """Causes and places of the parameters in use, or other than zero."""
    used = {*in_use, *np.flatnonzero(np.any(contender.theta != 0, axis=1)).tolist()}
    return {(whole(e.cause), e.where) for e in (problem.library.entries[i] for i in used)}


def white_part(laws: Sequence[Law], problem: DiagnosisProblem) -> Float[np.ndarray, "6"]:
    """Share of each axis' estimated diffusion that is not due to these laws.

    Impacts occur within single steps and count as diffusion; one that grows with the speed was
    estimated as the mean over all speeds. Slow disturbances are no part of the estimate.
    """
    share, data = np.ones(6), problem.data
    speed2 = (data.V[:-1, :3] ** 2).sum(axis=1)
    for law in laws:
        p = law.parameters
        if law.name == DisturbanceImpacts.name:
            square = (1 - p["share"]) * p["rest"] ** 2 + p["share"] * p["size"] ** 2
            share[AXES.index(law.where)] = p["rest"] / np.sqrt(square)
        elif law.name == DisturbanceStateDependence.name:
            grown = ((1 + p["growth"] * speed2) * data.weight).sum() / data.weight.sum()
            share[AXES.index(law.where)] = 1 / np.sqrt(grown)
    return share


def _spread(fold: np.ndarray, most: int) -> np.ndarray:
    """At most `most` pieces, equally many of each fold."""
    labels = np.unique(fold)
    each = max(1, most // len(labels))
    chosen = []
    for label in labels:
        own = np.flatnonzero(fold == label)
        chosen += own[np.unique(np.linspace(0, len(own) - 1, each).round().astype(int))].tolist()
    return np.array(sorted(chosen))


def _errors_at(
    simulated: Simulated, data: Data, horizon: float
) -> Iterator[tuple[Float[np.ndarray, "K c S R"], Bool[np.ndarray, "F K R"]]]:
    """By horizon, errors at the end of each window, and those that exist of each fold."""
    every, kept = simulated.every, simulated.pieces
    fold = data.fold[kept] == np.unique(data.fold)[:, None]
    for steps in horizons(horizon, every, data.dt):
        rows = np.arange(steps - 1, len(simulated.errors), every)
        errors = simulated.errors[rows].astype(np.float64)[:, data.compared > 0]
        yield errors, (data.weight[rows][:, kept] > 0) & fold[:, None]


def _square(simulated: Simulated, data: Data, horizon: float) -> Float[np.ndarray, "h g F"]:
    """Sums of squared errors without noise, by horizon, group and fold."""
    by_horizon, parts = [], _compared(data)
    for errors, exists in _errors_at(simulated, data, horizon):
        total = np.stack([(errors[:, group, 0] ** 2).sum(axis=1) for group in parts])
        by_horizon.append(np.where(exists, total[:, None], 0).sum(axis=(-2, -1)))
    return np.stack(by_horizon)


def _judged(simulated: Simulated, score: np.ndarray, data: Data, horizon: float) -> Judged:
    at, labels = horizons(horizon, simulated.every, data.dt), np.unique(data.fold)
    energy, count = np.zeros((len(at), len(labels))), np.zeros((len(at), len(labels)))
    inside = np.zeros((len(BANDS), len(at), len(labels)))
    for h, (errors, exists) in enumerate(_errors_at(simulated, data, horizon)):
        drawn = errors[:, :, 1:]
        apart = np.abs(drawn[:, :, 1:] - drawn[:, :, :-1])
        with np.errstate(invalid="ignore", over="ignore"):  # of forecasts that diverge
            far = np.sqrt((drawn**2).sum(axis=1)).mean(axis=1)
            far -= np.sqrt((apart**2).sum(axis=1)).mean(axis=1) / 2
        count[h] = exists.sum(axis=(1, 2))
        energy[h] = np.where(exists, far, 0).sum(axis=(1, 2))
        ordered = np.sort(drawn, axis=2)
        for b, band in enumerate(BANDS):
            low, high = order_statistics(SAMPLES, band)
            hit = (ordered[:, :, low] <= 0) & (ordered[:, :, high] >= 0)
            inside[b, h] = (hit.mean(axis=1) * exists).sum(axis=(1, 2))
    square = _square(simulated, data, horizon)
    return Judged(score, square, energy, inside, count, simulated)


def _compared(data: Data) -> list[list[int]]:
    """Places of each group's errors among those that are compared."""
    kept = np.flatnonzero(data.compared)
    return [
        [k for k, i in enumerate(kept) if group.start <= i < group.stop]
        for group in GROUPS.values()
    ]


def horizons(longest: float, every: int, dt: float) -> list[int]:
    """Steps of the horizons that fit into a window."""
    found = [round(h / dt) for h in HORIZONS if h <= longest + 1e-9 and 1 <= round(h / dt) <= every]
    return found or [every]


# ----------------------------------------------------------------------------------- summary


def model_gain(
    judged: Judged,
    base: Judged,
    problem: DiagnosisProblem,
    horizon: float,
    rng: np.random.Generator,
) -> result.ModelGain:
    """Scores with 95 % intervals, by bootstrap over folds."""
    data = problem.data
    labels = np.unique(data.fold)
    drawn = rng.integers(len(labels), size=(_DRAWS, len(labels)))
    at = horizons(horizon, judged.simulated.every, data.dt)
    names = [f"{h * data.dt:g}" for h in at]

    def ratio(top: np.ndarray, bottom: np.ndarray, root: bool = False) -> result.Interval:
        value = top.sum() / max(bottom.sum(), 1e-300)
        draws = top[drawn].sum(axis=1) / np.maximum(bottom[drawn].sum(axis=1), 1e-300)
        return _interval(np.sqrt(value), np.sqrt(draws)) if root else _interval(value, draws)

    def by_horizon(values: np.ndarray, root: bool = False) -> dict[str, result.Interval]:
        rows = zip(names, values, judged.count, strict=True)
        return {name: ratio(v, c, root) for name, v, c in rows}

    steps = np.array([data.weight[:, data.fold == f].sum() for f in labels])
    score = np.array([judged.score[data.fold == f].sum() for f in labels])
    before = np.array([base.score[data.fold == f].sum() for f in labels])
    parts = _compared(data)
    rmse = {
        g: by_horizon(judged.square[:, k], True) if parts[k] else {} for k, g in enumerate(GROUPS)
    }
    return result.ModelGain(
        log_score=ratio(score, steps),
        log_score_gain=ratio(score - before, steps),
        energy_score=by_horizon(judged.energy),
        position_rmse=rmse["position"],
        rotation_rmse=rmse["rotation"],
        velocity_rmse=rmse["velocity"],
        coverage={f"{100 * b:.0f} %": by_horizon(judged.inside[k]) for k, b in enumerate(BANDS)},
    )


def _interval(value: float, draws: np.ndarray) -> result.Interval:
    low, high = np.percentile(draws, (2.5, 97.5))
    return result.Interval(float(value), (float(low), float(high)))
