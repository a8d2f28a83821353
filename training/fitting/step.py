"""One training step, compiled once: gradient, clipping, Adam, and the check for finite numbers."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array, Bool, Float, Int, UInt

from ...models.dynamics import Dynamics
from ..compile_options import QUICK_COMPILE
from ..config import TrainingConfig
from ..losses.base import Batch, Objective

_WINDOWS = "windows"  # the mesh's axis


class Report(NamedTuple):
    """Results of one step; `ok` is false if anything was not finite and nothing was changed."""

    ok: Bool[Array, ""]
    loss: Float[Array, ""]
    parts: dict[str, Float[Array, ""]]
    gradient_norm: Float[Array, ""]


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number of every array of a tree is finite."""
    leaves = [jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves(tree) if eqx.is_inexact_array(a)]
    return jnp.all(jnp.stack(leaves)) if leaves else jnp.asarray(True)


def optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """Gradient clipping and Adam's direction for one vector; the rate is an argument of a step."""
    clip = optax.clip_by_global_norm(config.clip) if config.clip > 0 else optax.identity()
    return optax.chain(clip, optax.scale_by_adam())


def first_moments(config: TrainingConfig, params: Any) -> optax.OptState:
    """Adam's moments before the first step: one vector each for all parameters."""
    return optimizer(config).init(ravel_pytree(params)[0])


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Linear warm-up, then constant or cosine to 1 % of the peak at the last step."""
    if step < config.warm_up:
        return config.learning_rate * (step + 1) / config.warm_up
    if config.schedule == "constant":
        return config.learning_rate
    done = (step - config.warm_up) / max(1, config.steps - config.warm_up)
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))


def partition(model: Dynamics) -> tuple[Any, Any]:
    """Split a model into trained arrays and the rest.

    A model may define them (`trainable`, as `Spinn` does); else all inexact arrays are trained.
    """
    trainable = getattr(model, "trainable", None)
    return eqx.partition(model, eqx.is_inexact_array if trainable is None else trainable())


def head_weights(params: Any) -> Any:
    """A tree with one number per leaf: 1 for weights of networks' output layers, else 0."""
    paths, treedef = jax.tree_util.tree_flatten_with_path(params)
    chosen = [float("head" in (n := jax.tree_util.keystr(p)) and "weight" in n) for p, _ in paths]
    return jax.tree.unflatten(treedef, chosen)


class TrainStep:
    """The compiled step of one kind of model and one objective, over some of JAX's devices.

    `static` is the model without its parameters; its arrays are arguments of the program, so that
    models which differ only in numbers share a compiled one. `traces` counts the traces of the
    Python code: 1 from the first call on.
    """

    def __init__(self, config: TrainingConfig, params: Any, static: Any, devices: int = 1):
        self.traces = 0
        self._frozen, structure = eqx.partition(static, eqx.is_array)
        update = _update(config, params, structure, devices)

        def step(
            params: Any,
            moments: Any,
            frozen: Any,
            objective: Objective,
            data: Batch,
            indices: Int[Array, " B"],
            seed: UInt[Array, ""],
            number: UInt[Array, ""],
            rate: Float[Array, ""],
        ) -> tuple[Any, Any, Report]:
            self.traces += 1
            batch = data.take(indices)
            return update(frozen, params, moments, objective, batch, seed, number, rate)

        self._devices = devices
        self._placed: dict[str, tuple[Any, Any]] = {}
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
        numbers = _numbers(indices, seed, number, rate)
        given, numbers = on_all(((params, moments), numbers), self._devices)
        shared = {"frozen": self._frozen, "objective": objective, "data": data}
        for name, tree in shared.items():
            if name not in self._placed or self._placed[name][0] is not tree:
                self._placed[name] = tree, on_all(tree, self._devices)
            shared[name] = self._placed[name][1]
        return self._step(*given, *shared.values(), *numbers)


class EnsembleStep:
    """One step of several independent runs (seeds of a method), in one batch.

    `statics` are as for `TrainStep`, one per run, and equal except for their arrays.
    """

    def __init__(self, config: TrainingConfig, params: Any, statics: Sequence[Any]):
        self.traces = 0
        frozen, structures = zip(*(eqx.partition(s, eqx.is_array) for s in statics), strict=True)
        if any(structure != structures[0] for structure in structures[1:]):
            raise ValueError("models: their structures differ; train them one by one")
        self._frozen = jax.tree.map(lambda *leaves: jnp.stack(leaves), *frozen)
        update = _update(config, params, structures[0])

        def step(frozen: Any, runs: list[tuple]) -> list[tuple[Any, Any, Report]]:
            self.traces += 1
            inputs = [(*run[:3], run[3].take(run[4]), *run[5:]) for run in runs]
            together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *inputs)
            done = jax.vmap(update)(frozen, *together)
            return [jax.tree.map(lambda a, i=i: a[i], done) for i in range(len(runs))]

        self._step = jax.jit(step, compiler_options=QUICK_COMPILE)

    def __call__(self, runs: list[tuple]) -> list[tuple[Any, Any, Report]]:
        """The results of `TrainStep` for each run's arguments."""
        return self._step(self._frozen, [(*run[:4], *_numbers(*run[4:])) for run in runs])


def _numbers(indices: np.ndarray, seed: int, number: int, rate: float) -> tuple[Array, ...]:
    return (
        jnp.asarray(indices, jnp.int32),
        jnp.asarray(seed, jnp.uint32),
        jnp.asarray(number, jnp.uint32),
        jnp.asarray(rate, jnp.float32),
    )


def _update(
    config: TrainingConfig, params: Any, structure: Any, devices: int = 1
) -> Callable[..., tuple[Any, Any, Report]]:
    """The function of a step: loss, gradient, Adam, decay; no update if anything is not finite.

    From the gradient on all parameters are one vector: a few operations instead of a dozen for
    each array of the networks.
    """
    transformation = optimizer(config)

    def of_part(batch: Batch, params: Any, frozen: Any, objective: Objective, key: Array) -> Any:
        def loss(p: Any) -> tuple[Array, dict[str, Array]]:
            return objective.loss(eqx.combine(p, frozen, structure), batch, key)

        value, gradient = jax.value_and_grad(loss, has_aux=True)(params)
        return value, ravel_pytree(gradient)[0]

    of_batch = mean_over_devices(of_part, devices)
    decays = jax.tree.map(
        lambda w, p: np.full(p.shape, config.head_decay * w, p.dtype), head_weights(params), params
    )
    decay = np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(decays)])

    def update(
        frozen: Any,
        params: Any,
        moments: Any,
        objective: Objective,
        batch: Batch,
        seed: UInt[Array, ""],
        number: UInt[Array, ""],
        rate: Float[Array, ""],
    ) -> tuple[Any, Any, Report]:
        key = jax.random.fold_in(jax.random.key(seed), number)
        (value, parts), gradient = of_batch(batch, params, frozen, objective, key)
        old, unravel = ravel_pytree(params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 and float
            direction, new_moments = transformation.update(gradient, moments, old)
        new = old - rate.astype(old.dtype) * (direction + decay * old)
        ok = jnp.isfinite(value) & jnp.isfinite(gradient).all() & jnp.isfinite(new).all()

        def keep(fresh: Array, old: Array) -> Array:
            return jnp.where(ok, fresh, old)

        return (
            unravel(keep(new, old)),
            jax.tree.map(keep, new_moments, moments),
            Report(ok, value, parts, optax.tree.norm(gradient)),
        )

    return update


def mean_over_devices(of_part: Callable[..., Any], devices: int) -> Callable[..., Any]:
    """`of_part(batch, *whole)` of equal parts of the batch's windows, one per device, averaged.

    Each device differentiates its own part and they communicate once, for the mean. (The compiler's
    own partitioning communicates at every integration step, which is slower than one device.)
    """
    if devices == 1:
        return of_part

    def here(batch: Batch, whole: tuple[Any, ...]) -> Any:
        return jax.lax.pmean(of_part(batch, *whole), _WINDOWS)

    share = Spec(None, None, _WINDOWS)
    parts = Batch(share, share, share, Spec(_WINDOWS), share, share, share)  # pyright: ignore[reportArgumentType]
    mean = jax.shard_map(
        here, mesh=_mesh(devices), in_specs=(parts, Spec()), out_specs=Spec(), check_vma=False
    )
    return lambda batch, *whole: mean(batch, whole)


def on_all(arrays: Any, devices: int) -> Any:
    """A tree of arrays replicated on `devices`, as the programs for several devices return them.

    Arrays with another placement would make a program compile again.
    """
    if devices == 1:
        return arrays
    return jax.device_put(arrays, NamedSharding(_mesh(devices), Spec()))


def _mesh(devices: int) -> Mesh:
    return jax.make_mesh((devices,), (_WINDOWS,), axis_types=(AxisType.Auto,))


def usable_devices(objective: Objective, windows: int) -> int:
    """Number of JAX's devices that can share a batch of `windows`, whole groups each."""
    if not objective.mean_of_windows:
        return 1
    groups = max(1, windows // objective.group_size())
    return max(n for n in range(1, len(jax.devices()) + 1) if groups % n == 0)
