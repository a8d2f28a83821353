"""What the vehicle is made to do: maneuvers through all eight thrusters that excite every axis.

Scenarios differ in maneuver, depth and heading; the repetitions of one share the commands (in open
loop) and the depth, in four headings a quarter turn apart, so that a cause that stays with the
earth shows between headings and one that doesn't repeat shows within them. The battery empties
from run to run.
"""

from dataclasses import dataclass, replace

import numpy as np

from . import t200
from .effects_actuation import NOMINAL_VOLTS
from .rotations import conjugate, from_rpy, logarithm, product, to_body
from .simulator import Setup, streams
from .vehicle import Vehicle

REST = 0.2  # s of zero command at the start of every run
LIMIT = 35.0  # N
MANEUVERS = (
    "surge steps",
    "sway steps",
    "heave steps",
    "yaw steps",
    "surge and yaw chirp",
    "sway and heave chirp",
    "roll and pitch",
    "multisine",
    "thruster by thruster",
    "random steps",
)
AMPLITUDE = np.array([38.0, 38.0, 40.0, 1.2, 1.2, 6.0])  # N, N·m


@dataclass(frozen=True)
class Plan:
    """How much of what is recorded.

    Attributes:
        scenarios, runs: number of maneuvers and of repetitions of each.
        seconds, rate: length of a run and Hz.
        loop: `open` (commands are played) or `closed` (PD on the measured pose).
        form: commands in the files: `f`, `pwm` or `wrench`.
        even: False draws time steps between 0.4 and 1.6 of the usual.
        voltage: whether the files tell each run's open-circuit voltage.
        idle: axes (0 … 5) that are never commanded.
        dead_reckoned: position from velocity and attitude, instead of measured.
    """

    scenarios: int = 10
    runs: int = 20
    seconds: float = 10.0
    rate: float = 20.0
    loop: str = "open"
    form: str = "f"
    even: bool = True
    voltage: bool = True
    idle: tuple[int, ...] = ()
    dead_reckoned: bool = False
    h: float = 0.005

    def short(self) -> "Plan":
        """60 s in all: six runs of ten seconds."""
        return replace(self, scenarios=6, runs=1, seconds=10.0)


@dataclass(frozen=True)
class Scenarios:
    """A plan in numbers; runs of one scenario lie side by side."""

    setup: Setup
    names: tuple[str, ...]
    pwm: np.ndarray | None
    believed_volts: np.ndarray


def build(plan: Plan, seed: int) -> Scenarios:
    """Draw start states, time stamps and commands from a seed."""
    rng = streams(seed, 3)
    J, K = plan.scenarios, plan.runs
    B = J * K
    names, headings, depths = [], np.zeros(B), np.zeros(B)
    for j in range(J):
        kind = MANEUVERS[j % len(MANEUVERS)]
        names += [f"{j + 1:02d} {kind}"] * K
        runs = slice(j * K, (j + 1) * K)
        headings[runs] = rng.uniform(-np.pi, np.pi) + np.arange(K) % 4 * np.pi / 2
        depths[runs] = rng.uniform(2.0, 4.5)
    p0 = np.stack([*rng.normal(0, 0.3, (2, B)), -depths + rng.normal(0, 0.05, B)])
    q0 = from_rpy(*rng.normal(0, 0.02, (2, B)), headings)
    nu0 = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])[:, None] * rng.standard_normal((6, B))
    samples = _samples(plan, B, rng)
    # Runs were made in turn, all scenarios once, then all again.
    order = (np.arange(B) % K) * J + np.arange(B) // K
    volts = 16.8 - 3.3 * order / max(B - 1, 1)
    believed = volts if plan.voltage and plan.form == "pwm" else np.full(B, NOMINAL_VOLTS)
    pwm = None
    if plan.loop == "closed":
        commands = Pilot(plan, believed, p0, headings, seed)
    else:
        commands = np.empty((samples.shape[0], 8, B))
        for j in range(J):
            runs = slice(j * K, (j + 1) * K)
            own = streams([seed, j], 4)
            grid = np.arange(0, plan.seconds + 1, 1 / plan.rate)
            thrust = maneuver(j % len(MANEUVERS), grid, own, plan.idle)
            n = np.minimum((samples[:, runs] * plan.h * plan.rate).astype(int), grid.size - 1)
            commands[:, :, runs] = np.moveaxis(thrust[:, n], 0, 1)
        if plan.form == "pwm":
            pwm = pulses(commands, believed)
            commands = thrusts(pwm, believed)
    setup = Setup(p0, q0, nu0, samples, commands, volts, plan.h)
    return Scenarios(setup, tuple(names), pwm, believed)


def _samples(plan: Plan, batch: int, rng: np.random.Generator) -> np.ndarray:
    N = round(plan.seconds * plan.rate) + 1
    each = round(1 / plan.rate / plan.h)
    if plan.even:
        return (each * np.arange(N))[:, None] + np.zeros(batch, int)
    low, high = max(round(0.4 * each), 1), round(1.6 * each)
    steps = rng.integers(low, high + 1, (N - 1, batch))
    return np.concatenate([np.zeros((1, batch), int), np.cumsum(steps, axis=0)])


def pulses(forces: np.ndarray, volts: np.ndarray) -> np.ndarray:
    """PWM (…, B) in whole µs for forces (…, B) at each run's voltage."""
    return np.stack([t200.pulse(forces[..., b], v) for b, v in enumerate(volts)], axis=-1)


def thrusts(pwm: np.ndarray, volts: np.ndarray) -> np.ndarray:
    return np.stack([t200.thrust(pwm[..., b], v) for b, v in enumerate(volts)], axis=-1)


def allocate(wrench: np.ndarray) -> np.ndarray:
    """Smallest thrust for a wrench (6, …), scaled into ±`LIMIT`."""
    f = np.tensordot(np.linalg.pinv(Vehicle().allocation()), wrench, 1)
    return f / np.maximum(np.abs(f).max(axis=0) / LIMIT, 1.0)


# ---------------------------------------------------------------------------------- maneuvers


def maneuver(
    kind: int, t: np.ndarray, rng: np.random.Generator, idle: tuple[int, ...] = ()
) -> np.ndarray:
    """Thrust (8, N) of one maneuver."""
    wrench = _MAKE[kind](t, rng)
    wrench[2] -= 2.0  # the pilot trims the nominal buoyancy
    wrench[list(idle)] = 0.0
    thrust = allocate(wrench)
    if not idle:
        thrust = thrust + _inner(t, rng)
        if kind == 8:
            thrust = thrust + _one_by_one(t, rng)
    thrust[:, t < REST] = 0.0
    return np.clip(thrust, -LIMIT, LIMIT)


def _inner(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Thrusters against each other: the two combinations that leave the wrench as it is."""
    null = 0.5 * np.array([[1.0, 1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 1, -1, -1, 1]])
    waves = [_sine(t, rng, 0.1, 0.6) + 0.5 for _ in null]
    return 5.0 * null.T @ np.stack(waves)


def _one_by_one(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    out = np.zeros((8, t.size))
    slot = (t[-1] - REST) / 8
    for k, i in enumerate(rng.permutation(8)):
        begin = REST + k * slot
        inside = (t >= begin) & (t < begin + 0.8 * slot)
        half = np.where(t < begin + 0.4 * slot, 1.0, -1.0)
        out[i, inside] = (rng.uniform(8, 22) * half)[inside]
    return out


def _sine(t: np.ndarray, rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    return np.sin(2 * np.pi * rng.uniform(low, high) * t + rng.uniform(0, 2 * np.pi))


def _steps(t: np.ndarray, rng: np.random.Generator, hold: float = 1.2) -> np.ndarray:
    """Levels between -1 and 1, of alternating sign, each held about `hold` s."""
    edges = np.cumsum(rng.uniform(0.5, 1.5, 400) * hold)
    levels = rng.uniform(0.25, 1.0, 401) * np.where(np.arange(401) % 2, 1, -1)
    return rng.choice([-1, 1]) * levels[np.searchsorted(edges, t)]


def _chirp(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """From about 0.1 to 2 Hz and back in 10 s."""
    s = (t / 5.0) % 2.0
    f = 0.1 + 1.9 * np.where(s < 1, s, 2 - s)
    return np.sin(2 * np.pi * np.cumsum(f) * (t[1] - t[0]) + rng.uniform(0, 2 * np.pi))


def _background(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A little of everything, so that no axis rests."""
    rows = [0.15 * _sine(t, rng, 0.1, 0.5) + 0.1 * _sine(t, rng, 0.5, 1.5) for _ in range(6)]
    return AMPLITUDE[:, None] * np.stack(rows)


def _on(axes: dict[int, float], make):
    def program(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        wrench = _background(t, rng)
        for axis, part in axes.items():
            wrench[axis] += part * AMPLITUDE[axis] * make(t, rng)
        return wrench

    return program


def _multisine(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    rows = [sum(0.35 * _sine(t, rng, 0.08, 1.0) for _ in range(4)) for _ in range(6)]
    return AMPLITUDE[:, None] * np.stack(rows)


def _random_steps(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return AMPLITUDE[:, None] * np.stack([0.7 * _steps(t, rng, 0.8) for _ in range(6)])


_MAKE = (
    _on({0: 0.9}, _steps),
    _on({1: 0.9}, _steps),
    _on({2: 0.9}, _steps),
    _on({5: 0.9, 0: 0.4}, _steps),
    _on({0: 0.8, 5: 0.6}, _chirp),
    _on({1: 0.8, 2: 0.7}, _chirp),
    _on({3: 0.9, 4: 0.9}, _steps),
    _multisine,
    _background,
    _random_steps,
)


# -------------------------------------------------------------------------------- closed loop


class Pilot:
    """PD on the measured pose along a smooth reference that differs between scenarios.

    Gains for natural frequencies near 1 rad/s; references begin at the start pose.
    """

    KP = np.array([25.0, 25.0, 35.0, 3.0, 3.0, 3.0])
    KD = np.array([30.0, 30.0, 45.0, 1.0, 1.0, 2.0])

    def __init__(self, plan: Plan, volts: np.ndarray, p0: np.ndarray, yaw0: np.ndarray, seed: int):
        self.plan, self.volts, self.p0, self.yaw0 = plan, volts, p0, yaw0
        rng = streams(seed, 5)
        J, K = plan.scenarios, plan.runs
        size = np.array([1.0, 1.0, 0.5, 0.15, 0.15, 0.9])[:, None, None]
        self.size = np.repeat(size * rng.uniform(0.4, 1.0, (6, 3, J)), K, axis=2)
        self.frequency = np.repeat(rng.uniform(0.05, 0.35, (6, 3, J)), K, axis=2)
        edges = rng.uniform(1.5, 3.0, (6, 40, J)).cumsum(axis=1)
        self.edges = np.repeat(edges, K, axis=2)
        self.levels = np.repeat(0.6 * size * rng.uniform(-1, 1, (6, 40, J)), K, axis=2)

    def reference(self, t: float) -> np.ndarray:
        """Offsets from the start in the start's heading, m and rad (6, B): sines and steps."""
        s = max(t - REST, 0.0)
        sines = np.sum(self.size * np.sin(2 * np.pi * self.frequency * s), axis=1)
        n = np.minimum(np.sum(self.edges < s, axis=1), self.levels.shape[1] - 1)
        steps = np.take_along_axis(self.levels, n[:, None], axis=1)[:, 0]
        return sines + np.where(n > 0, steps, 0.0)

    def __call__(self, t: float, X: np.ndarray, V: np.ndarray, runs: np.ndarray) -> np.ndarray:
        if t < REST - 1e-9:
            return np.zeros((8, runs.size))
        r = self.reference(t)[:, runs]
        q, p, yaw = X[:4], X[4:], self.yaw0[runs]
        level = from_rpy(0.0, 0.0, yaw)
        wanted = self.p0[:, runs] + np.stack(
            [
                np.cos(yaw) * r[0] - np.sin(yaw) * r[1],
                np.sin(yaw) * r[0] + np.cos(yaw) * r[1],
                r[2],
            ]
        )
        turn = product(level, from_rpy(r[3], r[4], r[5]))
        error = np.concatenate([to_body(q, wanted - p), logarithm(product(conjugate(q), turn))])
        wrench = self.KP[:, None] * error - self.KD[:, None] * V
        wrench[:3] -= 2.0 * to_body(q, np.array([0.0, 0.0, 1.0])[:, None] + 0 * p)
        wrench[list(self.plan.idle)] = 0.0
        forces = allocate(wrench)
        if self.plan.form == "pwm":
            volts = self.volts[runs]
            forces = thrusts(pulses(forces, volts), volts)
        return forces
