"""Times of a log whose clock steps back: by a reboot, or by a fault."""

import numpy as np
from jaxtyping import Float

from ...models.recordings.checks.finding import Finding

REBOOT_S = 5.0
"""A step back of more than this is a reboot."""
_STEP_S, _STAYS_S, _LATER = 0.2, 0.1, 8
"""s of a step back that lasts for the next messages; a single message that comes late is none."""
_BETWEEN_S = 10.0
_WRAP_MS_S = 2**32 * 1e-3
_PIECE_S, _PIECES, _RATE = 10.0, 6, 0.02
"""Pieces over which two clocks are compared, how many are needed, and what they may differ by."""


def epochs(
    raw: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], tuple[float, ...], int]:
    """Offset of each time (s, in the order of the file) so that later parts follow earlier ones.

    Also the times at which a later part begins, and how many of the steps are no reboots. A counter
    of milliseconds that wraps (49.7 days) goes on.
    """
    found = np.flatnonzero(np.diff(raw) < -_STEP_S) + 1
    shift = np.zeros_like(raw)
    starts, steps = [], 0
    for start in found.tolist():
        before = raw[start - 1]
        if raw[start : start + _LATER].max() > before - _STAYS_S:
            continue
        if before - raw[start] > _WRAP_MS_S / 2:
            shift[start:] = shift[start - 1] + _WRAP_MS_S
            continue
        last = before + shift[start - 1]
        shift[start:] = last + _BETWEEN_S - raw[start]
        starts.append(float(last + _BETWEEN_S / 2))
        steps += int(before - raw[start] <= REBOOT_S)
    return shift, tuple(starts), steps


def in_words(starts: tuple[float, ...], steps: int) -> list[str]:
    """Sentences on reboots and other steps back."""
    told, boots = [], len(starts) - steps
    if boots:
        told.append(f"The autopilot booted {boots} more time{'s' * (boots > 1)} in it.")
    if steps:
        told.append(
            f"The vehicle's clock stepped back {steps} time{'s' * (steps > 1)} without a reboot; "
            "the log is cut there."
        )
    return told


def rate_findings(own: Float[np.ndarray, " n"], stamps: Float[np.ndarray, " n"]) -> list[Finding]:
    """A clock that runs faster or slower than the one of the logger (both s)."""
    edges = np.arange(own[0], own[-1], _PIECE_S)
    at = np.searchsorted(own, edges)
    apart, real = np.diff(own[at]), np.diff(stamps[at])
    usable = (apart < 2 * _PIECE_S) & (real > 0) & (real < 2 * _PIECE_S)
    if np.count_nonzero(usable) < _PIECES:
        return []
    rate = float(np.median(apart[usable] / real[usable]))
    if abs(rate - 1) < _RATE:
        return []
    how = "faster" if rate > 1 else "slower"
    return [
        Finding(
            "clock-rate",
            "",
            f"the vehicle's clock runs {100 * abs(rate - 1):.0f} % {how} than the logger's, and "
            "masses and drags depend on it: a simulator at another speed, or a faulty clock",
            "record in real time, or make sure that the vehicle's clock is the right one",
        )
    ]
