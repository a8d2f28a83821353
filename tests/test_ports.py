"""Every system says in its docstring which ports it has, and has them."""

import importlib
import importlib.util
import inspect
import re
import textwrap

import numpy as np
import pytest
import yaml
from pydrake.systems.framework import LeafSystem

from helpers import ROOT, module_files
from spinndrift.models.disturbances import Combined
from spinndrift.models.sensors import SHIPPED, Imu
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.controllers.impedance import ImpedanceLaw
from spinndrift.systems.controllers.maneuvers import ManeuverProgram, Steadiness
from spinndrift.systems.estimation.disturbance_observer import MomentumObserver
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.mppi_core import MppiPlanner
from spinndrift.systems.planning.paths import HoldPose
from spinndrift.systems.planning.plan import PlanLayout
from spinndrift.systems.planning.tasks import StationKeeping
from spinndrift.systems.plant.wrench_limits import ThrusterLimits
from spinndrift.systems.station.config import StationConfig

VEHICLE = load_vehicle("bluerov2_heavy")


def arguments() -> dict[str, dict]:
    """What a system's constructor needs; a system that is not listed is made without arguments."""
    dynamics, thrusters = VEHICLE.dynamics(), VEHICLE.thrusters()
    limits = ThrusterLimits.create(thrusters)
    planner = MppiPlanner(
        dynamics,
        limits,
        StationKeeping().build(StationConfig()),
        config=MppiConfig(horizon=10, sequences=20, knots=(2,)),
    )
    law = ImpedanceLaw(np.eye(6), np.eye(6), limits)
    start, nothing = np.eye(7)[:1], np.zeros((1, 6))
    program = ManeuverProgram(start, np.zeros(1, int), nothing[None], nothing, 0.1, (("a", 1),))
    return {
        "LearnedPlant": {"dynamics": dynamics, "thrusters": thrusters},
        "DisturbanceSource": {"disturbance": Combined()},
        "ThrustAllocation": {"thrusters": thrusters},
        "PulseWidths": {"thrusters": thrusters},
        "Mppi": {"planner": planner},
        "MppiBeside": {"planner": planner},
        "VehicleInterface": {"sensors": SHIPPED, "thrusters": 8, "health": 5},
        "Impedance": {"law": law, "layout": PlanLayout()},
        "WithoutPosition": {"place": (0.0, 0.0)},
        "DisturbanceObserver": {"observer": MomentumObserver(dynamics)},
        "ManeuverSequence": {"program": program, "law": law, "steady": Steadiness()},
        "Reference": {"path": HoldPose()},
        "PidController": {"vehicle": VEHICLE},
        "DeadReckoning": {"imu": Imu(), "X0_WB": np.eye(7)[0]},
        "SignalLog": {"size": 7, "period": 0.05},
    }


def leaf_systems() -> dict[str, type[LeafSystem]]:
    """Every LeafSystem that a module of systems/, sims/ or an example defines."""
    found = {}
    modules = [importlib.import_module(name) for name in module_files("systems", "sims")]
    for path in sorted((ROOT / "examples").glob("*.py")):
        spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        modules.append(module)
    for module in modules:
        for name, value in vars(module).items():
            is_leaf = inspect.isclass(value) and issubclass(value, LeafSystem)
            if is_leaf and value.__module__ == module.__name__:
                found[name] = value
    return found


def told_ports(cls: type[LeafSystem]) -> dict:
    """The `.. pydrake_system::` block of a docstring."""
    match = re.search(r"\.\. pydrake_system::\n\n((?: +.*\n|\n)+)", f"{inspect.getdoc(cls)}\n")
    assert match, f"{cls.__name__} has no pydrake_system block"
    return yaml.safe_load(textwrap.dedent(match[1]))


def test_every_system_has_the_ports_that_its_docstring_tells():
    systems = leaf_systems()
    given = arguments()
    assert set(given) <= set(systems)
    assert {"Ekf", "SensorSuite", "Mppi", "LearnedPlant"} <= set(systems)
    for name, cls in systems.items():
        system = cls(**given.get(name, {}))
        told = told_ports(cls)
        inputs = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
        outputs = [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]
        assert told["name"] == name
        assert (told.get("input_ports") or []) == inputs, name
        assert (told.get("output_ports") or []) == outputs, name


def test_a_missing_block_is_found():
    class Silent(LeafSystem):
        """No ports told."""

    with pytest.raises(AssertionError, match="Silent has no"):
        told_ports(Silent)
