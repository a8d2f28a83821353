"""Laws that ask for more than the innovations alone: swell, and a level other than believed."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...models.effects.base import AXES
from ...models.effects.unknown import Unknown
from .data import Data
from .laws import Law, estimated, run_constants
from .looking import Bench, Look
from .noise import Noise, estimate, filtered, make_filter, mean_jacobian
from .search import laws_of
from .structures import Group, Screen

_OMEGAS = np.arange(0.6, 5.3, 0.2)
"""Frequencies that are tried (rad/s); runs of ten seconds tell 0.6 rad/s apart."""
_FINER = (-0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.15)
_SHORTEST, _SMALLEST = 3.0, 0.1
"""Steps that a colour must last, share by which a level must differ."""
_GRAVITY = 9.80665


def all_laws(bench: Bench, look: Look, least: float) -> list[Law]:
    """Laws of what is left, waves and level included, largest gain first."""
    found = laws_of(bench, look)
    coloured = {law.where: law.heldout_gain for law in found if law.name == "disturbance_colour"}
    if max(coloured.values()) > least:
        waves = find_waves(bench, look)
        # turning follows from swell in ways of its own: pushes decide
        if waves.heldout_gain > sum(max(coloured[axis], 0.0) for axis in AXES[:3]):
            found.append(waves)
    found += find_levels(bench, look)
    return sorted(found, key=lambda law: -law.heldout_gain)


def is_apart(law: Law, bench: Bench) -> bool:
    """Whether a law differs from what the noise levels alone can be in error."""
    if law.name == "disturbance_colour" and law.loss is not None:
        return float(np.exp(estimated(law, bench.data.cluster)[0][0])) > _SHORTEST * bench.data.dt
    if law.name == "disturbance_level":
        return abs(law.parameters["change"]) > _SMALLEST
    return True


# ------------------------------------------------------------------------------------- waves


def find_waves(bench: Bench, look: Look) -> Law:
    """Swell of one frequency, its phase and size drawn anew for each piece of a run.

    A force in W along each direction with cos ωt and sin ωt, six amplitudes a piece, of one
    variance: z ~ N(0, I + σ² J Jᵀ). ω from a grid, then a finer one. The pressure of accelerated
    water acts at the centre of buoyancy, the force of its added mass at Bo.
    """
    screen = Screen(bench, look, None)

    def tried(omegas: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        groups = [_swell(bench, omega) for omega in omegas]
        J = [screen.responses(group) for group in groups]
        z = screen.z[:1]
        found = []
        for own in J:
            columns = np.concatenate([z, own]).astype(np.float64)
            G = np.einsum("iar,jar->rij", columns, columns, optimize=True)
            found.append((G, run_constants(G, list(range(1, 7)), np.ones(6), screen.fold)[0]))
        return found

    first = tried(_OMEGAS)
    centre = _OMEGAS[int(np.argmax([gain.sum() for _, gain in first]))]
    omegas = np.array([centre + step for step in _FINER])
    second = tried(omegas)
    gains = np.array([gain.sum() for _, gain in second])
    best = int(np.argmax(gains))
    G, heldout = second[best]
    std = run_constants(G, list(range(1, 7)), np.ones(6), screen.fold)[1]["std"]
    omega, error = _peak(omegas, gains)
    # amplitudes of each piece, least squares; the horizontal ones' main direction
    a = -np.linalg.solve(G[:, 1:, 1:] + np.eye(6) / max(std, 1e-3) ** 2, G[:, 1:, :1])[..., 0]
    east, north = a[:, 0:2].ravel(), a[:, 2:4].ravel()
    angle = 0.5 * np.arctan2(2 * (east @ north), east @ east - north @ north)
    along = np.cos(angle) * east + np.sin(angle) * north
    mass = bench.mass(look.theta)
    heavy = float(np.mean(np.diag(mass)[:2]))
    depth = float(bench.data.X[:, 6].mean())
    fade = np.exp(omega**2 * min(depth, 0.0) / _GRAVITY)
    speed = float(np.sqrt(np.mean(along**2)) / (heavy * omega) / fade)
    values = {"speed": speed, "frequency": float(omega), "direction": float(angle)}
    unsure = {"speed": 0.3 * speed, "frequency": error, "direction": 0.2}
    share = bench.data.steps / bench.data.weight[:, screen.kept].sum()
    return Law("waves", "W", values, heldout * share, errors=unsure)


def _peak(omegas: np.ndarray, gains: np.ndarray) -> tuple[float, float]:
    """The top of a parabola through the gains, and its width where half a nat is lost."""
    a, b, _ = np.polyfit(omegas - omegas.mean(), gains, 2)
    if a >= 0:
        return float(omegas[int(np.argmax(gains))]), float(np.ptp(omegas))
    top = float(np.clip(-b / (2 * a), -0.3, 0.3))
    return float(omegas.mean() + top), float(1 / np.sqrt(-2 * a))


def _swell(bench: Bench, omega: float) -> Group:
    d = bench.data

    def columns(kept: np.ndarray) -> np.ndarray:
        t = (d.times[:-1] + d.step / 2)[:, kept]
        found = np.zeros((len(t), 3, 6, len(kept)))
        for way in range(3):
            found[:, way, 2 * way] = np.cos(omega * t)
            found[:, way, 2 * way + 1] = np.sin(omega * t)
        return found

    effect = Unknown.neutral(kind="depth", acts_on="W", numbers=(0.0, 1.0))
    return Group(effect, "swell", ("t",), columns, (tuple(range(6)),))


# ------------------------------------------------------------------------------------- level


def find_levels(bench: Bench, look: Look) -> list[Law]:
    """White disturbance stronger or weaker than the belief says, axis by axis.

    The gain is that of the level estimated on the other folds over the believed one, all other
    levels being estimated; the error of the level by the jackknife over folds. A belief without a
    level has none to differ from.
    """
    believed = np.asarray(bench.model.base.mass_and_diffusion(jnp.zeros(6))[1])
    if not np.any(believed > 0):
        return []
    data = bench.data
    error, jacobian = np.asarray(look.predictions.error), np.asarray(look.predictions.jacobian)
    mass, labels = bench.mass(look.theta), np.unique(data.fold)
    inverse = np.linalg.inv(mass)
    gain = np.zeros((6, len(data.fold)))
    levels = np.zeros((len(labels), 6))
    for k, label in enumerate(labels):
        own = data.fold == label
        rest = data.weight * (~own if not own.all() else 1)
        A = mean_jacobian(jacobian, rest)
        noise = estimate(error, rest, A, mass, data.dt)
        levels[k] = noise.diffusion
        score = _score(error, jacobian, data, own, noise, A, inverse)
        for i in np.flatnonzero(believed > 0):
            b = noise.diffusion.copy()
            b[i] = believed[i]
            other = type(noise)(noise.record, b)
            gain[i, own] = score - _score(error, jacobian, data, own, other, A, inverse)
    found, n = [], len(labels)
    for i in np.flatnonzero(believed > 0):
        spread = np.sqrt((n - 1) / n * np.sum((levels[:, i] - levels[:, i].mean()) ** 2))
        change = float(look.noise.diffusion[i] / believed[i] - 1)
        error_of = {"change": float(spread / believed[i])}
        law = Law("disturbance_level", AXES[i], {"change": change}, gain[i], errors=error_of)
        found.append(law)
    return found


def _score(
    error: np.ndarray, jacobian: np.ndarray, data: Data, own: np.ndarray, noise: Noise,
    A: np.ndarray, inverse: np.ndarray,
) -> Float[np.ndarray, " R"]:  # fmt: skip
    """Log density of the innovations of some pieces, up to a constant."""
    kalman = make_filter(noise, A, inverse, data.dt, data.step[:, own])
    w = data.weight[:, own]
    z = filtered(error[:, :, own], jacobian[..., own], kalman) * w[:, None]
    return -(z**2).sum(axis=(0, 1)) / 2 - (kalman.log_det * w).sum(axis=0)
