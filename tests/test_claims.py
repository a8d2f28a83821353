"""Claims of a verdict: what left-out forecasts say against them, and the words."""

import numpy as np
import pytest

from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.diagnosis.filter.problem import DiagnosisProblem
from spinndrift.training.diagnosis.findings.result import Interval, Ratio, Refitted, Value
from spinndrift.training.diagnosis.findings.sentences import (
    coefficients_off,
    commands_lost,
    sentence,
    verdict,
    without_added_mass,
)
from spinndrift.training.diagnosis.validation.claims import (
    asserted,
    better_in_part,
    clearly_better,
    explained,
    improves,
    outside_bands,
    vetoes,
)
from spinndrift.training.diagnosis.validation.simulation import Contender, Simulated
from spinndrift.training.diagnosis.validation.validation import Judged, forecast_square, judge

FOLDS, AT = 10, ["1", "4"]


def judged(scale, spread=0.1, seed=0):
    """A model whose squared errors are `scale` squared, but for what differs between folds."""
    rng = np.random.default_rng(seed)
    chance = np.exp(spread * rng.standard_normal((2, 3, FOLDS)))
    square = np.broadcast_to(scale, (2, 3))[..., None] ** 2 * chance
    none = np.ones((2, FOLDS))
    simulated = Simulated(np.zeros((1, 12, 1, 1)), np.zeros(1, int), 80)
    return Judged(np.zeros(FOLDS), square, none, np.zeros((2, 2, FOLDS)), none, simulated)


def test_a_claim_is_refused_where_another_model_forecasts_better():
    base = judged(1.0)
    alike = {"base": base, "refitted": judged(0.97), "black_box": judged(3.0)}
    assert vetoes(alike, "base", AT, {}, 0) == []
    better = np.array([[1.0, 1.0, 1.0], [1.0, 0.6, 0.9]])
    (told,) = vetoes({**alike, "black_box": judged(better)}, "base", AT, {}, 0)
    assert told == "a black box forecasts rotation over 4 s better by 40 %"
    # what two of ten folds show alone may be chance
    few = base._replace(square=base.square * np.where(np.arange(FOLDS) < 2, 0.1, 1.0))
    assert vetoes({**alike, "black_box": few}, "base", AT, {}, 0) == []
    diverged = judged(np.nan)
    assert vetoes({**alike, "black_box": diverged}, "base", AT, {}, 0) == []
    assert vetoes({"base": diverged}, "base", AT, {}, 0) == ["its forecasts diverge"]


def test_bands_may_be_wide_and_not_narrow():
    def of(share, half=0.02):
        return {"90 %": {"4": Interval(share, (share - half, share + half))}}

    assert outside_bands(of(0.95)) is outside_bands(of(0.86)) is outside_bands(of(0.7, 0.2)) is None
    assert outside_bands(of(0.7)) == ("90 %", "4", 0.7)


def test_the_share_that_is_explained_is_that_of_the_error():
    models = {"base": judged(2.0), "extended": judged(0.5, seed=1)}
    assert asserted(models, False) == "extended"
    two = {"base": judged(2.0), "refitted": judged(1.0)}
    assert asserted(two, True) == "refitted"
    assert asserted(two, False) == "base"
    for share in explained(models, "extended", AT, 0).values():
        assert share.interval95[0] < 0.75 < share.interval95[1]
    assert clearly_better(models["extended"], models["base"], 0)
    assert not clearly_better(models["base"], models["extended"], 0)
    assert not clearly_better(judged(0.95), judged(1.0), 0)
    assert clearly_better(judged(1.0), judged(np.inf), 0)


def test_a_model_is_better_in_a_part_only_if_it_is_worse_in_none():
    old = judged(1.0)
    turned = np.array([[1.0, 1.0, 1.0], [1.0, 0.7, 1.0]])
    assert better_in_part(judged(turned), old, AT, 0)
    assert not clearly_better(judged(turned), old, 0)
    assert not better_in_part(old, judged(turned), AT, 0)
    assert not better_in_part(judged(0.97), old, AT, 0)
    elsewhere = turned * np.array([[1.0, 1.0, 1.4], [1.0, 1.0, 1.0]])
    assert not better_in_part(judged(elsewhere), old, AT, 0)


def test_a_cause_forecasts_better_by_a_practical_share_of_one_part():
    def better(new, old=None):
        return improves(new.square, (old or judged(1.0)).square, np.random.default_rng(0))

    one_part = np.array([1.0, 0.85, 1.0])
    assert better(judged(one_part))
    assert better(judged(0.95))
    assert not better(judged(np.array([1.0, 0.93, 1.0])))
    assert not better(judged(0.98))
    assert not better(judged(np.array([1.2, 0.85, 1.0])))
    few = judged(1.0)
    few = few._replace(square=few.square * np.where(np.arange(FOLDS) < 1, 0.2, 1.0))
    assert not better(few), "one of ten folds may be chance"
    assert not better(judged(np.inf))
    assert better(judged(1.0), judged(np.inf))
    unseen = judged(1.0)._replace(square=judged(1.0).square * [[[0.0], [1.0], [1.0]]])
    assert better(judged(np.array([0.0, 0.9, 0.93])), unseen), "a part without records counts not"
    assert not better(judged(0.0), judged(0.0)), "an exact forecast leaves nothing to save"


def ratio(name, where, believed, found, half=0.01):
    near = half * abs(found) + 1e-6
    return Ratio(name, where, believed, Value(found, "1", (found - near, found + near)))


def test_coefficients_lead_with_the_largest_ratio_in_words():
    rows = [
        ratio("quadratic_drag", "surge", 3.0, 4.8),
        ratio("half_thrust", "yaw", 14.0, 48.0),
        ratio("half_thrust", "surge", 2.0, 4.8),
        ratio("linear_drag", "heave", 0.2, 0.0),
        ratio("linear_drag", "roll", 0.2, 0.02, 2.0),
        ratio("restoring", "roll", 6.0, 6.12, 0.001),
        ratio("inertia", "heave", 1.6, 1.0),
    ]
    heave = Value(0.0, "kg", (-0.1, 0.1))
    added = without_added_mass([Refitted("added_mass", "heave", "change", 18.7, heave)])
    said = coefficients_off(rows, added)
    order = ["thrust at half command in yaw is 3.4 of yours (surge: 2.4)",
             "inertia in heave is 0.62", "quadratic drag in surge is 1.6 of yours",
             "no linear drag in heave, roll", "no added mass in heave"]  # fmt: skip
    at = [said.index(part) for part in order]
    assert at == sorted(at)
    assert "righting" not in said, "2 % is no practical size"
    assert coefficients_off(rows[5:6], added) == ""
    text = sentence((), (), True, (), {"4": Interval(0.9, (0.8, 1.0))}, said)
    assert text.startswith("Over inertia, your coefficients are off: thrust at half command in yaw")
    assert "That explains 90 % over 4 s of the forecast error. With its coefficients" in text
    assert verdict((), (), True) == "explained"
    assert verdict((), ["more"], True) == "partly_explained"


@pytest.mark.parametrize("share", [-1.0, 0.02])
def test_thrust_that_a_refit_takes_away_or_turns_is_the_finding(share):
    rows = [ratio("thrust", "sway", 2.0, 2.0 * share), ratio("thrust", "surge", 2.0, 2.4)]
    said = commands_lost(rows)
    assert "do not explain the motion in sway" in said
    assert "surge" not in said
    assert commands_lost(rows[1:]) == ""
    assert verdict((), [said]) == "unexplained"


@pytest.mark.slow
def test_forecasts_alone_have_the_errors_of_a_whole_judgement():
    vehicle = load_vehicle("bluerov2_heavy")
    made = GenerateConfig(("surge-forward", "yaw-left"), trajectories=2, duration=3.0)
    problem = DiagnosisProblem.of(generate(made, vehicle), vehicle, None, [])
    theta = np.repeat(problem.believed[:, None], len(problem.data.fold), axis=1)
    given = problem, Contender(theta), 1.0
    whole = judge(*given, 0, [], estimated=True)
    assert np.isfinite(whole.square).all()
    assert whole.square.any()
    np.testing.assert_allclose(
        forecast_square(*given, [], estimated=True), whole.square, rtol=1e-4, atol=1e-12
    )
