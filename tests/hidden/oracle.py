"""What the true model would predict: the yardstick of a diagnosis' gain.

    truth = case.simulate(seed=1007)                # held out; its files: case.write(…, 1007)
    oracle = predict(case, truth, starts=[20, 60], steps=20)
    base = predict(case, truth, starts=[20, 60], steps=20, effects=())
    share(base, extended, oracle, truth)            # 1: as good as the truth; 0: as the belief

Windows start at samples `starts` of every run and last `steps` samples. All begin at the recorded
state, as each model reads it, and go on without noise. Predictions are of what is recorded:
measurement effects are part of the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .draw import Case
from .effect import Effect, Latent
from .instruments import LEAD, instruments_show
from .plant import Plant, delayed
from .rotations import conjugate, exponential, logarithm, product
from .scenarios import build
from .simulator import Noise, Truth, simulate, streams

PARTS = ("position", "attitude", "velocity", "rate")


@dataclass(frozen=True)
class Prediction:
    """Recorded pose and twist to come: X (starts, steps + 1, 7, B), V (starts, steps + 1, 6, B)."""

    starts: tuple[int, ...]
    X: np.ndarray
    V: np.ndarray


class _Still:
    """A generator whose draws are at their mean, and of events none."""

    def standard_normal(self, size: tuple[int, ...]) -> np.ndarray:
        return np.zeros(size)

    def uniform(self, low: float = 0.0, high: float = 1.0, size: int = 1) -> np.ndarray:
        return np.ones(size)


def predict(
    case: Case,
    truth: Truth,
    starts: Sequence[int],
    steps: int,
    *,
    effects: Sequence[Effect] | None = None,
    exact_start: bool = False,
    knows_latents: bool = True,
) -> Prediction:
    """Predict windows of `truth`, made by `case.simulate(seed)`, under the effects (those hidden).

    With `knows_latents` it also knows, at a window's start, what is random in a run (phase of the
    waves, present current, coloured force), which data can only estimate: an upper bound. Without,
    it takes their mean, nothing.
    """
    hidden = case.effects if effects is None else effects
    if not knows_latents:
        hidden = [e for e in hidden if not e.draw_latent(1, _Still())]
    plant = Plant(case.true_vehicle(), hidden)
    full = Plant(case.true_vehicle(), case.effects)
    h, lead = case.plan.h, round(LEAD / case.plan.h)
    B = truth.states.shape[2]
    run = np.arange(B)
    samples = np.rint(truth.t / h).astype(int) + lead
    taken = plant.followed(truth.held, h)
    X, V = [], []
    for n in starts:
        span = samples[n : n + steps + 1] - samples[n]
        if span.shape[0] != steps + 1:
            raise ValueError(f"window of {steps} samples from {n} goes beyond the run")
        y = _start(truth, plant, full, samples[n], n, exact_start, h)
        past = np.stack([truth.states[samples[n] - k, :, run].T for k in range(lead, 0, -1)])
        rows = samples[n] - lead + np.arange(lead + int(span.max()))[:, None]
        held = taken[np.minimum(rows, taken.shape[0] - 1), :, run].transpose(0, 2, 1)
        latents = _latents(truth, plant, full, samples[n])
        future = [y]
        for i in range(int(span.max())):
            latents = {k: e.advance(latents[k], h, _Still()) for k, e in enumerate(plant.effects)}
            t = (samples[n] + i) * h - LEAD
            steady = plant.steady_thrust(delayed(held, lead + i, plant.delay, h), truth.voltage)
            y = plant.step(y, t, h, steady, latents)
            future.append(y)
        history = np.concatenate([past[:, :13], np.stack(future)[:, :13]])
        shown = instruments_show(history, (span + lead).astype(float), h, plant)
        X.append(np.moveaxis(np.concatenate([shown.q, shown.p]), 0, 1))
        V.append(np.moveaxis(np.concatenate([shown.v, shown.w]), 0, 1))
    return Prediction(tuple(starts), np.stack(X), np.stack(V))


def _start(
    truth: Truth, plant: Plant, full: Plant, at: np.ndarray, n: int, exact: bool, h: float
) -> np.ndarray:
    """State that a model with the plant's effects takes from the record at sample n.

    The true state, off by what the hidden instruments do to it less what the model's do (for the
    true model nothing, for the belief the record itself), and by the instruments' noise; and the
    own states that effects have.
    """
    true = truth.states[at, :, np.arange(at.size)].T
    y = np.zeros((plant.size, at.size))
    y[:13] = true[:13]
    if plant.lagged and full.lagged:
        y[13:21] = true[13:21]
    for i, effect in enumerate(plant.effects):
        if effect in full.effects:
            y[plant.own[i]] = true[full.own[full.effects.index(effect)]]
    shown = [instruments_show(truth.states, at[None].astype(float), h, m) for m in (full, plant)]
    hidden, own = (np.concatenate([s.p, s.v, s.w])[:, 0] for s in shown)
    turned = [logarithm(product(conjugate(true[3:7]), s.q[:, 0])) for s in shown]
    off = hidden - own
    noise = np.zeros_like(truth.errors[n]) if exact else truth.errors[n]
    y[:3] += off[:3] + noise[:3]
    y[3:7] = product(y[3:7], exponential(turned[0] - turned[1] + noise[3:6]))
    y[7:13] += off[3:] + noise[6:]
    return y


def _latents(truth: Truth, plant: Plant, full: Plant, at: np.ndarray) -> dict[int, Latent]:
    out: dict[int, Latent] = {}
    for i, effect in enumerate(plant.effects):
        k = full.effects.index(effect) if effect in full.effects else None
        names = () if k is None else truth.latents[0][k]
        out[i] = {
            name: np.stack([truth.latents[a][k][name][..., b] for b, a in enumerate(at)], axis=-1)
            for name in names
        }
    return out


def errors(a: Prediction, b: Prediction) -> dict[str, np.ndarray]:
    """Mean square over runs of the difference of two predictions, (starts, steps + 1), by part."""
    return _compare(a.X, a.V, b.X, b.V)


def recorded_errors(prediction: Prediction, truth: Truth) -> dict[str, np.ndarray]:
    """The same against what was recorded, noise included."""
    steps = prediction.X.shape[1]
    X = np.stack([truth.X[n : n + steps] for n in prediction.starts])
    V = np.stack([truth.V[n : n + steps] for n in prediction.starts])
    return _compare(prediction.X, prediction.V, X, V)


def _compare(X: np.ndarray, V: np.ndarray, X2: np.ndarray, V2: np.ndarray) -> dict[str, np.ndarray]:
    q, q2 = np.moveaxis(X[:, :, :4], 2, 0), np.moveaxis(X2[:, :, :4], 2, 0)
    turn = np.moveaxis(logarithm(product(conjugate(q), q2)), 0, 2)
    gaps = (
        X[:, :, 4:] - X2[:, :, 4:],
        turn,
        V[:, :, :3] - V2[:, :, :3],
        V[:, :, 3:] - V2[:, :, 3:],
    )
    return {
        part: np.mean(np.sum(gap**2, axis=2), axis=-1)
        for part, gap in zip(PARTS, gaps, strict=True)
    }


def share(
    base: Prediction, extended: Prediction, oracle: Prediction, truth: Truth
) -> dict[str, dict[str, float]]:
    """Part of the oracle's gain over the base that the extended model reaches, by part of state.

    `excess` compares mean predictions with the oracle's, 1 − |ext − oracle|²/|base − oracle|², free
    of the noise floor; `recorded` is (base − ext)/(base − oracle) of mean squares against the data.
    Over all starts and steps but the first.
    """
    out = {}
    off = [errors(m, oracle) for m in (base, extended)]
    data = [recorded_errors(m, truth) for m in (base, extended, oracle)]
    for part in PARTS:
        b, e = (float(d[part][:, 1:].mean()) for d in off)
        rb, re, ro = (float(d[part][:, 1:].mean()) for d in data)
        out[part] = {
            "excess": 1 - e / b if b > 0 else 1.0,
            "recorded": (rb - re) / (rb - ro) if rb != ro else 1.0,
        }
    return out


def noise_free(case: Case, seed: int) -> Truth:
    """Whole runs under the hidden effects without any noise, from the start states of `seed`."""
    return simulate(
        build(case.plan, seed).setup, case.effects, Noise.none(), [seed, 1], case.true_vehicle()
    )


def replicates(case: Case, seed: int, number: int) -> list[Truth]:
    """The runs of `seed` again and again: same starts and commands, other noise.

    Their mean is what a perfect model of the law predicts over whole runs.
    """
    setup = build(case.plan, seed).setup
    given = (setup, case.effects, case.noise)
    return [simulate(*given, [seed, 2, k], case.true_vehicle()) for k in range(number)]


def windows_of(case: Case, seed: int, count: int, steps: int) -> list[int]:
    """Some starts of windows, the same for the same seed, after the commands have begun."""
    last = round(case.plan.seconds * case.plan.rate) - steps
    first = min(round(0.5 * case.plan.rate), last)
    chosen = streams(seed, 7).choice(
        np.arange(first, last + 1), min(count, last - first + 1), False
    )
    return sorted(int(n) for n in chosen)
