"""Records of a vehicle at rest, which simulations start from."""

import jax.numpy as jnp
import numpy as np

from spinndrift.training.diagnosis.filter.along_records import Records


def at_rest(commands, past, dt):
    """Records of a vehicle 5 m deep, whose first `past` commands (T, n, R) come before them."""
    total, _, runs = commands.shape
    steps = total - past
    X = np.zeros((steps + 1, 7, runs))
    X[:, 0], X[:, 6] = 1.0, -5.0
    step = np.full((total, 1), dt)
    arrays = (X, np.zeros((steps + 1, 6, runs)), commands[past:], np.ones((steps, runs)),
              step[past:], commands[:past], step[:past])  # fmt: skip
    return Records(*(jnp.asarray(a) for a in arrays))
