"""Functions of the same code and equal values are one program; others are not taken for it."""

import functools
import math
from collections import ChainMap
from dataclasses import dataclass
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Array, Float, jaxtyped
from pydrake.systems.primitives import Adder

from spinndrift.systems.compiled import jit
from spinndrift.systems.compiled import structure as compiled_structure
from spinndrift.systems.compiled.jit import VectorFunction
from spinndrift.systems.compiled.structure import structure

pytestmark = pytest.mark.whole

SIZE = 2.0


@pytest.fixture(autouse=True)
def _own(monkeypatch):
    """This module counts as one of the package, whose functions do not change."""
    monkeypatch.setattr(
        compiled_structure, "_OWN", (*compiled_structure._OWN, __name__.partition(".")[0])
    )


@dataclass(frozen=True)
class Settings:
    gain: float
    names: tuple[str, ...] = ("a",)


class Model(eqx.Module):
    weight: jax.Array
    settings: Settings

    def __call__(self, x):
        return self.weight * x


class Holder:
    def __init__(self, value):
        self.value = value

    def call(self, x):
        return x if self.value is None else x * 2


def scaled(value, more=1.0):
    def call(x, y=more):
        def inner(z):
            return z * SIZE

        return inner(x) + y if isinstance(value, str) else jnp.sum(jnp.asarray(x)) + y

    held = value

    def outer(x):
        return call(x), held

    return outer


def scaled_by(unknown):
    held = SimpleNamespace(value=unknown)
    return lambda x: x if held else -x


VALUES = [
    1,
    1.0,
    True,
    0.0,
    -0.0,
    math.nan,
    None,
    "1",
    b"1",
    (1, 2),
    [1, 2],
    (1, (2,)),
    {"a": 1},
    {"b": 1},
    frozenset({1}),
    np.ones(2),
    np.ones(2, np.float32),
    np.ones((2, 1)),
    np.array([0.0, -0.0]),
    np.array([-0.0, 0.0]),
    Settings(1.0),
    Settings(1.0, ("b",)),
    np.float64,
    np.float32,
    functools.partial(max, 1),
    functools.partial(max, 2),
    slice(1, 2),
]


def test_equal_values_make_equal_keys_and_different_ones_do_not():
    again = [*VALUES[:15], *(np.array(v) if isinstance(v, np.ndarray) else v for v in VALUES[15:])]
    keys = [structure(scaled(value)) for value in VALUES]
    assert None not in keys
    assert [structure(scaled(value)) for value in again] == keys
    assert len(set(keys)) == len(keys)
    assert structure(scaled(1, more=2.0)) != keys[0]
    arrays = [structure(scaled(jnp.asarray(x))) for x in ([1.0, 2.0], [1.0, 2.5], [1.0, 2.0])]
    assert arrays[0] == arrays[2] != arrays[1]
    random = [structure(scaled(jax.random.key(n))) for n in (0, 1, 0)]
    assert random[0] == random[2] != random[1]


def test_models_and_methods_are_compared_by_what_is_in_them():
    made = [
        Model(jnp.full(2, w), Settings(g))
        for w, g in ((1.0, 1.0), (1.0, 1.0), (2.0, 1.0), (1.0, 2.0))
    ]
    keys = [structure(model.__call__) for model in made]
    assert keys[0] == keys[1]
    assert len(set(keys)) == 3


def test_checks_of_types_do_not_count_but_other_wrappers_do():
    def made(gain, wrapper):
        @jaxtyped(typechecker=beartype)
        def checked(x: Float[Array, "2"]) -> Float[Array, "2"]:
            return gain * x

        @functools.wraps(checked)
        def wrapped(x):
            return wrapper * checked(x)

        return checked, wrapped

    first, again, other, more = made(1.0, 1.0), made(1.0, 1.0), made(2.0, 1.0), made(1.0, 2.0)
    assert structure(first[0]) == structure(again[0]) != structure(other[0])
    assert structure(first[1]) == structure(again[1]) != structure(more[1])
    assert None not in map(structure, first)


def test_what_a_function_names_of_its_module_counts(monkeypatch):
    before = structure(scaled("a"))
    monkeypatch.setitem(globals(), "SIZE", 3.0)
    assert structure(scaled("a")) != before
    monkeypatch.setitem(globals(), "SIZE", 2.0)
    assert structure(scaled("a")) == before


class Changing(list):
    pass


@pytest.mark.parametrize(
    "unknown",
    [object(), Adder(1, 1), (Adder(1, 1),), SimpleNamespace(a=1), Changing(), ChainMap({"a": 1})],
)
def test_unknown_values_have_no_key(unknown):
    assert structure(scaled(unknown)) is None


def test_functions_and_objects_of_other_modules_have_no_key(monkeypatch):
    """A user's module may change between two runs, in places that the key does not see."""
    monkeypatch.undo()
    assert structure(scaled(1)) is None
    assert structure(Holder(1).call) is None
    assert structure(functools.partial(math.pow, 2.0)) is not None


def test_what_jax_tells_apart_is_told_apart():
    weak, strong = jnp.asarray(0.1), jnp.asarray(np.float64(0.1))
    assert structure(scaled(weak)) != structure(scaled(strong))
    fields = [np.zeros(2, [(name, "f4")]) for name in "ab"]
    assert structure(scaled(fields[0])) != structure(scaled(fields[1]))
    sums = [eqx.filter_vmap(jnp.cumsum, in_axes=k, out_axes=k) for k in (0, 1)]
    assert structure(scaled(sums[0])) != structure(scaled(sums[1]))
    powers = [jax.jit(lambda x: x**2), jax.jit(lambda x: x**2)]
    assert structure(scaled(powers[0])) != structure(scaled(powers[1]))
    assert structure(scaled(powers[0])) == structure(scaled(powers[0])) is not None


def test_a_variable_that_is_not_set_yet_is_no_error():
    def made(told):
        def call(x):
            return x * g if told else x

        if told:
            g = 2.0
        return call

    assert structure(made(False)) == structure(made(False))
    assert structure(made(True)) != structure(made(False))


def test_what_looks_like_a_check_of_types_may_be_anything():
    checked = jaxtyped(typechecker=None)(jax.jit(lambda x: x))
    assert structure(scaled(checked)) == structure(scaled(checked))


def test_a_circle_ends():
    circle: list = [1]
    circle.append(circle)
    assert structure(scaled(circle)) == structure(scaled(circle)) is not None


@pytest.fixture
def traced(monkeypatch):
    """How many functions were traced."""
    count, lowered = [], jit.Lowered.__init__

    def counted(self, *given):
        count.append(1)
        lowered(self, *given)

    monkeypatch.setattr(jit.Lowered, "__init__", counted)
    return count


def test_an_equal_function_is_not_traced_again(traced):
    def function(gain):
        return lambda x: gain * x

    kept = []

    def called(gain, size=2):
        kept.append(VectorFunction(function(gain), [size], [size]))
        return kept[-1](np.ones(size))[0].tolist()

    assert called(3.0) == called(3.0) == [3.0, 3.0]
    assert len(traced) == 1
    assert called(4.0) == [4.0, 4.0]
    assert called(3.0) == [3.0, 3.0]
    assert len(traced) == 2
    assert called(3.0, size=3) == [3.0] * 3
    assert len(traced) == 3


def test_equal_functions_among_others_compile_at_once(traced):
    gains = [1.0, 2.0, 1.0, 3.0, 2.0]
    made = [VectorFunction(lambda x, g=g: g * x, [1], [1]) for g in gains]
    own = Holder(None)
    made += [VectorFunction(f, [1], [1]) for f in (own.call, Holder(1).call, scaled_by(Adder))]
    VectorFunction.compile(*made)
    assert [f(np.ones(1))[0].item() for f in made] == [*gains, 1.0, 2.0, 1.0]
    assert len(traced) == 6  # three gains, both holders and one without a key
