"""A heading that is off, or a horizontal plane that is mirrored, as surge and sway tell.

With a heading that is off they answer the forces that are turned about the vertical. With x and y
of the world exchanged, or one of them with the other sign, the velocity in the body is that of a
mirror image, which turns with the heading, so no order or sign of the commands explains it.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..resample import rotations
from ..store import Recording
from .hypotheses import CAUSAL, EVIDENCE, MOST, PLAUSIBLE, Driven, named
from .response import responses

_COARSE = np.arange(-165, 181, 15)
_FINE = np.arange(-30, 31, 5)
_LEAST = 10
"""Degrees: offsets that are tried, those about the best of them, and the least that is told."""
_MIRRORS = range(0, 180, 15)
"""Directions of a mirror (degrees) that are tried."""


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
        turn = Rotation.from_euler("z", float(degrees), degrees=True).as_matrix()
        own, shares = _fits(recording, commands, level, turn)
        if own > best:
            best, found = own, (degrees, shares)
    assert found is not None
    degrees, shares = found
    clear = all(named(float(kept[i][0]), shares[i], level.axes[i].count) for i in (0, 1))
    degrees = (degrees + 180) % 360 - 180
    worth = best - float(usual[0]) - EVIDENCE
    return (worth, float(degrees)) if worth > 0 and clear and abs(degrees) >= _LEAST else None


def mirrored_plane(
    recording: Recording, commands: Float[np.ndarray, "J K N m"], data: Driven
) -> tuple[float, float] | None:
    """Nats beyond `EVIDENCE` for a mirrored horizontal plane, and the direction of its mirror.

    The mirror stands along this direction (degrees from x to y, 0 to 165): at 45° x and y are
    exchanged, at 0° y has the other sign, at 90° x. What is driven of surge and sway must gain as
    in `heading_offset`.
    """
    level = replace(data, axes={i: r for i, r in data.axes.items() if i in (0, 1)})
    if not level.axes:
        return None
    usual, kept, _ = level.best(data.weights[..., None], PLAUSIBLE)
    if any(float(share[0]) > 1 - (1 - MOST) ** 2 for share in kept.values()):
        return None  # a mirror image leaves most of both
    found = {}
    for degrees in _MIRRORS:
        twice = np.deg2rad(2.0 * degrees)
        mirror = np.diag([0.0, 0.0, 1.0])
        mirror[:2, :2] = [[np.cos(twice), np.sin(twice)], [np.sin(twice), -np.cos(twice)]]
        found[degrees] = _fits(recording, commands, level, mirror)
    best = max(found, key=lambda degrees: found[degrees][0])
    nats, shares = found[best]
    clear = all(named(float(kept[i][0]), shares[i], r.count) for i, r in level.axes.items())
    worth = nats - float(usual[0]) - EVIDENCE
    return (worth, float(best)) if worth > 0 and clear else None


def _fits(
    recording: Recording,
    commands: Float[np.ndarray, "J K N m"],
    level: Driven,
    change: Float[np.ndarray, "3 3"],
) -> tuple[float, dict[int, float]]:
    """Nats and shares of surge and sway with the world's velocity changed from the recorded one."""
    axes = responses(_changed(recording, change), commands, recording.command_period)
    own = replace(level, axes={i: replace(axes[i], count=r.count) for i, r in level.axes.items()})
    nats, shares, _ = own.best(level.weights[..., None], CAUSAL, strict=True)
    return float(nats[0]), {i: float(share[0]) for i, share in shares.items()}


def _changed(recording: Recording, change: Float[np.ndarray, "3 3"]) -> Recording:
    """The recording with the velocity in the world replaced by `change` times it."""
    dataset = recording.dataset
    X, V = (dataset[name].to_numpy() for name in ("X_WB", "V_WB_B"))
    turned = V.copy()
    for j, k in np.argwhere(recording.lengths > 1).tolist():
        part = (j, k, slice(0, int(recording.lengths[j, k])))
        R = rotations(X[part][:, :4].T)
        turned[part][:, :3] = R.inv().apply(R.apply(V[part][:, :3]) @ change.T)
    return Recording(dataset.assign(V_WB_B=(dataset["V_WB_B"].dims, turned, {})))
