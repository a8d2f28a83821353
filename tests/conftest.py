"""Settings that every test runs under; nothing in the library sets them."""

import functools
import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest
from jax._src.interpreters import mlir

from spinndrift.sims.compile_cache import (
    compiled_environment,
    compiled_folder,
    give_back_programs,
    keep_compiled,
    mend,
)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_traceback_in_locations_limit", 0)  # programs are lowered faster without


# JAX makes an MLIR context for each program (1 MB, some ms) and keeps it. Tests lower thousands of
# programs, so they share one context; this function is private to JAX.
mlir.make_ir_context = functools.cache(mlir.make_ir_context)
# Tracing allocates much that stays: fewer collections take an eighth of the time off.
gc.set_threshold(100_000, 50, 1000)
keep_compiled(Path(__file__).resolve().parent.parent / ".jax_cache")  # shared by all workers
# and by the processes that they start, if these have as many devices
os.environ.update(compiled_environment() | {"JAX_NUM_CPU_DEVICES": "1"})

hypothesis.settings.register_profile(
    "spinndrift",
    deadline=None,  # a first call compiles
    derandomize=True,
    database=None,
    max_examples=50,
    print_blob=True,
)
hypothesis.settings.load_profile("spinndrift")


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C as from a terminal, for a test of it and the processes that it starts.

    Shells have it ignored in what they run in the background, which the package leaves so.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True, scope="module")
def _types_checked(request: pytest.FixtureRequest) -> Iterator[None]:
    """Check types and shapes of every call, but not in modules that run whole commands.

    It takes a fifth of the time there, and modules of their own test what the commands call.
    """
    whole = request.node.get_closest_marker("whole") is not None
    jaxtyping.config.update("jaxtyping_disable", whole)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True, scope="session")
def _quick_compile() -> None:
    """Compile training steps without optimisation: tests take few of them."""
    from spinndrift.training.compile_options import QUICK_COMPILE  # not before types are checked

    QUICK_COMPILE["xla_backend_optimization_level"] = 0


@pytest.fixture(autouse=True, scope="module")
def _few_compiled_programs() -> Iterator[None]:
    """Forget compiled programs in time, and remove what killed processes have left half stored."""
    mend(Path(str(compiled_folder())))
    yield
    give_back_programs()
