"""Noise-free forecasts of recorded runs, window by window."""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models.effects.deterministic_step import advance
from ....models.effects.extended import Extended
from ....models.effects.inertia import times
from ....models.effects.recent import Recent
from ..data.arrays import Data
from ..filter.innovations import Arrays, as_arrays, at_first, settle, substeps


@runtime_checkable
class Learned(Protocol):
    """Learned acceleration error of a model, by any method; a pytree of arrays."""

    def acceleration(
        self, X: Float[Array, "7 S R"], V: Float[Array, "6 S R"], u: Array, before: Array
    ) -> Float[Array, "6 S R"]:
        """Correction to dV/dt (m/s², rad/s²), given commands and those a step before."""
        ...


@eqx.filter_jit
def _forecast(
    model: Extended, arrays: Arrays, every: int, count: int, rest: Learned | None
) -> tuple[Array, Array]:
    X, V, u, voltage, step, past, past_step = arrays
    inertia = model.inertia()

    def body(carry: Any, given: Any) -> Any:
        memory, x, v, recent = carry
        n, X0, V0, command, before, volts, h = given
        fresh = model.infer(X0, V0, recent)
        starts = n % every == 0
        x, v = (jnp.where(starts, a, b) for a, b in zip(fresh, (x, v), strict=True))
        push = None
        if rest is not None:
            lacking = rest.acceleration(*(k[:, None] for k in (x, v, command, before)))
            push = times(inertia.matrix, lacking[:, 0])
        memory, x, Vp, a = advance(
            model, inertia, memory, x, v, command, h[None], count, volts[None], push
        )
        recent = recent.after(Recent.over(v, Vp, a, h[None]))
        return (memory, x, Vp, recent), model.observe(x, Vp, recent)

    memory = settle(model, past, past_step[:, None])
    first = at_first(model, inertia, memory, X[0], V[0], past[-1], voltage[:1], step[:1])
    start = (memory, X[0], V[0], first)
    before = jnp.concatenate([past[-1:], u[:-1]])
    xs = (jnp.arange(len(u)), X[:-1], V[:-1], u, before, voltage, step)
    return jax.lax.scan(body, start, xs)[1]


def forecast(
    model: Extended, data: Data, every: int, rest: Learned | None = None
) -> tuple[Float[np.ndarray, "N 7 R"], Float[np.ndarray, "N 6 R"]]:
    """Poses and twists as they would be recorded at steps 1 … N.

    Windows start at steps 0, `every`, 2 `every`, … from the record there; actuator states continue
    from window to window. `rest` is added to the model's acceleration.
    """
    X, V = _forecast(model, as_arrays(data), every, substeps(data.longest), rest)
    return np.asarray(X), np.asarray(V)
