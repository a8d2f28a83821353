"""Samples of a model's conditional law for each window."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float, Int

from ..models.dynamics import Dynamics
from ..models.effects.extended import Extended
from ..models.effects.recorded_rollout import Commands, gaussians, simulate_recorded
from ..models.integrate import over_substeps, rollout


def predict(
    model: Dynamics,
    X_0: Float[Array, "7 W"],
    V_0: Float[Array, "6 W"],
    F: Float[Array, "T 6 W"],
    dt: float,
    key: Array,
    samples: int,
    *,
    substeps: int = 1,
    with_path_of_drift: bool = False,
    place: Int[Array, " W"] | None = None,
    commands: Commands | None = None,
    spread: Float[Array, "6 6 W"] | None = None,
    rise: Float[Array, "T 6 W"] | None = None,
) -> tuple[Float[Array, "T 7 P W"], Float[Array, "T 6 P W"]]:
    """Draw `samples` motions from each window's initial state and commands, at t_1 … t_T.

    `with_path_of_drift` appends the noise-free motion as one more sample. Increments depend on
    `key` and the windows' places (0, 1 … W - 1 by default). A model with effects takes the
    thrusters' `commands`, if given, and returns simulated measurements (`simulate_recorded`).
    With `spread`, L, the samples' first twists are drawn with the covariance L Lᵀ about `V_0`.
    Wrenches are held for a step, or have the mean `F` and change by `rise` over it.
    """
    T, _, W = F.shape
    count = samples + with_path_of_drift
    place = jnp.arange(W) if place is None else place

    # one axis for windows and samples: inner loops over it are long for any W and P
    def flat(a: Array) -> Array:
        a = jnp.broadcast_to(a[..., None], (*a.shape, count))
        return a.reshape(*a.shape[:-2], W * count)

    def drawn(steps: int, parts: int, components: int) -> Array:
        w = normal_by_window(key, place, (steps, parts, components), samples, F.dtype)
        if with_path_of_drift:
            w = jnp.concatenate([w, jnp.zeros((*w.shape[:4], 1), F.dtype)], axis=4)
        return w.reshape(steps, parts, components, W * count)

    start = flat(V_0)
    if spread is not None:
        w = normal_by_window(jax.random.fold_in(key, 1), place, (6,), samples, F.dtype)
        w = jnp.einsum("ijw,jwp->iwp", spread, w)
        if with_path_of_drift:
            w = jnp.concatenate([w, jnp.zeros((6, W, 1), F.dtype)], axis=2)
        start = start + w.reshape(6, W * count)
    if isinstance(model, Extended) and commands is not None:
        w = drawn(T, substeps, gaussians(model))
        Xs, Vs = simulate_recorded(
            model, flat(X_0), start, jax.tree.map(flat, commands), dt, w, substeps
        )
        return _by_sample(Xs, W), _by_sample(Vs, W)
    # substeps become steps, so that one step is compiled for any number of them
    dt = dt / substeps
    dW = jnp.asarray(dt**0.5, F.dtype) * drawn(T * substeps, 1, model.brownian_size)
    Xs, Vs = rollout(model, flat(X_0), start, flat(in_substeps(F, rise, substeps)), dt, dW)
    return _by_sample(Xs[substeps - 1 :: substeps], W), _by_sample(Vs[substeps - 1 :: substeps], W)


def normal_by_window(
    key: Array, place: Int[Array, " W"], shape: tuple[int, ...], samples: int, dtype: DTypeLike
) -> Float[Array, "*shape W P"]:
    """Standard normal numbers; those of a window depend on `key` and its place alone."""

    def draw(number: Array) -> Array:
        return jax.random.normal(jax.random.fold_in(key, number), (*shape, samples), dtype)

    return jax.vmap(draw, out_axes=len(shape))(place)


def _by_sample(a: Float[Array, "T C WP"], windows: int) -> Float[Array, "T C P W"]:
    return jnp.swapaxes(a.reshape(*a.shape[:2], windows, -1), 2, 3)


def predict_drift(
    model: Dynamics,
    X_0: Float[Array, "7 W"],
    V_0: Float[Array, "6 W"],
    F: Float[Array, "T 6 W"],
    dt: float,
    *,
    substeps: int = 1,
    commands: Commands | None = None,
    rise: Float[Array, "T 6 W"] | None = None,
) -> tuple[Float[Array, "T 7 W"], Float[Array, "T 6 W"]]:
    """The noise-free motion of each window at t_1 … t_T; `commands`, `rise` as in `predict`."""
    if isinstance(model, Extended) and commands is not None:
        return simulate_recorded(model, X_0, V_0, commands, dt, substeps=substeps)
    Xs, Vs = rollout(model, X_0, V_0, in_substeps(F, rise, substeps), dt / substeps)
    return Xs[substeps - 1 :: substeps], Vs[substeps - 1 :: substeps]


def in_substeps(
    F: Float[Array, "T 6 W"], rise: Float[Array, "T 6 W"] | None, substeps: int
) -> Float[Array, "N 6 W"]:
    """The wrenches of T steps, each as those of its substeps (`over_substeps`)."""
    return jnp.moveaxis(over_substeps(F, rise, substeps), -1, 1).reshape(-1, *F.shape[1:])
