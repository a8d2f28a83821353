"""Provenance of a run: versions, source revision and a fingerprint of the data."""

import hashlib
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ...models.recordings.store import Recording
from .windows import Windows

PACKAGES = ("spinndrift", "jax", "jaxlib", "equinox", "optax", "diffrax", "numpy", "xarray")


def fingerprint(windows: Windows) -> str:
    """A digest of the windows' numbers: equal data have equal digests."""
    digest = hashlib.sha256()
    arrays = (
        windows.X,
        windows.V,
        windows.F,
        windows.start,
        *(windows.commands or ()),
        *(windows.hidden or ()),
        windows.rise,
    )
    for array in arrays:
        if array is None:
            continue
        digest.update(repr((array.shape, str(array.dtype))).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr((windows.dt, windows.names, windows.normalise)).encode())
    return digest.hexdigest()[:16]


def recording_fingerprint(recording: Recording, *more: str) -> str:
    """A digest of a recording's numbers, and of `more` text."""
    digest = hashlib.sha256()
    for name, variable in sorted(recording.dataset.variables.items(), key=lambda v: str(v[0])):
        values = np.ascontiguousarray(variable.to_numpy())
        digest.update(repr((name, values.shape, str(values.dtype))).encode())
        digest.update(
            repr(values.tolist()).encode() if values.dtype == object else values.tobytes()
        )
    digest.update(repr((recording.dt, more)).encode())
    return digest.hexdigest()[:16]


def revision() -> str | None:
    """The git commit of the sources, with `+` if files have changed since; None without git."""
    folder = Path(__file__).resolve().parent

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", *arguments],
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=10,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None  # installed inside some other repository
    commit = git("rev-parse", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=no")
    return commit if commit is None or not changed else f"{commit}+"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect a run's numbers."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def provenance(windows: Windows) -> dict[str, Any]:
    """All of the above as plain JSON."""
    return {
        "revision": revision(),
        "versions": versions(),
        "data": fingerprint(windows),
        "windows": len(windows),
        "steps_a_window": windows.steps,
        "dt": windows.dt,
        "scenarios": list(windows.names),
    }
