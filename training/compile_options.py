"""Options of XLA for programs that take long to compile; each states what was measured for it."""

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax

QUICK_COMPILE = {"xla_backend_optimization_level": 1, "xla_cpu_prefer_vector_width": 512}
"""On a CPU, a training step: a third less time to compile at equal speed (18.1 to 12.5 s, 74 and
76 ms per step), and the processor's full vector width, of which XLA uses half by default."""

LOOP_EMITTERS = {"xla_cpu_use_fusion_emitters": False}
"""On a CPU, the filter along recorded runs: it compiles faster and runs as fast (one diagnosis on
one core: 179 to 130 s without cached programs, 73 to 61 s with them). A training step compiles
faster too, but takes an eighth longer."""

P = ParamSpec("P")
R = TypeVar("R")


def jit_with(options: Mapping[str, Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`eqx.filter_jit` with compiler options, and without them if this XLA does not know them.

    Only for options that save time: a program that needs an option must not lose it silently.
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        run: Any = eqx.filter_jit(function, compiler_options=dict(options))  # pyright: ignore[reportCallIssue]

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            nonlocal run
            try:
                return run(*args, **kwargs)
            except jax.errors.JaxRuntimeError as error:
                if "No such compile option" not in str(error):
                    raise
                run = eqx.filter_jit(function)
                return run(*args, **kwargs)

        return call

    return decorated
