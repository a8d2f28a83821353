"""One training step, compiled once: gradient, clipping, Adam, and the check that all is finite."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, UInt

from ..models.dynamics import Dynamics
from .config import TrainingConfig
from .objective import Batch, Objective

QUICK_COMPILE = {"xla_backend_optimization_level": 1}
"""A third less time to compile and equal speed on a CPU (18.1 to 12.5 s, 74 and 76 ms a step)."""


class Report(NamedTuple):
    """What one step tells; `ok` is false where anything was not finite and nothing was changed."""

    ok: Bool[Array, ""]
    loss: Float[Array, ""]
    parts: dict[str, Float[Array, ""]]
    gradient_norm: Float[Array, ""]


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number of every array of a tree is finite."""
    leaves = [jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves(tree) if eqx.is_inexact_array(a)]
    return jnp.all(jnp.stack(leaves)) if leaves else jnp.asarray(True)


def optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """Gradient clipping and Adam's direction; the rate is an argument of each step."""
    clip = optax.clip_by_global_norm(config.clip) if config.clip > 0 else optax.identity()
    return optax.chain(clip, optax.scale_by_adam())


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Linear warm-up, then constant or cosine to 1 % of the peak at the last step."""
    if step < config.warm_up:
        return config.learning_rate * (step + 1) / config.warm_up
    if config.schedule == "constant":
        return config.learning_rate
    done = (step - config.warm_up) / max(1, config.steps - config.warm_up)
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))


def partition(model: Dynamics) -> tuple[Any, Any]:
    """Split a model into what is trained and the rest.

    A model may say so itself (`trainable`, as `Spinn` does); else all inexact arrays are trained.
    """
    trainable = getattr(model, "trainable", None)
    return eqx.partition(model, eqx.is_inexact_array if trainable is None else trainable())


def head_weights(params: Any) -> Any:
    """A tree with one number a leaf: 1 for weights of networks' output layers, else 0."""
    paths, treedef = jax.tree_util.tree_flatten_with_path(params)
    chosen = [float("head" in (n := jax.tree_util.keystr(p)) and "weight" in n) for p, _ in paths]
    return jax.tree.unflatten(treedef, chosen)


class TrainStep:
    """The compiled step of one model structure and one objective.

    `traces` counts how often Python was traced: 1 after the first call and ever after.
    """

    def __init__(self, config: TrainingConfig, params: Any, static: Any):
        self.optimizer = optimizer(config)
        decay = jax.tree.map(lambda w: config.head_decay * w, head_weights(params))
        self.traces = 0
        transformation = self.optimizer

        def step(
            params: Any,
            moments: Any,
            objective: Objective,
            data: Batch,
            indices: Int[Array, " B"],
            seed: UInt[Array, ""],
            number: UInt[Array, ""],
            rate: Float[Array, ""],
        ) -> tuple[Any, Any, Report]:
            self.traces += 1
            key = jax.random.fold_in(jax.random.key(seed), number)
            batch = Batch(*(a[:, :, indices] for a in data))

            def loss(p: Any) -> tuple[Array, dict[str, Array]]:
                return objective.loss(eqx.combine(p, static), batch, key)

            (value, parts), gradient = jax.value_and_grad(loss, has_aux=True)(params)
            with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 and float
                direction, new_moments = transformation.update(gradient, moments, params)
            new = jax.tree.map(
                lambda p, d, w: p - rate.astype(p.dtype) * (d + w * p), params, direction, decay
            )
            ok = jnp.isfinite(value) & all_finite(gradient) & all_finite(new)

            def keep(fresh: Array, old: Array) -> Array:
                return jnp.where(ok, fresh, old)

            return (
                jax.tree.map(keep, new, params),
                jax.tree.map(keep, new_moments, moments),
                Report(ok, value, parts, optax.tree.norm(gradient)),
            )

        self._step = jax.jit(step, donate_argnums=(0, 1), compiler_options=QUICK_COMPILE)

    def __call__(
        self,
        params: Any,
        moments: Any,
        objective: Objective,
        data: Batch,
        indices: np.ndarray,
        seed: int,
        number: int,
        rate: float,
    ) -> tuple[Any, Any, Report]:
        """Parameters and moments after one step (unchanged if not `ok`), and the report.

        `params` and `moments` are donated: use the returned ones.
        """
        return self._step(
            params,
            moments,
            objective,
            data,
            jnp.asarray(indices, jnp.int32),
            jnp.asarray(seed, jnp.uint32),
            jnp.asarray(number, jnp.uint32),
            jnp.asarray(rate, jnp.float32),
        )


def batch_indices(seed: int, number: int, batch: int, usable: np.ndarray) -> np.ndarray:
    """Indices of the windows of one step: consecutive pieces of endless shuffles of all of them.

    A function of its arguments alone, so a resumed run draws what it would have drawn.
    """
    count = usable.size
    positions = np.arange(number * batch, (number + 1) * batch)
    chosen = np.empty(batch, int)
    for epoch in range(int(positions[0] // count), int(positions[-1] // count) + 1):
        order = np.random.default_rng([seed, epoch]).permutation(count)
        here = positions // count == epoch
        chosen[here] = order[positions[here] % count]
    return usable[chosen]
