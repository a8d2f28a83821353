from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem

from spinndrift.systems.compiled.jit import Lowered, VectorFunction, compiled, shared, together
from spinndrift.systems.drake import value_or_zeros
from spinndrift.systems.planning.plan_samples import SampleLayout


def test_arguments_and_results_keep_their_order_and_sizes():
    f = VectorFunction(lambda a, b: (a * 2, jnp.concatenate([b, a])), [2, 3], [2, 5])
    a, b = np.array([1.0, 2]), np.array([3.0, 4, 5])
    first, second = f(a, b)
    np.testing.assert_array_equal(first, [2, 4])
    np.testing.assert_array_equal(second, [3, 4, 5, 1, 2])
    np.testing.assert_array_equal(f.flat(a, b), [2, 4, 3, 4, 5, 1, 2])
    assert first.dtype == np.float64


def test_empty_vectors_are_allowed():
    (result,) = VectorFunction(lambda a, none: a + none.sum(), [1, 0], [1])(np.ones(1), np.zeros(0))
    assert result == 1


def test_a_wrong_size_of_results_is_told():
    with pytest.raises(ValueError, match=r"\(2,\), not \(3,\)"):
        VectorFunction(lambda a: a, [2], [3])(np.zeros(2))


def test_nothing_is_compiled_before_the_first_call():
    calls = []
    f = VectorFunction(lambda a: calls.append(1) or a, [1], [1])
    assert calls == []
    f(np.zeros(1))
    f(np.zeros(1))
    assert calls == [1]


def test_equal_functions_share_one_program_and_others_don_t():
    def scaled(factor):
        return VectorFunction(lambda a: factor * a, [2], [2])

    many = np.linspace(0, 1, 5000)
    other = many.copy()
    other[2500] += 1e-15
    functions = [scaled(2.0), scaled(2.0), scaled(2.0 + 1e-15)]
    functions += [VectorFunction(lambda a, c=c: a + jnp.sum(c), [1], [1]) for c in (many, other)]
    for f in functions:
        f(np.ones(2 if f in functions[:3] else 1))
    first, twin, near, long, long_near = (f._program for f in functions)
    assert first is twin
    assert len({id(p) for p in (first, near, long, long_near)}) == 4


def test_programs_of_one_text_but_other_trees_are_two():
    like = jax.ShapeDtypeStruct((2,), np.float64)
    code = (lambda a: (a, a), lambda a: {"x": a, "y": a}, lambda b: (b, b))
    pair, named, again = compiled(*(Lowered(function, like) for function in code))
    assert pair is again
    assert compiled(Lowered(code[0], like)) == [pair]
    assert set(named.call(np.ones(2))) == {"x", "y"}


def test_what_equal_functions_make_is_shared():
    one, twin, other = (partial(SampleLayout, 3, dt, 2) for dt in (0.1, 0.1, 0.2))
    made = shared(one)
    assert shared(twin) is made
    assert shared(other) == SampleLayout(3, 0.2, 2)
    assert shared(lambda: SampleLayout(3, 0.1, 2)) is not made  # nothing is known of this function


def test_programs_run_together_give_each_its_own():
    like = jax.ShapeDtypeStruct((2,), np.float64)
    programs = compiled(*(Lowered(lambda a, k=k: k * a, like) for k in (1.0, 2.0, 3.0)))
    results = together(programs, [(np.full(2, x),) for x in (1.0, 10.0, 100.0)])
    np.testing.assert_array_equal(results, [[1, 1], [20, 20], [300, 300]])


def test_single_precision_is_refused_with_a_remedy():
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        VectorFunction(lambda a: a, [1], [1])


def test_an_unconnected_port_counts_as_zero():
    class Reader(LeafSystem):
        def __init__(self):
            super().__init__()
            self.port = self.DeclareVectorInputPort("in", 3)

    reader = Reader()
    context = reader.CreateDefaultContext()
    np.testing.assert_array_equal(value_or_zeros(reader.port, context), np.zeros(3))
    reader.port.FixValue(context, [1.0, 2, 3])
    np.testing.assert_array_equal(value_or_zeros(reader.port, context), [1, 2, 3])
