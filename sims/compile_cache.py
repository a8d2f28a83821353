"""A cache of compiled programs on disk, so that later runs of a command start faster."""

import gc
import hashlib
import platform
from pathlib import Path

import jax
from filelock import FileLock, Timeout
from platformdirs import user_cache_path

_LARGEST = 2**30  # bytes; the least recently used programs are removed first
_WORTH_KEEPING = 0.3  # s of compilation, at least
_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 20_000  # Linux allows 65530 per process, and XLA's compiler crashes beyond


def keep_compiled(folder: Path | None = None) -> None:
    """Let JAX cache compiled programs in `folder`, by default the user's cache folder.

    An earlier choice (`JAX_COMPILATION_CACHE_DIR`) is kept. With a bounded size JAX takes a file
    lock for every read and write, so that processes can share the folder.
    """
    if compiled_folder() is not None:
        return
    base = user_cache_path("spinndrift") / "jax" if folder is None else folder
    chosen = base / f"{jax.__version__}-{_processor()}"
    mend(chosen)
    jax.config.update("jax_compilation_cache_dir", str(chosen))
    jax.config.update("jax_compilation_cache_max_size", _LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)


def mend(folder: Path) -> None:
    """Remove programs whose writing was interrupted by the end of a process.

    JAX writes a program first and the time of its last use after it. If it finds a program without
    such a time, it stores no further programs in the folder, without a log message.
    """
    if not folder.is_dir():
        return
    try:
        with FileLock(folder / ".lockfile", timeout=10):  # JAX holds this lock while it writes
            for program in folder.glob("*-cache"):
                if not program.with_name(f"{program.name.removesuffix('cache')}atime").exists():
                    program.unlink()
    except (Timeout, OSError):  # another process is writing, or no permission
        return


def compiled_folder() -> str | None:
    """The folder of JAX's cache of compiled programs, if one was chosen."""
    return jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]


def compiled_environment() -> dict[str, str]:
    """Environment variables for another process to share the cache with the same size limit.

    Without the limit it would store programs without the time of their last use, which processes
    with a limit can't read (`mend`). Empty if no folder was chosen.
    """
    folder = compiled_folder()
    if folder is None:
        return {}
    return {
        "JAX_COMPILATION_CACHE_DIR": folder,
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(_LARGEST),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(_WORTH_KEEPING),
    }


def give_back_programs() -> None:
    """Drop compiled programs before their memory maps reach the limit of the process."""
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()
        gc.collect()


def _processor() -> str:
    """A hash of this processor's features, as compiled code may use instructions others lack."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else [platform.processor()]
    told = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    model = next((line for line in lines if line.startswith("model name")), "")
    return hashlib.sha256(f"{platform.machine()}{model}{told}".encode()).hexdigest()[:12]
