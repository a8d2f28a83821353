"""Simulated measurements of a model with effects under recorded thruster commands.

A window of a recording is compared with them: the motion starts from the measured state, includes
the memory of commands before the window, and is returned as instruments would measure it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .extended import Extended
from .recent import Recent
from .stepping import advanced


class Commands(NamedTuple):
    """Thruster commands in a window and before it.

    Attributes:
        level: mean force along each thruster's axis (N) in a step.
        voltage: voltage of the battery, relative to the nominal one.
        before: commands (N) of the steps before the window.
        V_before: recorded twists at the start of these steps.
        rise: change of the forces (N) over each step; None if they are held.
    """

    level: Float[Array | np.ndarray, "T n *batch"]
    voltage: Float[Array | np.ndarray, "T 1 *batch"]
    before: Float[Array | np.ndarray, "K n *batch"]
    V_before: Float[Array | np.ndarray, "K 6 *batch"]
    rise: Float[Array | np.ndarray, "T n *batch"] | None = None


def gaussians(model: Extended) -> int:
    """Unit Gaussians per substep of `simulate_recorded`: b dW, effects, coloured noise."""
    return model.noise_size + model.base.brownian_size - 6


def simulate_recorded(
    model: Extended,
    X_0: Float[Array, "7 *batch"],
    V_0: Float[Array, "6 *batch"],
    commands: Commands,
    dt: float,
    noise: Float[Array, "T S k *batch"] | None = None,
    substeps: int = 1,
) -> tuple[Float[Array, "T 7 *batch"], Float[Array, "T 6 *batch"]]:
    """Measured states at dt, 2 dt, … from the measured state at 0.

    `noise` holds `gaussians` unit Gaussians for each of S substeps; without it the motion is that
    of the drift, in `substeps`. `model` must come from `for_steps_of(dt)`. For delayed instruments
    the twist is linear between steps.
    """
    count = substeps if noise is None else noise.shape[1]
    commands = jax.tree.map(jnp.asarray, commands)
    memory, random = model.simulation_state(commands.before[0])
    memory = _after(model, memory, commands, dt)
    X, V, recent = X_0, V_0, None
    if model.reads:
        recent = _beginning(model, memory, X_0, V_0, commands, dt)
        X, V = model.infer(X_0, V_0, recent)
    lasting = None
    if noise is not None and model.base.brownian_size > 6:
        w = noise[:, :, model.noise_size :]
        path = model.lasting_push(w.reshape(-1, *w.shape[2:]), dt / count)
        lasting = path.reshape(*w.shape[:2], *path.shape[1:])

    def advance(carry: Any, given: Any) -> Any:
        carried, X, V, recent = carry
        level, voltage, rise, w, extra, number = given
        pushes = [jnp.zeros_like(V)] * count if extra is None else list(extra)
        w = None if w is None else list(w)
        carried, X1, V1 = advanced(
            model, carried, X, V, level, voltage, pushes, w, dt, number > 0, rise=rise
        )  # fmt: skip
        seen = X1, V1
        if recent is not None:
            rates = jnp.concatenate([(V1 - V) / dt, jnp.zeros_like(V)])
            recent = recent.after(Recent.over(V, V1, rates, dt))
            seen = model.observe(X1, V1, recent)
        return (carried, X1, V1, recent), seen

    numbers = jnp.arange(len(commands.level))
    xs = (commands.level, commands.voltage, commands.rise, noise, lasting, numbers)
    start = ((memory, random), X, V, recent)
    return jax.lax.scan(jax.checkpoint(advance), start, xs)[1]


def actuated(
    model: Extended, commands: Commands, dt: float, substeps: int
) -> Float[Array, "T n *batch S"]:
    """Thruster forces (N) with lag and delay: means over the substeps of each step of `dt` s.

    `model` must come from `for_steps_of(dt)`.
    """
    commands = jax.tree.map(jnp.asarray, commands)
    memory = _after(model, model.remember(commands.before[0]), commands, dt)

    def step(memory: Any, given: tuple[Array, Array | None]) -> tuple[Any, Array]:
        level, rise = given
        return model.actuate(memory, level, dt, substeps, rise)

    given: Any = (commands.level, commands.rise)
    return jax.lax.scan(step, memory, given)[1]


def _after(model: Extended, memory: Any, commands: Commands, dt: float) -> Any:
    """Memories after the steps before the window."""
    if not memory:
        return memory

    def step(memory: Any, given: tuple[Array, Array]) -> tuple[Any, None]:
        command, V = given
        return model.feel(model.actuate(memory, command, dt, 1)[0], V, dt)[0], None

    before: Any = (commands.before, commands.V_before)
    return jax.lax.scan(step, memory, before)[0]


def _beginning(
    model: Extended, memory: Any, X: Array, V: Array, commands: Commands, dt: float
) -> Recent:
    """Twist history at the window's start: constant acceleration under the command before it."""
    level = model.actuate(memory, commands.before[-1], dt, 1)[1][..., 0]
    F = model.push(level, X, V, commands.voltage[0])
    return Recent.steady(model.body.acceleration(X, V, F), dt)
