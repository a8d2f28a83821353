"""A vehicle's file in a wrong unit, sign or axis is refused at its line, with the remedy."""

import json
import pickle
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import FieldError, UserError
from spinndrift.models.config.typed_yaml import dump, loads
from spinndrift.models.config.yaml_text import parse
from spinndrift.models.vehicles.vehicle import Vehicle, load_vehicle, vehicle_names

HEAVY, SIX = load_vehicle("bluerov2_heavy"), load_vehicle("bluerov2")
GRAVITY = 9.80665
SCALES = {"g": 1e3, "lb": 1 / 0.45359237}
LENGTHS = {"mm": 1e3, "cm": 1e2, "inch": 1 / 0.0254}


def written(vehicle, *path, value):
    """The vehicle's text with one value replaced, and the line of its field."""
    data = parse(dump(vehicle), "text")[0]
    *above, last = path
    part = data
    for key in above:
        part = part[key]
    part[last] = value
    text = "\n".join(f"{key}: {_flow(of)}" for key, of in data.items())
    return text, 1 + list(data).index(path[0])


def _flow(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if hasattr(value, "tag"):
        return f"!{value.tag} {_flow(value.value)}"
    return json.dumps(value)


def refused(vehicle, *path, value):
    text, line = written(vehicle, *path, value=value)
    with pytest.raises(UserError) as caught:
        loads(Vehicle, text, "mine.yaml")
    message = str(caught.value)
    assert "\n" not in message
    where, _, told = message.partition(": ")
    assert where == f"mine.yaml:{line}"
    return told


@pytest.mark.parametrize("name", vehicle_names())
@pytest.mark.parametrize("unit", ["kg", "lbf", "kN"])
def test_forces_in_another_unit_are_refused(name, unit):
    vehicle = load_vehicle(name)
    newton = {"kg": 1 / GRAVITY, "lbf": 1 / 4.4482216, "kN": 1e-3}[unit]
    for field in ("weight", "buoyancy"):
        told = refused(vehicle, field, value=getattr(vehicle, field) * newton)
        assert told.startswith(f"{field} is ")
        assert " in N" in told
    both = {name: getattr(vehicle, name) * newton for name in ("weight", "buoyancy")}
    with pytest.raises(UserError, match="weight is"):
        replace(vehicle, **both)


@pytest.mark.parametrize("name", vehicle_names())
def test_masses_lengths_and_inertias_in_another_unit_are_refused(name):
    vehicle = load_vehicle(name)
    for scale in SCALES.values():
        with pytest.raises(UserError, match=r"weight is .*`mass` in kg"):
            replace(vehicle, mass=vehicle.mass * scale)
    for scale in LENGTHS.values():
        size = [scale * a for a in vehicle.size]
        assert refused(vehicle, "size", value=size).startswith("size is ")
        position = [scale * a for a in vehicle.propulsion.mounts[2].position]
        told = refused(vehicle, "propulsion", "mounts", 2, "position", value=position)
        assert told.startswith("propulsion.mounts[2].position is ")
        assert "metres" in told
    inertia = [1e4 * a for a in vehicle.inertia]  # kg·cm²
    assert refused(vehicle, "inertia", value=inertia).startswith("inertia is ")
    center = [0.0, 0.0, 1e3 * vehicle.center_of_buoyancy[2]]
    assert refused(vehicle, "center_of_buoyancy", value=center).startswith("center_of_buoyancy is ")
    assert refused(vehicle, "water_density", value=1.025).startswith("water_density is 1.025")


def test_faults_of_propulsion_are_named_by_their_fields():
    for path, value, told in (
        (("mounts", 4, "motor"), 2.0, "propulsion.mounts[4].motor is 2.0: give 1, or -1"),
        (("mounts", 0, "direction"), [0.0, 0.0, 0.0], "propulsion.mounts[0].direction is "),
        (("mounts", 0, "direction"), [0.0, 45.0, 0.0], "propulsion.mounts[0].direction is "),
        (("time_constant",), -0.15, "propulsion.time_constant is -0.15: "),
        (("time_constant",), 150.0, "propulsion.time_constant is 150.0: "),
        (("start_delay",), -1.0, "propulsion.start_delay is -1.0: "),
        (("voltage",), 0.0, "propulsion.voltage is 0.0: "),
        (("resistance",), 30.0, "propulsion.resistance is 30.0: "),
        (("resistance",), -0.03, "propulsion.resistance is -0.03: "),
        (("mounts",), [], "propulsion.mounts has 0 thrusters: "),
    ):
        assert refused(HEAVY, "propulsion", *path, value=value).startswith(told)
    sitl = load_vehicle("ardusub_sitl")
    for field, value in (("full_force", 0.0), ("dead_band", 400.0)):
        text = written(sitl, "name", value="mine")[0]
        usual = getattr(sitl.propulsion.curve, field)
        text = text.replace(f"{field}: {usual!r}", f"{field}: {value}")
        where = rf"mine\.yaml:14: propulsion\.curve\.{field} is {value}"
        with pytest.raises(UserError, match=where):
            loads(Vehicle, text, "mine.yaml")


def test_lines_are_those_of_the_fields_in_a_file_of_many_lines():
    text = dump(HEAVY).replace("resistance: 0.03", "resistance: 30")
    line = 1 + text[: text.index("resistance: 30")].count("\n")
    with pytest.raises(UserError, match=rf"^mine\.yaml:{line}: propulsion\.resistance is 30\.0: "):
        loads(Vehicle, text, "mine.yaml")


def test_length_of_a_direction_multiplies_the_thrust():
    mounts = HEAVY.propulsion.mounts
    twice = tuple(replace(m, direction=tuple(2 * a for a in m.direction)) for m in mounts)
    double = replace(HEAVY, propulsion=replace(HEAVY.propulsion, mounts=twice))
    pulses = jnp.linspace(1300.0, 1800.0, 8)
    forces = HEAVY.thrusters().force(pulses)
    wrench = HEAVY.thrusters().wrench(forces)
    np.testing.assert_array_equal(double.thrusters().wrench(forces), 2 * wrench)


def test_a_vehicle_that_nothing_holds_upright_is_refused():
    below = tuple(-a for a in SIX.center_of_buoyancy)
    told = refused(SIX, "center_of_buoyancy", value=list(below))
    assert "hold pitch" in told
    assert "sign" in told
    held = replace(HEAVY, center_of_buoyancy=below)  # eight thrusters can stabilise it
    assert "unstable in roll and pitch" in held.instability()
    assert HEAVY.instability() == ""


def test_error_of_a_field_passes_between_processes():
    error = FieldError("Vehicle", ("propulsion", "mounts", 2), "is none: give one.")
    copy = pickle.loads(pickle.dumps(error))
    assert str(copy) == str(error) == "Vehicle.propulsion.mounts[2] is none: give one."
    assert copy.path == error.path
