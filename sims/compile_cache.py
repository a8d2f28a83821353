"""Compiled programs kept on disk, so that the second run of a command starts at once."""

import gc
import hashlib
import platform
from pathlib import Path

import jax
from filelock import FileLock, Timeout
from platformdirs import user_cache_path

_LARGEST = 2**30  # bytes; what was used longest ago goes first
_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 20_000  # Linux gives a process 65530, and a compiler that gets no more crashes


def keep_compiled(folder: Path | None = None) -> None:
    """Let JAX keep what it compiles in `folder`, by default the user's cache folder.

    A folder chosen before (`JAX_COMPILATION_CACHE_DIR`) stays. A bounded size makes JAX take a file
    lock around every read and write, so that processes may share it.
    """
    if compiled_folder() is not None:
        return
    base = user_cache_path("spinndrift") / "jax" if folder is None else folder
    chosen = base / f"{jax.__version__}-{_processor()}"
    mend(chosen)
    jax.config.update("jax_compilation_cache_dir", str(chosen))
    jax.config.update("jax_compilation_cache_max_size", _LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def mend(folder: Path) -> None:
    """Remove programs that a process was killed in the middle of writing.

    JAX writes a program first and the time of its last use after it, and stores nothing more in a
    folder where it meets a program without one; it says so at no log level.
    """
    if not folder.is_dir():
        return
    try:
        with FileLock(folder / ".lockfile", timeout=10):  # JAX's own, held while it writes
            for program in folder.glob("*-cache"):
                if not program.with_name(f"{program.name.removesuffix('cache')}atime").exists():
                    program.unlink()
    except (Timeout, OSError):  # another process is busy there, or the folder is not ours
        return


def compiled_folder() -> str | None:
    """The folder where JAX keeps compiled programs, if one was chosen."""
    return jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]


def compiled_environment() -> dict[str, str]:
    """Variables by which another process keeps its programs in the same folder, bounded alike.

    One that knew the folder alone would store programs without the time of their last use, which
    those that bound it can't read (`mend`). None where no folder was chosen.
    """
    folder = compiled_folder()
    if folder is None:
        return {}
    return {
        "JAX_COMPILATION_CACHE_DIR": folder,
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(_LARGEST),
    }


def give_back_programs() -> None:
    """Forget compiled programs before their pages, several maps each, use up the process's."""
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()
        gc.collect()


def _processor() -> str:
    """A short name of this processor: compiled code may use what another one lacks."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else [platform.processor()]
    told = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    model = next((line for line in lines if line.startswith("model name")), "")
    return hashlib.sha256(f"{platform.machine()}{model}{told}".encode()).hexdigest()[:12]
