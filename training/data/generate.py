"""Simulated data: maneuvers under noise and disturbances, as a `Recording`."""

from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.config.checks import SECONDS, SEED, Vector6, Within, check_numbers, require
from ...models.disturbances.base import Disturbance
from ...models.dynamics import Dynamics, Flow
from ...models.integrate import step
from ...models.lasting import lasting_wrench
from ...models.recordings.build import Trajectory
from ...models.recordings.store import Recording
from ...models.vehicles.vehicle import Vehicle
from .maneuvers import MANEUVERS, maneuver_wrench


@dataclass(frozen=True)
class GenerateConfig:
    """Simulation settings; the defaults are the paper's sparse regime.

    Example:
        >>> GenerateConfig(maneuvers=("surge-forward", "yaw-left"), seed=2).trajectories
        20
    """

    maneuvers: tuple[str, ...] = tuple(MANEUVERS)
    trajectories: Annotated[int, Within(1, 100_000)] = 20
    """Trajectories of each maneuver."""
    duration: Annotated[float, SECONDS] = 10.0
    """Seconds of each trajectory."""
    rate: Annotated[float, Within(0.1, 1000)] = 20.0
    """Sampling rate (Hz)."""
    substeps: Annotated[int, Within(1, 1000)] = 10
    """Integration steps per sample."""
    effort: Annotated[float, Within(0, 1, above=True)] = 0.3
    """Share of the largest wrench in each maneuver's direction."""
    diffusion: Annotated[Vector6, Within(0, 1e6)] = (2.0, 2.0, 2.0, 0.2, 0.2, 0.2)
    """Diffusion b of the simulated vehicle (N√s, N·m√s), unless the given model has its own."""
    depth: Annotated[float, Within(0, 11_000)] = 5.0
    """Depth of the start (m)."""
    start_spread: Annotated[Vector6, Within(0, 100)] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Standard deviation of the twist at the start (m/s, rad/s)."""
    seed: Annotated[int, SEED] = 0
    """Seed of all noise."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(len(self.maneuvers) > 0, self, "maneuvers", "give at least one")


def generate(
    config: GenerateConfig,
    vehicle: Vehicle,
    disturbances: tuple[Disturbance, ...] = (),
    dynamics: Dynamics | None = None,
) -> Recording:
    """Simulate every maneuver `trajectories` times from rest, under noise and disturbances.

    The vehicle is `dynamics`, with the lasting wrench of a learned model, or the preset with the
    configured diffusion. Thruster limits apply;
    there is no lag. All trajectories run as one batch with independent noise; equal seeds give
    equal recordings.

    Raises:
        UserError: a maneuver is unknown.
        ValueError: the simulated motion is not finite.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> generate(GenerateConfig(trajectories=1, duration=4.0), vehicle).duration
        40.0
    """
    dtype = jnp.result_type(float)
    if dynamics is None:
        dynamics = vehicle.dynamics(np.asarray(config.diffusion), dtype)
    disturbances = (*disturbances, *lasting_wrench(dynamics))
    thrusters = vehicle.thrusters(dtype)
    commands = [maneuver_wrench(name, thrusters, config.effort) for name in config.maneuvers]
    K = config.trajectories
    F = jnp.asarray(np.repeat(np.stack([c[0] for c in commands], axis=1), K, axis=1), dtype)
    T = round(config.duration * config.rate)
    start_key, key = jax.random.split(jax.random.key(config.seed))
    spread = jnp.asarray(config.start_spread, dtype)[:, None]
    V_0 = spread * jax.random.normal(start_key, F.shape, dtype)
    X, V = _simulate(dynamics, disturbances, config, V_0, F, T, key)
    if not np.isfinite(X).all() or not np.isfinite(V).all():
        raise ValueError("the simulated motion is not finite; use more substeps or less effort")
    trajectories = []
    for j, name in enumerate(config.maneuvers):
        wrench, forces = (np.tile(c, (T + 1, 1)) for c in commands[j])
        for k in range(K):
            column = j * K + k
            trajectories.append(
                Trajectory(
                    name,
                    X[:, :, column],
                    V[:, :, column],
                    {"F_Bo_B": wrench, "thruster_force": forces},
                )
            )
    kinds = ", ".join(type(d).__name__ for d in disturbances) or "none"
    return Recording.from_trajectories(
        trajectories,
        1 / config.rate,
        vehicle=vehicle.name,
        source=f"simulated: {type(dynamics).__name__}, disturbances: {kinds}, seed {config.seed}",
    )


def _simulate(
    dynamics: Dynamics,
    disturbances: tuple[Disturbance, ...],
    config: GenerateConfig,
    V_0: Float[Array, "6 W"],
    F: Float[Array, "6 W"],
    T: int,
    key: Array,
) -> tuple[Float[np.ndarray, "N 7 W"], Float[np.ndarray, "N 6 W"]]:
    """Poses and twists at t_0 … t_T; disturbances advance with every integration step."""
    h = 1 / config.rate / config.substeps
    W, dtype = F.shape[1], F.dtype
    X_0 = jnp.zeros((7, W), dtype).at[0].set(1).at[6].set(-config.depth)
    key, start_key = jax.random.split(key)
    states = tuple(
        d.initial(jax.random.normal(k, (d.initial_noise_size, W), dtype))
        for d, k in zip(disturbances, jax.random.split(start_key, len(disturbances)), strict=True)
    )

    def substep(carry: Any, number: Array) -> Any:
        X, V, states = carry
        t = number.astype(dtype) * jnp.asarray(h, dtype)
        keys = jax.random.split(jax.random.fold_in(key, number), 1 + len(disturbances))
        dW = jnp.asarray(h**0.5, dtype) * jax.random.normal(keys[0], (6, W), dtype)
        total, flow, moved = F, None, []
        for d, state, k in zip(disturbances, states, keys[1:], strict=True):
            w = jax.random.normal(k, (d.noise_size, W), dtype)
            state = d.advance(state, X, V, t, jnp.asarray(h, dtype), w)
            moved.append(state)
            total = total + d.wrench(state, X, V, t)
            own = d.flow(state, X, t)
            flow = own if flow is None else Flow(flow[0] + own[0], flow[1] + own[1])
        X, V = step(dynamics, X, V, total, h, dW, flow)
        return (X, V, tuple(moved)), None

    def sample(carry: Any, n: Array) -> Any:
        numbers = n * config.substeps + jnp.arange(config.substeps, dtype=jnp.int32)
        carry, _ = jax.lax.scan(substep, carry, numbers)
        return carry, carry[:2]

    run = jax.jit(lambda carry: jax.lax.scan(sample, carry, jnp.arange(T, dtype=jnp.int32))[1])
    X, V = run((X_0, V_0, states))
    return np.asarray(jnp.concatenate([X_0[None], X])), np.asarray(jnp.concatenate([V_0[None], V]))
