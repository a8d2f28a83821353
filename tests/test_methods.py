"""Methods by name: complete settings, written and read back, that a file can't contradict."""

import inspect
from dataclasses import replace

import pytest

from spinndrift.models.config import typed_yaml as yaml
from spinndrift.models.config.errors import UserError
from spinndrift.sims.commands.train import Train
from spinndrift.training.config import TrainingConfig
from spinndrift.training.losses.matching import Fdm, Mse
from spinndrift.training.methods import METHODS, method_config


@pytest.mark.parametrize("name", METHODS)
def test_settings_of_each_method_survive_yaml(name):
    config = method_config(name)
    assert yaml.loads(TrainingConfig, yaml.dump(config)) == config
    METHODS[name].check(name, config, "its own")


def test_no_two_methods_are_the_same():
    texts = [yaml.dump(method.config) for method in METHODS.values()]
    assert len(set(texts)) == len(texts)


def test_an_unknown_method_is_refused_with_the_names():
    with pytest.raises(UserError, match="'fdm' is unknown; take one of fdm-geodesic, "):
        method_config("fdm")


def test_a_file_sets_what_does_not_make_the_method(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("steps: 7\nmodel: {width: 8}\nobjective: !Fdm {samples: 4}\n")
    base = method_config("fdm-chordal")
    expected = replace(
        base,
        steps=7,
        model=replace(base.model, width=8),
        objective=Fdm("chordal", samples=4, mse_weight=0.0),
    )
    assert method_config("fdm-chordal", path) == expected


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("objective: !Mse {}", "objective"),
        ("objective: !Fdm {pose_kernel: chordal}", "objective.pose_kernel"),
        ("objective: !Fdm {mse_weight: 0.1}", "objective.mse_weight"),
        ("model: {stochastic: false}", "model.stochastic"),
        ("model: {coordinates: euler}", "model.coordinates"),
    ],
)
def test_a_file_that_contradicts_the_method_is_refused(tmp_path, text, field):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=rf"settings.yaml: {field}: found .* 'fdm-geodesic'"):
        method_config("fdm-geodesic", path)


def test_the_weight_of_the_squared_error_is_free_where_there_is_one(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("objective: !Fdm {mse_weight: 0.5}")
    assert method_config("fdm-geodesic+mse", path).objective == Fdm(mse_weight=0.5)


def test_the_paper_form_of_the_potential_is_open_to_a_file(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("model: {potential: pose}\nwindows: {normalise: identity}\n")
    for name in METHODS:
        config = method_config(name, path)
        assert (config.model.potential, config.windows.normalise) == ("pose", "identity")


def test_every_method_stands_in_the_commands_help():
    source = inspect.getsource(Train)
    for name in METHODS:
        assert name.removesuffix("+mse") in source


def test_the_default_settings_are_a_method():
    assert method_config("fdm-geodesic+mse") == TrainingConfig()


def test_the_geometric_pinn_has_no_diffusion():
    config = method_config("pinn")
    assert not config.model.stochastic
    assert isinstance(config.objective, Mse)
