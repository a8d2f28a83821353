import dataclasses
import io
import json
import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import integrate
from spinndrift.models.config.errors import UserError
from spinndrift.models.dynamics import Dynamics
from spinndrift.models.files import checkpoint
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia
from spinndrift.models.spinn import Spinn, SpinnConfig

METADATA = {"vehicle": "test", "loss": [1.5, 0.25], "note": "ξ"}


def fossen(dtype=float):
    return FossenDynamics(
        rigid_inertia=spatial_inertia(10.0, np.array([0.01, 0, 0]), np.diag([0.2, 0.3, 0.4])),
        added_mass=np.diag([5.0, 6.0, 7.0, 0.1, 0.2, 0.3]),
        linear_drag=np.eye(6),
        quadratic_drag=2 * np.eye(6),
        weight=98.0,
        buoyancy=99.0,
        p_BoBcm_B=np.array([0.01, 0, 0]),
        p_BoCb_B=np.array([0, 0, 0.02]),
        diffusion=np.arange(6.0),
        dtype=dtype,
    )


def spinn(**settings):
    config = SpinnConfig(width=5, depth=2, **settings)
    model = Spinn.create(config, fossen(jnp.float32), jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda a: a + jnp.asarray(rng.normal(size=a.shape), a.dtype) / 10, model)


MODELS = {
    "fossen": lambda: fossen(),
    "fossen in float32": lambda: fossen(jnp.float32),
    "spinn": lambda: spinn(),
    "as in the paper": lambda: spinn(spd="eigenvalues", potential="pose"),
    "constant and deterministic": lambda: spinn(constant_mass=True, stochastic=False),
}


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "m.spinn"
    save_model(path, spinn(), METADATA)
    return path.read_bytes()


def rewritten(stored, change):
    """The file's bytes with its header changed by `change(header)`, or to the text it returns."""
    with np.load(io.BytesIO(stored)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(arrays["header"].tobytes())
    told = change(header)
    text = told if isinstance(told, str) else json.dumps(header)
    arrays["header"] = np.frombuffer(text.encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize("name", MODELS)
def test_a_loaded_model_is_the_stored_one_bit_for_bit(name, tmp_path):
    model = MODELS[name]()
    save_model(tmp_path / "m.spinn", model, METADATA)
    loaded, metadata = load_model(tmp_path / "m.spinn")
    assert metadata == METADATA
    assert jax.tree.structure(loaded) == jax.tree.structure(model)
    for old, new in zip(jax.tree.leaves(model), jax.tree.leaves(loaded), strict=True):
        assert old.dtype == new.dtype
        np.testing.assert_array_equal(old, new)


def test_a_loaded_model_flies_bit_for_bit_alike(tmp_path):
    model = spinn()
    save_model(tmp_path / "m.spinn", model)
    loaded, _ = load_model(tmp_path / "m.spinn")
    X = jnp.zeros(7, jnp.float32).at[0].set(1)
    V, F = jnp.full(6, 0.1, jnp.float32), jnp.ones(6, jnp.float32)
    step = eqx.filter_jit(lambda model, dW: integrate.step(model, X, V, F, 0.05, dW))
    for old, new in zip(step(model, F), step(loaded, F), strict=True):
        np.testing.assert_array_equal(old, new)


def test_precision_is_kept_or_converted_on_request(tmp_path):
    path = tmp_path / "m.spinn"
    save_model(path, fossen())
    assert load_model(path)[0].rigid_inertia.dtype == jnp.float64
    assert load_model(path, jnp.float32)[0].rigid_inertia.dtype == jnp.float32
    with jax.enable_x64(False):
        with pytest.raises(UserError, match=r"m\.spinn.*float64.*jax_enable_x64"):
            load_model(path)
        assert load_model(path, jnp.float32)[0].rigid_inertia.dtype == jnp.float32


def test_a_file_cut_anywhere_is_refused_by_name(stored, tmp_path):
    path = tmp_path / "cut.spinn"
    for size in np.linspace(0, len(stored) - 1, 40).astype(int):
        path.write_bytes(stored[:size])
        with pytest.raises(UserError, match=r"cut\.spinn"):
            load_model(path)


def test_a_damaged_byte_is_refused_or_without_effect(stored, tmp_path):
    path = tmp_path / "damaged.spinn"
    path.write_bytes(stored)
    whole = jax.tree.leaves(load_model(path)[0])
    refused = 0
    for position in np.random.default_rng(1).integers(0, len(stored), 200):
        damaged = bytearray(stored)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            model, metadata = load_model(path)
        except UserError:
            refused += 1
            continue
        assert metadata == METADATA
        for old, new in zip(whole, jax.tree.leaves(model), strict=True):
            np.testing.assert_array_equal(old, new)
    assert refused > 100


def foreign_files():
    other = io.BytesIO()
    np.savez(other, weights=np.ones(3))
    lone = io.BytesIO()
    np.save(lone, np.ones(3))
    objects = io.BytesIO()
    np.savez(objects, header=np.array([{"format": "spinndrift model"}], dtype=object))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as handle:
        handle.writestr("header.npy", b"{}")
    return {
        "empty": b"",
        "text": b"width: 32\n",
        "picture": b"\x89PNG\r\n\x1a\n" + bytes(100),
        "other npz": other.getvalue(),
        "lone array": lone.getvalue(),
        "pickled objects": objects.getvalue(),
        "other zip": archive.getvalue(),
    }


@pytest.mark.parametrize("kind", foreign_files())
def test_a_foreign_file_is_refused_by_name(kind, tmp_path):
    path = tmp_path / "foreign.bin"
    path.write_bytes(foreign_files()[kind])
    with pytest.raises(UserError, match=r"foreign\.bin"):
        load_model(path)


def test_a_missing_file_and_a_folder_are_refused_by_name(tmp_path):
    with pytest.raises(UserError, match=r"none\.spinn: no such model file"):
        load_model(tmp_path / "none.spinn")
    with pytest.raises(UserError, match=tmp_path.name):
        load_model(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(version=99), "version 99 is newer than 1; update spinndrift"),
        (lambda h: h.update(kind="Teapot"), "Teapot"),
        (lambda h: h.update(format="other"), "not a spinndrift model"),
        (lambda h: h["config"].update(whidth=3), "whidth"),
        (lambda h: h["config"].update(width=6), "shapes"),
        (lambda h: h["config"].update(activation="relu"), "activation"),
        (lambda h: h["config"].update(velocity_scale=[1e-200] * 6), "beyond single precision"),
        (lambda h: h["arrays"].pop(), "header and arrays don't agree"),
        (lambda h: h.pop("config"), "config"),
        (lambda h: h.update(metadata=3), "agree"),
    ],
)
def test_a_header_that_does_not_fit_is_refused(stored, tmp_path, change, message):
    path = tmp_path / "m.spinn"
    path.write_bytes(rewritten(stored, change))
    with pytest.raises(UserError, match=message) as caught:
        load_model(path)
    assert "m.spinn" in str(caught.value)


@pytest.mark.parametrize(
    ("base", "message"), [(1.5, "no mapping"), ([], "no mapping"), ({"kind": []}, "kind")]
)
def test_a_base_that_is_no_model_is_refused(stored, tmp_path, base, message):
    config = {"effects": [], "thrusters": 1, "base": base}
    path = tmp_path / "m.spinn"
    path.write_bytes(rewritten(stored, lambda h: h.update(kind="Extended", config=config)))
    with pytest.raises(UserError, match=f"m.spinn.*{message}"):
        load_model(path)


@pytest.mark.parametrize("depth", [300, 5000])
def test_models_about_models_without_end_are_refused(stored, tmp_path, depth):
    def change(h):
        part = '{"kind": "Extended", "config": {"effects": [], "thrusters": 1, "base": '
        h.update(kind="Extended", config={"effects": [], "thrusters": 1, "base": "BASE"})
        return json.dumps(h).replace('"BASE"', part * depth + "1" + "}}" * depth)

    path = tmp_path / "m.spinn"
    path.write_bytes(rewritten(stored, change))
    with pytest.raises(UserError, match=r"m\.spinn"):
        load_model(path)


@pytest.mark.parametrize("fault", [OSError("no space left"), KeyboardInterrupt()])
def test_a_failed_save_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch, fault):
    path = tmp_path / "m.spinn"
    save_model(path, fossen(), {"old": True})

    def failing(handle, **_):
        handle.write(b"half")
        raise fault

    monkeypatch.setattr(np, "savez_compressed", failing)
    with pytest.raises(type(fault)):
        save_model(path, fossen(), {"old": False})
    assert load_model(path)[1] == {"old": True}
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.spinn"]


@pytest.mark.parametrize("metadata", [{"loss": float("nan")}, {"path": object()}])
def test_metadata_must_be_plain_json(tmp_path, metadata):
    with pytest.raises(ValueError, match="metadata must be plain JSON"):
        save_model(tmp_path / "m.spinn", fossen(), metadata)
    assert not list(tmp_path.iterdir())


def test_same_model_same_bytes(tmp_path):
    for name in ("a", "b"):
        save_model(tmp_path / name, spinn(), METADATA)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


class Wrapped(FossenDynamics):
    """A class of its own, whose storage nobody has described."""


def test_a_class_is_storable_once_registered(tmp_path, monkeypatch):
    inner = fossen()
    model = object.__new__(Wrapped)
    for field in dataclasses.fields(FossenDynamics):
        object.__setattr__(model, field.name, getattr(inner, field.name))
    with pytest.raises(ValueError, match="Wrapped"):
        save_model(tmp_path / "m.spinn", model)

    def make(_) -> Dynamics:
        return model

    monkeypatch.setattr(checkpoint, "_KINDS", dict(checkpoint._KINDS))
    checkpoint.register(Wrapped, lambda _: {}, make)
    save_model(tmp_path / "m.spinn", model)
    assert type(load_model(tmp_path / "m.spinn")[0]) is Wrapped
