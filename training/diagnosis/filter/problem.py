"""The diagnosis problem: evaluation of θ (innovations, noise, sensitivities), and exact fits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from ....models.config.checks import require_double
from ....models.dynamics import Dynamics
from ....models.effects.base import Effect
from ....models.effects.extended import Extended, core
from ....models.effects.library import KINDS, Library, kind
from ....models.effects.traits import Region
from ....models.lasting import whitened
from ....models.recordings.store import Recording
from ....models.vehicles.vehicle import Vehicle
from ..data.arrays import Data, make_data
from ..selection.correlated_noise import CorrelatedNoise
from ..selection.hypotheses import Design, Evidence, Fit
from ..selection.model_selection import parameters_of
from .gram import gram
from .innovations import Predictions, predict
from .kalman import Filter, judging_filter
from .noise import Noise, estimate
from .reference import with_latent
from .sensitivities import whitened_sensitivities
from .transition import Transition
from .varying import Part, widened

_HALVINGS = 4
"""Steps that may fail before a fit ends."""
WILD = 1e3
"""Errors (m, rad, m/s, rad/s) and Jacobian entries beyond which a one-step prediction diverged."""
_WORSE = 20.0
"""Nats of one-step likelihood that a step may lose: the filtered fit weighs errors differently."""
_CONVERGED = 1.0
"""Nats that a step may promise at the end of a fit: errors by run are large while runs differ."""
_LIGHTEST = 0.1
"""Least share of the believed mass matrix, along any direction, that a step may leave."""


class Evaluation(NamedTuple):
    """Evaluation of one θ; `z` are the whitened innovations, not divided by `Filter.memory`.

    `evidence` accounts for the problem's correlated noise, `plain` does not.
    """

    theta: Float[np.ndarray, " p"]
    predictions: Predictions
    noise: Noise
    kalman: Filter
    evidence: Evidence
    plain: Evidence
    z: Float[np.ndarray, "N 12 R"]
    loss: float

    def likelihood(self, weight: Float[np.ndarray, "N R"]) -> Float[np.ndarray, " R"]:
        """Log density of each piece's innovations up to a constant (nats)."""
        square = (self.z.astype(float) ** 2).sum(axis=(0, 1))
        return -square / 2 - (self.kalman.log_det * weight).sum(axis=0)

    @property
    def correlation(self) -> Float[np.ndarray, "12"]:
        """Lag-one autocorrelation of the innovations; padded samples count as zero."""
        z = self.z.astype(float)
        square = np.maximum((z**2).sum(axis=(0, 2)), 1e-300)
        return (z[1:] * z[:-1]).sum(axis=(0, 2)) / square


@dataclass(frozen=True)
class DiagnosisProblem:
    """One recording and one believed model: the problem that a diagnosis solves.

    Attributes:
        data: the runs.
        vehicle: with the thrusters that were commanded.
        model: the believed model without effects.
        library: every effect that may explain a difference.
        believed: θ of the believed model: zero except for effects that it already has (p,).
        bounds: ranges of parameters that are narrower than those of their effects.
        correlated_noise: correlated noise that fits and tests of causes account for.
    """

    data: Data
    vehicle: Vehicle
    model: Extended
    library: Library
    believed: Float[np.ndarray, " p"]
    bounds: Mapping[tuple[str, str, str], tuple[float, float]] = field(default_factory=dict)
    correlated_noise: CorrelatedNoise | None = None

    @classmethod
    def of(
        cls,
        recording: Recording,
        vehicle: Vehicle,
        base: Dynamics | None = None,
        without: Sequence[int] = (),
        beside: Data | None = None,
    ) -> "DiagnosisProblem":
        """The problem of `base` (or the preset), its noise made white, `without` the faulty runs.

        With data `beside` these, effects that depend on the place refer to the region of both.

        Raises:
            ValueError: if JAX runs in single precision.
        """
        require_double("a diagnosis computes", "anything of it is made")
        data = make_data(recording, vehicle, without=without)
        believed = whitened(vehicle.dynamics() if base is None else base)
        effects = believed.effects if isinstance(believed, Extended) else ()
        region = data.region if beside is None else data.region.with_other(beside.region)
        library, theta = _library(data, effects, region)
        model = Extended.create(core(believed), (), vehicle.thrusters())
        data = with_latent(data, model, library, theta)
        return cls(data, vehicle, model, library, theta)

    def with_effect(self, effect: Effect) -> "DiagnosisProblem":
        """The problem with one more effect, zero in θ, appended to the library."""
        return self._with(widened(self.library, [effect]))

    def with_part(self, part: Part) -> "DiagnosisProblem":
        """The problem with an effect that changes in a part of the data, by zero in θ."""
        return self._with(widened(self.library, parts=[part]))

    def _with(self, library: Library) -> "DiagnosisProblem":
        old = [library.index(*_key(e)) for e in self.library.entries]
        theta = np.zeros(library.size)
        theta[old] = self.believed
        return replace(self, library=library, believed=theta)

    def along(self, theta: Float[np.ndarray, " p"]) -> "DiagnosisProblem":
        """The problem with velocities that were not measured as they are under θ."""
        return replace(self, data=with_latent(self.data, self.model, self.library, theta))

    def within(self, bounds: Mapping[int, tuple[float, float]]) -> "DiagnosisProblem":
        """The problem with narrower bounds of some parameters, by index in θ."""
        named = {_key(self.library.entries[i]): both for i, both in bounds.items()}
        return replace(self, bounds={**self.bounds, **named})

    def limits(self, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds; drag stays passive, unless the believed drag is not."""
        rows = list(rows)
        entries = [self.library.entries[i] for i in rows]
        both = [self.bounds.get(_key(e), (e.parameter.low, e.parameter.high)) for e in entries]
        least = [
            -self.believes(e.cause, e.where) if kind(e.cause).passive else -np.inf for e in entries
        ]
        low = np.maximum([b[0] for b in both], np.minimum(least, self.believed[rows]))
        return low, np.array([b[1] for b in both])

    def moved(self, theta: Float[np.ndarray, " q"], library: Library) -> Float[np.ndarray, " p"]:
        """θ of another library, reordered for this problem's library."""
        found = np.zeros(self.library.size)
        for value, entry in zip(theta, library.entries, strict=True):
            found[self.library.index(*_key(entry))] = value
        return found

    def believes(self, cause: str, where: str) -> float:
        """The believed model's own coefficient that a cause changes; 0 where it has none."""
        return kind(cause).believed(self.model.base, where)

    def mass(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, "6 6"]:
        """The mass matrix under θ (kg, kg·m, kg·m²)."""
        return mass(self.model, self.library, theta)

    # ---------------------------------------------------------------------------- evaluation

    def predict(
        self, theta: Float[np.ndarray, " p"], kalman: Filter | None = None
    ) -> tuple[Predictions, Noise, Filter]:
        """Predictions, the noise estimated from their errors, and its filter or the one given."""
        p = predict(self.model, self.library, theta, self.data)
        error, weight = np.asarray(p.error), self.data.weight
        if not np.isfinite(error[:, :, weight.any(axis=0)]).all():
            raise FloatingPointError("predictions diverge")
        jacobian = np.asarray(p.jacobian)
        steps = Transition.along(jacobian, weight, p.late, p.latent)
        whose, known = self.data.estimated or None, self.data.known
        noise = estimate(error, weight, steps, self.mass(theta), self.data.dt, None, whose, known)
        return p, noise, self.filter_in(noise, theta, p) if kalman is None else kalman

    def filter_in(self, noise: Noise, theta: Float[np.ndarray, " p"], p: Predictions) -> Filter:
        """The filter of predictions in a noise."""
        data, jacobian = self.data, np.asarray(p.jacobian)
        steps = Transition.along(jacobian, data.weight, p.late, p.latent)
        inverse = np.linalg.inv(self.mass(theta))
        given = data.dt, data.step, jacobian, p.latent, data.spread
        return judging_filter(noise, steps, inverse, *given)

    def errors(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, "N 12 R"]:
        """Errors of one-step predictions, zero where a piece has no sample or lost a velocity."""
        return self._there(predict(self.model, self.library, theta, self.data))

    def _there(self, p: Predictions) -> Float[np.ndarray, "N 12 R"]:
        error = np.asarray(p.error) * self.data.weight[:, None]
        return error if self.data.known is None else error * self.data.known

    def evaluate(
        self,
        theta: Float[np.ndarray, " p"],
        chosen: Sequence[int] | None = None,
        kalman: Filter | None = None,
        previous: Evaluation | None = None,
    ) -> Evaluation:
        """Evaluate θ: innovations, and sensitivities to the parameters chosen.

        By default these are all causes (in single thrusters only if they can't be in all of them),
        parameters in use, and those with bounds of their own (`within`). An evaluation at the same
        θ may be passed as `previous`: its predictions, noise and filter are reused.
        """
        if previous is None:
            p, noise, kalman = self.predict(theta, kalman)
        else:
            p, noise, kalman = previous.predictions, previous.noise, previous.kalman
        if chosen is None:
            first = parameters_of(self.library, self.library.hypotheses(single=False))
            ranged = (i for i, e in enumerate(self.library.entries) if _key(e) in self.bounds)
            chosen = sorted({*first, *np.flatnonzero(theta).tolist(), *ranged})
        design = Design.of(self.library, theta, chosen)
        z = whitened_sensitivities(
            self.model, self.library, theta, design.probes, self.data, p, kalman
        )
        data = self.data

        def evidence(products: np.ndarray) -> Evidence:
            return Evidence(self.library, theta, design, products, data.cluster, data.fold)

        plain = evidence(gram(z))
        judged = (
            plain if self.correlated_noise is None else evidence(self.correlated_noise.products(z))
        )
        own_z = z[0].reshape(len(data.u), 12, -1) * np.sqrt(kalman.memory)[:, None]
        return Evaluation(
            theta, p, noise, kalman, judged, plain, own_z, float(judged.total[0, 0]) / 2
        )

    def whitened(
        self, seen: Evaluation, probes: Float[np.ndarray, "k p"]
    ) -> Float[np.ndarray, "m N12 R"]:
        """Whitened innovations of an evaluation (row 0), and how probes change them."""
        return whitened_sensitivities(
            self.model, self.library, seen.theta, probes, self.data, seen.predictions, seen.kalman
        )

    def polish(
        self,
        theta: Float[np.ndarray, " p"],
        chosen: Sequence[int],
        kalman: Filter | None = None,
        rounds: int = 4,
        origin: Evaluation | None = None,
    ) -> tuple[np.ndarray, Evaluation, Fit]:
        """Gauss–Newton on the parameters chosen, with exact predictions at every step.

        A step that makes one-step errors clearly less likely is halved; so is the first one, from
        `origin` to the start, if an origin is given. The fit returned is at the θ returned; its
        standard errors are joint, clustered by run. FloatingPointError where all steps diverge.
        """
        chosen = list(chosen)
        low, high = self.limits(chosen)
        theta = theta.copy()
        theta[chosen] = np.clip(theta[chosen], low, high)
        best: tuple[np.ndarray, Evaluation, Fit] | None = None
        back = self.believed if origin is None else origin.theta
        bar = np.inf if origin is None else self.loss_of(origin)
        done = failed = 0
        while done < rounds and failed < _HALVINGS:
            seen = self._try_evaluate(theta, chosen, kalman)
            if seen is None or not self.loss_of(seen) <= bar + _WORSE:
                # the step is too long: go back halfway to the last good θ
                theta = (theta + (back if best is None else best[0])) / 2
                failed += 1
                continue
            fit = seen.evidence.fit(chosen)
            best, bar = (theta.copy(), seen, fit), self.loss_of(seen)
            done += 1
            step = seen.evidence.step(chosen, low - theta[chosen], high - theta[chosen])
            theta[chosen] = self._stepped(theta, chosen, step, low, high)
            if np.all(np.abs(step) < 0.15 * fit.errors + 1e-12) and fit.gain < _CONVERGED:
                break
        if best is None:
            seen = self.evaluate(back, chosen, kalman)
            best = back.copy(), seen, seen.evidence.fit(chosen)
        return best

    def _try_evaluate(
        self, theta: np.ndarray, chosen: list[int], kalman: Filter | None
    ) -> Evaluation | None:
        """An evaluation, or None where predictions diverge."""
        try:
            return self.evaluate(theta, chosen, kalman)
        except (FloatingPointError, np.linalg.LinAlgError):
            return None

    def loss_of(self, seen: Evaluation) -> float:
        """Negative log likelihood of one-step errors under their own sample covariance.

        It needs no filter, whose noise levels would change with the fit.
        """
        error = self._there(seen.predictions)
        return self.merit(self.covariance(error, seen.noise.estimated))

    def loss(self, theta: Float[np.ndarray, " p"]) -> float:
        """Negative log likelihood at θ, pose and twist taken as uncorrelated (`covariance`)."""
        return self.merit(self.covariance(self.errors(theta), apart=True))

    def covariance(self, error: np.ndarray, apart: bool) -> Float[np.ndarray, "12 12"]:
        """Of one-step errors; `apart`: pose and twist uncorrelated, as for estimated poses."""
        C = np.einsum("nir,njr->ij", error, error) / self.data.weight.sum()
        if apart:
            C[:6, 6:], C[6:, :6] = 0.0, 0.0
        return C + np.diag(np.diag(C) == 0) if self.data.unmeasured else C

    def merit(self, C: Float[np.ndarray, "12 12"]) -> float:
        """Negative log likelihood of errors with the sample covariance C."""
        if not np.isfinite(C).all():
            return np.inf
        return float(self.data.weight.sum() * np.linalg.slogdet(C)[1] / 2)

    def _stepped(
        self, theta: np.ndarray, chosen: list[int], step: np.ndarray, low: np.ndarray,
        high: np.ndarray,
    ) -> Float[np.ndarray, " k"]:  # fmt: skip
        """θ after a step, halved until the mass matrix is at least `_LIGHTEST` of the believed."""
        believed = self.mass(self.believed)
        moved, share = theta.copy(), 1.0
        while True:
            moved[chosen] = np.clip(theta[chosen] + share * step, low, high)
            least = scipy.linalg.eigh(self.mass(moved), believed, eigvals_only=True)[0]
            if least > _LIGHTEST or share < 1e-3:
                return moved[chosen] if least > 0 else theta[chosen]
            share /= 2

    def without_each(
        self, evaluation: Evaluation, chosen: Sequence[int]
    ) -> Float[np.ndarray, "p R"]:
        """θ of each piece, with the parameters chosen refitted without the piece's fold.

        One Gauss–Newton step from the fit to all data, which is exact to first order in a fold's
        weight; values stay within bounds, and steps whose predictions diverge are halved.
        """
        data, chosen = self.data, list(chosen)
        theta = np.repeat(evaluation.theta[:, None], len(data.fold), axis=1)
        evidence = evaluation.evidence
        if not chosen or len(evidence.folds) < 2:
            return theta
        low, high = (bound - evaluation.theta[chosen] for bound in self.limits(chosen))
        low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        for number, label in enumerate(np.unique(data.fold)):
            values = evaluation.theta[chosen] + evidence.step(chosen, low, high, without=number)
            theta[np.ix_(chosen, data.fold == label)] = values[:, None]
        for share in (*(0.5 for _ in range(_HALVINGS)), 1.0):
            wild = np.isin(data.fold, data.fold[self._wild(theta)])
            if not wild.any():
                break
            theta[:, wild] += share * (evaluation.theta[:, None] - theta[:, wild])
        return theta

    def _wild(self, theta: Float[np.ndarray, "p R"]) -> Bool[np.ndarray, " R"]:
        """Pieces whose predictions diverge, each under its own θ."""
        p = predict(self.model, self.library, theta, self.data)
        here = self.data.weight > 0
        sizes = (
            np.abs(np.asarray(a)).max(axis=(1, *range(2, a.ndim - 1)))
            for a in (p.error, p.jacobian)
        )
        return np.any([np.any(~(size < WILD) & here, axis=0) for size in sizes], axis=0)


def mass(
    model: Extended, library: Library, theta: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "6 6"]:
    """The mass matrix with a library's effects (kg, kg·m, kg·m²)."""
    return np.asarray(_mass(model, library.filled(theta)))


@eqx.filter_jit
def _mass(model: Extended, effects: tuple[Effect, ...]) -> Float[Array, "6 6"]:
    return model.with_effects(effects).inertia().matrix


def _key(entry: tuple) -> tuple[str, str, str]:
    return entry[0], entry[1], entry[2].name


def _library(data: Data, effects: Sequence[Effect], region: Region) -> tuple[Library, np.ndarray]:
    kinds = [k for k in KINDS.values() if not (k.random or k.observed) and k.needs <= data.offers]
    own = [e for e in effects if e.name not in {k.name for k in kinds}]
    n = data.u.shape[1]
    library = Library([*(k.neutral(thrusters=n, **k.options_for(region)) for k in kinds), *own])
    theta = np.zeros(library.size)
    for effect in effects:
        rows = [i for where in effect.places for i in library.at(effect.name, where)]
        theta[rows] = np.asarray(effect.values)
    return library, theta
