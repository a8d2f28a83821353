"""A heading that is off: surge and sway answer the forces that are turned about the vertical."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..resample import rotations
from ..store import Recording
from .hypotheses import CAUSAL, EVIDENCE, PLAUSIBLE, Driven, named
from .response import responses

_COARSE = np.arange(-165, 181, 15)
_FINE = np.arange(-30, 31, 5)
_LEAST = 10
"""Degrees: offsets that are tried, those about the best of them, and the least that is told."""


def heading_offset(
    recording: Recording, commands: Float[np.ndarray, "J K N m"], data: Driven
) -> tuple[float, float] | None:
    """Nats beyond `EVIDENCE` for a wrong heading, and by how many degrees it is left of the bow.

    First the commanded force is turned in the body, which is cheap, then about the best of these
    offsets the velocity is turned about the vertical, which is exact. Surge and sway must both gain
    clearly: a weak thruster couples them with a matrix that is no rotation.
    """
    if not {0, 1} <= data.axes.keys():
        return None
    level = replace(data, axes={i: data.axes[i] for i in (0, 1)})
    usual, kept, _ = level.best(data.weights[..., None], PLAUSIBLE)
    angles = np.deg2rad(_COARSE)
    turned = np.repeat(data.weights[..., None], angles.size, axis=-1)
    X, Y = data.weights[0][:, None], data.weights[1][:, None]
    turned[0] = np.cos(angles) * X + np.sin(angles) * Y
    turned[1] = np.cos(angles) * Y - np.sin(angles) * X
    nats, _, _ = level.best(turned, CAUSAL, strict=True)
    if nats.max() - usual[0] < EVIDENCE:
        return None
    best, found = -np.inf, None
    for degrees in _COARSE[int(nats.argmax())] + _FINE:
        axes = responses(
            _turned_back(recording, float(degrees)), commands, recording.command_period
        )
        own = replace(level, axes={i: replace(axes[i], count=level.axes[i].count) for i in (0, 1)})
        nats, shares, _ = own.best(data.weights[..., None], CAUSAL, strict=True)
        if nats[0] > best:
            best, found = float(nats[0]), (degrees, shares)
    assert found is not None
    degrees, shares = found
    clear = all(named(float(kept[i][0]), float(shares[i][0]), level.axes[i].count) for i in (0, 1))
    degrees = (degrees + 180) % 360 - 180
    worth = best - float(usual[0]) - EVIDENCE
    return (worth, float(degrees)) if worth > 0 and clear and abs(degrees) >= _LEAST else None


def _turned_back(recording: Recording, degrees: float) -> Recording:
    """The recording with the velocities of the true heading, if the recorded one is so far left."""
    turn = Rotation.from_euler("z", degrees, degrees=True)
    dataset = recording.dataset
    X, V = (dataset[name].to_numpy() for name in ("X_WB", "V_WB_B"))
    turned = V.copy()
    for j, k in np.argwhere(recording.lengths > 1).tolist():
        part = (j, k, slice(0, int(recording.lengths[j, k])))
        R = rotations(X[part][:, :4].T)
        turned[part][:, :3] = (R.inv() * turn * R).apply(V[part][:, :3])
    return Recording(dataset.assign(V_WB_B=(dataset["V_WB_B"].dims, turned, {})))
