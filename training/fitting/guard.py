"""Explanation of steps that are not finite."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ...models.dynamics import Dynamics
from ..data.windows import Windows
from ..losses.base import Batch, Objective
from ..predict import predict_drift

_FEW = 0.25
"""Share of the windows below which those that run away are at fault, instead of the model."""


class TrainingError(RuntimeError):
    """Training can't go on; the last good state is kept in the run folder."""


@dataclass(frozen=True)
class Diagnosis:
    """Location of non-finite numbers: windows (by index), parameters or gradients (by name)."""

    windows: tuple[int, ...]
    data: tuple[int, ...]
    """Those of `windows` whose own data are not finite."""
    leaves: tuple[str, ...]
    text: str


def leaf_names(tree: Any) -> list[str]:
    """Readable paths of a tree's inexact arrays, in order: `hidden.weights[0]`."""
    paths = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_inexact_array))[0]
    return [jax.tree_util.keystr(path).lstrip(".") for path, _ in paths]


def not_finite(tree: Any) -> tuple[str, ...]:
    """Paths of the arrays that hold a number that is not finite."""
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))
    names = leaf_names(tree)
    return tuple(
        name
        for name, leaf in zip(names, leaves, strict=True)
        if not np.isfinite(np.asarray(leaf)).all()
    )


def explain_non_finite(
    model: Dynamics,
    objective: Objective,
    windows: Windows,
    indices: np.ndarray,
    key: jax.Array,
    dt: float,
) -> Diagnosis:
    """Find why the step over the windows `indices` is not finite.

    Checked in turn: parameters, the windows' data, the noise-free motion (with the time at which it
    becomes non-finite), and each window's loss and gradient.
    """
    if broken := not_finite(model):
        return Diagnosis((), (), broken, f"parameter {_list(broken)} is not finite")
    batch = windows.take(np.unique(indices))
    ids = np.unique(indices)
    bad = [i for i in range(ids.size) if not _finite(batch, i)]
    if bad:
        named = "; ".join(f"{batch.label(i)} ({_where(batch, i)})" for i in bad)
        found = tuple(int(ids[i]) for i in bad)
        return Diagnosis(found, found, (), f"data not finite in {named}")
    lost, when = runaways(model, batch, dt)
    if lost.size:
        named = "; ".join(
            f"{batch.label(int(i))} (after {t:.2f} s)" for i, t in zip(lost, when, strict=True)
        )
        return Diagnosis(tuple(int(ids[i]) for i in lost), (), (), f"motion runs away in {named}")
    return _one_by_one(model, objective, windows, indices, key)


def runaways(model: Dynamics, windows: Windows, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Windows whose noise-free motion is not finite, and after how many seconds it is not."""
    arrays = Batch.of(windows)
    X, V = eqx.filter_jit(predict_drift)(
        model, arrays.X[0], arrays.V[0], arrays.F, dt, rise=arrays.rise
    )  # fmt: skip
    state = np.concatenate([np.asarray(X), np.asarray(V)], axis=1)
    finite: np.ndarray = np.asarray(np.isfinite(state).all(axis=1))
    lost = np.flatnonzero(~finite.all(0))
    return lost, dt * (1 + np.argmin(finite[:, lost], axis=0))


def few_running_away(
    model: Dynamics, windows: Windows, excluded: Sequence[int], found: Diagnosis
) -> tuple[int, ...]:
    """All windows that run away, if those of a step do and they are few; else none.

    A model that runs away in many windows is at fault itself. `excluded` windows don't count.
    """
    if not found.windows or found.leaves:
        return ()
    usable = np.setdiff1d(np.arange(len(windows)), excluded)
    lost, _ = runaways(model, windows.take(usable), windows.dt)
    faulty = {*found.windows, *usable[lost].tolist()}
    return tuple(sorted(faulty)) if len(faulty) < _FEW * usable.size else ()


def _one_by_one(
    model: Dynamics, objective: Objective, windows: Windows, indices: np.ndarray, key: jax.Array
) -> Diagnosis:
    """Check each window's loss and gradient, or each group's."""

    @eqx.filter_jit
    def value_and_gradient(model: Dynamics, one: Batch) -> Any:
        return eqx.filter_value_and_grad(lambda m: objective.loss(m, one, key)[0])(model)

    found, leaves = [], []
    size = objective.group_size()
    alone = np.unique(indices)[:, None] if size == 1 else indices.reshape(-1, size)
    for group in alone:
        value, gradient = value_and_gradient(model, Batch.of(windows.take(group)))
        names = not_finite(gradient)
        if not np.isfinite(float(value)) or names:
            found.extend(int(i) for i in group)
            leaves.extend(names)
    unique = tuple(dict.fromkeys(leaves))
    if not found:
        return Diagnosis(
            (), (), (), "loss or update not finite, though no window alone is at fault"
        )
    found = list(dict.fromkeys(found))
    named = "; ".join(windows.label(i) for i in found)
    what = f"gradient of {_list(unique)}" if unique else "loss"
    return Diagnosis(tuple(found), (), unique, f"{what} not finite in {named}")


def _finite(windows: Windows, i: int) -> bool:
    return all(np.isfinite(a[..., i]).all() for a in (windows.X, windows.V, windows.F))


def _where(windows: Windows, i: int) -> str:
    for name, a in (("X_WB", windows.X), ("V_WB_B", windows.V), ("F_Bo_B", windows.F)):
        rows = np.flatnonzero(~np.isfinite(a[..., i]).all(axis=1))
        if rows.size:
            return f"{name} at {windows.dt * rows[0]:.2f} s"
    return "nowhere"


def _list(names: tuple[str, ...]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
