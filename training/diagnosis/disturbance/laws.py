"""Disturbance laws of whitened innovations: heavy tails, growth with speed, colour, run constants.

Whitened innovations are unit Gaussians if the disturbance is white, Gaussian and of constant
intensity. Each law below changes their density by a few parameters; gains are in nats, with the
parameters fitted to the other scenarios.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from jaxtyping import Float, Int

from ....models.effects.noise import (
    DisturbanceColour,
    DisturbanceImpacts,
    DisturbanceStateDependence,
)
from ....models.se3 import AXES


@dataclass(frozen=True)
class Law:
    """A law of the disturbance on one axis, with the parameters of the effect of that name."""

    name: str
    where: str
    parameters: dict[str, float]
    heldout: Float[np.ndarray, " R"]
    loss: Callable[[np.ndarray], np.ndarray] | None = None
    """Nats lost by each piece at the logarithms of the parameters, in their order."""
    errors: dict[str, float] | None = None
    """Standard errors of the parameters where they were estimated without a loss."""

    @property
    def heldout_gain(self) -> float:
        """Nats won on scenarios left out."""
        return float(self.heldout.sum())


LawFit = tuple[np.ndarray, dict[str, float], Callable[[np.ndarray], np.ndarray]]
"""Held-out gain by piece, the best parameters, and the loss as a function of their logarithms."""
_GROWTHS = np.geomspace(0.05, 1000.0, 48)
_EVENNESS, _ALIKE = (0.3, 0.1, 0.03), 4.0
"""Evenness (w² / size²) of impacts of about one size; nats that this must win."""
_KAPPAS = (0.004, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3)


def _folds(fold: np.ndarray) -> list[np.ndarray]:
    labels = np.unique(fold)
    if len(labels) == 1:
        return [np.ones(len(fold), bool)]
    return [fold == label for label in labels]


def _held_out(losses: np.ndarray, fold: np.ndarray) -> tuple[np.ndarray, int]:
    """Losses of pieces, each fold at the best choice of the others; index of the best of all."""
    found = np.zeros(losses.shape[1])
    for here in _folds(fold):
        rest = losses[:, ~here] if not here.all() else losses
        found[here] = losses[int(np.argmin(rest.sum(axis=1)))][here]
    return found, int(np.argmin(losses.sum(axis=1)))


def impacts(
    z: Float[np.ndarray, "N R"], weight: Float[np.ndarray, "N R"], fold: Int[np.ndarray, " R"]
) -> LawFit:
    """Gain of a mixture of N(0, s²) with share 1 - p and impacts with share p over N(0, σ²).

    Impacts have Gaussian sizes, w = `size`, or where that clearly wins more, about one size, ±μ
    with a spread w: μ² + w² = size², w² / size² the `evenness`.
    """
    sigma = np.sqrt((z**2 * weight).sum() / weight.sum())
    # a histogram for each run: the density is smooth on its bins
    edges = sigma * np.concatenate([np.arange(0, 6, 0.05), np.geomspace(6, 1e3, 80)])
    bins = np.searchsorted(edges, np.minimum(np.abs(z), 999 * sigma), side="right") - 1
    counts = np.zeros((len(edges), z.shape[1]))
    np.add.at(counts, (bins, np.broadcast_to(np.arange(z.shape[1]), bins.shape)), weight)
    x = np.append((edges[1:] + edges[:-1]) / 2, edges[-1])
    plain = ((x / sigma) ** 2 / 2 + np.log(sigma)) @ counts

    def loss(logs: np.ndarray) -> np.ndarray:
        p, size, s, *of = np.exp(logs)
        p, even = min(p, 0.9), min(of[0], 1.0) if of else 1.0
        mu, w = size * np.sqrt(1 - even), size * np.sqrt(even)
        a = np.log1p(-p) - np.log(s) - (x / s) ** 2 / 2
        both = np.logaddexp(-(((x - mu) / w) ** 2) / 2, -(((x + mu) / w) ** 2) / 2) - np.log(2)
        return -np.logaddexp(a, np.log(p) - np.log(w) + both) @ counts

    shares, sizes = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1), (2.0, 3.0, 5.0, 8.0, 15.0, 30.0)
    rests = (0.6 * sigma, 0.8 * sigma, 0.9 * sigma, 0.96 * sigma)
    gaussian = [
        {"share": p, "size": k * s, "rest": s}
        for p, k, s in itertools.product(shares, sizes, rests)
    ]
    alike = [{**choice, "evenness": e} for choice in gaussian for e in _EVENNESS]

    def held_out(choices: list[dict[str, float]]) -> tuple[np.ndarray, dict[str, float]]:
        losses = np.array([loss(np.log(list(choice.values()))) for choice in choices])
        held, best = _held_out(losses, fold)
        return plain - held, choices[best]

    gain, values = held_out(gaussian)
    of_one_size, also = held_out(alike)
    if of_one_size.sum() > gain.sum() + _ALIKE:
        gain, values = of_one_size, also
    return gain, values, loss


def speed_dependence(
    z: Float[np.ndarray, "N R"],
    speed: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
    fold: Int[np.ndarray, " R"],
    share: float = 1.0,
) -> LawFit:
    """Gain of a process with the variance q (1 + k |v|²) over a constant one.

    `share` of the variance of z is process noise, the rest measurement noise.
    """
    growth = np.concatenate([[0.0], _GROWTHS])

    def at(k: float) -> np.ndarray:
        grown = 1 + k * speed**2
        shape = 1 - share + share * grown * weight.sum() / (grown * weight).sum()
        s2 = (z**2 / shape * weight).sum() / weight.sum()
        return ((z**2 / (s2 * shape) + np.log(s2 * shape)) / 2 * weight).sum(axis=0)

    losses = np.array([at(k) for k in growth])
    held, best = _held_out(losses, fold)
    return losses[0] - held, {"growth": float(growth[best])}, lambda logs: at(np.exp(logs[0]))


def growth_alone(
    z: Float[np.ndarray, "N R"],
    speed: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
    rest: float,
    share: float = 1.0,
) -> float:
    """Nats by which a variance that grows with the speed, from rest² times, beats any constant one.

    As 1 + k |v|² or as (1 + k |v|)², whichever is better; `share` as in `speed_dependence`.
    """

    def loss(s2: np.ndarray) -> float:
        return float(((z**2 / s2 + np.log(s2)) / 2 * weight).sum())

    alone = loss(np.full_like(z, (z**2 * weight).sum() / weight.sum()))
    shapes = [1 + k * speed**2 for k in _GROWTHS] + [(1 + k * speed) ** 2 for k in _GROWTHS]
    return alone - min(loss(1 - share + share * rest**2 * shape) for shape in shapes)


def colour(
    z: Float[np.ndarray, "N R"], weight: Float[np.ndarray, "N R"], fold: Int[np.ndarray, " R"],
    dt: float,
) -> LawFit:  # fmt: skip
    """Gain of predicting z by a slow part m' = ρ (m + κ (z - m)) (an ARMA(1, 1) process)."""
    plain = (z**2 * weight / 2).sum(axis=0)

    def at(rho: np.ndarray, kappa: np.ndarray) -> np.ndarray:
        """Losses (k, R) for each of k pairs."""
        m, loss = np.zeros((len(rho), z.shape[1])), np.zeros((len(rho), z.shape[1]))
        for n in range(len(z)):
            e = z[n] - m
            loss += e**2 * weight[n] / 2
            m = rho[:, None] * (m + kappa[:, None] * e)
        return loss

    times, gains = np.meshgrid((0.3, 0.6, 1.2, 2.5, 5.0, 10.0, 20.0), _KAPPAS)
    rho = np.exp(-dt / times.ravel())
    losses = np.concatenate([plain[None], at(rho, gains.ravel())])
    held, best = _held_out(losses, fold)
    values = {"time_constant": 0.0, "kappa": 0.0}
    if best > 0:
        pair = times.ravel()[best - 1], gains.ravel()[best - 1]
        values = dict(zip(values, map(float, pair), strict=True))

    def loss(logs: np.ndarray) -> np.ndarray:
        tau, kappa = np.exp(logs)
        return at(np.array([np.exp(-dt / tau)]), np.array([min(kappa, 0.99)]))[0]

    return plain - held, values, loss


def run_constants(
    products: Float[np.ndarray, "R m m"], columns: list[int], sizes: np.ndarray, fold: np.ndarray
) -> LawFit:
    """Gain of effects whose size is drawn anew for each run: z ~ N(0, I + σ² J Jᵀ).

    By the matrix determinant lemma the likelihood of a run needs J'J and J'z alone. σ is the
    standard deviation of each parameter, tried at 1/8 to 64 times `sizes`. Returned by run.
    """
    H = products[:, columns][:, :, columns]
    g = products[:, columns, 0]
    H, g = H * sizes[:, None] * sizes, g * sizes
    factors = np.concatenate([[0.0], np.geomspace(0.125, 64, 28)])
    eye = np.eye(len(columns))

    def at(s: float) -> np.ndarray:
        inner = eye + s**2 * H
        inside = np.linalg.solve(inner, (s**2 * g)[..., None])[..., 0]
        return np.linalg.slogdet(inner)[1] / 2 - np.sum(g * inside, axis=1) / 2

    held, best = _held_out(np.array([at(s) for s in factors]), fold)
    values = {"std": float(factors[best] * sizes[0])}
    return -held, values, lambda logs: at(float(np.exp(logs[0])) / sizes[0])


def find_laws(
    z: Float[np.ndarray, "N 12 R"],
    speed: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
    fold: Int[np.ndarray, " R"],
    dt: float,
    share: Float[np.ndarray, "6"],
    known: Float[np.ndarray, "N 12 R"] | None = None,
) -> list[Law]:
    """All laws on all axes, largest gain first; `share` as in `speed_dependence`, by axis.

    Innovations with lost velocities in them have no weight (`known`, `Data.known`).
    """
    found = []
    for i, axis in enumerate(AXES):
        own, w = z[:, 6 + i], weight
        if known is not None:
            w = weight * known[:, 6 + i]
            if not w.any():
                continue
        for name, fitted in (
            (DisturbanceImpacts.name, impacts(own, w, fold)),
            (DisturbanceStateDependence.name, speed_dependence(own, speed, w, fold, share[i])),
            (DisturbanceColour.name, colour(own, w, fold, dt)),
        ):
            gain, values, loss = fitted
            found.append(Law(name, axis, values, gain, loss))
    return sorted(found, key=lambda law: -law.heldout_gain)


def estimated(
    law: Law, cluster: Int[np.ndarray, " R"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Logarithms of a law's parameters where the likelihood is largest, and their covariance.

    The covariance is the sandwich H⁻¹ Σ g gᵀ H⁻¹ over clusters (Huber 1967; White 1982), with
    derivatives by central differences.
    """
    assert law.loss is not None
    loss, x0 = law.loss, np.log(np.maximum(list(law.parameters.values()), 1e-6))
    labels, index = np.unique(cluster, return_inverse=True)

    def total(x: np.ndarray) -> float:
        return float(loss(x).sum())

    def near(x: np.ndarray) -> float:
        return total(x) if np.all(np.abs(x - x0) < 4) else np.inf

    found = scipy.optimize.minimize(
        near, x0, method="Nelder-Mead", options={"maxfev": 120, "xatol": 1e-3, "fatol": 1e-2}
    ).x
    k, h = len(found), 0.02
    steps = h * np.eye(k)
    by_piece = np.array([(loss(found + d) - loss(found - d)) / (2 * h) for d in steps])
    g = np.zeros((len(labels), k))
    np.add.at(g, index, by_piece.T)
    H = np.array(
        [
            [
                total(found + a + b) - total(found + a - b) - total(found - a + b)
                + total(found - a - b)
                for b in steps
            ]
            for a in steps
        ]
    ) / (4 * h * h)  # fmt: skip
    if not np.isfinite(H).all() or np.any(np.diag(H) <= 0):
        return found, np.full((k, k), np.nan)  # at the boundary of the range
    inverse = np.linalg.pinv(H + 1e-9 * np.eye(k))
    n = len(labels)
    return found, inverse @ (g.T @ g) @ inverse * n / max(n - 1, 1)
