"""Laws of the disturbance: which are reported, and causes judged with slow ones as noise."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hidden.draw import draw
from hidden.effects_environment import Waves
from hidden.scenarios import Plan
from hidden.simulator import Noise

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import Extended, kind
from spinndrift.models.effects.drag import LinearDrag
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.disturbance.found import (
    _grown,
    all_laws,
    laws_of,
    reported_laws,
    won_by,
)
from spinndrift.training.diagnosis.disturbance.laws import Law, estimated, impacts
from spinndrift.training.diagnosis.disturbance.levels import LEVEL
from spinndrift.training.diagnosis.disturbance.waves import (
    correlated_noise_of,
    find_current,
    find_waves,
)
from spinndrift.training.diagnosis.filter.kalman import score_of
from spinndrift.training.diagnosis.filter.noise import estimate
from spinndrift.training.diagnosis.filter.transition import Transition
from spinndrift.training.diagnosis.pipeline import Diagnoser
from spinndrift.training.diagnosis.selection.correlated_noise import CorrelatedNoise
from spinndrift.training.diagnosis.selection.search import Search
from spinndrift.training.diagnosis.selection.state import Selection

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
LEVELS = np.array([1.0] * 3 + [0.03] * 3)


@pytest.fixture(scope="module")
def problem_of(tmp_path_factory):
    """A bench of a hidden cause, and its cause; the belief states the level that was hidden."""

    def made(name, size, noise=None, believed=LEVELS, **plan):
        folder = tmp_path_factory.mktemp(name) / "data"
        plan = Plan(runs=2, seconds=6.0, **plan)
        case = draw(3, names=(name,), size=size, plan=plan, noise=noise)
        case.write(folder)
        diagnoser = Diagnoser(read_csv(folder), VEHICLE, VEHICLE.dynamics(believed))
        return diagnoser.problem, case.effects[0]

    return made


def test_what_is_drawn_anew_is_integrated_out():
    """Products beside it are those under the dense covariance I + J S Jᵀ."""
    rng = np.random.default_rng(0)
    z, J = rng.standard_normal((4, 36, 5)), rng.standard_normal((3, 36, 5))
    variance = np.array([0.5, 2.0, 10.0])
    G = CorrelatedNoise(amplitudes=J, precision=1 / variance).products(z)
    for r in range(5):
        dense = np.eye(36) + J[..., r].T @ np.diag(variance) @ J[..., r]
        np.testing.assert_allclose(
            G[r], z[..., r] @ np.linalg.solve(dense, z[..., r].T), rtol=1e-9, atol=1e-9
        )


def test_a_slow_push_is_taken_out_of_all_that_it_moves():
    """White after, in its own innovation and where it leaks, and columns lose what z loses."""
    rng = np.random.default_rng(1)
    N, R, rho, q = 400, 40, 0.95, 0.2
    m = np.zeros((N, R))
    for n in range(N - 1):
        m[n + 1] = rho * m[n] + q * rng.standard_normal(R)
    z = rng.standard_normal((N, 12, R))
    z[:, 8] += m
    z[:, 2] += 0.5 * m
    P = q * q  # variance of what is predicted: the Riccati equation of one state
    for _ in range(500):
        P = rho**2 * P / (P + 1) + q * q
    correlated_noise = CorrelatedNoise.from_slow(z, {2: (rho, P / (P + 1))})
    white = correlated_noise._without_slow(z.reshape(1, -1, R)).reshape(N, 12, R)
    for axis, share in ((8, 0.05), (2, 0.5)):
        before, after = (np.mean(a[1:, axis] * a[:-1, axis]) for a in (z, white))
        assert before > 0.05
        assert abs(after) < share * before
    assert np.mean(white[50:] ** 2) == pytest.approx(1, abs=0.02)
    doubled = correlated_noise._without_slow(np.stack([z, 2 * z]).reshape(2, -1, R))
    np.testing.assert_allclose(doubled[1], 2 * doubled[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("disturbance_colour", marks=pytest.mark.slow),
        "waves",
        pytest.param("current_varying", marks=pytest.mark.slow),
    ],
)
def test_no_name_imitates_a_large_random_structure(problem_of, name):
    """Three times a realistic size: names win thousands of nats, and none beside the structure."""
    problem, _ = problem_of(name, 3.0)
    evaluation = problem.evaluate(problem.believed)
    assert laws_of(problem, evaluation)[0].heldout_gain > 1000
    search, start = Search(), Selection.start(problem, evaluation)
    best = max(f.heldout_gain for f in search._chosen(start)[2].values())
    choice, fits = search.propose(start).proposed
    assert best > 100
    assert choice is None
    assert max(f.heldout_gain for f in fits.values()) < 0.3 * best


@pytest.mark.slow
def test_a_name_that_leaves_nothing_of_a_law_is_taken(tmp_path):
    """A minute of a tether: pull and lever multiply, so before they are fitted colour wins more."""
    case = draw(1024, names=("tether",), plan=Plan().short())
    case.write(tmp_path / "data")
    problem = Diagnoser(read_csv(tmp_path / "data"), VEHICLE, VEHICLE.dynamics(LEVELS)).problem
    evaluation = problem.evaluate(problem.believed)
    search, start = Search(), Selection.start(problem, evaluation)
    best = max(f.heldout_gain for f in search._chosen(start)[2].values())
    law = laws_of(problem, evaluation)[0].heldout_gain
    assert law > best
    choice, _ = search.propose(start).proposed
    assert choice is not None
    assert choice.hypothesis == ("tether", "W")
    assert choice.fit.heldout_gain > law


@pytest.mark.slow
def test_what_a_name_wins_exactly_is_likelihood(tmp_path):
    """A name's own noise is smaller: squares of innovations alone may even grow."""
    case = draw(5, names=("thruster_lag",), plan=Plan().short())
    case.write(tmp_path / "data")
    problem = Diagnoser(read_csv(tmp_path / "data"), VEHICLE, VEHICLE.dynamics(LEVELS)).problem
    evaluation = problem.evaluate(problem.believed)
    search, start, h = Search(), Selection.start(problem, evaluation), ("thruster_lag", "all")
    fit = search._chosen(start)[2][h]
    theta, seen, _ = search._fitted(start, h, {h: fit}, None)
    exact = search._exact(start, fit, theta, seen)
    data, scores = problem.data, []
    for one in (evaluation, seen):
        error, jacobian = (np.asarray(a) for a in (one.predictions.error, one.predictions.jacobian))
        steps = Transition.along(jacobian, data.weight, np.zeros(6))
        inverse = np.linalg.inv(problem.mass(one.theta))
        given = one.noise, steps, inverse, data.dt, data.step, data.weight
        scores.append(score_of(error, jacobian, *given).sum())
    assert exact.gain == pytest.approx(scores[1] - scores[0], rel=0.01)
    assert exact.heldout_gain == pytest.approx(exact.gain - 1)
    assert exact.heldout_gain > fit.heldout_gain


@pytest.mark.slow
def test_water_is_drawn_for_every_piece(problem_of):
    """Scenarios of unequal numbers of runs: none of their pieces is left out."""
    problem, _ = problem_of("current_varying", 1.0)
    scenario = np.where(np.arange(20) < 15, 0, np.arange(20))
    problem = replace(problem, data=replace(problem.data, scenario=scenario))
    evaluation = problem.evaluate(problem.believed)
    correlated_noise = correlated_noise_of(
        problem, evaluation, [w for w in laws_of(problem, evaluation) if "current" in w.name]
    )
    assert correlated_noise.amplitudes is not None
    assert correlated_noise.amplitudes.shape[2] == 20
    assert (
        replace(problem, correlated_noise=correlated_noise).evaluate(problem.believed, []).loss
        < evaluation.loss
    )


@pytest.mark.parametrize("loop", ["open", pytest.param("closed", marks=pytest.mark.slow)])
def test_swell_is_measured(problem_of, loop):
    """Frequency, direction and size of a wave, with a pilot who works against it and without."""
    problem, wave = problem_of("waves", 1.0, loop=loop)
    law = find_waves(problem, problem.evaluate(problem.believed, []))
    omega = 2 * np.pi / wave.period
    agrees(law, omega, wave.direction, wave.amplitude)
    assert law.parameters["frequency"] == pytest.approx(omega, abs=0.03)


@dataclass(frozen=True)
class Sea(Waves):
    """Many waves of one direction, each run with other phases."""

    periods: tuple[float, ...] = ()
    amplitudes: tuple[float, ...] = ()

    def neutral(self):
        return not self.periods

    def draw_latent(self, batch, rng):
        return {"phase": rng.uniform(0, 2 * np.pi, (len(self.periods), batch))}

    def flow(self, p, t, latent):
        waves = zip(self.amplitudes, self.periods, latent["phase"], strict=True)
        parts = [Waves(a, T, self.direction).flow(p, t, {"phase": phi}) for a, T, phi in waves]
        return sum(v for v, _ in parts), sum(a for _, a in parts)


@pytest.mark.slow
def test_a_wind_sea_is_no_slow_push(tmp_path):
    """A sea of 0.4 m and 3 s (Hasselmann et al. 1973): waves, and not what only reverts."""
    omega = np.linspace(0.6, 3.0, 25) * 2 * np.pi / 3.0
    x = omega * 3.0 / (2 * np.pi)
    peak = 3.3 ** np.exp(-(((x - 1) / np.where(x <= 1, 0.07, 0.09)) ** 2) / 2)
    energy = x**-5 * np.exp(-1.25 * x**-4) * peak
    energy *= 0.1**2 / energy.sum()
    a = np.sqrt(2 * energy)
    case = draw(3, names=("waves",), plan=Plan(runs=2, seconds=6.0))
    sea = Sea(0.1, 3.0, 0.7, tuple(2 * np.pi / omega), tuple(a))
    replace(case, effects=(sea,)).write(tmp_path / "data")
    problem = Diagnoser(read_csv(tmp_path / "data"), VEHICLE, VEHICLE.dynamics(LEVELS)).problem
    evaluation = problem.evaluate(problem.believed, [])
    law = next(law for law in all_laws(problem, evaluation, 12.0) if kind(law.name).slow)
    assert law.name == "waves"
    # that of a regular wave of the same orbital speed
    agrees(law, 2 * np.pi / 3.0, 0.7, np.sqrt(np.sum((a * omega) ** 2)) * 3.0 / (2 * np.pi), 0.3)


def agrees(law, omega, direction, amplitude, within=0.15):
    assert law.parameters["frequency"] == pytest.approx(omega, rel=0.1)
    turn = np.angle(np.exp(1j * (law.parameters["direction"] - direction)))
    assert abs(turn) < 0.2
    assert law.parameters["amplitude"] == pytest.approx(amplitude, rel=within)


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("disturbance_level", 3.0),
        *(
            pytest.param(f"disturbance_{name}", size, marks=pytest.mark.slow)
            for name, size in (
                ("impacts", 3.0),
                ("state_dependence", 3.0),
                ("level", 1.0),
                ("state_dependence", 1.0),
                ("impacts", 1.0),
            )
        ),
    ],
)
def test_levels_and_what_comes_and_goes_are_told_apart(problem_of, name, size):
    problem, _ = problem_of(name, size)
    evaluation = problem.evaluate(problem.believed)
    assert not evaluation.noise.estimated
    groups = reported_laws(all_laws(problem, evaluation, 12.0), problem, evaluation, 12.0)
    assert [group[0].name for group in groups] == [name]
    assert all(law.name == name for law in groups[0])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("disturbance_colour", marks=pytest.mark.slow),
        "disturbance_state_dependence",
    ],
)
@pytest.mark.slow
def test_what_lasts_or_grows_is_no_level_in_calm_water(problem_of, name):
    """With a twentieth of the white disturbance, and as little of it believed."""
    calm = tuple(LEVELS / 20)
    problem, _ = problem_of(name, 1.0, Noise(diffusion=calm), believed=np.array(calm))
    evaluation = problem.evaluate(problem.believed)
    laws = all_laws(problem, evaluation, 12.0)
    assert any(law.name == "disturbance_level" and law.heldout_gain > 12 for law in laws)
    assert [group[0].name for group in reported_laws(laws, problem, evaluation, 12.0)] == [name]


def test_growth_beside_a_level_is_told_where_it_holds_on_data_left_out(problem_of):
    problem, _ = problem_of("disturbance_state_dependence", 1.0)
    evaluation = problem.evaluate(problem.believed)
    runs, name = np.ones(len(problem.data.fold)), "disturbance_state_dependence"
    grown = next(law for law in laws_of(problem, evaluation) if law.name == name)
    other = "sway" if grown.where != "sway" else "heave"
    # what the levels take off is nothing: growth alone explains them as well
    levels = [Law(LEVEL, axis, {"change": 0.0}, 40 * runs) for axis in (grown.where, other)]
    for gain, growth, holds in ((-0.1, 0.1, False), (0.1, 0.0, False), (0.1, 0.1, True)):
        also = Law(name, other, {"growth": growth}, gain * runs)
        shaped, left = _grown([grown, also], [grown], levels, problem, evaluation)
        assert left == []
        assert [law.where for law in shaped] == [grown.where] + [other] * holds


def test_states_known_exactly_are_not_taken_for_estimates(problem_of):
    """No errors of records at all: whoever simulates may write down what he simulated."""
    rng = np.random.default_rng(2)
    problem, _ = problem_of("disturbance_level", 1.0)
    A = np.eye(12)
    A[:6, 6:] = 0.05 * np.eye(6)
    mass = problem.mass(problem.believed)
    w = np.linalg.solve(mass, LEVELS[:, None] * rng.standard_normal((6, 200 * 30)))
    error = np.concatenate([0.025 * w, w]).reshape(12, 200, 30).swapaxes(0, 1) * np.sqrt(0.05)
    noise = estimate(error, np.ones((200, 30)), Transition.constant(A), mass, 0.05)
    assert not noise.estimated
    np.testing.assert_allclose(noise.diffusion, LEVELS, rtol=0.05)


@pytest.mark.slow
def test_a_name_that_halves_the_errors_is_told_of_states_without_noise(problem_of):
    """Smooth errors of a wrong model look like an estimator's until the name is found."""
    problem, hidden = problem_of("current_steady", 1.0, noise=Noise.none())
    evaluation = problem.evaluate(problem.believed)
    assert evaluation.noise.estimated
    choice, _ = Search().propose(Selection.start(problem, evaluation)).proposed
    assert choice is not None
    assert choice.hypothesis == ("current_steady", "W")
    theta = problem.polish(problem.believed, problem.library.at(*choice.hypothesis))[0]
    found = theta[problem.library.at(*choice.hypothesis)]
    np.testing.assert_allclose(found, [hidden.east, hidden.north], atol=1e-3)


@pytest.mark.slow
def test_drag_stays_passive_and_wild_steps_are_tamed(problem_of):
    problem, _ = problem_of("quadratic_drag", 1.0)
    row = problem.library.at("quadratic_drag", "pitch")
    believed = problem.believes("quadratic_drag", "pitch")
    far = problem.believed.copy()
    far[row] = -2 * believed
    theta = problem.polish(far, row, rounds=1)[0]
    assert -believed <= theta[row][0] < 0
    assert not problem._wild(np.repeat(problem.believed[:, None], len(problem.data.fold), 1)).any()
    heavy = np.repeat(problem.believed[:, None], len(problem.data.fold), 1)
    heavy[problem.library.at("linear_drag", "yaw"), 3] = -3000.0
    assert np.flatnonzero(problem._wild(heavy)).tolist() == [3]


def test_a_belief_that_diverges_on_the_data_is_told(tmp_path):
    """Drag that drives the vehicle, a thousand times too large: a sentence, and no traceback."""
    draw(3, "null", plan=Plan(runs=1, seconds=3.0)).write(tmp_path / "data")
    drag = LinearDrag.neutral()
    drag = replace(drag, values=drag.values.at[0].set(-1e6))
    belief = Extended.create(VEHICLE.dynamics(), (drag,), VEHICLE.thrusters())
    with pytest.raises(UserError, match="unstable on these data"):
        Diagnoser(read_csv(tmp_path / "data"), VEHICLE, belief).run()


@pytest.mark.slow
@pytest.mark.parametrize("size", [1.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_current_that_wanders_is_one_motion_of_the_water(tmp_path, size):
    """Not pushes on every axis: its size and time constant within three standard errors."""
    case = draw(4, names=("current_varying",), size=size, plan=Plan(runs=3))
    case.write(tmp_path / "data")
    problem = Diagnoser(read_csv(tmp_path / "data", resample=False), VEHICLE).problem
    evaluation = problem.evaluate(problem.believed)
    laws = all_laws(problem, evaluation, 20.0)
    assert laws[0].name == "current_varying"
    assert laws[0].heldout_gain > won_by("disturbance_colour", laws)
    law = find_current(problem, evaluation)
    assert law.errors is not None
    for name, found in case.answer()["causes"][0]["parameters"].items():
        if np.isfinite(law.errors[name]):
            assert abs(law.parameters[name] - found["value"]) < 3 * law.errors[name]


@pytest.mark.parametrize("sizes", ["alike", "gaussian"])
def test_blows_come_out_as_many_and_as_large_whatever_their_sizes(sizes):
    """Their rate and root mean square, by three standard errors."""
    rng = np.random.default_rng(4)
    share, size, N, R = 0.01, 7.0, 200, 30
    hit = rng.uniform(size=(N, R)) < share
    drawn = rng.choice([-1.0, 1.0], (N, R)) if sizes == "alike" else rng.standard_normal((N, R))
    z = rng.standard_normal((N, R)) + size * drawn * hit
    gain, values, loss = impacts(z, np.ones((N, R)), np.arange(R) % 5)
    assert ("evenness" in values) == (sizes == "alike")
    law = Law("disturbance_impacts", "surge", values, gain, loss)
    found, covariance = estimated(law, np.arange(R))
    truth = np.log([hit.mean(), np.sqrt(np.mean((size * drawn[hit]) ** 2) + 1), 1.0])
    errors = np.sqrt(np.diag(covariance))[:3]
    assert np.all(np.abs(found[:3] - truth) < 3 * errors)
    assert np.all(errors < 0.2)
