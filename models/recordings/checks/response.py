"""How much of each command the motion accounts for: the statistic behind the checks of commands.

Along each axis a body answers as

    F(t - τ) = m v̇ + d v + e |v| v + (restoring, Coriolis, a constant),    m, d, e ≥ 0,

because mass and drag take up energy and never give it. The commanded force is regressed on the
motion with these signs (least squares with non-negative coefficients), so that a share of 1 means
that the command belongs to the motion, whatever the vehicle's mass and drag are, and a share of 0
that no passive body could have moved so. The opposite regression, of acceleration on command and
velocity, fails where drag dominates: command and velocity are then nearly proportional.

Derivatives are avoided: both sides are correlated with a smooth window φ, and ∫φ v̇ = -∫φ' v. A
linear filter on both sides leaves the coefficients unchanged.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ..resample import grid, hold, linear, rotations, slerp
from ..store import Recording

HALF_WIDTH_S = 0.3
"""Half width of the window: a period of 0.6 s is damped to a half, a thruster's lag is inside."""
LAGS_S = np.round(np.arange(-1.0, 1.01, 0.1), 3)
"""s by which the motion may follow the command (negative: precede it)."""
_LEAST_RUN = 8
"""Windows that a run must have to be used."""
_ACF_S = 5.0
_SUBSETS = np.stack([
    np.outer(used, used)
    for used in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1])
])  # fmt: skip
"""Parts of RR: 1 where both coefficients are used."""
_CORIOLIS = {0: ((1, 5), (2, 4)), 1: ((2, 3), (0, 5)), 2: ((0, 4), (1, 3)),
             3: ((4, 5), (1, 2)), 4: ((3, 5), (0, 2)), 5: ((3, 4), (0, 1))}  # fmt: skip
"""Products of twist components in the equation of each axis: Coriolis and Munk terms."""


@dataclass(frozen=True)
class AxisResponse:
    """Sums of products of one axis' motion R (3: v̇, v, |v|v) and of all commands C (m), by lag.

    Attributes:
        RR: (3, 3).
        RC: (lags, 3, m).
        CC: (lags, m, m).
        count: independent windows: those of the record over their correlation along time.
        windows: all windows.
    """

    RR: Float[np.ndarray, "3 3"]
    RC: Float[np.ndarray, "L 3 m"]
    CC: Float[np.ndarray, "L m m"]
    count: float
    windows: int

    def fit(
        self, weights: Float[np.ndarray, "m *H"], lag: int | Sequence[int]
    ) -> tuple[Float[np.ndarray, "*L_H"], Float[np.ndarray, "*L_H"]]:
        """Share of the force C·weights that the motion accounts for, and the mass m fitted to it.

        `weights` may have trailing axes of hypotheses; `lag` is an index into `LAGS_S`, or several,
        which then are the first axis of both.
        """
        w, at = weights.reshape(len(weights), -1), np.asarray(lag)
        size = np.sum((self.CC[at] @ w) * w, axis=-2)
        b = self.RC[at] @ w
        x = self._inverses.reshape(-1, *(1,) * (b.ndim - 2), 3, 3) @ b
        gain = np.where((x >= 0).all(axis=-2), np.sum(x * b, axis=-2), 0.0)
        most = gain.argmax(axis=0)[None]
        best, mass = (np.take_along_axis(of, most, 0)[0] for of in (gain, x[..., 0, :]))
        share = np.where(size > 0, best / np.maximum(size, 1e-300), 0.0)
        shape = share.shape[:-1] + weights.shape[1:]
        mass = np.where(best > 0, mass, 0.0).reshape(shape)
        return np.clip(share, 0.0, 1.0 - 1e-6).reshape(shape), mass

    @cached_property
    def _inverses(self) -> Float[np.ndarray, "7 3 3"]:
        """Inverse of RR restricted to each subset of the coefficients, zero elsewhere."""
        found = np.linalg.pinv(self.RR * _SUBSETS, rcond=1e-10, hermitian=True)
        return found * _SUBSETS


def responses(
    recording: Recording, commands: Float[np.ndarray, "J K N m"], period: float
) -> dict[int, AxisResponse]:
    """The response of every axis with a measured velocity (0 … 5); empty if all runs are short.

    `period` (s) is the step at which commands are known.
    """
    pieces = [piece for _, piece in _pieces(recording, commands, period)]
    return {i: _sums(*_projected(i, own, step)) for i, own, step in _usable(pieces, recording.dt)}


def responses_along(
    recording: Recording, commands: Float[np.ndarray, "J K N m"], period: float, seconds: float
) -> list[tuple[tuple[int, int], int, dict[int, AxisResponse]]]:
    """Responses of blocks of some `seconds`, which add up to those of the whole.

    Each with the indices of its run and the sample in it at which the block begins.
    """
    found = _pieces(recording, commands, period)
    size = max(round(seconds / recording.dt), 1)
    blocks: dict[tuple[int, int, int], dict[int, AxisResponse]] = {}
    for i, own, step in _usable([piece for _, piece in found], recording.dt):
        R, C, count = _projected(i, own, step)
        places = [at for at, piece in found if any(piece is one for one in own)]
        keys = np.concatenate([
            np.stack([np.broadcast_to(n, len(p.middle)), p.middle // size], axis=1)
            for n, p in enumerate(own)
        ])  # fmt: skip
        for n, block in np.unique(keys, axis=0).tolist():
            rows = (keys == (n, block)).all(axis=1)
            part = _sums(R[rows], C[:, rows], count * rows.mean())
            blocks.setdefault((*places[n], block), {})[i] = part
    return [((j, k), block * size, axes) for (j, k, block), axes in sorted(blocks.items())]


def _pieces(
    recording: Recording, commands: np.ndarray, period: float
) -> list[tuple[tuple[int, int], "Piece"]]:
    """The filtered runs, each with its indices."""
    half = max(HALF_WIDTH_S, 1.5 * period)
    return [
        ((j, k), piece)
        for j, k in np.argwhere(recording.lengths > 1).tolist()
        if (piece := filtered(recording, j, k, commands, half)) is not None
    ]


def _usable(pieces: "Sequence[Piece]", dt: float) -> Iterator[tuple[int, "list[Piece]", float]]:
    """Each axis with a measured velocity, the runs that have it, and the step of windows (s)."""
    for axis in range(6):
        own = [p for p in pieces if np.isfinite(p.rate[:, axis]).all()]
        if own:
            yield axis, own, max(round(own[0].half / 2), 1) * dt


@dataclass(frozen=True)
class Piece:
    """One run, filtered and thinned, less its mean.

    Attributes:
        rate: v̇ (n, 6).
        terms: v, |v| v and others (n, q).
        commands: by lag (L, n, m).
        middle: sample in the middle of each window.
        half: samples on each side of it.
    """

    rate: np.ndarray
    terms: np.ndarray
    commands: np.ndarray
    middle: np.ndarray
    half: int


def filtered(
    recording: Recording, j: int, k: int, commands: np.ndarray, half: float
) -> Piece | None:
    """One run correlated with a window of half width `half` (s); None if it is too short."""
    dt, length = recording.dt, int(recording.lengths[j, k])
    V = recording.dataset["V_WB_B"].to_numpy()[j, k, :length]
    q = recording.dataset["X_WB"].to_numpy()[j, k, :length, :4]
    f = np.nan_to_num(commands[j, k, :length])
    if recording.uneven:
        t = recording.elapsed(j, k)
        even = grid(t[0], t[-1], dt)
        V, q, f = linear(even, t, V.T).T, slerp(even, t, q.T).T, hold(even, t, f.T, dt).T
    n = max(round(half / dt), 2)
    step = max(round(half / 2 / dt), 1)
    reach = np.rint(LAGS_S / dt).astype(int)
    if len(V) < 2 * n + 1 + _LEAST_RUN * step:
        return None
    x = np.arange(-n, n + 1) / n
    window = np.cos(np.pi * x / 2) ** 4
    slope = -2 * np.pi * np.cos(np.pi * x / 2) ** 3 * np.sin(np.pi * x / 2) / (n * dt)
    slope, window = slope / window.sum(), window / window.sum()
    held = np.concatenate([f[:1], (f[1:] + f[:-1]) / 2])  # about t of a command held from t on
    up = rotations(q.T).inv().apply([0.0, 0.0, 1.0])
    products = [V[:, a] * V[:, b] for pair in _CORIOLIS.values() for a, b in pair]
    terms = np.concatenate([V, V * np.abs(V), up, np.stack(products, axis=1)], axis=1)
    inner = np.arange(len(V))
    shifted = np.stack([held[np.clip(inner - r, 0, len(V) - 1)] for r in reach])
    return Piece(
        _smoothed(V, -slope, step),
        _smoothed(terms, window, step),
        np.stack([_smoothed(c, window, step) for c in shifted]),
        np.arange(n, len(V) - n, step),
        n,
    )


def _smoothed(x: np.ndarray, window: np.ndarray, step: int) -> np.ndarray:
    """Correlation of every column with the window, at every `step`-th place, less its mean."""
    views = np.lib.stride_tricks.sliding_window_view(x, window.size, axis=0)[::step]
    y = views @ window
    return y - y.mean(axis=0)


def _projected(
    axis: int, pieces: Sequence[Piece], step: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Motion (n, 3), commands (L, n, m) without what restoring and Coriolis give; independent n."""
    free = [12, 13, 14, 15 + 2 * axis, 16 + 2 * axis]
    terms = np.concatenate([p.terms for p in pieces])
    R = np.stack(
        [np.concatenate([p.rate[:, axis] for p in pieces]), terms[:, axis], terms[:, 6 + axis]], 1
    )
    Z = terms[:, free]
    Z = Z[:, np.isfinite(Z).all(axis=0)]
    Z = Z[:, Z.std(axis=0) > 1e-9]
    C = np.concatenate([p.commands for p in pieces], axis=1)
    Q = np.linalg.qr(Z)[0] if Z.size else np.zeros((len(R), 0))
    R = R - Q @ (Q.T @ R)
    C = C - Q @ (Q.T @ C)
    zero = int(np.argmin(np.abs(LAGS_S)))
    lengths = np.cumsum([len(p.rate) for p in pieces])[:-1]
    count = len(R) / _correlation(np.split(C[zero], lengths), round(_ACF_S / step))
    return R, C, count


def _sums(R: np.ndarray, C: np.ndarray, count: float) -> AxisResponse:
    return AxisResponse(
        R.T @ R,
        np.einsum("na,lnm->lam", R, C),
        np.einsum("lna,lnb->lab", C, C),
        count,
        len(R),
    )


def _correlation(pieces: Sequence[np.ndarray], most: int) -> float:
    """1 + 2 Σ ρ² of the commands along time: windows for one independent window.

    Two series with the autocorrelation ρ are correlated by chance with the variance of n/(1 + 2 Σ
    ρ²) independent pairs (Bartlett 1935).
    """
    size = sum(float(np.sum(p**2)) for p in pieces)
    if size <= 0:
        return 1.0
    total = 1.0
    for lag in range(1, most + 1):
        products = (float(np.sum(p[lag:] * p[:-lag])) for p in pieces if len(p) > lag)
        total += 2 * (sum(products) / size) ** 2
    return total
