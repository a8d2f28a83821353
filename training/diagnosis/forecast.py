"""What a model forecasts of recorded runs, window by window, without noise."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.effects.extended import Extended
from ...models.effects.predict import advance
from .data import Data
from .innovations import Arrays, as_arrays, settle, substeps


@eqx.filter_jit
def _forecast(model: Extended, arrays: Arrays, every: int, dt: float) -> tuple[Array, Array]:
    X, V, u, voltage = arrays
    inertia = model.inertia()

    def body(carry: Any, given: Any) -> Any:
        memory, x, v, rate = carry
        n, X0, V0, command, volts = given
        fresh = model.infer(X0, V0, rate)
        starts = n % every == 0
        x, v = (jnp.where(starts, a, b) for a, b in zip(fresh, (x, v), strict=True))
        memory, x, v, a = advance(
            model, inertia, memory, x, v, command, dt, substeps(dt), volts[None]
        )
        return (memory, x, v, a), model.observe(x, v, a)

    start = (settle(model, u[0], dt, substeps(dt)), X[0], V[0], (V[1] - V[0]) / dt)
    xs = (jnp.arange(len(u)), X[:-1], V[:-1], u, voltage)
    return jax.lax.scan(body, start, xs)[1]


def forecast(
    model: Extended, data: Data, every: int
) -> tuple[Float[np.ndarray, "N 7 R"], Float[np.ndarray, "N 6 R"]]:
    """Poses and twists as they would be recorded at steps 1 … N.

    Windows start at steps 0, `every`, 2 `every`, … from the record there; what the actuators
    remember goes on from window to window.
    """
    X, V = _forecast(model, as_arrays(data), every, data.dt)
    return np.asarray(X), np.asarray(V)
