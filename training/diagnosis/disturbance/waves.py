"""Fits of waves and of varying currents; correlated noise of these or of slow disturbances."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ....models.effects.noise import DisturbanceColour
from ....models.effects.water import CurrentVarying, Waves
from ....models.se3 import AXES
from ..candidates.structures import Screen
from ..filter.gram import gram
from ..filter.problem import DiagnosisProblem, Evaluation
from ..selection.correlated_noise import CorrelatedNoise
from .laws import Law, LawFit, estimated, run_constants

_OMEGAS = np.arange(0.6, 5.3, 0.2)
"""Frequencies that are tried (rad/s); runs of ten seconds resolve 0.6 rad/s."""
_WAYS = 12
"""Directions that are tried; a quarter of them with every frequency."""
_FIRST = 0.05
"""Reference speed (m/s): 1/8 to 64 times as much is tried."""
_PARTS = np.array([0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 1.9])
"""Frequencies of a sea, as multiples of the peak frequency."""
_ABOUT = (0.85, 0.95, 1.0, 1.05)
"""Peak frequencies of a sea that are tried, as multiples of the best single frequency."""
_FINER = (-0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.15)
_GRAVITY = 9.80665
_LEAST = 5.0
"""Nats that a slow disturbance on an axis must win to be taken into account."""
_TIMES = 2.0
"""Multiple of the gain of slow forces that waves must win."""
_BENDS = 4
"""Cosine terms of a current over a piece, besides a constant."""
_WANDER = np.array([0.3, 0.6, 1.0, 2.0, 4.0, 10.0, 100.0])
"""Time constants of a current that are tried, in lengths of a piece."""
_ROUNDS = 4
"""Iterations for the most likely current of a piece."""
_LONG = 10.0
"""Lengths of a piece: a longer time constant is only known to exceed a piece."""


def correlated_noise_of(
    problem: DiagnosisProblem, evaluation: Evaluation, laws: Sequence[Law]
) -> CorrelatedNoise:
    """The correlated noise that wins most: slow disturbances by axis, a current, or swell."""
    slow = [law for law in laws if law.name == DisturbanceColour.name and law.heldout_gain > _LEAST]
    pushes = sum(law.heldout_gain for law in slow)
    stays = max((law.heldout_gain for law in laws if law.name == CurrentVarying.name), default=0.0)
    wanders = find_current(problem, evaluation)
    if max(stays, wanders.heldout_gain) > pushes:
        whole = Screen(problem, evaluation, None, whole=True)
        v = _flow(problem, whole.kept)
        length = float(np.median(problem.data.times[-1, whole.kept]))
        return _drawn(
            whole, v, np.zeros_like(v), _bends(wanders.parameters["time_constant"] / length)
        )
    if slow:
        swell, waves = _found(problem, evaluation)
        if are_waves(waves, slow):
            whole = Screen(problem, evaluation, None, whole=True)
            return _drawn(whole, *swell.water(problem, whole.kept), swell.spread)
    numbers = {}
    for law in slow:
        tau, kappa = np.exp(estimated(law, problem.data.cluster)[0])
        rho = np.exp(-problem.data.dt / tau)
        numbers[AXES.index(law.where)] = float(rho), float(min(kappa, 0.99))
    return CorrelatedNoise.from_slow(evaluation.z.astype(float), numbers)


def are_waves(waves: Law, slow: Sequence[Law]) -> bool:
    """Whether waves explain more than slow disturbances by axis do.

    They act on all axes with four parameters, and explain half of a Gauss–Markov force at most.
    """
    forces, all_axes = (
        sum(max(law.heldout_gain, 0.0) for law in slow if law.where in axes)
        for axes in (AXES[:3], AXES)
    )
    return waves.heldout_gain > max(_TIMES * forces, all_axes)


def _drawn(screen: Screen, v: np.ndarray, a: np.ndarray, spread: np.ndarray) -> CorrelatedNoise:
    """Water motion drawn anew for each piece; `spread` has its terms' relative deviations."""
    J = _sensitivities(screen, v, a)
    G = _products(screen.z[0], J)
    std = run_constants(G, list(range(1, len(J) + 1)), spread, screen.fold)[1]["std"] / spread[0]
    return CorrelatedNoise(amplitudes=J, precision=1 / (max(std, 1e-9) * spread) ** 2)


def _sensitivities(screen: Screen, v: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "k N12 R"]:
    """Whitened sensitivities to velocities and accelerations of the water in W (N, 3, k, R)."""
    by_v, by_a = screen.water
    return screen.whitened(
        np.einsum("nijr,njkr->nikr", by_v, v) + np.einsum("nijr,njkr->nikr", by_a, a)
    )


def _linearised(
    screen: Screen, v: np.ndarray, a: np.ndarray, likely: Float[np.ndarray, "R k"]
) -> tuple[Float[np.ndarray, "N12 R"], Float[np.ndarray, "k N12 R"]]:
    """Innovations in still water and sensitivities, linearised at a likely motion of the water."""
    push, slope = screen.in_current(np.einsum("nikr,rk->nir", v, likely))
    by_a = np.einsum("nijr,njkr->nikr", screen.water[1], a)
    J = screen.whitened(np.einsum("nijr,njkr->nikr", slope, v) + by_a)
    push = push + np.einsum("nikr,rk->nir", by_a, likely)
    there = screen.z[0] + screen.whitened(push[:, :, None])[0]
    return there - np.einsum("kar,rk->ar", J, likely), J


def _refined(
    screen: Screen,
    v: np.ndarray,
    a: np.ndarray,
    fit: Callable[[np.ndarray], tuple[LawFit, Float[np.ndarray, " k"]]],
) -> tuple[Float[np.ndarray, "R m m"], LawFit]:
    """Products and fit, relinearised at the most likely motion of each piece (Laplace's method).

    `fit` maps products to its result and to the standard deviations that it finds.
    """
    still = _squares(screen.z[0])

    def linearised(likely: np.ndarray) -> tuple[np.ndarray, LawFit, np.ndarray]:
        z, J = _linearised(screen, v, a, likely)
        G = _products(z, J)
        (gain, values, loss), spread = fit(G)
        fitted = gain + (still - _squares(z)) / 2, values, loss
        return G, fitted, _most_likely(G, spread)

    G, fitted, likely = linearised(np.zeros((v.shape[3], v.shape[2])))
    for _ in range(_ROUNDS - 1):
        G, fitted, likely = linearised(likely)
    return G, fitted


def _squares(z: np.ndarray) -> Float[np.ndarray, " R"]:
    return (z.astype(np.float64) ** 2).sum(axis=0)


def _most_likely(G: Float[np.ndarray, "R m m"], spread: np.ndarray) -> Float[np.ndarray, "R k"]:
    """Most likely coefficients of each piece with prior standard deviations `spread`."""
    prior = np.diag(1 / np.maximum(spread, 1e-6) ** 2)
    return -np.linalg.solve(G[:, 1:, 1:] + prior, G[:, 1:, :1])[..., 0]


def _products(z: np.ndarray, J: np.ndarray) -> Float[np.ndarray, "R m m"]:
    return gram(np.concatenate([z[None], J]).astype(np.float64))


def _times(problem: DiagnosisProblem, kept: np.ndarray) -> Float[np.ndarray, "N R"]:
    """Mid-step times since the start of each piece (s)."""
    return (problem.data.times[:-1] + problem.data.step / 2)[:, kept]


def _flow(problem: DiagnosisProblem, kept: np.ndarray) -> Float[np.ndarray, "N 3 k R"]:
    """East and north flow of 1 m/s: a constant and `_BENDS` cosines of time each."""
    t = _times(problem, kept) / np.maximum(problem.data.times[-1, kept], 1e-9)
    found = np.zeros((len(t), 3, 2 * (_BENDS + 1), len(kept)))
    for k in range(_BENDS + 1):
        for way in range(2):
            found[:, way, 2 * k + way] = np.cos(np.pi * k * t) * (np.sqrt(2) if k else 1)
    return found


def find_current(problem: DiagnosisProblem, evaluation: Evaluation) -> Law:
    """A horizontal current that varies within runs: Gauss–Markov in W, drawn anew for each piece.

    Its Karhunen–Loève series is truncated after `_BENDS` cosines. Drag is nonlinear in the current,
    so sensitivities are taken at the most likely current of each piece, iteratively (Laplace's
    method). The time constant with the largest gain is taken; one of ten pieces and more is only
    known to be longer than a piece.
    """
    screen = Screen(problem, evaluation, None)
    v = _flow(problem, screen.kept)
    length = float(np.median(problem.data.times[-1, screen.kept]))
    columns = list(range(1, v.shape[2] + 1))

    def fit(G: np.ndarray) -> tuple[LawFit, np.ndarray]:
        tried = [run_constants(G, columns, _bends(tau), screen.fold) for tau in _WANDER]
        best = int(np.argmax([fitted[0].sum() for fitted in tried]))
        gain, values, loss = tried[best]
        bends = _bends(_WANDER[best])
        std = values["std"] / bends[0]
        numbers = {"std": float(std), "time_constant": float(length * _WANDER[best])}
        return (gain, numbers, loss), std * bends

    G, (heldout, numbers, _) = _refined(screen, v, np.zeros_like(v), fit)

    def lost(logs: np.ndarray) -> np.ndarray:
        """Nats by piece at the logarithms of standard deviation and time constant."""
        spread = _bends(float(np.exp(logs[1])) / length)
        return run_constants(G, columns, spread, screen.fold)[2](logs[:1] + np.log(spread[0]))

    share = problem.data.steps / problem.data.weight[:, screen.kept].sum()
    law = Law(CurrentVarying.name, "W", numbers, heldout * share, loss=lost)
    logs, covariance = estimated(law, np.arange(len(screen.kept)))
    numbers = dict(zip(numbers, np.exp(logs).tolist(), strict=True))
    unsure = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    errors = {
        name: value * float(e) for (name, value), e in zip(numbers.items(), unsure, strict=True)
    }
    if numbers["time_constant"] > _LONG * length:
        numbers["time_constant"], errors["time_constant"] = length, float("nan")
    return replace(law, parameters=numbers, loss=None, errors=errors)


def _bends(tau: float) -> np.ndarray:
    """Standard deviations of the flow's terms, for a time constant of `tau` lengths of a piece."""
    t = (np.arange(64) + 0.5) / 64
    C = np.exp(-np.abs(t[:, None] - t) / tau)
    phi = np.stack([np.cos(np.pi * k * t) * (np.sqrt(2) if k else 1) for k in range(_BENDS + 1)])
    return np.repeat(np.sqrt(np.diag(phi @ C @ phi.T)) / 64, 2)


@dataclass(frozen=True)
class Swell:
    """Waves towards ψ (rad), for each piece and frequency two amplitudes (four if `flat`).

    Water moves along ψ with cos θ and up with sin θ, θ = k (x cos ψ + y sin ψ) - ω t, and a quarter
    of a period later, fading with exp(k z), ω² = g k (Airy; Faltinsen 1990, table 2.1, deep water).

    Attributes:
        frequency: peak frequency ω (rad/s).
        direction: ψ.
        sea: whether it has the spectrum of a wind sea, and not a single frequency.
        flat: whether horizontal and vertical motion have independent amplitudes and phases, as in
            shallow water or under waves from several directions; ψ may then be opposite.
    """

    frequency: float
    direction: float
    sea: bool = False
    flat: bool = False

    @property
    def spread(self) -> Float[np.ndarray, " k"]:
        """Reference standard deviations of the amplitudes, together `_FIRST`."""
        share = np.sqrt(_sea() / _sea().sum()) if self.sea else np.ones(1)
        return _FIRST * np.repeat(share, 4 if self.flat else 2)

    def water(
        self, problem: DiagnosisProblem, kept: np.ndarray
    ) -> tuple[Float[np.ndarray, "N 3 k R"], Float[np.ndarray, "N 3 k R"]]:
        """Velocities for amplitudes of 1 m/s at the surface, and accelerations, in W."""
        X, t = problem.data.X[:-1][..., kept], _times(problem, kept)
        way = np.array([np.cos(self.direction), np.sin(self.direction), 0.0])
        ahead = way[0] * X[:, 4] + way[1] * X[:, 5]
        along, up = way[:, None], np.array([[0.0], [0.0], [1.0]])
        v, a = [], []
        for omega in self.frequency * (_PARTS if self.sea else np.ones(1)):
            k = omega**2 / _GRAVITY
            fade = np.exp(k * np.minimum(X[:, 6], 0.0))
            c, s = (fade * f(k * ahead - omega * t) for f in (np.cos, np.sin))
            c, s = c[:, None], s[:, None]
            pairs = [(c * along + s * up, s * along - c * up)]
            if self.flat:
                pairs = [(c * d, s * d) for d in (along, up)]
            for first, second in pairs:  # a quarter of a period apart
                v += [first, second]
                a += [omega * second, -omega * first]
        return np.stack(v, axis=2), np.stack(a, axis=2)


def _sea() -> Float[np.ndarray, " k"]:
    """Energy of the motion at the surface at `_PARTS` times a wind sea's peak frequency.

    ω² times the spectrum of Hasselmann et al. (1973) with γ = 3.3, times the spacing.
    """
    x = _PARTS
    peak = 3.3 ** np.exp(-(((x - 1) / np.where(x <= 1, 0.07, 0.09)) ** 2) / 2)
    return x**-3.0 * np.exp(-1.25 * x**-4.0) * peak * np.gradient(x)


def find_waves(problem: DiagnosisProblem, evaluation: Evaluation) -> Law:
    """Waves from one direction, of one frequency or a sea, amplitudes drawn anew for each piece."""
    return _found(problem, evaluation)[1]


def _found(problem: DiagnosisProblem, evaluation: Evaluation) -> tuple[Swell, Law]:
    """The waves with the largest gain, z ~ N(0, I + σ² J Jᵀ).

    Frequency and direction from a grid, then from finer ones; then a sea of about that frequency.
    """
    screen = Screen(problem, evaluation, None)

    def tried(swells: list[Swell]) -> list[LawFit]:
        """The result of each; all have the same number of frequencies."""
        water = [swell.water(problem, screen.kept) for swell in swells]
        J = _sensitivities(screen, *(np.concatenate(w, axis=2) for w in zip(*water, strict=True)))
        found, spread = [], swells[0].spread
        for own in np.split(J, len(swells)):
            G = _products(screen.z[0], own)
            columns = list(range(1, len(own) + 1))
            found.append(run_constants(G, columns, spread, screen.fold))
        return found

    def gains(swells: list[Swell]) -> np.ndarray:
        return np.array([fitted[0].sum() for fitted in tried(swells)])

    ways = np.arange(_WAYS) * 2 * np.pi / _WAYS
    few = [Swell(omega, way) for omega in _OMEGAS for way in ways[:: _WAYS // 4]]
    best = few[int(np.argmax(gains(few)))]
    won = gains([Swell(best.frequency, way) for way in ways])
    middle = int(np.argmax(won))
    near = won[[(middle + k) % _WAYS for k in (-1, 0, 1)]]
    apart = 2 * np.pi / _WAYS * np.array([-1.0, 0.0, 1.0])
    direction, unsure = _peak(ways[middle] + apart, near)
    finer = best.frequency + np.array(_FINER)
    omega, error = _peak(finer, gains([Swell(w, direction) for w in finer]))
    best = Swell(omega, direction)
    heldout, values, loss = tried([best])[0]
    for alike in _others(omega, direction):
        for other, fitted in zip(alike, tried(alike), strict=True):
            if fitted[0].sum() > heldout.sum():
                best, (heldout, values, loss) = other, fitted
    if best.sea:
        error = 0.05 * best.frequency
    v, a = best.water(problem, screen.kept)
    columns = list(range(1, v.shape[2] + 1))

    def fit(G: np.ndarray) -> tuple[LawFit, np.ndarray]:
        fitted = run_constants(G, columns, best.spread, screen.fold)
        return fitted, fitted[1]["std"] / best.spread[0] * best.spread

    heldout, values, loss = _refined(screen, v, a, fit)[1]
    speed, spread = _size(values["std"], loss, best.spread[0] / _FIRST)
    size = float(np.sqrt(2)) / best.frequency
    turned = float(np.angle(np.exp(1j * best.direction)))
    numbers = {"amplitude": size * speed, "frequency": best.frequency, "direction": turned}
    errors = {"amplitude": size * spread, "frequency": error, "direction": unsure}
    share = problem.data.steps / problem.data.weight[:, screen.kept].sum()
    return best, Law(Waves.name, "W", numbers, heldout * share, errors=errors)


def _others(omega: float, direction: float) -> list[list[Swell]]:
    """Further models near the best single frequency: flat waves, seas and flat seas.

    Flat slow swell has nearly the same effect from ahead and from astern.
    """
    both = (direction, direction + np.pi)
    return [
        [Swell(omega, way, flat=True) for way in both],
        [Swell(share * omega, direction, sea=True) for share in _ABOUT],
        [Swell(share * omega, way, True, True) for share in _ABOUT for way in both],
    ]


def _size(std: float, loss: Callable[[np.ndarray], np.ndarray], part: float) -> tuple[float, float]:
    """Most likely speed, of which the share `part` deviates by `std`, and its standard error."""
    logs = np.log(max(std, 1e-9)) + np.linspace(-0.4, 0.4, 9)
    top, error = _peak(logs, -np.array([loss(np.array([at])).sum() for at in logs]))
    speed = float(np.exp(top)) / part
    return speed, speed * float(error)


def _peak(at: np.ndarray, gains: np.ndarray) -> tuple[float, float]:
    """The maximum of a parabola through the gains, and its half-width half a nat below."""
    a, b, _ = np.polyfit(at - at.mean(), gains, 2)
    if a >= 0:
        return float(at[int(np.argmax(gains))]), float(np.ptp(at))
    reach = float(np.ptp(at)) / 2
    top = float(np.clip(-b / (2 * a), -reach, reach))
    return float(at.mean() + top), float(1 / np.sqrt(-2 * a))
