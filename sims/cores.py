"""How many processor cores the arithmetic of this process may share."""

import os

import jax

_MOST = 8  # a batch has some ten to a hundred windows: shares of one or two are mostly overhead


def share_cores() -> None:
    """Let JAX count each core that this process may use, up to eight, as a device of its own.

    Training then shares each batch among them (`training.fitting.step`); all else runs on the
    first. A number chosen before (`JAX_NUM_CPU_DEVICES`) stays, and so does one already in use.
    """
    if jax.config.jax_num_cpu_devices >= 0:  # pyright: ignore[reportAttributeAccessIssue]
        return
    try:
        jax.config.update("jax_num_cpu_devices", min(_cores(), _MOST))
    except RuntimeError:  # JAX has begun to compute with what it found
        return


def _cores() -> int:
    """Cores that the operating system lets this process use (fewer than there are, at times)."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
