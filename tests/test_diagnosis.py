"""The diagnosis: innovations are white on a null, causes are named first, the JSON is as told."""

import json
from dataclasses import fields, replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hidden.draw import draw
from hidden.scenarios import Plan

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import KINDS, Extended, Library
from spinndrift.models.recordings.checks.finding import Finding as Checked
from spinndrift.models.recordings.checks.finding import with_findings
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.se3 import AXES, CHANNELS
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.reports.diagnosis_report import diagnosis_page
from spinndrift.sims.reports.figures_simulated import at_ends
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.diagnosis.causes import unsupported
from spinndrift.training.diagnosis.data.arrays import Data
from spinndrift.training.diagnosis.data.checks import limits
from spinndrift.training.diagnosis.disturbance.laws import find_laws
from spinndrift.training.diagnosis.filter import problem as problem_module
from spinndrift.training.diagnosis.filter.innovations import predict
from spinndrift.training.diagnosis.filter.kalman import filtered, make_filter
from spinndrift.training.diagnosis.filter.noise import Noise, process_covariance
from spinndrift.training.diagnosis.filter.sensitivities import whitened_sensitivities
from spinndrift.training.diagnosis.filter.transition import Transition
from spinndrift.training.diagnosis.findings.reported import following, noise_levels, residual
from spinndrift.training.diagnosis.findings.result import (
    AxisResidual,
    Cause,
    DataFinding,
    Diagnosis,
    Support,
    schema,
)
from spinndrift.training.diagnosis.findings.sentences import sentence, verdict
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, Diagnoser, for_all_coefficients
from spinndrift.training.diagnosis.selection.hypotheses import Fit
from spinndrift.training.diagnosis.selection.model_selection import admissible, choose, is_itself
from spinndrift.training.diagnosis.selection.search import Search
from spinndrift.training.diagnosis.selection.state import Selection
from spinndrift.training.diagnosis.validation.claims import LEFT, clearly_better, vetoes

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(runs=2, seconds=6.0)


def recorded(tmp_path, seed, kind="single", **options):
    case = draw(seed, kind, plan=PLAN, **options)
    case.write(tmp_path / "data")
    return case, read_csv(tmp_path / "data")


@pytest.mark.parametrize("even", [True, False])
def test_the_filter_whitens_a_linear_system(even):
    """Innovations from gain-one errors are those of the Kalman filter: unit, white Gaussians."""
    rng = np.random.default_rng(0)
    J = np.zeros((12, 12))
    J[:6, 6:] = np.eye(6)
    J[6:, 6:] = -1.5 * np.eye(6)
    dt, N, R = 0.05, 60, 300
    step = np.full((N, R), dt) if even else dt * rng.choice([0.4, 0.8, 1.1, 1.6], (N, R))
    noise = Noise(np.full(12, 0.02), np.full(6, 1.0))
    kalman = make_filter(
        noise, Transition.constant(scipy.linalg.expm(J * dt)), np.eye(6) / 10, dt, step
    )
    assert kalman.keep.shape[-1] == (1 if even else R)
    moves = {}
    for h in np.unique(step):
        A = scipy.linalg.expm(J * h)
        Q = process_covariance(A, np.eye(6) / 10, noise.diffusion, h)
        moves[h] = A, np.linalg.cholesky(Q)
    x = np.zeros((12, R))
    y = [x + 0.02 * rng.standard_normal((12, R))]
    error, jacobian = np.zeros((N, 12, R)), np.zeros((N, 12, 12, R))
    for n in range(N):
        A, root = (np.stack([moves[h][i] for h in step[n]], axis=-1) for i in (0, 1))
        x = np.einsum("ijr,jr->ir", A, x)
        x = x + np.einsum("ijr,jr->ir", root, rng.standard_normal((12, R)))
        y.append(x + 0.02 * rng.standard_normal((12, R)))
        error[n] = y[n + 1] - np.einsum("ijr,jr->ir", A, y[n])
        jacobian[n] = A
    z = filtered(error, jacobian, kalman)
    off = 1 / np.sqrt(z.size)
    assert np.mean(z**2) == pytest.approx(1, abs=6 * off)
    if not even:  # whatever the step
        for h in np.unique(step):
            own = z.swapaxes(0, 1)[:, step == h]
            assert np.mean(own**2) == pytest.approx(1, abs=6 / np.sqrt(own.size))
    for lag in (1, 2, 5):
        assert np.mean(z[lag:] * z[:-lag]) == pytest.approx(0, abs=6 * off)
    assert np.mean(z[1:, :6] * z[:-1, 6:]) == pytest.approx(0, abs=8 * off)


@pytest.fixture(scope="module")
def null(tmp_path_factory):
    """Two nulls, looked at."""
    found = []
    for seed in (1, 2):
        folder = tmp_path_factory.mktemp("null")
        _, recording = recorded(folder, seed, "null")
        diagnoser = Diagnoser(recording, VEHICLE).problem
        found.append((diagnoser, diagnoser.evaluate(diagnoser.believed)))
    return found


def test_slopes_that_overflow_are_a_step_too_far(null, monkeypatch):
    problem, evaluation = null[0]
    steep = np.full(evaluation.predictions.jacobian.shape, np.inf)
    broken = evaluation.predictions._replace(jacobian=steep)
    monkeypatch.setattr(problem_module, "predict", lambda *given: broken)
    with pytest.raises(FloatingPointError, match="overflow"):
        problem.predict(problem.believed)


def test_noise_is_found_and_innovations_are_white_on_a_null(null):
    """Two minutes of data: levels within what so few samples allow, whiteness to a few sigma."""
    for diagnoser, evaluation in null:
        record, b = evaluation.noise.record, evaluation.noise.diffusion
        np.testing.assert_allclose(record[:3], 0.005, rtol=0.2)
        np.testing.assert_allclose(record[3:6], 0.0017, rtol=0.2)
        np.testing.assert_allclose(b[:3], 1.0, rtol=0.25)
        np.testing.assert_allclose(b[3:], 0.03, rtol=0.25)
        z = evaluation.z
        n = np.sqrt(z.shape[0] * z.shape[2])
        assert np.abs(z.mean(axis=(0, 2)) * n).max() < 4.5
        acf = (z[1:] * z[:-1]).mean(axis=(0, 2)) / (z**2).mean(axis=(0, 2))
        assert np.abs(acf).max() * n < 6
        assert diagnoser.data.steps == 20 * 110  # half a second is what thrusters remember


@pytest.mark.parametrize(
    "reckoned", [(0, 1), *(pytest.param(c, marks=pytest.mark.slow) for c in ((), (0, 1, 2)))]
)
def test_responses_of_instruments_are_derivatives_of_the_innovations(null, reckoned):
    """Also where instruments are at fault already: records differ as they show states.

    To first order: errors before a step move on as they do at θ.
    """
    problem = null[0][0]
    problem = replace(problem, data=replace(problem.data, reckoned=reckoned))
    library = problem.library
    rows = [library.index("heading_error", "all", "sine")]
    rows += [library.index("dvl_misalignment", "yaw", "angle")]
    theta = problem.believed.copy()
    theta[rows] = 0.06, 0.04
    p, _, kalman = problem.predict(theta)
    probes = np.zeros((2, library.size))
    probes[[0, 1], rows] = 0.002
    z = whitened_sensitivities(problem.model, library, theta, probes, problem.data, p, kalman)
    before = filtered(np.asarray(p.error), np.asarray(p.jacobian), kalman)
    for response, probe in zip(z[1:], probes, strict=True):
        q = predict(problem.model, library, theta + probe, problem.data)
        after = filtered(np.asarray(q.error), np.asarray(p.jacobian), kalman)
        change = (after - before) * problem.data.weight[:, None]
        off = response.reshape(change.shape) - change
        assert np.sum(off**2) < 5e-4 * np.sum(change**2)


@pytest.mark.slow
def test_one_step_finds_a_heading_error_where_a_sample_turns_less_than_a_probe(tmp_path):
    case = draw(0, names=("heading_error",), plan=replace(PLAN, rate=50.0))
    case.write(tmp_path / "data")
    problem = Diagnoser(read_csv(tmp_path / "data"), VEHICLE).problem
    rows = problem.library.at("heading_error", "all")
    step = problem.evaluate(problem.believed, rows).evidence.fit(rows).values
    truth, none = case.effects[0].parameters(), {"value": 0.0}
    for i, found in zip(rows, step, strict=True):
        name = problem.library.entries[i].parameter.name
        assert found == pytest.approx(truth.get(name, none)["value"], abs=0.004), name


def test_nulls_are_adequate(null):
    """No name wins what noise can't: the calibrated threshold holds on data of another maker."""
    for diagnoser, evaluation in null:
        library = diagnoser.library
        sets = {h: library.at(*h) for h in library.hypotheses(single=False)}
        chance = evaluation.evidence.chance(list(sets.values()), [], np.random.default_rng(0))
        threshold = chance.exceeded(0.01)
        assert chance.beyond(threshold) == pytest.approx(0.01)
        assert 3 < threshold < 20
        fits = {h: evaluation.evidence.fit(s) for h, s in sets.items()}
        assert choose(library, diagnoser.believed, fits, threshold, 0.01) is None


@pytest.mark.parametrize(
    "name",
    [
        "current_steady",
        "dvl_misalignment",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("thruster_dead_zone", "thruster_gain", "net_buoyancy")
        ),
    ],
)
def test_causes_are_named_first(tmp_path, name):
    case, recording = recorded(tmp_path, 11, names=(name,))
    diagnoser = Diagnoser(recording, VEHICLE).problem
    evaluation = diagnoser.evaluate(diagnoser.believed)
    library = diagnoser.library
    fits = {h: evaluation.evidence.fit(library.at(*h)) for h in library.hypotheses(single=False)}
    choice = choose(library, diagnoser.believed, fits, 8.0, 0.01)
    assert choice is not None
    assert choice.hypothesis[0] == name
    del case


@pytest.mark.slow
def test_a_lag_is_named_measured_and_extended(tmp_path):
    """The whole way: name, value inside three standard errors, gain, JSON as its schema says."""
    case, recording = recorded(tmp_path, 5, names=("thruster_lag",))
    seen = []
    finding = Diagnoser(
        recording, VEHICLE, config=DiagnoseConfig(most=1, horizon=2.0),
        progress=lambda fraction, remark: seen.append(fraction),
    ).run()  # fmt: skip
    d = finding.diagnosis
    assert d.verdict == "explained"
    assert d.causes[0].name == "thruster_lag"
    truth = case.answer()["causes"][0]
    found = d.causes[0].parameters["time_constant"]
    if truth["where"] == "all":
        error = (found.interval95[1] - found.interval95[0]) / 3.92
        assert abs(found.value - truth["parameters"]["time_constant"]["value"]) < 3 * error + 1e-3
    assert (
        d.gain["extended"].position_rmse["1"].value < 0.9 * d.gain["base"].position_rmse["1"].value
    )
    scores = {name: gain.log_score.value for name, gain in d.gain.items()}
    assert scores["extended"] == max(scores.values()), "naming pays its way"
    assert d.gain["extended"].log_score_gain.interval95[0] > 0
    # bands of 39 samples at 7 s of 20 runs: what the noise alone leaves unsure
    for band, table in d.gain["extended"].coverage.items():
        assert table["1"].value == pytest.approx(float(band.split()[0]) / 100, abs=0.1)
    assert [effect.name for effect in finding.extended.effects] == ["thruster_lag"]
    assert seen == sorted(seen)
    assert 0.9 < seen[-1] < 1, "a second pass may follow"
    check(json.loads(d.as_json()), schema())
    assert min(d.causes[0].experiments.values()) >= 0
    html = diagnosis_page(finding, "A lag").html()
    for title in ("Simulations and records", "Where the error lives", "Error or noise"):
        assert title in html
    assert html.count("data:image") == 13
    # simulated windows end as far from the records as the simulated noise is wide
    z, _, _ = at_ends(finding, finding.simulated["extended"])
    assert np.sqrt((z**2).mean()) == pytest.approx(1, abs=0.15)
    assert (at_ends(finding, finding.simulated["base"])[0] ** 2).mean() > (z**2).mean()
    # the claim holds on left-out data, and would not hold of the belief
    assert d.left == []
    assert d.sentence.endswith("of the forecast error.")
    assert all(0 < share.value < 1 for share in d.explained.values())
    assert finding.asserted is finding.judged["extended"]
    assert clearly_better(finding.judged["extended"], finding.judged["base"], 0)
    at = list(d.explained)
    assert set(finding.judged) - set(d.gain) == {LEFT}, "a black box on what the cause leaves"
    rivals = {"base": finding.judged["base"], "refitted": finding.judged["extended"]}
    (told,) = vetoes(rivals, "base", at, {}, 0)
    assert told.startswith("refitted coefficients forecast")


def check(value, rule, root=None):
    """As much of JSON Schema as ours uses."""
    root = rule if root is None else root
    if "$ref" in rule:
        rule = root["$defs"][rule["$ref"].split("/")[-1]]
    if "anyOf" in rule:
        one = [r for r in rule["anyOf"] if (r.get("type") == "null") == (value is None)]
        check(value, one[0], root)
        return
    if "enum" in rule:
        assert value in rule["enum"]
        return
    kinds = {"object": dict, "array": list, "string": str, "integer": int, "number": (int, float),
             "null": type(None)}  # fmt: skip
    names = rule["type"] if isinstance(rule["type"], list) else [rule["type"]]
    assert any(isinstance(value, kinds[name]) for name in names), (value, rule)
    if isinstance(value, dict):
        known = rule.get("properties", {})
        assert set(rule.get("required", ())) <= set(value)
        for key, part in value.items():
            if known:
                assert key in known
                check(part, known[key], root)
            else:
                check(part, rule["additionalProperties"], root)
    if isinstance(value, list):
        assert rule.get("minItems", 0) <= len(value) <= rule.get("maxItems", len(value))
        for part in value:
            check(part, rule["items"], root)


def test_the_schema_is_that_of_the_dataclasses():
    told = schema(Diagnosis)
    assert told["$ref"] == "#/$defs/Diagnosis"
    assert told["$defs"]["Diagnosis"]["properties"]["verdict"]["enum"][0] == "adequate"
    assert set(told["$defs"]) >= {"Cause", "Value", "ModelGain", "DataSummary"}


LIBRARY = Library(
    [KINDS[n].neutral() for n in ("thruster_lag", "thrust_curve", "thrust_scale", "clock_offset")]
)


def fit(name, where, gain, values, spread=0.0, seed=0, runs=40, p=1e-9):
    heldout = np.full(runs, gain / runs)
    heldout += spread * np.random.default_rng(seed).standard_normal(runs)
    heldout += (gain - heldout.sum()) / runs
    rows = LIBRARY.at(name, where)
    return Fit(tuple(rows), np.array(values), {}, np.full(len(rows), 1e-3), gain, heldout, p)


def test_names_follow_the_rules():
    zero = np.zeros(LIBRARY.size)
    scale, curve = ("thrust_scale", "all"), ("thrust_curve", "all")
    fits = {scale: fit(*scale, 500.0, [0.1]), curve: fit(*curve, 505.0, [0.01, 0.1])}
    choice = choose(LIBRARY, zero, fits, 8.0, 0.01)
    assert choice is not None
    assert choice.hypothesis == scale, "the simpler name wins unless beaten by 10 nats"
    fits[curve] = fit(*curve, 600.0, [0.05, 0.1])
    choice = choose(LIBRARY, zero, fits, 8.0, 0.01)
    assert choice is not None
    assert choice.hypothesis == curve
    lag, clock = ("thruster_lag", "all"), ("clock_offset", "twist")
    assert not admissible(LIBRARY, zero, fit(*lag, 50.0, [-0.05])), "a negative lag is vetoed"
    fits = {clock: fit(*clock, 50.0, [0.01])}
    assert choose(LIBRARY, zero, fits, 8.0, 0.01) is not None
    assert choose(LIBRARY, zero, fits, 8.0, 0.01, {"thruster_lag": 1e4}) is None, "an echo"
    tied = {lag: fit(*lag, 52.0, [0.1], 1.0), clock: fit(*clock, 50.0, [0.01], 1.0, seed=1)}
    choice = choose(LIBRARY, zero, tied, 8.0, 0.01)
    assert choice is not None
    assert choice.ties == (clock,)
    assert choice.apart_from([lag, clock]).ties == (), "what is named itself is told apart"
    assert choice.apart_from([lag]).ties == (clock,)
    behind = {lag: fit(*lag, 300.0, [0.1], 40.0), clock: fit(*clock, 50.0, [0.01], 40.0, seed=1)}
    choice = choose(LIBRARY, zero, behind, 8.0, 0.01)
    assert choice is not None
    assert choice.ties == (), "hundreds of nats are no tie, however few the runs that show them"


def test_names_need_the_support_of_the_joint_fit():
    """One interval without no effect, and no parameter at a bound of its range."""
    curve = ("thrust_curve", "all")
    rows = LIBRARY.at(*curve)
    for values, errors, kept in (
        ((0.1, 0.1), (0.01, 0.2), True),
        ((0.1, 0.1), (0.1, 0.2), False),
        ((1.0, 0.1), (0.01, 0.02), False),
    ):
        theta = np.zeros(LIBRARY.size)
        theta[rows] = values
        joint = replace(fit(*curve, 500.0, [0.0, 0.0]), errors=np.array(errors))
        dropped = unsupported(LIBRARY, [curve], theta, joint)
        assert dropped == ([] if kept else [curve]), values


@pytest.mark.parametrize(
    ("runs", "gain", "named"), [(6, 15.0, True), (6, 10.0, False), (40, 15.0, False)]
)
def test_few_runs_ask_for_a_clear_gain_in_place_of_a_robust_p(runs, gain, named):
    """An effect that some of six runs show has no p between runs at all."""
    scale = ("thrust_scale", "all")
    fits = {scale: fit(*scale, gain, [0.1], runs=runs, p=0.2)}
    choices = [
        choose(LIBRARY, np.zeros(LIBRARY.size), fits, 8.0, 0.01, strict=s) for s in (False, True)
    ]
    assert (choices[0] is not None) == named
    assert choices[1] is None, "unless a law of the disturbance wins more"


def test_laws_of_what_is_left():
    """White noise has no law; blows, speed dependence and slow parts are told apart."""
    rng = np.random.default_rng(4)
    N, R = 120, 60
    weight, fold = np.ones((N, R)), np.repeat(np.arange(6), R // 6)
    speed = np.abs(rng.normal(0.4, 0.2, (N, R)))

    def best(change):
        z = rng.standard_normal((N, 12, R))
        z[:, 7] = change(z[:, 7])
        return find_laws(z, speed, weight, fold, 0.05, np.ones(6))[0]

    assert best(lambda z: z).heldout_gain < 6
    blows = best(lambda z: z * np.where(rng.random(z.shape) < 0.01, 8.0, 1.0))
    assert (blows.name, blows.where) == ("disturbance_impacts", "sway")
    grows = best(lambda z: z * np.sqrt(1 + 4 * speed**2))
    assert (grows.name, grows.where) == ("disturbance_state_dependence", "sway")
    slow = np.zeros((N, R))
    for n in range(1, N):
        slow[n] = 0.96 * slow[n - 1] + 0.12 * rng.standard_normal(R)
    coloured = best(lambda z: z + slow)
    assert (coloured.name, coloured.where) == ("disturbance_colour", "sway")


def test_predictions_without_noise_have_no_error():
    """Data of the model itself: one-step errors are those of the integrator alone."""
    rng = np.random.default_rng(7)
    model = Extended.create(VEHICLE.dynamics(), (), VEHICLE.thrusters())
    N, R, fine = 120, 20, 8
    u = np.repeat(rng.normal(0, 2, (N // 10, 8, R)), 10, axis=0)
    X0 = np.zeros((7, R))
    X0[0] = 1
    commands = jnp.asarray(np.repeat(u, fine, axis=0))
    X, V = model.rollout(jnp.asarray(X0), jnp.zeros((6, R)), commands, 0.05 / fine)
    X = np.concatenate([X0[None], np.asarray(X)[fine - 1 :: fine]])
    V = np.concatenate([np.zeros((1, 6, R)), np.asarray(V)[fine - 1 :: fine]])
    data = Data(
        X, V, u, u[:1], np.full((1, R), 0.05), np.ones((N, R)), np.full((N, R), 0.05),
        np.ones((N, R)), np.zeros(R, int), np.arange(R), ("one",), 0.05, "thruster_force", True,
    )  # fmt: skip
    library = Library([KINDS["net_buoyancy"].neutral()])
    p = predict(model, library, np.zeros(library.size), data)
    # a hundredth of what the process noise of one step makes of the twist
    step = np.repeat([1.0, 0.03], 3) * np.sqrt(0.05) / np.diag(np.asarray(model.inertia().matrix))
    error = np.abs(np.asarray(p.error)).max(axis=(0, 2))
    assert np.all(error[6:] < 0.01 * step)
    assert np.all(error[:6] < 0.01 * step * 0.05)


def test_steps_of_any_length_are_predicted_with_what_thrusters_remember():
    """Commands that begin with each uneven step, late and lagged: as a fine rollout has it."""
    rng = np.random.default_rng(8)
    fine, N, R = 0.005, 60, 6
    counts = rng.choice([4, 8, 11, 16], (N, R))  # 20 to 80 ms
    total = int(counts.sum(axis=0).max())
    level = rng.normal(0, 3, (N, 8, R))
    u = np.zeros((total, 8, R))
    for r in range(R):
        own = np.repeat(level[:, :, r], counts[:, r], axis=0)
        u[:, :, r] = np.concatenate([own, np.repeat(own[-1:], total - len(own), axis=0)])
    late = KINDS["actuation_delay"].of(delay=0.07, options={"steps": 30})
    lag = KINDS["thruster_lag"].of(time_constant=0.1)
    model = Extended.create(VEHICLE.dynamics(), (late, lag), VEHICLE.thrusters())
    X0 = np.zeros((7, R))
    X0[0] = 1
    X, V = model.rollout(jnp.asarray(X0), jnp.zeros((6, R)), jnp.asarray(u), fine)
    X = np.concatenate([X0[None], np.asarray(X)])
    V = np.concatenate([np.zeros((1, 6, R)), np.asarray(V)])
    at = np.concatenate([np.zeros((1, R), int), np.cumsum(counts, axis=0)])
    X, V = (np.stack([a[at[:, r], :, r] for r in range(R)], axis=-1) for a in (X, V))
    data = Data(
        X, V, level, level[:1], fine * counts[:1], np.ones((N, R)), fine * counts, np.ones((N, R)),
        np.zeros(R, int), np.arange(R), ("one",), float(fine * counts.mean()), "thruster_force",
        True,
    )  # fmt: skip
    library = Library([KINDS["actuation_delay"].neutral(), KINDS["thruster_lag"].neutral()])
    theta = np.zeros(library.size)
    before = predict(model.with_effects(()), library, theta, data)
    theta[library.index("actuation_delay", "all", "delay")] = 0.07
    theta[library.index("thruster_lag", "all", "time_constant")] = 0.1
    p = predict(model.with_effects(()), library, theta, data)
    wrong, right = (np.abs(np.asarray(a.error))[5:, 6:].max(axis=(0, 2)) for a in (before, p))
    assert np.all(right < 0.02 * wrong), (right, wrong)


def test_structure_without_a_name_is_found_where_it_is(tmp_path):
    """The flow's memory on one axis: seen there, with its time and frequency, and on no other."""
    from spinndrift.training.diagnosis.candidates.groups import _memory, refined
    from spinndrift.training.diagnosis.candidates.structures import Screen

    case, recording = recorded(tmp_path, 70002, "unknown", names=("memory",))
    hidden = case.answer()["causes"][0]
    problem = Diagnoser(recording, VEHICLE).problem
    evaluation = problem.evaluate(problem.believed)
    screen, rng = Screen(problem, evaluation, None), np.random.default_rng(0)
    nodes = [(t, f) for t in (0.4, 1.2, 4.0) for f in (0.0, 0.2, 0.5, 1.0)]
    found = {
        axis: screen.match(_memory(problem, i, i, nodes), 0.01, rng)
        for i, axis in ((1, "sway"), (5, "yaw"))
    }
    assert hidden["where"] == "yaw"
    assert found["yaw"].gain > found["yaw"].threshold
    assert found["yaw"].gain > 50 * abs(found["sway"].gain)
    effect = refined(screen, found["yaw"], rng)
    parameters = hidden["parameters"]
    assert effect.numbers[0] == pytest.approx(parameters["decay"]["value"], rel=0.3)
    assert effect.numbers[1] == pytest.approx(parameters["frequency"]["value"], rel=0.15)


@pytest.mark.parametrize(
    ("name", "seed", "kind", "words"),
    [
        pytest.param("backlash", 70013, "play", "backlash", marks=pytest.mark.slow),
        ("slew", 70004, "slew", "N/s at most"),
        pytest.param(
            "exchange", 70005, "exchange", "take each other's command", marks=pytest.mark.slow
        ),
        pytest.param("steps", 70006, "steps", "in steps of", marks=pytest.mark.slow),
    ],
)
def test_how_thrusters_follow_is_told_with_number_and_place(tmp_path, name, seed, kind, words):
    """One of eight with play, all at a limited rate or in steps, two at each other's drive."""
    from spinndrift.training.diagnosis.candidates.groups import described, refined
    from spinndrift.training.diagnosis.candidates.unknowns import screened

    case, recording = recorded(tmp_path, seed, "unknown", names=(name,))
    hidden = case.answer()["causes"][0]
    problem = Diagnoser(recording, VEHICLE).problem
    rng = np.random.default_rng(0)
    seen = screened(problem, problem.evaluate(problem.believed), [], 0.01, rng)
    assert seen is not None
    effect = refined(seen[0], seen[1], rng)
    assert (effect.kind, effect.acts_on) == (kind, hidden["where"])
    told = described(effect, np.ones(1), np.zeros(1), problem)
    assert told["variables"] == list(case.answer()["causes"][0]["variables"])
    if name != "exchange":
        (number,) = hidden["parameters"].values()
        assert effect.numbers[0] == pytest.approx(number["value"], rel=0.1)
    assert words in told["description"]


@pytest.mark.slow
def test_a_velocity_that_heading_turns_is_found_with_its_terms_alone(tmp_path):
    """And thrusters of ten times the force are tried with steps and rates of ten times the size."""
    from spinndrift.training.diagnosis.candidates.groups import described, groups, refined
    from spinndrift.training.diagnosis.candidates.unknowns import screened

    case, recording = recorded(tmp_path, 70017, "unknown", names=("course",))
    hidden = case.answer()["causes"][0]
    problem = Diagnoser(recording, VEHICLE).problem
    evaluation, rng = problem.evaluate(problem.believed), np.random.default_rng(0)
    seen = screened(problem, evaluation, [], 0.01, rng)
    assert seen is not None
    effect = refined(seen[0], seen[1], rng)
    assert (effect.kind, effect.acts_on) == ("course", hidden["where"])
    _, velocity = hidden["variables"]
    k, turned = (p["value"] for p in hidden["parameters"].values())
    own = [effect.terms.index(f"{turn} ψ·{velocity}") for turn in ("cos", "sin")]
    weights, errors = np.zeros(12), np.full(12, 0.1)
    weights[own] = k * np.cos(turned), k * np.sin(turned)
    told = described(effect, weights, errors, problem)
    assert told["variables"] == ["heading", velocity]
    assert set(told["description"].split(" in ")[1].split(", ")) == {effect.terms[i] for i in own}

    def numbers(data):
        tried = groups(replace(problem, data=data), evaluation, of_commands=True)
        return np.array([n for g in tried if g.labels and g.effect.kind != "exchange"
                         for label in g.labels for n in label])  # fmt: skip

    ten = replace(problem.data, u=10 * problem.data.u)
    np.testing.assert_allclose(numbers(ten), 10 * numbers(problem.data))
    assert not numbers(replace(problem.data, u=0 * problem.data.u)).size


def test_what_runs_ahead_of_its_command_has_no_rate_limit(tmp_path, monkeypatch):
    from spinndrift.models.effects.unknown import Unknown
    from spinndrift.training.diagnosis.candidates.groups import FOLLOWED, _of_follower
    from spinndrift.training.diagnosis.candidates.structures import Screen

    problem = Diagnoser(recorded(tmp_path, 3, "null")[1], VEHICLE).problem
    largest = float(np.abs(problem.data.u).max())
    numbers = [n * largest for n in FOLLOWED["slew"]]
    group = _of_follower(problem, "slew", "thrusters", numbers)

    def won(lag):
        theta = problem.believed.copy()
        theta[problem.library.at("thruster_lag", "all")] = lag
        screen = Screen(problem, problem.evaluate(theta), None)
        return screen.match(group, 0.01, np.random.default_rng(0), draws=0).gain

    assert won(0.1) < 8.0  # nats, below which no gain is tested
    monkeypatch.setattr(Unknown, "is_share", False)
    assert won(0.1) > 100.0, "a weight of any sign wins against a belief that lags"


def test_single_precision_is_refused_with_a_remedy(tmp_path):
    recording = recorded(tmp_path, 3, "null")[1]
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        Diagnoser(recording, VEHICLE)


@pytest.mark.slow
def test_a_swaying_mass_ahead_of_the_origin_is_seen_in_yaw(tmp_path):
    """The turning moment remembers the velocity to the side, and rings with the hidden spring."""
    from spinndrift.training.diagnosis.candidates.unknowns import screened

    case, recording = recorded(tmp_path, 70011, "unknown", names=("appendage",))
    hidden = case.answer()["causes"][0]
    problem = Diagnoser(recording, VEHICLE).problem
    evaluation = problem.evaluate(problem.believed)
    seen = screened(problem, evaluation, [], 0.01, np.random.default_rng(0))
    assert hidden["where"] == "sway"
    assert seen is not None
    group = seen[1].group
    assert (group.effect.kind, group.effect.acts_on, group.variables) == ("memory", "yaw", ("v",))
    hertz = hidden["parameters"]["frequency"]["value"]
    assert group.labels[seen[1].node][1] == pytest.approx(hertz, rel=0.1)


def test_errors_that_follow_each_other_are_not_called_adequate():
    """Of velocities alone: a filter's estimates err slowly in positions too, a law has a name."""

    def left(position, velocity, causes=(), attitude=0.0):
        sizes = 3 * [position] + 3 * [attitude] + 3 * [velocity] + 3 * [0.0]
        residual = {
            name: AxisResidual(1.0, size, 0.0) for name, size in zip(CHANNELS, sizes, strict=True)
        }
        return following(residual, causes)

    assert left(0.0, 0.1) == left(0.8, 0.8) == []
    assert left(np.nan, 0.8, attitude=0.8) == [], "without positions, the attitude tells"
    assert left(np.nan, 0.8) == left(0.0, 0.8, attitude=0.8) != []
    (told,) = left(0.0, 0.8)
    assert told.startswith("errors of u, v, w follow each other")
    assert verdict((), [told]) == "unexplained"
    assert told in sentence((), (), False, [told])
    law = Cause("disturbance_colour", "surge", {}, Support(0.0, 9.0), [], [], "")
    assert left(0.0, 0.8, [law]) == []
    assert verdict([law], [told]) == "partly_explained"


def test_an_instrument_slower_than_the_rows_is_told(tmp_path):
    """A DVL of 5 Hz in rows of 20 Hz repeats its samples: its mean delay is no clock's."""
    from spinndrift.training.diagnosis.data.checks import problems

    recording = recorded(tmp_path, 3, "null")[1]
    V = recording.dataset["V_WB_B"].to_numpy()
    V[:, :, :, :3] = V[:, :, np.arange(V.shape[2]) // 4 * 4, :3]
    told, faulty = problems(recording)
    assert len(told) == 1
    assert told[0].startswith("u,v,w repeat the sample before in 75% of the rows")
    assert not faulty


def test_positions_that_were_not_measured_tell_nothing_and_ask_for_nothing(tmp_path):
    """A lever arm is in what is dead-reckoned too: that must not count as a second witness."""
    case, recording = recorded(tmp_path, 2, names=("dvl_lever_arm",), size=2.0)
    hidden = recording.dataset.copy(deep=True)
    hidden["X_WB"][..., 4:6] = np.nan
    diagnoser = Diagnoser(Recording(hidden), VEHICLE)
    problem = diagnoser.problem
    assert problem.data.unmeasured == ("x", "y")
    assert not diagnoser.faults
    evaluation = problem.evaluate(problem.believed)
    elsewhere = problem.data.X.copy()
    elsewhere[:, 4] += np.sin(problem.data.times)
    moved = replace(problem, data=replace(problem.data, X=elsewhere))
    np.testing.assert_allclose(moved.evaluate(problem.believed).z, evaluation.z, atol=2e-3)
    assert np.abs(evaluation.z[:, :3]).max() < 0.01
    rows = [problem.library.index("dvl_lever_arm", axis, "offset") for axis in "xyz"]
    theta, after, fit = problem.polish(problem.believed, rows)
    arm = np.array([p["value"] for p in case.effects[0].parameters().values()])
    assert np.all(np.abs(theta[rows] - arm) < 3 * fit.errors)
    assert np.all(fit.errors < 0.02)
    np.testing.assert_allclose((after.z[:, 3:] ** 2).mean(axis=(0, 2)), 1.0, atol=0.15)
    left = residual(problem, after)
    assert all(np.isnan(left[name].variance_ratio) for name in "xyz")
    assert "position_m" not in noise_levels(problem, after)
    assert "x, y of the position were not measured" in limits(problem.data, [], False)[0]
    hidden["V_WB_B"][..., 3] = np.nan
    with pytest.raises(UserError, match="V_WB_B p is missing; a diagnosis needs"):
        Diagnoser(Recording(hidden), VEHICLE)


def test_a_fit_goes_back_from_a_filter_that_diverges(tmp_path):
    _, recording = recorded(tmp_path, 2, names=("net_buoyancy",), size=1.0)
    problem = Diagnoser(recording, VEHICLE).problem
    seen = problem.evaluate(problem.believed)
    unstable = replace(seen.kalman, keep=30 * seen.kalman.keep)
    row = next(i for i, e in enumerate(problem.library.entries) if e.cause == "net_buoyancy")
    with pytest.raises(FloatingPointError, match="the filter of one-step errors diverges"):
        problem.evaluate(problem.believed, [row], unstable)
    real, tried = type(problem).evaluate, []

    class Fragile(type(problem)):
        """Its filter diverges the farther half of the way."""

        def evaluate(self, theta, chosen=None, kalman=None, previous=None):
            tried.append(theta[row])
            far = abs(theta[row]) > 2.5
            return real(self, theta, chosen, unstable if far else kalman, previous)

    given = {f.name: getattr(problem, f.name) for f in fields(problem) if f.init}
    start = problem.believed.copy()
    start[row] = 4.0
    found, _, _ = Fragile(**given).polish(start, [row], seen.kalman, origin=seen)
    assert max(np.abs(tried)) == 4.0
    assert abs(found[row]) <= 2.5


def test_states_that_a_log_says_are_estimated_have_the_noise_of_estimates(tmp_path):
    _, recording = recorded(tmp_path, 2, names=("net_buoyancy",), size=1.0)
    told = Recording(recording.dataset.assign_attrs(states_estimated=1))
    for given, estimated in ((recording, False), (told, True)):
        problem = Diagnoser(given, VEHICLE).problem
        assert problem.data.estimated == estimated
        assert problem.predict(problem.believed)[1].estimated == estimated


@pytest.mark.parametrize(
    ("names", "left", "again"),
    [
        (("quadratic_drag", "added_mass"), (), True),
        (("thrust_scale", "linear_drag", "tether"), (), True),
        (("quadratic_drag", "quadratic_drag"), (), False),
        (("quadratic_drag", "tether"), (), False),
        (("unknown", "dvl_scale"), (), False),
        ((), ("its forecasts diverge",), True),
    ],
)
def test_all_coefficients_are_tried_where_several_are_named_or_something_is_left(
    names, left, again
):
    causes = [SimpleNamespace(name=name) for name in names]
    assert bool(for_all_coefficients(SimpleNamespace(causes=causes, left=left))) == again


def test_axes_that_are_not_driven_and_filled_samples_are_told(tmp_path):
    from hidden.faults import spoil

    from spinndrift.training.diagnosis.data.checks import problems

    idle = draw(3, "null", plan=Plan(scenarios=2, runs=1, seconds=4.0, idle=(1,)))
    idle.write(tmp_path / "idle")
    recording = read_csv(tmp_path / "idle")
    checked = Checked("axis-silent", "sway", "it does not answer", "drive it")
    diagnoser = Diagnoser(Recording(with_findings(recording.dataset, [checked])), VEHICLE)
    assert diagnoser.quiet == ["sway"]
    (told,) = diagnoser.checked  # go into diagnosis.json
    assert told == DataFinding("axis-silent", "note", "sway", "it does not answer", "drive it")
    case = draw(3, "null", plan=PLAN)
    assert problems(_read(tmp_path / "clean", case.logged())) == ([], [])
    faults = (("stuck", "stuck"), ("clock_jump", "clock"), ("outliers", "outliers"))
    for fault, word in faults:
        runs, told = spoil(case.logged(), fault, seed=3)
        found, faulty = problems(_read(tmp_path / fault, runs))
        assert word in " ".join(found)
        assert faulty == [int(told[0]["file"][4:7]) - 1]
    runs, _ = spoil(case.logged(), "gap", seed=3)
    assert "missing" in problems(_read(tmp_path / "gap", runs))[0][0]
    blows = draw(3, names=("disturbance_impacts",), size=3.0, plan=PLAN)
    assert problems(_read(tmp_path / "blows", blows.logged())) == ([], [])


def test_a_small_jump_of_the_clock_is_told_and_a_lost_sample_is_none(tmp_path):
    """Longer steps among even ones: the vehicle moves on as in one step, or as in all of it."""
    from hidden.faults import change, clock_jump
    from hidden.write import write_folder

    from spinndrift.training.diagnosis.data.checks import problems

    runs = draw(3, "null", plan=PLAN).logged()
    moving = runs[2]
    jumped = clock_jump(moving, np.random.default_rng(0), 0.12)[0]

    def read(name, run):
        write_folder(tmp_path / name, [*runs[:2], run, *runs[3:]])
        return read_csv(tmp_path / name, resample=False)

    (told,), faulty = problems(read("jump", jumped))
    assert "time stamps jump by 0.12 s" in told
    assert faulty == [2]
    kept = np.delete(np.arange(moving.columns["t"].size), [40, 70, 71])
    lost = change(moving, **{name: x[kept] for name, x in moving.columns.items()})
    assert problems(read("lost", lost)) == ([], [])


@pytest.mark.parametrize("channel", ["v", "w", "q"])
def test_a_velocity_of_the_wrong_sign_is_refused(tmp_path, channel):
    from spinndrift.training.diagnosis.data.checks import problems

    recording = recorded(tmp_path, 3, "null")[1]
    recording.dataset["V_WB_B"][..., "uvwpqr".index(channel)] *= -1
    with pytest.raises(UserError, match=f"^{channel}: the recorded sign is opposite.*NED/FRD"):
        problems(recording)


def test_commands_that_never_change_name_nothing_that_follows_them(tmp_path):
    recording = recorded(tmp_path, 3, "null")[1]
    recording.dataset["thruster_force"][...] = 3.0
    diagnoser = Diagnoser(recording, VEHICLE)
    assert diagnoser.faults[0].startswith("thruster_force never changes")
    assert diagnoser.quiet == list(AXES)
    search = diagnoser._selector(diagnoser.problem, [])
    names = {name for name, _ in search.names(diagnoser.problem)}
    assert not names & {"thruster_lag", "quadratic_drag", "proximity", "payload"}
    assert names >= {"net_buoyancy", "current_steady", "dvl_scale"}


def test_too_little_data_and_pulses_as_forces_are_refused(tmp_path):
    recording = recorded(tmp_path, 3, "null")[1]
    short = recording.dataset.isel(scenario=slice(0, 3), time=slice(0, 6))
    with pytest.raises(UserError, match="too little for a diagnosis"):
        Diagnoser(Recording(short), VEHICLE)
    pulses = recording.dataset.copy(deep=True)
    pulses["thruster_force"][...] = 1500.0 + 8 * pulses["thruster_force"]
    with pytest.raises(UserError, match="times what one of bluerov2_heavy gives: give newtons"):
        Diagnoser(Recording(pulses), VEHICLE)


@pytest.mark.slow
def test_times_below_those_of_sparse_commands_are_no_cause(tmp_path):
    """Lines between commands that were logged now and then show as a small delay of something."""
    case, recording = recorded(tmp_path, 3, names=("clock_offset",), size=0.3)
    assert all(abs(p["value"]) < 0.1 * 0.1 for p in case.effects[0].parameters().values())
    sparse = Recording(recording.dataset.assign_attrs(command_period=0.1))
    for given, named in ((recording, True), (sparse, False)):
        diagnoser = Diagnoser(given, VEHICLE)
        evaluation = diagnoser.problem.evaluate(diagnoser.problem.believed)
        start = Selection.start(diagnoser.problem, evaluation)
        choice, _ = diagnoser._selector(diagnoser.problem, []).propose(start).proposed
        assert (choice is not None and choice.hypothesis[0] == "clock_offset") == named
    assert "logged at 10 Hz" in limits(diagnoser.problem.data, [], False, command_period=0.1)[-1]
    assert limits(
        diagnoser.problem.data, [], False, command_period=diagnoser.problem.data.dt
    ) == limits(diagnoser.problem.data, [], False)


def _read(folder, runs):
    from hidden.write import write_folder

    write_folder(folder, runs)
    return read_csv(folder)


@pytest.mark.slow
def test_a_name_nested_in_another_keeps_the_data(tmp_path):
    """A tether can push up as buoyancy does, with six numbers more: the simple name is given."""
    _, recording = recorded(tmp_path, 12, names=("net_buoyancy",))
    problem = Diagnoser(recording, VEHICLE).problem
    evaluation = problem.evaluate(problem.believed)
    found = Search(most=1).run(Selection.start(problem, evaluation))
    assert found.hypotheses == [("net_buoyancy", "all")]
    fits, won = found.fits, found.accepted[0].fit.heldout_gain
    tether = fits["tether", "W"]
    assert tether.heldout_gain > won - 10
    assert not is_itself(problem.library, evaluation.theta, tether), (
        "a tether pulls sideways or tautens"
    )
    held = replace(tether, values=np.array([0.5, *tether.values[1:]]))
    assert is_itself(problem.library, evaluation.theta, held)


@pytest.mark.slow
def test_simulated_states_without_noise_are_no_clock_that_is_off():
    """Of ten substeps a sample: the pose feels a push half a substep late."""
    config = GenerateConfig(
        maneuvers=("surge-forward", "yaw-left", "heave-roll-pitch"), trajectories=4, duration=6.0
    )
    diagnoser = Diagnoser(generate(config, VEHICLE), VEHICLE)
    evaluation = diagnoser.problem.evaluate(diagnoser.problem.believed)
    start = Selection.start(diagnoser.problem, evaluation)
    assert diagnoser._selector(diagnoser.problem, []).propose(start).proposed[0] is None


@pytest.mark.slow
def test_bands_hold_what_a_law_of_the_disturbance_adds(tmp_path):
    """Simulated bands are too narrow without the slow pushes that were hidden, not with them."""
    from spinndrift.training.diagnosis.disturbance.found import laws_of
    from spinndrift.training.diagnosis.findings.reported import law_cause
    from spinndrift.training.diagnosis.validation.simulation import Contender
    from spinndrift.training.diagnosis.validation.validation import judge
    from spinndrift.training.evaluation.metrics import BANDS

    _, recording = recorded(tmp_path, 5, names=("disturbance_colour",))
    problem = Diagnoser(recording, VEHICLE).problem
    evaluation = problem.evaluate(problem.believed, [])
    laws = [w for w in laws_of(problem, evaluation) if w.heldout_gain > 5 and "colour" in w.name]
    _, colour = law_cause(laws, [], problem, evaluation)
    theta = np.repeat(problem.believed[:, None], len(problem.data.fold), axis=1)
    shares, energies = [], []
    for random_effects in ((), (colour,)):
        judged = judge(
            problem, Contender(theta, random_effects=random_effects), 2.0, 0, [], estimated=False
        )
        shares.append(judged.inside[BANDS.index(0.9)].sum(axis=1) / judged.count.sum(axis=1))
        energies.append(judged.energy.sum(axis=1) / judged.count.sum(axis=1))
    assert shares[0][-1] < 0.8
    assert np.all((shares[1] > 0.83) & (shares[1] < 0.96))
    assert np.all(energies[1] < energies[0])
