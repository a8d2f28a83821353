"""A diagnosis in words and numbers: causes with intervals, residuals, refitted coefficients."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from ....models.effects.base import Effect
from ....models.effects.library import kind, whole
from ....models.effects.noise import DisturbanceColour, DisturbanceImpacts
from ....models.effects.thrust import ThrustScale
from ....models.effects.unknown import Unknown
from ....models.effects.water import CurrentVarying
from ....models.se3 import AXES, CHANNELS
from ..data.repeats import repeating
from ..disturbance.estimator import colour_size, unit_responses
from ..disturbance.laws import Law, estimated, run_constants
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.varying import parts_of
from ..selection.hypotheses import Fit
from ..selection.model_selection import Choice, parameters_of
from ..selection.state import Selection
from . import result
from .experiments import Experiment, of_law
from .sentences import OF_THRUST

_NAN = float("nan")
_SCALE = 0.01
"""Reference spread of thrust between runs (1/8 to 64 times as much is tried)."""
_FOLLOWING, _SEVERAL = 0.5, 3
"""Correlation of neighbouring errors that counts as clear, and least number of such velocities."""


def quantile(fit: Fit) -> float:
    """Student's t for 95 % intervals, with clusters less parameters as degrees of freedom."""
    return float(scipy.stats.t.ppf(0.975, max(len(fit.heldout) - len(fit.parameters), 1)))


def unit(of: str, where: str) -> str:
    """The unit at one place, of a parameter whose unit differs between translation and rotation.

    A coefficient of one axis by the motion on another (`sway_from_yaw`), a force by a speed, has
    the units of both; a lever (`pitch_from_surge`) is a length everywhere.
    """
    both = of.split(" or ")
    axis, _, source = where.partition("_from_")
    if len(both) == 2:
        return both[axis in AXES[3:] or where == "munk"]
    if source and "/" in of:
        force, _, speed = of.partition("/")
        force = force.replace("N", "N·m") if axis in AXES[3:] else force
        speed = speed.replace("m", "rad") if source in AXES[3:] else speed
        return f"{force}/{speed}"
    return of


def values_of(
    problem: DiagnosisProblem, theta: Float[np.ndarray, " p"], rows: Sequence[int], joint: Fit
) -> dict[str, result.Value]:
    """Parameters with intervals from the joint fit of all free ones, clustered by run."""
    t = quantile(joint)
    found = {}
    for i in rows:
        p = problem.library.entries[i].parameter
        v = p.usual + float(theta[i])
        error = t * float(joint.errors[joint.parameters.index(i)])
        its_unit = unit(p.unit, problem.library.entries[i].where)
        found[p.name] = result.Value(v, its_unit, (v - error, v + error))
    return found


def _assumed(problem: DiagnosisProblem, name: str, where: str) -> dict[str, result.Value]:
    """Assumed values that a cause's parameters refer to, without intervals."""
    own = (e for e in problem.library.effects if e.name == name and where in e.places)
    assumed = next(own).assumed(where)
    return {what: result.Value(at, unit, (_NAN, _NAN)) for what, (at, unit) in assumed.items()}


def cause(
    choice: Choice,
    problem: DiagnosisProblem,
    evaluation: Evaluation,
    joint: Fit,
    experiment: Experiment,
    structure: result.Structure | None = None,
) -> result.Cause:
    """A named cause; `joint` is the fit of all accepted parameters together."""
    full, where = choice.hypothesis
    name = whole(full)
    when = next((p.when for p in parts_of(problem.library) if p.name == full), None)
    rivals = [result.Rival(h[0], h[1], float(g)) for h, g in choice.rivals]
    return result.Cause(
        name=name,
        where=where,
        parameters=values_of(problem, evaluation.theta, problem.library.at(full, where), joint)
        | _assumed(problem, name, where),
        evidence=result.Support(choice.p_value, choice.fit.heldout_gain),
        rivals=rivals,
        indistinguishable_from=list(
            dict.fromkeys(other if other != name else f"{name} ({at})" for other, at in choice.ties)
        ),
        next_experiment=experiment.text,
        experiments=experiment.nats,
        structure=structure,
        when=when,
    )


def refitted(
    problem: DiagnosisProblem, evaluation: Evaluation, rows: Sequence[int], joint: Fit
) -> list[result.Refitted]:
    """Coefficients that were fitted with the causes: believed and found values."""
    found = []
    t = quantile(joint) if rows else 0.0
    for i in rows:
        e = problem.library.entries[i]
        old = problem.believes(e.cause, e.where)
        new = old + float(evaluation.theta[i] - problem.believed[i])
        error = t * float(joint.errors[joint.parameters.index(i)])
        value = result.Value(new, unit(e.parameter.unit, e.where), (new - error, new + error))
        found.append(result.Refitted(e.cause, e.where, e.parameter.name, old, value))
    return found


def residual(problem: DiagnosisProblem, evaluation: Evaluation) -> dict[str, result.AxisResidual]:
    """Statistics of the residual by channel; NaN where nothing was measured."""
    n, correlation = problem.data.weight.sum(), evaluation.correlation
    found = {}
    for i, name in enumerate(CHANNELS):
        z = evaluation.z[:, i]
        mean = float(z.sum() / np.sqrt(n))
        values = float((z**2).sum()) / n, float(correlation[i]), mean
        found[name] = result.AxisResidual(*(values if problem.data.measured[i] else [np.nan] * 3))
    return found


def left_over(
    residual: Mapping[str, result.AxisResidual],
    causes: Sequence[result.Cause],
    problem: DiagnosisProblem,
    evaluation: Evaluation,
    least: float,
) -> list[str]:
    """Systematic residuals that the causes leave, in words."""
    left = following(residual, causes)
    if evaluation.noise.estimated:
        return left
    alike = repeating(evaluation.z, problem.data)
    if alike:
        left.append(
            f"errors of {', '.join(alike)} repeat from run to run under the same commands (up to "
            f"{max(alike.values()):.1f} times what chance makes): the simulation lacks something "
            "there that follows the commands"
        )
    gain, std = thrust_by_run(problem, evaluation)
    laws = (c.evidence.heldout_gain for c in causes if _is_random(c.name))
    if std > OF_THRUST and gain > max(least, *laws, 0.0):
        when = "within runs" if problem.data.left_out == "block" else "from run to run"
        left.append(
            f"thrust differs {when} (by {100 * std:.1f} %, standard deviation), as with a supply "
            "voltage that was not recorded or a thruster that fails"
        )
    return left


def _is_random(name: str) -> bool:
    return kind(name).random


def thrust_by_run(problem: DiagnosisProblem, evaluation: Evaluation) -> tuple[float, float]:
    """Held-out nats that a thrust scale by run wins, and the scales' standard deviation."""
    evidence, at = evaluation.plain, problem.library.at(ThrustScale.name, "all")
    if not set(at) <= set(evidence.design.owner.tolist()) or len(evidence.runs) < 3:
        return 0.0, 0.0
    columns, size = [evidence.column(i) for i in at], np.array([_SCALE])
    gain, values, _ = run_constants(evidence.runs, columns, size, evidence.fold)
    return float(gain.sum()), values["std"]


def following(
    residual: Mapping[str, result.AxisResidual], causes: Sequence[result.Cause]
) -> list[str]:
    """A sentence where only errors of velocities are autocorrelated and no law was named.

    A filter's estimates have autocorrelated errors of pose too: of position, or of attitude where
    no position was measured.
    """
    lasting = ("disturbance", "environment")
    if any(kind(c.name).family in lasting for c in causes if c.name != Unknown.name):
        return []
    alike = {name: residual[name].autocorrelation for name in CHANNELS}
    of = [name for name in CHANNELS[6:] if alike[name] > _FOLLOWING]
    poses = [name for name in CHANNELS[:3] if np.isfinite(alike[name])] or CHANNELS[3:6]
    if len(of) < _SEVERAL or any(abs(alike[name]) > _FOLLOWING / 2 for name in poses):
        return []
    return [
        f"errors of {', '.join(of)} follow each other (correlations up to "
        f"{max(alike[n] for n in of):.2f}): the simulation lacks something large that has no name "
        "here, or commands have other units, signs or frames than it believes"
    ]


# ------------------------------------------------------------------------------------- laws


def law_cause(
    laws: Sequence[Law], rivals: Sequence[Law], problem: DiagnosisProblem, evaluation: Evaluation
) -> tuple[result.Cause, Effect]:
    """Laws of one name as a cause, axis by axis, and their effect."""
    same = sorted(laws, key=lambda law: law.where in AXES[3:])  # newtons before newton metres
    top = max(laws, key=lambda law: law.heldout_gain)
    experiment = of_law(top, rivals, problem, evaluation)
    parameters: dict[str, result.Value] = {}
    cls = kind(top.name)
    values = np.zeros(len(cls.neutral().values))
    for number, law in enumerate(same):
        for name, value in _law_values(law, problem, evaluation).items():
            parameters[name if number == 0 else f"{name}_{law.where}"] = value
            values[cls.index(law.where, name)] = value.value
    named = result.Cause(
        name=top.name,
        where=", ".join(law.where for law in same),
        parameters=parameters,
        evidence=result.Support(float(np.exp(-top.heldout_gain)), top.heldout_gain),
        rivals=[result.Rival(r.name, r.where, r.heldout_gain) for r in rivals[:4]],
        indistinguishable_from=[],
        next_experiment=experiment.text,
        experiments=experiment.nats,
    )
    return named, cls(jnp.asarray(values))


def _law_values(
    law: Law, problem: DiagnosisProblem, evaluation: Evaluation
) -> dict[str, result.Value]:
    """A law's parameters in the units of its effect, with intervals by the delta method."""
    data = problem.data
    units = {p.name: unit(p.unit, law.where) for p in kind(law.name).parameters}
    if law.errors is not None:
        spreads = {name: 1.96 * law.errors[name] for name in law.parameters}
        return {
            name: result.Value(v, units[name], (v - spreads[name], v + spreads[name]))
            for name, v in law.parameters.items()
        }
    cluster = data.cluster
    if law.loss is not None and len(law.heldout) != len(cluster):
        cluster = np.arange(len(law.heldout))
    at, covariance = estimated(law, cluster)
    once, _ = unit_responses(problem, evaluation, law.where)

    def physical(x: np.ndarray) -> np.ndarray:
        v = np.exp(x)
        if law.name == DisturbanceImpacts.name:
            share, size, rest = v[:3]
            return np.array([np.sqrt(max(size**2 - rest**2, 1e-12)) / once, share / data.dt])
        if law.name == DisturbanceColour.name:
            return np.array([colour_size(v[0], v[1], problem, evaluation, law.where), v[0]])
        return v

    values, D = physical(at), []
    for d in 1e-4 * np.eye(len(at)):
        D.append((np.log(physical(at + d)) - np.log(physical(at - d))) / 2e-4)
    spread = np.sqrt(np.maximum(np.diag(np.array(D).T @ covariance @ np.array(D)), 0))
    found = {}
    for name, value, s in zip(units, values, spread, strict=False):
        low, high = value * np.exp(-1.96 * s), value * np.exp(1.96 * s)
        found[name] = result.Value(float(value), units[name], (float(low), float(high)))
    if law.name == CurrentVarying.name:
        least = float(data.weight.sum(axis=0).mean() * data.dt)  # constant over a run
        found["time_constant"] = result.Value(least, "s", (_NAN, _NAN))
    return found


def noise_levels(problem: DiagnosisProblem, evaluation: Evaluation) -> dict[str, float]:
    """Levels of noise, mean over the axes of a sensor."""
    groups = ("position_m", "attitude_rad", "velocity_m_s", "rate_rad_s")
    found, measured = {}, problem.data.measured > 0
    for i, group in enumerate(groups):
        own = slice(3 * i, 3 * i + 3)
        if measured[own].any():
            found[group] = float(np.mean(evaluation.noise.record[own][measured[own]]))
    for i in problem.data.felt:
        found[f"specific_force_{AXES[i]}"] = float(evaluation.noise.record[6 + i] / problem.data.dt)
    for name, slip in zip(
        ("position", "attitude"), np.split(evaluation.noise.slip, 2), strict=True
    ):
        if np.any(slip > 0) and not (name == "position" and problem.data.felt):
            found[f"slip_{name}"] = float(np.mean(slip))
    return found | {
        f"diffusion_{a}": float(b)
        for a, b in zip(AXES, evaluation.noise.diffusion, strict=True)
        if a not in problem.data.unseen
    }


def joint_rows(state: Selection, nuisance: Sequence[int], problem: DiagnosisProblem) -> list[int]:
    """All parameters of the final joint fit."""
    rows = [*parameters_of(problem.library, state.hypotheses), *nuisance]
    return list(dict.fromkeys(rows))
