"""Options of XLA save time alone: without them a function gives the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.training.compile_options import LOOP_EMITTERS, jit_with


@pytest.mark.parametrize("options", [LOOP_EMITTERS, {"xla_cpu_of_another_version": True}])
def test_a_function_gives_the_same_whether_the_compiler_has_the_options_or_not(options):
    traced = []

    @jit_with(options)
    def function(x, power: int):
        """Its own text."""
        traced.append(power)
        return jnp.sin(x) ** power

    x = np.linspace(0.0, 1.0, 5)
    for power in (2, 2, 3):
        np.testing.assert_allclose(function(x, power), np.sin(x) ** power, rtol=1e-12)
    assert len(traced) == (2 if options is LOOP_EMITTERS else 3)  # once more where they failed
    assert function.__doc__ == "Its own text."


def test_the_compiler_at_hand_has_them():
    jax.jit(jnp.sin, compiler_options=LOOP_EMITTERS)(1.0)


def test_other_errors_are_told():
    def fails(x):
        raise jax.errors.JaxRuntimeError("no memory")

    @jit_with({})
    def function(x):
        return jax.pure_callback(fails, jax.ShapeDtypeStruct((), x.dtype), x)

    with pytest.raises(jax.errors.JaxRuntimeError, match="no memory"):
        jax.block_until_ready(function(jnp.asarray(1.0)))
