"""Number of processor cores that the computations of this process share."""

import os

import jax

_MOST = 8  # a batch has ten to a hundred windows: one or two per core would be mostly overhead


def share_cores() -> None:
    """Make each core that this process may use, up to eight, a separate JAX device.

    Training then splits each batch among them (`training.fitting.step`); all else runs on the
    first. An earlier choice (`JAX_NUM_CPU_DEVICES`) is kept, and so is a number already in use.
    """
    if jax.config.jax_num_cpu_devices >= 0:  # pyright: ignore[reportAttributeAccessIssue]
        return
    try:
        jax.config.update("jax_num_cpu_devices", min(_cores(), _MOST))
    except RuntimeError:  # JAX is initialised already
        return


def _cores() -> int:
    """Number of cores available to this process, which may be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
