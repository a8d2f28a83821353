"""Laws of what is left: heavy tails, dependence on speed, memory, level.

Whitened innovations are unit Gaussians if the disturbance is white, Gaussian and of constant
intensity. Each law below is one or two numbers that change their density; gains are in nats, with
the numbers fitted on the other scenarios.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ...models.effects.base import AXES


@dataclass(frozen=True)
class Law:
    """A finding about the disturbance on one axis, with parameters as the effect of that name."""

    name: str
    where: str
    parameters: dict[str, float]
    heldout: Float[np.ndarray, " R"]

    @property
    def heldout_gain(self) -> float:
        """Nats won on scenarios left out."""
        return float(self.heldout.sum())


def _folds(fold: np.ndarray) -> list[np.ndarray]:
    labels = np.unique(fold)
    if len(labels) == 1:
        return [np.ones(len(fold), bool)]
    return [fold == label for label in labels]


def _held_out(losses: np.ndarray, fold: np.ndarray) -> tuple[np.ndarray, int]:
    """Losses (choices, R) with each fold judged at the best choice of the others; best of all."""
    found = np.zeros(losses.shape[1])
    for here in _folds(fold):
        rest = losses[:, ~here] if not here.all() else losses
        found[here] = losses[int(np.argmin(rest.sum(axis=1)))][here]
    return found, int(np.argmin(losses.sum(axis=1)))


def impacts(
    z: Float[np.ndarray, "N R"], weight: Float[np.ndarray, "N R"], fold: Int[np.ndarray, " R"]
) -> tuple[np.ndarray, dict[str, float]]:
    """Gain of a mixture (1 - p) N(0, s²) + p N(0, (k s)²) over N(0, σ²)."""
    sigma = np.sqrt((z**2 * weight).sum() / weight.sum())
    # a histogram for each run: the density is smooth on its bins
    edges = sigma * np.concatenate([np.arange(0, 6, 0.05), np.geomspace(6, 1e3, 80)])
    bins = np.searchsorted(edges, np.minimum(np.abs(z), 999 * sigma), side="right") - 1
    counts = np.zeros((len(edges), z.shape[1]))
    np.add.at(counts, (bins, np.broadcast_to(np.arange(z.shape[1]), bins.shape)), weight)
    x = np.append((edges[1:] + edges[:-1]) / 2, edges[-1])
    plain = ((x / sigma) ** 2 / 2 + np.log(sigma)) @ counts
    choices, losses = [], []
    for p in (0.002, 0.005, 0.01, 0.02, 0.05, 0.1):
        for k in (2.0, 3.0, 5.0, 8.0, 15.0, 30.0):
            for s in (0.6 * sigma, 0.8 * sigma, 0.9 * sigma, 0.96 * sigma):
                a = np.log1p(-p) - np.log(s) - (x / s) ** 2 / 2
                b = np.log(p) - np.log(k * s) - (x / (k * s)) ** 2 / 2
                losses.append(-np.logaddexp(a, b) @ counts)
                choices.append({"share": p, "size": k * s})
    losses = np.array(losses)
    held, best = _held_out(losses, fold)
    return plain - held, choices[best]


def speed_dependence(
    z: Float[np.ndarray, "N R"],
    speed: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
    fold: Int[np.ndarray, " R"],
) -> tuple[np.ndarray, dict[str, float]]:
    """Gain of the variance s² (1 + k |v|²) over a constant one."""
    growth = np.concatenate([[0.0], np.geomspace(0.05, 200.0, 40)])
    losses = []
    for k in growth:
        shape = 1 + k * speed**2
        s2 = (z**2 / shape * weight).sum() / weight.sum()
        losses.append(((z**2 / (s2 * shape) + np.log(s2 * shape)) / 2 * weight).sum(axis=0))
    losses = np.array(losses)
    held, best = _held_out(losses, fold)
    return losses[0] - held, {"growth": float(growth[best])}


def colour(
    z: Float[np.ndarray, "N R"], weight: Float[np.ndarray, "N R"], fold: Int[np.ndarray, " R"],
    dt: float,
) -> tuple[np.ndarray, dict[str, float]]:  # fmt: skip
    """Gain of predicting z from a slow part m' = ρ m + κ (z - m) (an ARMA(1, 1) of slow waves)."""
    plain = (z**2 * weight / 2).sum(axis=0)
    choices, losses = [{"time_constant": 0.0, "share": 0.0}], [plain]
    for tau in (0.3, 0.6, 1.2, 2.5, 5.0, 10.0, 20.0):
        rho = np.exp(-dt / tau)
        for kappa in (0.004, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3):
            m, loss = np.zeros(z.shape[1]), np.zeros(z.shape[1])
            total = np.zeros(z.shape[1])
            for n in range(len(z)):
                e = z[n] - m
                loss += e**2 * weight[n] / 2
                total += m * m * weight[n]
                m = rho * (m + kappa * e)
            losses.append(loss)
            choices.append({"time_constant": tau, "share": float(total.sum() / weight.sum())})
    losses = np.array(losses)
    held, best = _held_out(losses, fold)
    return plain - held, choices[best]


def run_constants(
    products: Float[np.ndarray, "R m m"], columns: list[int], sizes: np.ndarray, fold: np.ndarray
) -> tuple[np.ndarray, dict[str, float]]:
    """Gain of effects whose size is drawn anew for each run: z ~ N(0, I + σ² J Jᵀ).

    By the matrix determinant lemma the likelihood of a run needs J'J and J'z alone. σ is the
    standard deviation of each parameter, tried at 1/8 to 64 times `sizes`. Returned by run.
    """
    H = products[:, columns][:, :, columns]
    g = products[:, columns, 0]
    H, g = H * sizes[:, None] * sizes, g * sizes
    factors = np.concatenate([[0.0], np.geomspace(0.125, 64, 28)])
    losses = [np.zeros(len(H))]
    eye = np.eye(len(columns))
    for s in factors[1:]:
        inner = eye + s**2 * H
        inside = np.linalg.solve(inner, (s**2 * g)[..., None])[..., 0]
        losses.append(np.linalg.slogdet(inner)[1] / 2 - np.sum(g * inside, axis=1) / 2)
    table = np.array(losses)
    held, best = _held_out(table, fold)
    return -held, {"std": float(factors[best] * sizes[0])}


def find_laws(
    z: Float[np.ndarray, "N 12 R"],
    speed: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
    fold: Int[np.ndarray, " R"],
    dt: float,
) -> list[Law]:
    """All laws on all axes, largest gain first."""
    found = []
    for i, axis in enumerate(AXES):
        own = z[:, 6 + i]
        gain, values = impacts(own, weight, fold)
        found.append(Law("disturbance_impacts", axis, values, gain))
        gain, values = speed_dependence(own, speed, weight, fold)
        found.append(Law("disturbance_state_dependence", axis, values, gain))
        gain, values = colour(own, weight, fold, dt)
        found.append(Law("disturbance_colour", axis, values, gain))
    return sorted(found, key=lambda law: -law.heldout_gain)
