"""Runs of the true vehicle, all at once: RK4 between two halves of the noise.

Within an inner step h commands and random processes are constant; half of the white impulse b ΔW
is given before and half after one step of RK4 (Strang's splitting), each by Stratonovich's Heun
where b depends on speed. Commands are held from sample to sample; before the first they are zero.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from .effect import Effect, Latent
from .instruments import LEAD, observe, record
from .plant import Plant, delayed
from .vehicle import Vehicle

Controller = Callable[[float, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(time, X (7, k), V (6, k) as measured, numbers of these runs (k,)) → thrust (8, k)."""


@dataclass(frozen=True)
class Noise:
    """White wrench b (N√s, N·m√s) and standard deviations of what is measured.

    DVL 5 mm/s; gyro as the ICM-20602 at 20 Hz (7e-5 rad/s/√Hz and motion); attitude 0.1°;
    position 5 mm. Errors of an estimator have a memory (s): Gauss–Markov, of velocity and attitude.
    """

    diffusion: tuple[float, ...] = (1.0, 1.0, 1.0, 0.03, 0.03, 0.03)
    velocity: float = 0.005
    rate: float = 0.001
    attitude: float = 0.0017
    position: float = 0.005
    velocity_memory: float = 0.0
    attitude_memory: float = 0.0
    rate_filter: float = 0.0  # Hz of the two-pole low-pass in front of recorded rates; 0 for none

    @staticmethod
    def none() -> "Noise":
        return Noise((0.0,) * 6, 0.0, 0.0, 0.0, 0.0)

    def measured_only(self) -> "Noise":
        return Noise((0.0,) * 6, self.velocity, self.rate, self.attitude, self.position)


@dataclass(frozen=True)
class Setup:
    """What is done with the vehicle.

    Attributes:
        p0, q0, nu0: start states (3, B), (4, B), (6, B), at `LEAD` before the first sample.
        samples: inner step of each sample, (N, B), the first 0.
        commands: thrust commanded from sample to sample (N, 8, B); or a controller.
        voltage: (B,) open-circuit V of each run.
        h: inner step, s.
    """

    p0: np.ndarray
    q0: np.ndarray
    nu0: np.ndarray
    samples: np.ndarray
    commands: np.ndarray | Controller
    voltage: np.ndarray
    h: float = 0.005

    @property
    def batch(self) -> int:
        return self.p0.shape[1]


@dataclass
class Truth:
    """What happened and what was measured; (samples, component, B)."""

    t: np.ndarray  # (N, B)
    X: np.ndarray  # measured pose, 7
    V: np.ndarray  # measured twist, 6
    forces: np.ndarray  # commanded thrust, 8
    errors: np.ndarray  # of position, attitude, velocity and rate, 12
    voltage: np.ndarray  # (B,)
    X_true: np.ndarray
    V_true: np.ndarray
    states: np.ndarray = field(repr=False)  # (steps + 1, size, B) at inner steps, from -LEAD
    held: np.ndarray = field(repr=False)  # (steps + 1, 8, B) commands of inner steps
    latents: list[dict[int, Latent]] = field(default_factory=list, repr=False)  # of inner steps


def streams(seed: int | Sequence[int], name: int) -> np.random.Generator:
    """An own generator for each purpose, so that none disturbs another."""
    return np.random.default_rng([*np.atleast_1d(seed).tolist(), name])


def remembered(white: np.ndarray, memory: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Gauss–Markov errors of the same variance as white ones (N, k, B), at times t (N, B)."""
    found = white.copy()
    for n in range(1, len(t)):
        kept = np.exp(-(t[n] - t[n - 1]) / memory[:, None])
        found[n] = kept * found[n - 1] + np.sqrt(1 - kept**2) * white[n]
    return found


def simulate(
    setup: Setup,
    effects: Sequence[Effect] = (),
    noise: Noise | None = None,
    seed: int | Sequence[int] = 0,
    vehicle: Vehicle | None = None,
    dead_reckoned: bool = False,
) -> Truth:
    """Simulate all runs and measure them.

    The noise depends on `seed` alone: two simulations that differ in effects only meet the same.
    With `dead_reckoned` the measured position is the integral of measured attitude and velocity.
    """
    noise = noise or Noise()
    plant = Plant(vehicle or Vehicle(), effects)
    B, h, samples = setup.batch, setup.h, setup.samples
    N, lead = samples.shape[0], round(LEAD / h)
    steps = int(samples.max()) + lead
    own = [streams(seed, 100 + e.order * 50 + i) for i, e in enumerate(plant.effects)]
    latents = {i: e.draw_latent(B, own[i]) for i, e in enumerate(plant.effects)}
    white, instruments = streams(seed, 1), streams(seed, 2)
    sizes = (noise.position, noise.attitude, noise.velocity, noise.rate)
    errors = np.repeat(sizes, 3)[:, None] * instruments.standard_normal((N, 12, B))
    memory = np.repeat([0.0, noise.attitude_memory, noise.velocity_memory, 0.0], 3)
    errors[:, memory > 0] = remembered(errors[:, memory > 0], memory[memory > 0], samples * h)

    y = np.zeros((plant.size, B))
    y[:3], y[3:7], y[7:13] = setup.p0, setup.q0, setup.nu0
    states = np.empty((steps + 1, plant.size, B))
    states[0], past = y, [latents]
    n = plant.allocation.shape[1]
    held = np.zeros((steps + 1, n, B))  # commands, by inner step
    taken = np.zeros_like(held)  # and what drives take them for
    forces = np.zeros((N, n, B))
    current, index, run = np.zeros((n, B)), np.zeros(B, int), np.arange(B)
    b = np.array(noise.diffusion)[:, None]
    noisy = bool(np.any(b > 0))

    for i in range(steps):
        t = i * h - LEAD
        due = np.flatnonzero((index < N) & (samples[np.minimum(index, N - 1), run] == i - lead))
        if due.size:
            n = index[due]
            if callable(setup.commands):
                X, V = observe(states, h, i, due, errors[n, :, due].T, plant)
                wanted = setup.commands(t, X, V, due)
            else:
                wanted = setup.commands[n, :, due].T
            current = current.copy()
            current[:, due] = wanted
            forces[n, :, due] = wanted.T
            index[due] += 1
        held[i] = current
        taken[i] = plant.follow(taken[i - 1], current, h)
        u = delayed(taken, i, plant.delay, h)
        steady = plant.steady_thrust(u, setup.voltage, t)
        latents = {k: e.advance(latents[k], h, own[k]) for k, e in enumerate(plant.effects)}
        y = plant.knock(y, h, own)
        dW = np.sqrt(h / 2) * white.standard_normal((2, 6, B))
        if noisy:
            y = plant.kick(y, t, b, dW[0], latents)
        y = plant.step(y, t, h, steady, latents)
        if noisy:
            y = plant.kick(y, t + h, b, dW[1], latents)
        states[i + 1] = y
        past.append(latents)

    # A command after a run's end acts on nothing, but a file has one.
    forces[-1] = forces[-2] if callable(setup.commands) else setup.commands[-1]
    X, V = record(states, samples + lead, h, errors, plant, dead_reckoned, noise.rate_filter)
    true = states[samples + lead, :13, run].transpose(0, 2, 1)
    return Truth(
        samples * h,
        X,
        V,
        forces,
        errors,
        setup.voltage,
        np.concatenate([true[:, 3:7], true[:, :3]], axis=1),
        true[:, 7:],
        states,
        held,
        past,
    )
