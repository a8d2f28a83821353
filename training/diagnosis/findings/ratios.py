"""Coefficients over inertia, which motion determines without knowledge of the mass.

Scaling all forces and masses by one factor leaves the motion unchanged, so data determine
coefficients only relative to inertia. Intervals are those of the likelihood (inverse of its
curvature, corrected for the correlation of errors in time) by the delta method or, where wider,
those from the variation of scores between clusters (Huber 1967); a coefficient at its physical
limit counts as known.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ....models.effects.drag import LinearDrag, QuadraticDrag
from ....models.effects.extended import Extended
from ....models.effects.load import NetBuoyancy
from ....models.rigid_body import FossenDynamics
from ....models.se3 import AXES
from ..filter.problem import DiagnosisProblem, Evaluation
from . import result

_TILT = 1e-3
_HALF = 200.0
"""µs from neutral at half command."""
_STEP = 0.1
"""Standard errors by which parameters are moved for the derivative of a ratio."""
_SMALL = 1e-9
_UNITS = {
    "inertia": ("1", "1"),
    QuadraticDrag.name: ("1/m", "1"),
    LinearDrag.name: ("1/s", "1/s"),
    "half_thrust": ("m/s²", "rad/s²"),
    "thrust": ("m/s²", "rad/s²"),
    "restoring": ("", "rad/s²"),
    NetBuoyancy.name: ("m/s²", ""),
}
"""Units of translations and of rotations."""


def ratios(
    problem: DiagnosisProblem, evaluation: Evaluation, rows: Sequence[int]
) -> list[result.Ratio]:
    """Believed and found ratios by axis; `rows` are the parameters that were fitted.

    `inertia` is relative to surge's (of rotations to roll's), everything else over the
    axis' inertia; `half_thrust` is the acceleration when all thrusters push along the axis at
    half command, for commands by PWM, `thrust` that at the commands' RMS where they are forces or
    wrenches. Empty for a base without constant coefficients.
    """
    if not isinstance(problem.model.base, FossenDynamics) or not rows:
        return []
    numbers, theta = _numbers(problem), evaluation.theta
    mean, before = numbers(theta), numbers(problem.believed)
    low, high = problem.limits(rows)
    at = theta[list(rows)]
    free = [
        i for i, a, b, x in zip(rows, low, high, at, strict=True) if a < x - _SMALL < b - _SMALL
    ]
    columns = [evaluation.evidence.column(i) for i in free]
    H = evaluation.evidence.total[np.ix_(columns, columns)] + np.diag(
        evaluation.evidence.prior(free)
    )
    # principal directions, each moved by a share of its standard error
    values, vectors = np.linalg.eigh(H)
    roots = vectors / np.sqrt(np.maximum(values, 1e-300))
    scores = evaluation.evidence.runs[:, columns, 0] @ roots
    scores = scores - scores.mean(axis=0)
    slopes: dict[tuple[str, str], list[float]] = {key: [] for key in mean}
    for direction in roots.T:
        moved = theta.copy()
        moved[free] += _STEP * direction
        for key, after in numbers(moved).items():
            slopes[key].append((after - mean[key]) / _STEP)
    found = []
    for (name, where), value in mean.items():
        if where in problem.data.unseen:
            continue
        slope = np.array(slopes[name, where])
        error = 1.96 * float(np.sqrt(max(slope @ slope, np.sum((scores @ slope) ** 2))))
        unit = _UNITS[name][where in AXES[3:]]
        fitted = result.Value(value, unit, (value - error, value + error))
        found.append(result.Ratio(name, where, before[name, where], fitted))
    return found


def _numbers(problem: DiagnosisProblem) -> Callable[[np.ndarray], dict[tuple[str, str], float]]:
    """A function from θ to all ratios."""
    data = problem.data
    thrusters = problem.vehicle.thrusters()
    volts = float((data.voltage * data.weight).sum() / data.weight.sum())
    nominal = float(thrusters.nominal_voltage)
    identity = se3.identity(jnp.float64)
    B = np.asarray(problem.model.allocate(jnp.eye(data.u.shape[1])))
    along = np.sign(np.round(B, 9))
    usual = np.sqrt((data.u**2 * data.weight[:, None]).sum(axis=(0, 2)) / data.weight.sum())

    @eqx.filter_jit
    def at_rest(model: Extended, effects: tuple, X: Array) -> Array:
        """Wrench without motion and command."""
        still, model = jnp.zeros(6), model.with_effects(effects)
        _, wrench = model.base.balance(X, still, jnp.zeros(6))
        return wrench + model.extra_wrench(X, still)

    @eqx.filter_jit
    def pushed(model: Extended, effects: tuple, commands: Array) -> Array:
        """Wrenches (6, 6) of commands for all thrusters (6, n)."""
        still, model = jnp.zeros(6), model.with_effects(effects)

        def wrench(command: Array) -> Array:
            volt = jnp.full(len(command), volts * nominal)
            force = thrusters.force(command, volt) if data.command == "pwm" else command
            given = model.thrust(force, still, jnp.array([volts]))
            return model.together(model.allocate(given))

        return jax.vmap(wrench)(commands)

    def numbers(theta: Float[np.ndarray, " p"]) -> dict[tuple[str, str], float]:
        effects = problem.library.filled(theta)
        inertia = np.diag(problem.mass(theta))
        level = at_rest(problem.model, effects, identity)
        found = {("inertia", a): inertia[i] / inertia[i // 3 * 3] for i, a in enumerate(AXES)}
        for name in (QuadraticDrag.name, LinearDrag.name):
            for i, axis in enumerate(AXES):
                change = theta[problem.library.index(name, axis, "change")]
                value = problem.believes(name, axis) + change
                found[name, axis] = float(value / inertia[i])
        pwm = data.command == "pwm"
        commands = 1500.0 + _HALF * along if pwm else usual * along
        F = np.asarray(pushed(problem.model, effects, jnp.asarray(commands)))
        for i, axis in enumerate(AXES):
            found["half_thrust" if pwm else "thrust", axis] = float(F[i, i] / inertia[i])
        for i, axis in ((3, "roll"), (4, "pitch")):
            tilted = se3.retract(identity, jnp.zeros(6).at[i].set(_TILT))
            less = level[i] - at_rest(problem.model, effects, tilted)[i]
            found["restoring", axis] = float(less / _TILT / inertia[i])
        found[NetBuoyancy.name, "heave"] = float(level[2] / inertia[2])
        return found

    return numbers
