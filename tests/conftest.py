"""Settings that every test runs under; nothing in the library sets them."""

import hashlib
import platform
from pathlib import Path

import hypothesis
import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def _cpu_key() -> str:
    """Return a short name of this processor: compiled code may use what another one lacks."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else [platform.processor()]
    told = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    model = next((line for line in lines if line.startswith("model name")), "")
    return hashlib.sha256(f"{platform.machine()}{model}{told}".encode()).hexdigest()[:12]


# Compiled programs are kept between runs and shared by all workers. A bounded size makes JAX take
# a file lock around every read, write and eviction, so no worker sees half an entry.
jax.config.update(
    "jax_compilation_cache_dir",
    str(Path(__file__).resolve().parent.parent / ".jax_cache" / f"{jax.__version__}-{_cpu_key()}"),
)
jax.config.update("jax_compilation_cache_max_size", 2**30)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)

hypothesis.settings.register_profile(
    "spinndrift",
    deadline=None,  # a first call compiles
    derandomize=True,
    database=None,
    max_examples=50,
    print_blob=True,
)
hypothesis.settings.load_profile("spinndrift")
