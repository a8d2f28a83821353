"""`spinndrift check estimator`: scores against their laws, settings, what is done stays done."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_example import example_log

from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.sensors.faults import SensorFault
from spinndrift.sims.commands.check_estimator import CheckEstimator
from spinndrift.sims.estimator_check import run as running
from spinndrift.sims.estimator_check.run import run_settings
from spinndrift.sims.estimator_check.scores import (
    Average,
    average_nis,
    score,
    stacked,
    time_averages,
    within_three_sigma,
)
from spinndrift.sims.estimator_check.settings import (
    Setting,
    chosen,
    consistency_settings,
    fault_settings,
)
from spinndrift.sims.estimator_check.tables import tables
from spinndrift.sims.run.log import RunLog
from spinndrift.sims.run.loop import Run, Timing
from spinndrift.sims.scenarios.criteria import Outcome
from spinndrift.sims.scenarios.scenario import Scenario

pytestmark = pytest.mark.whole

RUNS = {"consistency": 3, "faults": 2}


def healthy(seconds: float = 4.0) -> Setting:
    return consistency_settings(["calm"], seconds, None)[0]


def flown(seconds: float = 4.0, **variables: np.ndarray) -> Run:
    """A made-up run of a setting."""
    log = example_log(seconds)
    data = log.recording.dataset.copy(deep=True)
    for name, values in variables.items():
        data[name].to_numpy()[0, 0] = values
    outcome = Outcome("duration", seconds, "Over.")
    return Run(healthy(seconds).scenario, RunLog(type(log.recording)(data)), outcome, Timing())


def test_an_average_of_chi_square_values_is_within_its_bounds():
    """95 % of 2000 independent times, 4 standard errors; a factor of two is seen at all times."""
    squares = np.random.default_rng(0).chisquare(3, (60, 2000))
    right = Average.of(squares, 3)
    assert abs(right.share - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 2000)
    assert right.holds(right.mean)
    assert Average.of(2 * squares, 3).share < 0.01
    squares[:30, 5] = np.nan  # half of the runs have nothing then: the bounds there are wider
    squares[:, 6] = np.nan
    some = Average.of(squares, 3)
    assert some.values.size == 1999
    assert some.values[5] == pytest.approx(squares[30:, 5].mean())


def test_the_average_over_time_is_that_of_what_a_run_has():
    squares = np.arange(18.0).reshape(2, 3, 3)
    squares[0, 2], squares[1, :, 1] = np.nan, np.nan
    found = time_averages({"nees": squares})
    np.testing.assert_array_equal(found, [[1.5, 2.5, 3.5], [12.0, np.nan, 14.0]])


def test_three_sigma_hold_what_they_say():
    """99.73 % of Gaussian errors with any covariance; a covariance too small by four does not."""
    rng = np.random.default_rng(1)
    L = rng.normal(size=(3, 3, 3))
    error = np.einsum("bij,nbj->nbi", L, rng.normal(size=(20000, 3, 3))).reshape(-1, 9)
    P = np.broadcast_to((L @ np.swapaxes(L, 1, 2)).reshape(27), (20000, 27))
    share = within_three_sigma({"error": error, "covariance": P}).mean(axis=0)
    np.testing.assert_allclose(share, 0.9973, atol=4 * np.sqrt(0.9973 * 0.0027 / 20000))
    assert within_three_sigma({"error": error, "covariance": P / 4}).mean() < 0.9
    lost = {"error": np.full((1, 9), np.nan), "covariance": P[:1]}
    assert not within_three_sigma(lost).any()


def test_readings_are_counted_once_and_rejected_ones_apart():
    run = flown()
    n = run.log.time.size
    nis, rejected = np.zeros((n, 3)), np.zeros((n, 3))
    nis[10:, 0] = 2.0  # one reading, held
    nis[20:, 0], rejected[20:30, 0] = 90.0, 1.0
    nis[25:, 0], rejected[25:30, 0] = 80.0, 2.0
    nis[30:, 0] = 4.0
    found = score(flown(nis=nis, rejected=rejected))
    assert found["taken"].tolist() == [2, 0, 0]
    assert found["gated"].tolist() == [2, 0, 0]
    average = average_nis(stacked([found]), "dvl")
    assert average.values.tolist() == [2.0, 4.0]
    assert found["finite"] == 1
    speed = np.linalg.norm(run.log["V_WB_B"][:, :3], axis=1)
    assert found["length"] == pytest.approx(np.trapezoid(speed, run.log.time), rel=1e-3)
    assert found["health_after"].tolist() == [1, 0, 1, 0, 0, 1]


def test_a_run_that_breaks_off_counts_as_not_finite():
    run = flown(2.0)
    found = score(run._replace(scenario=healthy(4.0).scenario))
    assert found["finite"] == 0
    assert not within_three_sigma(stacked([found])).any()
    assert found["nees"].shape == (81, 3)
    assert np.isnan(found["nees"][41:]).all()
    bad = run.log["X_WB_estimate"].copy()
    bad[10] = np.nan
    assert score(flown(2.0, X_WB_estimate=bad))["finite"] == 0


def test_every_setting_is_a_scenario_that_comes_back_from_its_file():
    names = chosen(())
    settings = [
        *consistency_settings([n for n in names if n != "learned"], 60.0, None),
        *fault_settings(names, 30.0),
    ]
    assert {str(s) for s in settings} == set(names) - {"learned"}
    calm, harbour = settings[:2]
    assert calm.seeds(60) == range(60)
    assert harbour.seeds(60) == range(60, 120)
    assert consistency_settings(["harbour"], 60.0, None)[0].seeds(60) == harbour.seeds(60)
    for setting in settings:
        again = typed_yaml.loads(Scenario, typed_yaml.dump(setting.scenario))
        assert again == setting.scenario
        for fault in setting.scenario.station.sensing.faults:
            assert (fault.start, setting.name.split("_")[0]) == (10.0, fault.sensor)
    assert chosen(["depth_j*", "consistency"]) == [*names[:7], "depth_jump"]
    kinds = {f.fault for s in settings for f in s.scenario.station.sensing.faults}
    assert kinds >= {"nan", "infinite", "offset", "frozen", "latency", "dropout", "frozen_stamp"}


def test_settings_are_flown_once_and_others_refused(tmp_path, monkeypatch):
    calls = []

    def fly(scenario, seeds, progress, engine):
        calls.append(scenario.station.sensing.faults)
        for seed in seeds:
            if len(calls) == 2 and seed == seeds[1]:
                yield flown()._replace(outcome=Outcome("interrupted", 1.0, "Stopped."))
            progress(0.5, "half")
            yield flown()

    monkeypatch.setattr(running, "simulate_seeds", fly)
    settings = [healthy(), fault_settings(["depth_jump"], 4.0)[0]]
    seen = []

    def again(runs=RUNS, settings=settings):
        return run_settings(settings, tmp_path, runs, lambda f, r="": seen.append(f))

    with pytest.raises(KeyboardInterrupt):
        again()
    results, failed = again()
    again()
    assert len(calls) == 3
    assert not failed
    assert seen[-1] == 1
    assert [len(r.scores["finite"]) for r in results] == [3, 2]
    made = tables(results)
    assert [table.rows[0][0] for table in made] == ["calm water"] * 2 + ["depth jumps by 0.5 m"]
    assert made[2].rows[0][-1] == "degraded 100 % (dvl 100 %); at the end degraded 100 %"
    with pytest.raises(UserError, match=r"calm.npz: was flown with other settings.*--out"):
        again(RUNS | {"consistency": 4})
    jump = SensorFault("depth", "offset", 1.0, size=0.6)
    station = settings[1].scenario.station
    station = replace(station, sensing=replace(station.sensing, faults=(jump,)))
    other = replace(settings[1], scenario=replace(settings[1].scenario, station=station))
    with pytest.raises(UserError, match="other settings"):
        again(settings=[other])
    (tmp_path / "consistency" / "calm.npz").write_bytes(b"no zip")
    with pytest.raises(UserError, match="is no result of a check"):
        again()


def test_the_command_flies_and_tells(tmp_path):
    """Two runs of two seconds."""
    page = tmp_path / "page.md"
    page.write_text("# Mine\n\n<!-- measured: begin -->\n<!-- measured: end -->\n")
    command = CheckEstimator(only=("calm",), runs=2, seconds=2.0, out=tmp_path / "out", docs=page)
    command.run()
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Mine")
    assert "NEES, average of 2 runs of 2 s" in text
    assert "| calm water | " in text
    assert (tmp_path / "out" / "consistency" / "calm.npz").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"only": ("sonar*",)}, r"--only sonar\*: fits none of consistency, faults, calm"),
        ({"docs": "page.txt"}, "--docs"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_work(tmp_path, options, message):
    if "docs" in options:
        options = {"docs": Path(options["docs"])}
    with pytest.raises(UserError, match=message):
        CheckEstimator(out=tmp_path / "out", **options).run()
    assert not (tmp_path / "out").exists()
