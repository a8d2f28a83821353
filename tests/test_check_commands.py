"""Commands against motion, on a dive of a real autopilot and on simulated runs."""

import numpy as np
import pytest
from recordings_changed import as_wrench, changed

from helpers import ROOT
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.checks.commands import command_findings
from spinndrift.models.recordings.checks.hypotheses import Driven
from spinndrift.models.recordings.checks.orders import loses
from spinndrift.models.recordings.checks.response import LAGS_S, responses
from spinndrift.models.recordings.outputs import with_outputs
from spinndrift.models.recordings.resample import rotations
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import import_log
from spinndrift.training.data.generate import GenerateConfig, generate

HEAVY, SITL = load_vehicle("bluerov2_heavy"), load_vehicle("ardusub_sitl")
ZERO = int(np.argmin(np.abs(LAGS_S)))


@pytest.fixture(scope="module")
def dive() -> Recording:
    """40 s of the packaged dive, pilot's multisines on all axes, then thruster by thruster."""
    return import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0].cut(0.0, 20.0)


@pytest.fixture(scope="module")
def wrench(dive) -> Recording:
    return as_wrench(dive, HEAVY)


def words(recording, vehicle=HEAVY):
    return [finding.word for finding in command_findings(recording, vehicle)]


def mirrored(*thrusters):
    sign = np.ones(8)
    sign[[k - 1 for k in thrusters]] = -1
    return lambda pwm: 1500 + sign * (pwm - 1500)


def test_the_share_and_the_masses_are_those_of_the_vehicle(dive):
    """The simulator's constants: force / 10.5 kg, moment / 0.2681 kg m², no added mass."""
    forces, _ = dive.thrust(SITL)
    weights = np.asarray(SITL.thrusters().allocation)
    found = responses(dive, forces, dive.command_period)
    for axis, mass in enumerate((10.5,) * 3 + (0.2681,) * 3):
        share, fitted = found[axis].fit(weights[axis], ZERO)
        # the estimates of velocity are off by 0.01 m/s, of rates by less, at 1 m/s and 1 rad/s
        assert share > 0.98
        np.testing.assert_allclose(fitted, mass, rtol=0.03)
        assert found[axis].fit(-weights[axis], ZERO)[0] < 0.01


@pytest.mark.parametrize("vehicle", [HEAVY, SITL])
def test_a_good_dive_has_no_finding_whatever_the_belief(dive, vehicle):
    assert words(dive, vehicle) == []
    assert words(as_wrench(dive, vehicle), vehicle) == []
    assert words(as_wrench(dive, vehicle), None) == []


def test_simulated_maneuvers_have_no_finding():
    made = generate(GenerateConfig(trajectories=1, duration=6.0), HEAVY)
    assert words(made) == []


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ((4, 3, 2, 5, 0, 1), "ArduSub's order of RC channels"),
        ((3, 4, 5, 0, 1, 2), "torque first"),
        ((1, 0, 2, 3, 4, 5), "`Y` drives surge, `X` drives sway"),
    ],
)
def test_columns_in_another_order_are_named(wrench, order, said):
    """Column c of the files holds the command of axis order[c]."""
    (finding,) = command_findings(changed(wrench, "F_Bo_B", lambda F: F[..., order]), HEAVY)
    assert finding.word == "columns-exchanged"
    assert said in finding.text


def test_columns_with_the_other_sign_are_named(wrench):
    right_down = np.array([1, -1, -1, 1, -1, -1])
    (finding,) = command_findings(changed(wrench, "F_Bo_B", lambda F: F * right_down), None)
    assert finding.word == "axis-reversed"
    assert finding.place == "columns Y, Z, M, N"
    assert "forward-right-down" in finding.text
    yaw = np.array([1, 1, 1, 1, 1, -1])
    (finding,) = command_findings(changed(wrench, "F_Bo_B", lambda F: F * yaw), None)
    assert (finding.word, finding.place) == ("axis-reversed", "column N")


@pytest.mark.parametrize("thrusters", [(3,), (3, 6), (1, 2, 5)])
def test_reversed_thrusters_are_named_by_number(dive, thrusters):
    found = command_findings(changed(dive, "pwm", mirrored(*thrusters)), HEAVY)
    assert [f.word for f in found] == ["thruster-reversed"] * len(thrusters)
    assert [f.place for f in found] == [f"column pwm{k}" for k in thrusters]
    first = thrusters[0]
    assert f"(output {first}) " in found[0].text
    assert f"SERVO{first}_REVERSED or MOT_{first}_DIRECTION" in found[0].text


def test_findings_name_the_output_that_drives_a_thruster(dive):
    other = Recording(with_outputs(dive.dataset, (1, 2, 5, 4, 3, 6, 7, 0)))
    wrong = changed(other, "pwm", mirrored(5, 8))
    first, second = command_findings(wrong, HEAVY)
    expected = "thruster 5 (output 3) pushes the other way: SERVO3_REVERSED or MOT_5_DIRECTION"
    assert first.text == expected
    assert second.text.startswith("thruster 8 pushes the other way: MOT_8_DIRECTION, or SERVOn")
    (unknown, _) = command_findings(Recording(with_outputs(wrong.dataset, ())), HEAVY)
    assert unknown.text.startswith("thruster 5 pushes the other way: MOT_5_DIRECTION, or SERVOn")


def test_one_reversed_thruster_is_one_finding_without_horizontal_velocities(dive):
    """Each further change costs as much as the first: an exchange that changes nothing is none."""
    blind = np.array([np.nan, np.nan, 1, 1, 1, 1])
    V = dive.dataset["V_WB_B"]
    unaided = Recording(dive.dataset.assign(V_WB_B=(V.dims, V.to_numpy() * blind, V.attrs)))
    found = command_findings(changed_pwm(unaided, mirrored(2)), HEAVY)
    assert [(f.word, f.place) for f in found] == [("thruster-reversed", "column pwm2")]


def changed_pwm(recording, change):
    pwm = recording.dataset["pwm"]
    return Recording(recording.dataset.assign(pwm=(pwm.dims, change(pwm.to_numpy()), pwm.attrs)))


def with_heading(recording, degrees):
    """The recording of a compass that is off: poses turned about the vertical, velocities in W."""
    X, V = (recording.dataset[name].to_numpy() for name in ("X_WB", "V_WB_B"))
    half = np.deg2rad(degrees) / 2
    turned, seen = X.copy(), V.copy()
    w, x, y, z = np.moveaxis(X[..., :4], -1, 0)
    c, s = np.cos(half), np.sin(half)
    q = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
    turned[..., :4] = q
    for j, k in np.argwhere(recording.lengths > 0):
        n = recording.lengths[j, k]
        v_W = rotations(X[j, k, :n, :4].T).apply(V[j, k, :n, :3])
        seen[j, k, :n, :3] = rotations(q[j, k, :n].T).inv().apply(v_W)
    made = changed(recording, "X_WB", lambda _: turned)
    return changed(made, "V_WB_B", lambda _: seen)


@pytest.mark.parametrize(
    ("degrees", "word", "side"),
    [(-20, "heading-offset", "right"), (30, "heading-offset", "left"), (90, "heading-wrong", "")],
)
def test_a_heading_that_is_off_is_named_and_no_thruster_is(dive, degrees, word, side):
    (finding,) = command_findings(with_heading(dive, degrees), HEAVY)
    assert finding.word == word
    told = float(finding.text.split("°")[0].rsplit(" ", 1)[1])
    assert abs(told - abs(degrees)) <= 10  # steps of 5°, and masses that differ by axis
    assert side in finding.text


def test_velocities_that_come_later_than_rates_are_named(dive):
    late = changed(
        dive, "V_WB_B", lambda V: np.concatenate([shifted_by(V[..., :3], 6), V[..., 3:]], axis=-1)
    )
    (finding,) = command_findings(late, HEAVY)
    assert (finding.word, finding.place) == ("velocity-lag", "u,v,w")
    assert "0.3 s after p,q,r" in finding.text
    later = changed(
        dive, "V_WB_B", lambda V: np.concatenate([shifted_by(V[..., :3], 16), V[..., 3:]], axis=-1)
    )
    (finding,) = command_findings(later, HEAVY)
    assert (finding.word, finding.place) == ("command-lag", "commands of surge, sway, heave")
    assert "0.8 s after its command" in finding.text


def shifted_by(values, samples):
    return np.concatenate([values[:, :, :1]] * samples + [values[:, :, :-samples]], axis=2)


def test_a_gain_at_the_expense_of_an_axis_that_a_thruster_acts_on_is_no_fault(dive):
    forces, _ = dive.thrust(HEAVY)
    weights = np.asarray(HEAVY.thrusters().allocation)
    found = responses(dive, forces, dive.command_period)
    data = Driven(found, weights, ("",) * 8, {}, {}, {})
    exchanged = weights[:, [2, 1, 0, 3, 4, 5, 6, 7]]  # acts on surge and yaw
    usual = dict.fromkeys(range(6), 0.6)
    assert not loses(data, exchanged, usual, usual | {0: 0.95, 5: 0.95, 4: 0.3})
    assert loses(data, exchanged, usual, usual | {0: 0.95, 5: 0.3})
    assert loses(data, exchanged, usual, usual | {4: 0.95, 5: 0.3})


def test_parts_of_a_good_dive_have_no_finding(dive):
    assert [words(dive.cut(start, start + 10.0)) for start in (0.0, 5.0, 10.0)] == [[], [], []]


def test_exchanged_thrusters_are_named(dive):
    order = [0, 1, 2, 3, 6, 5, 4, 7]
    (finding,) = command_findings(changed(dive, "pwm", lambda pwm: pwm[..., order]), HEAVY)
    assert (finding.word, finding.place) == ("thruster-exchanged", "columns pwm5, pwm7")


def swum(acting, duration=60.0, dt=0.05, seed=0):
    """A level body with mass and linear drag on each axis, driven by eight thrusters.

    `acting` is the share of each recorded force that acts. Steps of 0.5 s, exact in each step.
    """
    rng = np.random.default_rng(seed)
    N = round(duration / dt)
    f = rng.normal(0, 10.0, (N // 10, 8)).repeat(10, axis=0)
    F = (f * acting) @ np.asarray(HEAVY.thrusters().allocation).T
    mass = np.array((HEAVY.mass,) * 3 + HEAVY.inertia) + np.array(HEAVY.added_mass)
    drag = 2.0 * np.array(HEAVY.linear_damping) + 1.0
    kept, V = np.exp(-drag / mass * dt), np.zeros((N, 6))
    for n in range(N - 1):
        V[n + 1] = kept * V[n] + (1 - kept) * F[n] / drag
    X = np.tile([1.0, 0, 0, 0, 0, 0, -2], (N, 1))
    return Recording.from_trajectories([Trajectory("swum", X, V, {"thruster_force": f})], dt)


def test_a_dead_thruster_is_named_and_a_weak_one_is_not():
    fourth = np.arange(8) == 3
    assert words(swum(np.ones(8))) == []
    (finding,) = command_findings(swum(np.where(fourth, 0.0, 1.0)), HEAVY)
    assert (finding.word, finding.place) == ("thruster-dead", "column f4")
    assert words(swum(np.where(fourth, 0.5, 1.0))) == []


def test_a_controller_that_opposes_a_disturbance_is_no_reversed_axis():
    """The command is -k v a moment ago, the motion that of a drifting body: drag of wrong sign."""
    rng = np.random.default_rng(2)
    N, dt, mass = 2400, 0.05, HEAVY.mass + HEAVY.added_mass[0]
    V, F, push = np.zeros((N, 6)), np.zeros((N, 6)), 0.0
    for n in range(1, N):
        push = 0.95 * push + rng.normal(0, 12.0)
        F[n] = -40.0 * V[n - 2]
        V[n, 0] = V[n - 1, 0] + dt / mass * (F[n - 1, 0] + push - 20.0 * V[n - 1, 0])
    X = np.tile([1.0, 0, 0, 0, 0, 0, -2], (N, 1))
    run = Recording.from_trajectories([Trajectory("held", X, V, {"F_Bo_B": F})], dt)
    assert "axis-reversed" not in words(run) + words(run, None)


def test_shifted_commands_are_named_with_the_shift(dive):
    late = changed(dive, "pwm", lambda p: np.concatenate([p[:, :, :1]] * 8 + [p[:, :, :-8]], 2))
    (finding,) = command_findings(late, HEAVY)
    assert finding.word == "command-lag"
    assert "0.4 s before its command" in finding.text


def test_zero_commands_and_commands_of_another_run_are_refused(dive, wrench):
    (finding,) = command_findings(changed(wrench, "F_Bo_B", np.zeros_like), HEAVY)
    assert (finding.word, finding.severity) == ("no-commands", "severe")
    rng = np.random.default_rng(1)
    steps = rng.normal(0, 150.0, (1, 1, dive.mask.shape[2] // 10 + 1, 8)).repeat(10, axis=2)
    noise = 1500 + steps[:, :, : dive.mask.shape[2]]
    (finding,) = command_findings(changed(dive, "pwm", lambda pwm: noise + 0 * pwm), SITL)
    assert (finding.word, finding.severity) == ("no-answer", "severe")


def test_an_axis_that_never_answers_is_named(dive):
    still = changed(dive, "V_WB_B", lambda V: V * np.array([1, 1, 1e-3, 1, 1, 1]))
    (finding,) = command_findings(still, HEAVY)
    assert (finding.word, finding.place) == ("axis-silent", "heave")


def test_too_little_data_say_nothing(dive):
    assert words(changed(dive.cut(0.0, 2.0), "pwm", mirrored(3))) == []


@pytest.mark.parametrize(
    ("mirror", "said"),
    [
        ([[0, 1], [1, 0]], "x and y look exchanged"),
        ([[1, 0], [0, -1]], "the motion along y has the other sign"),
        ([[-1, 0], [0, 1]], "the motion along x has the other sign"),
    ],
)
def test_a_horizontal_plane_that_is_mirrored_is_named(dive, mirror, said):
    """Position and velocity alike, so that they agree; the heading is right."""

    def change(V):
        V = V.copy()
        for j in range(V.shape[0]):
            R = rotations(dive.dataset["X_WB"].to_numpy()[j, 0, :, :4].T)
            v = R.apply(V[j, 0, :, :3])
            v[:, :2] = v[:, :2] @ np.array(mirror)
            V[j, 0, :, :3] = R.inv().apply(v)
        return V

    (found,) = command_findings(changed(dive, "V_WB_B", change), HEAVY)
    assert found.word == "plane-mirrored"
    assert said in found.text
