"""A study: tasks that go on where they stopped, failures that are findings, tables, pages."""

import json
import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from diagonal import Diagonal
from killing import killed, litter

from spinndrift.models.config import typed_yaml as yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.files.owned import claim
from spinndrift.sims.cli import main
from spinndrift.sims.fanout import run_here
from spinndrift.sims.study import train
from spinndrift.sims.study.config import (
    SizeConfig,
    StudyConfig,
    TruthConfig,
    asked_for,
    from_belief,
    scaled,
)
from spinndrift.sims.study.judge import diffusions
from spinndrift.sims.study.pages import render
from spinndrift.sims.study.run import STUDY, run_study
from spinndrift.sims.study.table import collect
from spinndrift.sims.study.task import RunSettings, Task, make_tasks
from spinndrift.sims.study.train import descended
from spinndrift.sims.study.work import run_task
from spinndrift.training.fitting.guard import TrainingError
from spinndrift.training.methods import METHODS, method_config

pytestmark = pytest.mark.whole

TINY = scaled("tiny")
PREPARE = """
from diagonal import Diagonal
from spinndrift.sims.study import train
train.starting_model = lambda *_: Diagonal.of(mass=20.0, drag=20.0, diffusion=1.0)
"""
TASK = Task("rich", "fdm-geodesic", (0,))


def called(*arguments):
    """Exit code of the command; None is success."""
    try:
        main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code
    return None


@pytest.fixture
def quick(monkeypatch):
    """Start from a model that compiles fast, not from networks."""

    def start(config, vehicle, windows, progress=None):
        return Diagonal.of(mass=20.0, drag=20.0, diffusion=1.0)

    monkeypatch.setattr(train, "starting_model", start)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder of one finished task, with a model that compiles fast."""
    out = tmp_path_factory.mktemp("study")
    claim(out, STUDY)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            train, "starting_model", lambda *_: Diagonal.of(mass=20.0, drag=20.0, diffusion=1.0)
        )
        run_task(TINY, TASK, str(out))
    return out


def test_every_scale_survives_its_yaml_file():
    for scale in ("full", "small", "tiny"):
        study = scaled(scale)
        assert yaml.loads(StudyConfig, yaml.dump(study)) == study


def test_the_options_told_are_those_that_were_given():
    assert asked_for(scaled("full")) == ""
    assert asked_for(scaled("small")) == " --scale small"
    belief = from_belief(scaled("full"))
    assert asked_for(belief) == " --start belief"
    assert asked_for(from_belief(TINY)) == " --scale tiny --start belief"
    assert asked_for(replace(belief, validation=0.2)) == " --config study.yaml"
    assert belief.size.steps == 2000
    assert belief.size.drift_iterations == 0
    assert replace(belief, size=scaled("full").size) == scaled("full")


def test_the_full_study_has_the_papers_sizes():
    study = scaled("full")
    assert (len(study.rich.maneuvers), study.rich.trajectories) == (1, 100)
    assert (len(study.sparse.maneuvers), study.sparse.trajectories) == (10, 20)
    for regime in (study.rich, study.sparse):
        assert (regime.duration, regime.rate) == (10.0, 20.0)
    assert (study.evaluation.samples, study.evaluation.shown_samples) == (350, 750)
    for name in METHODS:
        config = RunSettings.of(study, "sparse", name, 3).training
        method = method_config(name)
        objective = replace(method.objective, substeps=3)
        assert config == replace(method, seed=3, steps=600, objective=objective)


def test_sizes_fit_every_method():
    size = SizeConfig(steps=8, samples=4, width=4, length_s=1.0, stride_s=0.5)
    for name in METHODS:
        config = size.apply(method_config(name), 1)
        assert (config.steps, config.model.width, config.windows.length_s) == (8, 4, 1.0)
        assert config.warm_up <= 2
        assert yaml.loads(type(config), yaml.dump(config)) == config


def test_tasks_begin_with_one_seed_of_everything():
    tasks = make_tasks(("rich", "sparse"), ("pinn", "fdm-chordal"), 3)
    assert len(tasks) == 12
    assert {(t.regime, t.method) for t in tasks[:4]} == {
        (r, m) for r in ("rich", "sparse") for m in ("pinn", "fdm-chordal")
    }
    assert all(t.seeds == (0,) for t in tasks[:4])
    assert [t.seeds for t in make_tasks(("rich",), ("pinn",), 5, 2)] == [(0, 1), (2, 3), (4,)]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--methods", "sorcery"), ("sorcery", "fdm-geodesic")),
        (("--seeds", "0"), ("--seeds 0",)),
        (("--together", "0"), ("--together 0",)),
        (("--workers", "-1"), ("--workers -1",)),
        (("--workers", "1", "--cluster", "tcp://127.0.0.1:1"), ("--workers", "leave one out")),
        (("--config", "missing.yaml"), ("missing.yaml",)),
        (("--config", "wrong.yaml"), ("wrong.yaml", "beleif", "belief")),
        (("--config", "same.yaml"), ("belief", "bluerov2_heavy")),
        (("--config", "loop.yaml"), ("loop", "surge-forward")),
        (("--render-only",), ("no finished run",)),
        (("--docs", "page.html"), (".md",)),
        (("--cluster", "tcp://127.0.0.1:1"), ("tcp://127.0.0.1:1", "scheduler")),
    ],
)
def test_bad_input_is_refused_in_one_sentence(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.yaml").write_text("beleif: bluerov2_heavy_ng\n")
    (tmp_path / "same.yaml").write_text("belief: bluerov2_heavy\n")
    (tmp_path / "loop.yaml").write_text("sparse: {maneuvers: [loop]}\n")
    assert called("study", "ablation", *arguments) == 2
    told = capsys.readouterr().err
    for word in words:
        assert word in told
    assert "Traceback" not in told
    assert {p.name for p in tmp_path.iterdir()} == {"wrong.yaml", "same.yaml", "loop.yaml"}


def test_every_option_is_explained(capsys):
    assert called("study", "--help") == 0
    told = capsys.readouterr().out
    for option in ("--regime", "--seeds", "--methods", "--scale", "--cluster", "--render-only"):
        assert option in told


def test_a_done_task_is_left_alone(finished, monkeypatch):
    before = (finished / "rich/fdm-geodesic/seed-0/result.json").read_bytes()

    def refuse(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(train, "starting_model", refuse)
    run_task(TINY, TASK, str(finished))
    assert run_study(TINY, [TASK], finished, lambda fraction, remark="", /: None) == []
    assert (finished / "rich/fdm-geodesic/seed-0/result.json").read_bytes() == before


def test_other_settings_are_refused(finished):
    other = replace(TINY, truth=TruthConfig(diffusion=(2.0,) * 6, substeps=5))
    with pytest.raises(UserError, match=r"seed-0: was made with other settings.*--out"):
        run_study(other, [TASK], finished, lambda fraction, remark="", /: None)


def test_a_task_leaves_its_numbers(finished):
    folder = finished / "rich" / "fdm-geodesic" / "seed-0"
    assert sorted(p.name for p in folder.iterdir()) == [
        "metrics.nc", "motions.nc", "result.json", "settings.yaml", "spinndrift.json", "training",
    ]  # fmt: skip
    result = json.loads((folder / "result.json").read_text())
    assert result["trained"]
    assert result["finite"]
    assert result["success"] == result["converged"]
    assert result["steps"] == 8
    # the floor is the truth against itself: the truth's own spread, whatever was learned
    assert 0 < result["metrics"]["w2"]["floor"] < result["metrics"]["w2"]["value"]
    assert result["metrics"]["coverage_90"]["floor"] == pytest.approx(0.9, abs=0.1)
    assert result["diffusion"]["b_surge"]["true"] == pytest.approx(TINY.truth.diffusion[0])
    assert result["diffusion"]["b_surge"]["learned"] == pytest.approx(1, abs=0.3)
    with xr.open_dataset(folder / "metrics.nc", engine="h5netcdf") as d:
        assert d["w2"].dims == ("scenario", "side", "time")
        np.testing.assert_allclose(d["time"], [0.5, 1.0, 1.5, 2.0])
    with xr.open_dataset(folder / "motions.nc", engine="h5netcdf") as d:
        assert d["position"].shape == (1, 2, 39, 20, 3)
        ahead = d["position"].isel(time=-1).sel(axis="x", law="true")
        assert float(ahead.min()) > 0.3  # forward thrust
    assert not list(finished.rglob("*.lock"))


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_task_leaves_a_checkpoint(quick, tmp_path):
    def interrupt(fraction, remark="", /):
        seen.append(remark)
        if len([r for r in seen if "loss" in r]) == 5:
            os.kill(os.getpid(), signal.SIGINT)

    seen = []
    with pytest.raises(KeyboardInterrupt):
        run_task(TINY, TASK, str(tmp_path), interrupt)
    partial = tmp_path / "rich" / "fdm-geodesic" / ".seed-0.partial"
    assert (partial / "training" / "checkpoint.npz").exists()
    assert not (tmp_path / "rich" / "fdm-geodesic" / "seed-0").exists()


@pytest.mark.slow
def test_a_killed_study_goes_on_to_the_same_numbers(finished, quick, tmp_path, monkeypatch):
    given = ("study", "ablation", "--scale", "tiny", "--methods", "fdm-geodesic", "--regime")
    given = (*given, "rich", "--seeds", "1", "--out", tmp_path)
    killed("checkpoint.npz", 2, PREPARE, *given)
    seed = Path("rich", "fdm-geodesic", "seed-0")
    assert len(litter(tmp_path / seed.parent)) > 2
    assert not (tmp_path / seed).exists()
    seen = []
    run_task(TINY, TASK, str(tmp_path), lambda fraction, remark="", /: seen.append(remark))
    assert len([r for r in seen if "loss" in r]) == 6  # the second checkpoint was being written
    whole, cut = (
        json.loads((out / seed / "result.json").read_text()) for out in (finished, tmp_path)
    )
    assert cut["metrics"] == whole["metrics"]
    assert cut["diffusion"] == whole["diffusion"]
    assert litter(tmp_path / seed.parent) == []


@pytest.mark.slow
def test_seeds_trained_together_are_those_trained_alone(finished, quick, tmp_path):
    """Equal data and starts; the batched program sums in another order, hence the tolerance."""
    run_task(TINY, replace(TASK, seeds=(0, 1)), str(tmp_path))
    alone, together = (
        json.loads((out / "rich" / "fdm-geodesic" / "seed-0" / "result.json").read_text())
        for out in (finished, tmp_path)
    )
    for name, metric in alone["metrics"].items():
        assert together["metrics"][name]["floor"] == metric["floor"]
        assert together["metrics"][name]["value"] == pytest.approx(metric["value"], rel=0.02)
    other = json.loads((tmp_path / "rich/fdm-geodesic/seed-1/result.json").read_text())
    assert other["metrics"]["w2"] != together["metrics"]["w2"]


def test_training_that_fails_is_a_finding(quick, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise TrainingError("step 3: motion runs away")

    monkeypatch.setattr(train, "fit", fail)
    monkeypatch.setattr(train, "fit_ensemble", lambda *_, **__: [TrainingError("ran away")] * 2)
    run_task(TINY, Task("rich", "pinn", (0, 1)), str(tmp_path))
    run_task(TINY, Task("rich", "pinn", (2,)), str(tmp_path))
    rows = collect(tmp_path)
    assert [(r["method"], r["seed"]) for r in rows] == [("pinn", 0), ("pinn", 1), ("pinn", 2)]
    assert [r["failure"] for r in rows] == ["ran away"] * 2 + ["step 3: motion runs away"]
    for row in rows:
        assert not row["success"]
        assert math.isnan(row["w2"])
    assert not render(tmp_path)[0]["success"]
    assert "**not reproduced**" in (tmp_path / "ablation.md").read_text()


def test_an_error_costs_its_own_task(tmp_path):
    done, shares = [], []

    def work(task, progress):
        progress(0.5)
        if task == 1:
            raise MemoryError("too large")
        done.append(task)

    failed = run_here(work, [0, 1, 2], lambda fraction, remark="", /: shares.append(fraction))
    assert done == [0, 2]
    assert [(f.task, f.reason) for f in failed] == [(1, "MemoryError: too large")]
    assert shares == sorted(shares)


def test_descent_is_judged_beyond_scatter():
    rng = np.random.default_rng(0)
    noise = 0.1 * rng.standard_normal(200)
    falling = np.linspace(1, 0, 200)
    assert descended(falling + noise)
    assert descended(noise)  # nothing left to gain is no failure
    assert not descended(1 - falling + noise)
    assert not descended(np.where(np.arange(200) < 80, falling, np.nan))
    jump = np.where(np.arange(200) < 100, 0.0, 5.0)  # another scale from there on
    assert descended(jump + falling + noise, refit_at=(0.5,))
    assert not descended(jump + noise)


def test_diffusion_is_compared_axis_by_axis():
    b = jnp.asarray([1.0, 2, 3, 4, 5, 6], jnp.float32)
    truth = Diagonal.of(mass=10.0, diffusion=1.0)
    V = np.random.default_rng(0).standard_normal((6, 20))
    model = replace_diffusion(Diagonal.of(mass=20.0), b)
    found = diffusions(model, truth, V)
    own = np.exp(np.asarray(truth.log_diffusion))
    for i, axis in enumerate(("surge", "sway", "heave", "roll", "pitch", "yaw")):
        assert found[f"b_{axis}"]["ratio"] == pytest.approx(float(b[i]) / own[i], rel=1e-5)
        assert found[f"noise_{axis}"]["ratio"] == pytest.approx(float(b[i]) / own[i] / 2, rel=1e-5)


def replace_diffusion(model, b):
    return eqx.tree_at(lambda m: m.log_diffusion, model, jnp.log(b))


def test_pages_are_written_anew_from_what_is_there(finished, tmp_path, capsys):
    docs = tmp_path / "docs" / "ablation.md"
    assert called("study", "--out", finished, "--render-only", "--docs", docs) is None
    assert "of 1 runs succeeded" in capsys.readouterr().err
    for name in ("table.csv", "summary.csv", "rich.nc", "results.png", "report.html"):
        assert (finished / name).stat().st_size > 100
    assert "distributions-surge-forward.png" in {p.name for p in finished.iterdir()}
    told = docs.read_text()
    assert "ablation-results.png" in told
    assert (docs.parent / "ablation-results.png").exists()
    assert "**not tested**" in told
