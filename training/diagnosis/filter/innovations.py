"""Errors of one-step predictions from every sample, and how they propagate."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ....models.effects.extended import Extended
from ....models.effects.library import Library
from ....models.effects.recent import Recent
from ...compile_options import LOOP_EMITTERS, jit_with
from ..data.arrays import Data
from .along_records import AlongRecords, Records, State, Step, scan, substeps
from .latent import levels, specific_force_errors
from .transition import Latent
from .varying import Modulated, changes_of


class Predictions(NamedTuple):
    """One step from every sample, under one set of effects.

    Attributes:
        error: r_n: pose error seen from the predicted body, then twist (N, 12, R).
        X: predicted pose itself, before it is observed (N, 7, R).
        V: predicted twist (N, 6, R).
        jacobian: A_n, of errors (pose in B, twist) over a step (N, 12, 12, R).
        latest: history of the twist over the step, for delayed instruments (N, 1, 3, 6, R).
        start: pose and twist at the samples, with the effects of instruments removed.
        first: history of the twist before the first sample.
        late: delay of recorded poses against twists, by axis (s).
        latent: of velocities that were not measured: the records have those of a simulation under
            these effects, in which all other velocities and the pose are reset at every sample.
    """

    error: Float[Array, "N 12 R"]
    X: Float[Array, "N 7 R"]
    V: Float[Array, "N 6 R"]
    jacobian: Float[Array, "N 12 12 R"]
    latest: Recent
    start: tuple[Float[Array, "N 7 R"], Float[Array, "N 6 R"]]
    first: Recent | None = None
    late: Any = None
    latent: Latent | None = None


def difference(
    X: Float[Array, "7 *#b"], V: Float[Array, "6 *#b"], X2: Array, V2: Array
) -> Float[Array, "12 *#b"]:
    """(X2, V2) ⊖ (X, V)."""
    return jnp.concatenate(jnp.broadcast_arrays(se3.local(X, X2), V2 - V))


@jit_with(LOOP_EMITTERS)
def _predict(
    model: Extended,
    effects: Any,
    records: Records,
    count: int,
    measured: Array | None = None,
    changes: tuple[Modulated, ...] = (),
    reckoned: tuple[int, ...] = (),
) -> Predictions:
    every = AlongRecords.of(model.with_effects(effects), count, changes, reckoned)
    plain = model.with_effects(())
    rest = plain.inertia()

    def predicted(state: State, given: Step) -> tuple[State, Predictions]:
        along, V = every.at(given.number), given.V
        if measured is not None:
            V = jnp.where(measured[6:, None] > 0, V, along.observe(state)[1])
        start = along.restart(state, given.X, V)
        end = along.step(start, given)
        middle = (start.V + end.V) / 2
        # what was not measured moves on as the model at hand lets it, over many steps
        own = (plain, rest) if measured is None else (along.model, along.inertia)
        jacobian, slope = step_jacobian(
            *own, start.X, middle, given.command, given.length[0], count, given.voltage
        )
        recent = end.recent.keeping(end.V, slope)
        end = end._replace(recent=recent)
        latest = Recent(recent.bends[:1], recent.step[:1], end.V, slope)
        read = every.at(given.number + 1).observe(end)
        error = difference(*read, given.X_next, given.V_next)
        return end, Predictions(error, end.X, end.V, jacobian, latest, (start.X, start.V))

    start, V = every.at(0).init(records), records.V[0]
    first = start.recent.keeping(V, jnp.zeros((6, *V.shape), V.dtype))
    found = scan(predicted, start._replace(recent=first), records)
    return found._replace(first=first)


def step_jacobian(
    model: Extended,
    inertia: Any,
    X: Float[Array, "7 R"],
    V: Float[Array, "6 R"],
    u: Float[Array, "n R"],
    dt: Float[Array, "*_"],
    count: int,
    voltage: Float[Array, "1 *#R"] | None = None,
) -> tuple[Float[Array, "12 12 R"], Float[Array, "6 6 R"]]:
    """exp(J dt) of δ' = δV - ad_V δ, δV' = ∂a/∂x δ; ∂a/∂V.

    By a series to third order over a part of the step, at most 1/`count` of it, and squaring (Moler
    and Van Loan 2003, method 3): in a fast turn drag ends an error within a step, where a series
    over all of it grows.
    """
    halvings = math.ceil(math.log2(count))
    eye = jnp.eye(12, dtype=V.dtype)[3:]

    def drift(d: Array) -> Array:
        turned = se3.retract(X, jnp.concatenate([jnp.zeros_like(d[:3]), d[:3]]))
        return model.drift(inertia, turned, V + d[3:], u, voltage)

    zero = jnp.zeros((9, *V.shape[1:]), V.dtype)
    tangents = jnp.broadcast_to(
        eye[:, 3:].reshape((9, 9) + (1,) * (V.ndim - 1)), (9, 9, *V.shape[1:])
    )
    columns = jax.vmap(lambda t: jax.jvp(drift, (zero,), (t,))[1])(tangents)  # (9, 6, R)
    lower = jnp.moveaxis(columns, 0, 1)  # (6, 9, R)
    ad = se3.ad(V)
    unit = jnp.broadcast_to(
        jnp.eye(6, dtype=V.dtype).reshape((6, 6) + (1,) * (V.ndim - 1)), ad.shape
    )
    top = jnp.concatenate([-ad, unit], axis=1)
    bottom = jnp.concatenate([jnp.zeros_like(lower[:, :3]), lower], axis=1)
    J = dt[None, None] / 2**halvings * jnp.concatenate([top, bottom])
    JJ = _times(J, J)
    part = jnp.eye(12, dtype=V.dtype)[:, :, None] + J + JJ / 2 + _times(JJ, J) / 6
    for _ in range(halvings):
        part = _times(part, part)
    return part, lower[:, 3:]


def _times(A: Float[Array, "n n R"], B: Float[Array, "n n R"]) -> Float[Array, "n n R"]:
    return jnp.einsum("ijr,jkr->ikr", A, B)


def predict(model: Extended, library: Library, theta: np.ndarray, data: Data) -> Predictions:
    """Predictions of all samples with the effects' values `theta`: (p,), or (p, R) by piece."""
    theta = theta.reshape(len(theta), -1)
    effects, changes = library.filled(theta), changes_of(library, theta)
    measured = jnp.asarray(data.measured) if data.latent else None
    count = substeps(data.longest)
    found = _predict(model, effects, Records.of(data), count, measured, changes, data.reckoned)
    late = sum((e.pose_delay() for e in effects), np.zeros(6))
    if data.reckoned:
        late[:3] = 0.0  # the position is an integral of what the twist shows
    found = found._replace(late=late)
    if not data.unmeasured:
        return found
    found = found._replace(error=found.error * data.measured[None, :, None])
    if not data.latent:
        return found
    assumed = levels(model, data)
    if not data.felt:
        return found._replace(latent=Latent(assumed))
    error, jacobian, carried = specific_force_errors(found, data)
    latent = Latent(assumed, data.felt, carried)
    return found._replace(error=error, jacobian=jacobian, latent=latent)
