"""One planner call, 1000 rollouts (16 000 with 4000 sequences) of 80 steps among pylons.

What is timed is what the system `Mppi` does every 0.2 s, on two processors. The reference has
nothing of this package in it: times over it compare states of the code (`baseline.py`).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.controllers.impedance import ImpedanceGains
from spinndrift.systems.planning.mppi import Mppi
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.mppi_core import MppiPlanner
from spinndrift.systems.planning.obstacles import Pylon
from spinndrift.systems.planning.paths import PoseConfig
from spinndrift.systems.planning.tasks import PylonCrossing
from spinndrift.systems.plant.wrench_limits import ThrusterLimits
from spinndrift.systems.station.config import StationConfig

VEHICLE = load_vehicle("bluerov2_heavy")
PYLONS = [Pylon(1.5, y) for y in (-2.25, -0.65, 0.95)] + [Pylon(3.1, y) for y in (-3.0, -1.4, 0.2)]

TASK = PylonCrossing(PoseConfig((4.5, -2.0, -1.5)))


def model(kind: str):
    physics = VEHICLE.dynamics(np.array([3.0, 3.0, 3.0, 0.2, 0.2, 0.2]))
    if kind == "physics":
        return physics
    config = SpinnConfig(constant_mass=kind == "spinn, constant mass")
    return Spinn.create(config, physics, jax.random.key(0))


def test_reference(benchmark):
    """A recurrent network of 64 units, 80 steps of 1000 states in single precision."""
    weights = jax.random.normal(jax.random.key(0), (64, 64), jnp.float32) / 8
    states = jax.random.normal(jax.random.key(1), (64, 1000), jnp.float32)

    def step(x, _):
        return jnp.tanh(weights @ x), x[0]

    roll = jax.jit(lambda x: jax.lax.scan(step, x, length=80))
    jax.block_until_ready(roll(states))  # compiles
    benchmark(lambda: jax.block_until_ready(roll(states)))


@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("sequences", [1000, 250, 4000])
@pytest.mark.parametrize("kind", ["physics", "spinn", "spinn, constant mass"])
def test_mppi_call(benchmark, kind, sequences, substeps):
    realisations = 1 if sequences == 1000 else 4
    config = MppiConfig(sequences=sequences, realisations=realisations, substeps=substeps)
    planner = MppiPlanner(
        model(kind),
        ThrusterLimits.create(VEHICLE.thrusters(), fraction=config.wrench_fraction),
        TASK.build(StationConfig(obstacles=tuple(PYLONS))),
        config=config,
        tracking=ImpedanceGains().matrices(VEHICLE.dynamics()),
    )
    system = Mppi(planner)
    nominal = np.asarray(planner.init().F_Bo_B, float).ravel()
    X = np.asarray(PoseConfig((0.0, 0.0, -1.5)).pose())
    noise = np.array([0.3, -1.2, 0.1, 2.5])
    call = partial(system.plan, 0.0, nominal, X, np.zeros(6), np.zeros(6), noise)
    call()  # compiles
    benchmark(call)
