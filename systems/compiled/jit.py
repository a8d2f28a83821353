"""Compiled calls from Drake events: one flat NumPy vector in, one out."""

import hashlib
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from itertools import accumulate, pairwise
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.config import checks
from .structure import structure

T = TypeVar("T")

_INLINE = {
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    "xla_cpu_multi_thread_eigen": False,
}
"""Runs a program's kernels sequentially in the calling thread: for small kernels that is faster
than a thread pool (14 µs instead of 54 µs for one call of the impedance law)."""


def require_double() -> None:
    """Check that JAX runs in double precision.

    Raises:
        ValueError: if JAX runs in single precision.
    """
    checks.require_double("the systems compute", "building a diagram")


class Program:
    """Compiled code, shared by all functions with the same lowered text while one of them lives."""

    def __init__(self, lowered: Any):
        """Compile the result of `jax.jit(…).lower(…)`; `compiled` shares programs."""
        try:
            self.call: Callable[..., Any] = lowered.compile(_INLINE)
        except jax.errors.JaxRuntimeError:  # another version's compiler without these options
            self.call = lowered.compile()


_PROGRAMS: WeakValueDictionary[bytes, Program] = WeakValueDictionary()
_RECENT: deque[Program] = deque(maxlen=8)
"""Programs kept alive for later functions of the same text, without other references to them."""


_BY_STRUCTURE: WeakValueDictionary[Hashable, Program] = WeakValueDictionary()
"""Programs by the structure of functions, so that equal ones need not be traced again."""


_SHARED: WeakValueDictionary[Hashable, Any] = WeakValueDictionary()
"""Objects by the structure of what made them (`shared`)."""


def shared(make: Callable[[], T]) -> T:
    """What `make` returns, or what an equal function (`structure`) returned, while that lives."""
    key = structure(make)
    found: T | None = None if key is None else _SHARED.get(key)
    if found is None:
        found = make()
        if key is not None:
            _SHARED[key] = found
    return found


class Lowered:
    """A function's program before compilation, for arguments like these (arrays or shapes).

    Attributes:
        result: shapes of what the function returns.
    """

    def __init__(self, function: Callable[..., Any], *like: Any):
        """Trace the function."""
        self.lowered = jax.jit(function).lower(*like)
        self.result = jax.tree.map(
            lambda info: jax.ShapeDtypeStruct(info.shape, info.dtype), self.lowered.out_info
        )

    @cached_property
    def key(self) -> bytes:
        """Equal for equal programs."""
        one = self.lowered
        # the text has all digits of all constants; the trees the names of arguments and results
        text = f"{one.in_tree}\n{one.out_tree}\n{one.as_text()}"
        return hashlib.sha256(text.encode()).digest()


def compiled(*codes: Lowered) -> list[Program]:
    """The program of each, or an equal one that is there; compiled in parallel."""
    found = {code.key: _PROGRAMS.get(code.key) for code in codes}
    missing = {code.key: code for code in codes if found[code.key] is None}
    with ThreadPoolExecutor() as threads:
        made = list(threads.map(lambda code: Program(code.lowered), missing.values()))
    found |= dict(zip(missing, made, strict=True))
    programs = [program for code in codes if (program := found[code.key]) is not None]
    for code, program in zip(codes, programs, strict=True):
        _PROGRAMS[code.key] = program
    return programs


@cache
def _threads() -> ThreadPoolExecutor:
    """Threads of `together`; each inherits the priority of the thread that first needs it."""
    return ThreadPoolExecutor(thread_name_prefix="spinndrift")


def together(programs: Sequence[Program], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Results of several programs in parallel, each called with its arguments in its own thread.

    A program runs in the calling thread and leaves other processors idle, and XLA runs independent
    parts of one program sequentially.
    """

    def call(program: Program, arguments: tuple[Any, ...]) -> Any:
        return jax.block_until_ready(program.call(*arguments))

    first, *others = zip(programs, arguments, strict=True)
    futures = [_threads().submit(call, *other) for other in others]
    return [call(*first), *(future.result() for future in futures)]


class VectorFunction:
    """A pure function of vectors, compiled once for its sizes and called with NumPy arrays.

    All arguments are passed as one float64 vector and all results as one: a call costs one
    conversion each way, some 10 µs, for any number of ports. Variables in the function's closure
    (parameters, configurations) become constants of the compiled code. Compilation happens at the
    first call, so that building a diagram is cheap; diagrams with equal functions share the
    compiled program, so that many runs cost one compilation (and the memory of one: systems with
    ports are never freed by pydrake). Functions of the same code and equal values are not even
    traced again (`structure`).
    """

    def __init__(
        self,
        function: Callable[..., Array | tuple[Array, ...]],
        inputs: Sequence[int],
        outputs: Sequence[int],
        keep: bool = False,
    ):
        """`function` takes one vector for each of `inputs` and returns one for each of `outputs`.

        With `keep` the program outlives the function for a while, for the next equal function.

        Raises:
            ValueError: if JAX runs in single precision.
        """
        require_double()
        self._function = function
        self._keep = keep
        self._inputs = tuple(inputs)
        self._outputs = tuple(outputs)
        self._slices = [slice(a, b) for a, b in pairwise(accumulate(self._outputs, initial=0))]

    def _packed(self, packed: Array) -> Array:
        ends = list(accumulate(self._inputs))
        results = self._function(*jnp.split(packed, ends[:-1]))
        results = results if isinstance(results, tuple) else (results,)
        sizes = tuple(result.size for result in results)
        if sizes != self._outputs:
            raise ValueError(f"the function returns vectors of sizes {sizes}, not {self._outputs}")
        return jnp.concatenate([result.reshape(-1) for result in results])

    @cached_property
    def _program(self) -> Program:
        self.compile(self)
        return vars(self)["_program"]

    def _key(self) -> Hashable:
        """Equal for equal functions of equal sizes; the function itself if that is not known."""
        found = structure(self._function)
        return self if found is None else (found, self._inputs, self._outputs)

    def _lowered(self) -> Lowered:
        return Lowered(self._packed, jax.ShapeDtypeStruct((sum(self._inputs),), np.float64))

    @staticmethod
    def compile(*functions: "VectorFunction") -> None:
        """Compile functions now, in parallel, so that no call has to wait for it."""
        waiting = [one for one in functions if "_program" not in vars(one)]
        keys = [one._key() for one in waiting]
        programs = {key: program for key in keys if (program := _BY_STRUCTURE.get(key)) is not None}
        traced: dict[Hashable, VectorFunction] = {}
        for one, key in zip(waiting, keys, strict=True):
            if key not in programs:
                traced.setdefault(key, one)
        made = compiled(*(one._lowered() for one in traced.values()))
        programs |= dict(zip(traced, made, strict=True))
        for one, key in zip(waiting, keys, strict=True):
            program = programs[key]
            vars(one)["_program"] = program
            if key is not one:
                _BY_STRUCTURE[key] = program
            if one._keep:
                _RECENT.append(program)

    def flat(self, *parts: Float[np.ndarray, "_"]) -> Float[np.ndarray, "m"]:
        """Call with one array for each input and return all results in one (read-only) array."""
        return np.asarray(self._program.call(np.concatenate(parts)))

    def __call__(self, *parts: Float[np.ndarray, "_"]) -> list[Float[np.ndarray, "_"]]:
        """Call with one array for each input and return one array for each output."""
        result = self.flat(*parts)
        return [result[part] for part in self._slices]
