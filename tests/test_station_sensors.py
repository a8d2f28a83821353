"""A station's sensors follow from its configuration, and its ports and filter from them."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, LeafSystem

from helpers import ROOT
from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import dump, loads
from spinndrift.models.sensors import SHIPPED, Compass, Imu, Sensor, SensorFault
from spinndrift.systems.closed_loop import Signal, build_diagram, logged, seeded
from spinndrift.systems.controllers.kinds import TrackReference
from spinndrift.systems.estimation.ekf import Ekf
from spinndrift.systems.own import port_sizes
from spinndrift.systems.planning.paths import HoldPose, PoseConfig
from spinndrift.systems.station.config import Sensing, StationConfig
from spinndrift.systems.station.ports import ports_page, station_ports
from spinndrift.systems.station.simulated import make_station

USBL = """
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from spinndrift.models import se3
from spinndrift.models.sensors import Sensor


@dataclass(frozen=True)
class Usbl(Sensor):
    "Position of a transponder on the vehicle, as a ship measures it."

    rate: float = 2.0
    noise: float = 0.1
    observes: ClassVar[str] = "position"
    state_size = noise_size = reading_size = 3
    initial_noise_size = 0

    def initial(self, w):
        return jnp.zeros((3, *w.shape[1:]), w.dtype)

    def measure(self, state, X_WB, V_WB_B, dV_WB_B, t, w):
        return self.predicted(X_WB, V_WB_B, None) + self.noise * w

    def predicted(self, X_WB, V_WB_B, slow):
        return se3.act(X_WB, jnp.asarray(self.position, X_WB.dtype))
"""
STD = 0.05  # m, of a fix
HOLD = TrackReference(HoldPose(PoseConfig((0.0, 0.0, -1.5))))


def fly(station: StationConfig, end: float) -> dict[str, Signal]:
    diagram = build_diagram(station, HOLD)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, 3)
    simulator.AdvanceTo(end)
    return logged(diagram, context)


def last_error(logs: dict[str, Signal]) -> tuple[np.ndarray, np.ndarray]:
    """Error [δp, δθ, δv] at the last row that pose and covariance have, and its deviations."""
    P = logs["covariance"].value[-1]
    i = int(np.argmin(np.abs(logs["X_WB"].time - logs["covariance"].time[-1])))
    X_hat, X = (jnp.asarray(logs[name].value[i]) for name in ("X_WB", "X_WB_cheat"))
    V_hat, V = (logs[name].value[i] for name in ("V_WB_B", "V_WB_B_cheat"))
    error = np.concatenate([se3.local(X_hat, X), (V - V_hat)[:3]])
    return error, np.sqrt(np.diag(P.reshape(int(np.sqrt(P.size)), -1)))[:9]


@pytest.fixture(name="text", scope="module")
def _text(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("own") / "usbl.py"
    path.write_text(USBL)
    given = f"{{noise: {STD}, position: [0.1, 0, 0.2]}}"
    kind = f"!OwnSensor {{system: '{path}:Usbl', parameters: {given}}}"
    return f"sensing: {{ekf: {{position_std: [0.5, 0.5, 0.02]}}, more: {{usbl: {kind}}}}}"


def test_the_page_of_the_ports_is_the_one_that_the_table_gives():
    page = (ROOT / "docs" / "ports.md").read_text(encoding="utf-8")
    assert page == ports_page(), "write docs/ports.md anew from ports_page()"


@pytest.mark.parametrize("hardware", [False, True])
def test_a_cheat_is_named_so_and_hardware_has_none(hardware):
    outputs = station_ports(hardware=hardware)[1]
    assert sum(name.endswith("_cheat") for name in outputs) == (0 if hardware else 4)


@pytest.mark.slow
def test_a_position_fix_from_outside_the_package_is_fused(text):
    """Of n fixes of σ: horizontal position, unknown to 0.5 m, is known to between σ/√n and σ."""
    station = loads(StationConfig, text)
    assert loads(StationConfig, dump(station)) == station
    inputs, outputs = station_ports(station)
    assert outputs["usbl"] == 3 + 2
    assert outputs["covariance"] == (15 + 4) ** 2
    assert (outputs["status"], outputs["health"]) == (1 + 3 * 4, 2 + 4)
    assert port_sizes(make_station(station)) == (inputs, outputs)
    logs = fly(station, 6.0)
    assert logs["usbl"].value[-1, 3] == 1
    error, std = last_error(logs)
    assert STD / np.sqrt(2.0 * 6.0 + 1) < std[:2].min()
    assert std[:2].max() < STD
    assert np.all(np.abs(error) < 4 * std)
    assert logs["health"].value[-1].tolist() == [0, 1, 1, 1, 1, 1]


def test_a_measurement_model_is_differentiated_unless_it_states_its_slopes(text):
    """p_WS = p + R r: the slope in δp is R, that in δθ −R r^, and those in the twist are zero."""
    usbl = loads(StationConfig, text).sensing.sensors["usbl"]
    X = se3.from_position_rpy(jnp.array([1.0, 2, -3]), jnp.array([0.1, -0.2, 0.7]))
    R, (x, y, z) = np.asarray(se3.rotation_matrix(X)), usbl.position
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    found = usbl.innovation(X, jnp.ones(6), jnp.zeros(1), jnp.zeros(3))
    np.testing.assert_allclose(found.pose, np.hstack([R, -R @ cross]), atol=1e-12)
    np.testing.assert_allclose(found.residual, -(np.array([1.0, 2, -3]) + R @ usbl.position))
    for slope in (found.velocity, found.rate, found.slow):
        np.testing.assert_array_equal(slope, 0)


@pytest.mark.slow
def test_without_dvl_and_compass_the_filter_says_what_it_does_not_know():
    """Velocity is at least as unknown as the accelerometer's bias b makes it: b t."""
    station = loads(StationConfig, "sensing: {dvl: null, compass: null}")
    assert loads(StationConfig, dump(station)) == station
    assert not {"dvl", "compass"} & set(station_ports(station)[1])
    assert port_sizes(make_station(station)) == station_ports(station)
    logs, end = fly(station, 3.0), 2.8
    error, std = last_error(logs)
    assert std[6:8].min() > Imu().accelerometer_bias * end
    assert std[5] > station.sensing.ekf.attitude_std[2]
    assert np.all(np.abs(error) < 4 * std)
    assert logs["health"].value.shape[1] == 3


@dataclass(frozen=True)
class Thermometer(Sensor):
    """A sensor that is a Drake system of its own, and that no filter fuses."""

    state_size = noise_size = initial_noise_size = 0  # pyright: ignore[reportAssignmentType]
    reading_size = 1  # pyright: ignore[reportAssignmentType]

    def initial(self, w):
        raise NotImplementedError

    def measure(self, state, X_WB, V_WB_B, dV_WB_B, t, w):
        raise NotImplementedError

    def add_to(self, station, name):
        station.add_system(name, Colder())


class Colder(LeafSystem):
    """Water at the surface has 20 °C, and is 1 °C colder a metre below; [value, valid, time]."""

    def __init__(self):
        super().__init__()
        X = self.DeclareVectorInputPort("X_WB", 7)

        def show(context, output: BasicVector):
            pose: Any = X.Eval(context)
            output.SetFromVector([20.0 + pose[6], 1.0, context.get_time()])

        self.DeclareVectorOutputPort("temperature", 3, show)


def test_a_sensor_may_be_a_drake_system_of_its_own():
    station = StationConfig(sensing=Sensing(more={"temperature": Thermometer()}))
    assert station_ports(station)[1] == {**station_ports()[1], "temperature": 3}
    made = make_station(station)
    context = made.CreateDefaultContext()
    made.GetInputPort("F_Bo_B").FixValue(context, np.zeros(6))
    seen: Any = made.GetOutputPort("temperature").Eval(context)
    np.testing.assert_allclose(seen, [20 - 1.5, 1, 0])


def test_what_does_not_fit_is_refused_with_a_remedy(text, tmp_path):
    for name in ("dvl", "health", "two words"):
        with pytest.raises(UserError, match=r"more is .*word of its own"):
            Sensing(more={name: Compass()})
    with pytest.raises(UserError, match=r"sensor is 'dvl': take one of imu, depth, compass"):
        Sensing(dvl=None, faults=(SensorFault("dvl", "nan"),))
    with pytest.raises(UserError, match="a sensor to fuse with it"):
        Ekf({"imu": SHIPPED["imu"]})
    (tmp_path / "no.py").write_text("class Usbl: pass\n")
    kind = f"!OwnSensor {{system: '{tmp_path / 'no.py'}:Usbl'}}"
    station = loads(StationConfig, f"sensing: {{more: {{usbl: {kind}}}}}")
    with pytest.raises(UserError, match="no Sensor called `Usbl`"):
        make_station(station)
    fault = "faults: [{sensor: usbl, fault: nan, components: [3]}], more"
    with pytest.raises(UserError, match="some of 0 to 2"):
        make_station(loads(StationConfig, text.replace("more", fault)))
