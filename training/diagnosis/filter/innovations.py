"""Errors of one-step predictions from every sample, and how they propagate."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ....models.dynamics import Memory
from ....models.effects.deterministic_step import advance
from ....models.effects.extended import Extended
from ....models.effects.inertia import Inertia
from ....models.effects.library import Library
from ....models.effects.recent import Recent
from ..data.arrays import Data

SUBSTEPS, LONGEST = 2, 0.0125
"""Fewest substeps of a step, and their greatest length (s): drag is stiff in fast turns."""


def substeps(longest: float) -> int:
    """Substeps of predictions over steps of up to `longest` s."""
    return max(SUBSTEPS, math.ceil(longest / LONGEST - 1e-6))


Arrays = tuple[Array, Array, Array, Array, Array, Array, Array]
"""Poses, twists, commands, voltages and steps of `Data`, commands and steps before them."""


def as_arrays(data: Data) -> Arrays:
    """The arrays that compiled programs take; equal steps as one column, (N, 1)."""
    now = (data.X, data.V, data.u, data.voltage, data.own_steps())
    arrays = (*now, data.past, data.past_steps())
    return tuple(jnp.asarray(a) for a in arrays)  # pyright: ignore[reportReturnType]


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
    """

    error: Float[Array, "N 12 R"]
    X: Float[Array, "N 7 R"]
    V: Float[Array, "N 6 R"]
    jacobian: Float[Array, "N 12 12 R"]
    latest: Recent
    start: tuple[Float[Array, "N 7 R"], Float[Array, "N 6 R"]]
    first: Recent | None = None
    late: Any = None


def difference(
    X: Float[Array, "7 *#b"], V: Float[Array, "6 *#b"], X2: Array, V2: Array
) -> Float[Array, "12 *#b"]:
    """(X2, V2) ⊖ (X, V)."""
    return jnp.concatenate(jnp.broadcast_arrays(se3.local(X, X2), V2 - V))


def settle(model: Extended, past: Float[Array, "P n *batch"], step: Array) -> Memory:
    """Actuator states after commands, each held for a `step` (s); steady under the first before."""
    memory = model.remember(past[0])
    if not memory:
        return ()

    def after(memory: Memory, given: tuple[Array, Array]) -> tuple[Memory, None]:
        return model.actuate(memory, *given, 1)[0], None

    shapes = jax.eval_shape(lambda m: after(m, (past[0], step[0]))[0], memory)
    memory = tuple(jnp.broadcast_to(m, s.shape) for m, s in zip(memory, shapes, strict=True))
    return jax.lax.scan(after, memory, (past, step))[0]


def at_first(
    model: Extended, inertia: Inertia, memory: Memory, X: Float[Array, "7 *#b"],
    V: Float[Array, "6 *#b"], before: Float[Array, "n *#b"], voltage: Array, step: Array,
) -> Recent:  # fmt: skip
    """History of the twist before the first sample: constant acceleration under `before`."""
    level = model.actuate(memory, before, step, 1)[1][..., 0]
    return Recent.steady(model.drift(inertia, X, V, level, voltage), step)


@eqx.filter_jit
def _predict(model: Extended, effects: Any, arrays: Arrays, count: int) -> Predictions:
    X, V, u, voltage, step, past, past_step = arrays
    model = model.with_effects(effects)
    inertia = model.inertia()
    plain = model.with_effects(())
    rest = plain.inertia()

    def body(carry: tuple[Memory, Recent], given: Any) -> Any:
        memory, recent = carry
        X0, V0, X1, V1, command, volts, h = given
        # what delayed instruments do not show yet happened under earlier commands
        x, v = model.infer(X0, V0, recent)
        memory, Xp, Vp, a = advance(
            model, inertia, memory, x, v, command, h[None], count, volts[None]
        )
        latest = Recent.over(v, Vp, a, h[None])
        jacobian, slope = _jacobian(plain, rest, x, (v + Vp) / 2, command, h)
        latest = latest.keeping(Vp, slope)
        recent = recent.after(latest)
        error = difference(*model.observe(Xp, Vp, recent), X1, V1)
        return (memory, recent), Predictions(error, Xp, Vp, jacobian, latest, (x, v))

    memory = settle(model, past, past_step[:, None])
    first = at_first(model, inertia, memory, X[0], V[0], past[-1], voltage[:1], step[:1])
    first = first.keeping(V[0], jnp.zeros((6, *V[0].shape), V.dtype))
    xs = (X[:-1], V[:-1], X[1:], V[1:], u, voltage, step)
    return jax.lax.scan(body, (memory, first), xs)[1]._replace(first=first)


def _jacobian(
    model: Extended, inertia: Any, X: Array, V: Array, u: Array, dt: Array
) -> tuple[Array, Array]:
    """exp(J dt) of δ' = δV - ad_V δ, δV' = ∂a/∂x δ, to third order; ∂a/∂V."""
    F = model.allocate(u)
    eye = jnp.eye(12, dtype=V.dtype)[3:]

    def drift(d: Array) -> Array:
        turned = se3.retract(X, jnp.concatenate([jnp.zeros_like(d[:3]), d[:3]]))
        _, wrench = model.base.balance(turned, V + d[3:], F)
        return jnp.tensordot(inertia.inverse, wrench, 1)

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
    J = dt[None, None] * jnp.concatenate([top, bottom])
    JJ = jnp.einsum("ijr,jkr->ikr", J, J)
    whole = jnp.eye(12, dtype=V.dtype)[:, :, None] + J + JJ / 2
    return whole + jnp.einsum("ijr,jkr->ikr", JJ, J) / 6, lower[:, 3:]


def predict(model: Extended, library: Library, theta: np.ndarray, data: Data) -> Predictions:
    """Predictions of all samples with the effects' values `theta`: (p,), or (p, R) by piece."""
    effects = library.filled(theta.reshape(len(theta), -1))
    found = _predict(model, effects, as_arrays(data), substeps(data.longest))
    found = found._replace(late=sum((e.pose_delay() for e in effects), np.zeros(6)))
    return (
        found._replace(error=found.error * data.measured[None, :, None])
        if data.unmeasured
        else found
    )
