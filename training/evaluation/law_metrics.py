"""Distances between samples of a predicted law and of the true one, and their sampling floor.

Two finite sets of samples of one law differ too. That difference is the *floor*: each metric is
computed twice, for the predicted samples and for other samples of the truth, against the same
samples of the truth; a ratio of 1 is the best that can be measured.

At each time, with true samples x_i, predicted x̂_j, d the `GroundMetric`'s distance and means over
all pairs:

    w2            (min over couplings π of Σ π_ij d²(x_i, x̂_j))^½, solved exactly (Villani 2009,
                  definition 6.1; network simplex of Bonneel et al. 2011 in POT)
    w2_debiased   (W₂²(x, x̂) - ½ W₂²(x, x') - ½ W₂²(x̂, x̂'))^½ with other samples x', x̂' of either
                  law (as Feydy et al. 2019, eq. 3, without entropy). In twelve dimensions W₂ of
                  some hundred samples is mostly sampling error, and a law that is too narrow can
                  come out *below* the floor; this difference detects it.
    energy_score  mean d(x̂_j, x_i) - ½ mean over j ≠ j' of d(x̂_j, x̂_j'), smaller is better
                  (Gneiting and Raftery 2007, eq. 22, sign turned)
    rmse_mean     ‖log(μ⁻¹ μ̂)‖ and ‖V̄ - V̂̄‖: the error of the mean path, μ the group mean
    rmse_samples  (mean ‖log(x_i⁻¹ x̂_j)‖²)^½, likewise for V: a sample against an observation. It is
                  √2 of the spread for the truth itself and *smaller* for its mean path alone, so a
                  deterministic law may lie below the floor.
    coverage      share of the x_i in the predicted law's central band, by axis
    spread        (mean ‖log(μ̂⁻¹ x̂_j)‖²)^½, likewise for V: the width of the law; its floor is the
                  true law's
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.checks import check_numbers, require
from ...models.se3 import CHANNELS
from ..losses.geodesic import relative_log
from .metrics import BANDS, displacement, order_statistics

PARTS = ("geodesic", "velocity")
SIDES = ("law", "floor")
_NEWTON_STEPS = 20


@dataclass(frozen=True)
class GroundMetric:
    """Weights of the parts of d² = ‖log(g⁻¹ g')‖² + ‖ξ - ξ'‖², per m, rad, m/s and rad/s.

    With the defaults 1 m, 1 rad, 1 m/s and 1 rad/s have equal weight, as in the paper's squared
    error.
    """

    position: float = 1.0
    rotation: float = 1.0
    linear_velocity: float = 1.0
    angular_velocity: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(self)
        for field in dataclasses.fields(self):
            require(getattr(self, field.name) >= 0, self, field.name, "give zero or more")

    def squares(self) -> tuple[float, ...]:
        """Squared weights of the four groups of three components."""
        return tuple(w**2 for w in dataclasses.astuple(self))


@dataclass(frozen=True)
class LawSamples:
    """S motions from one law at equal times: poses X and twists V. S = 1 is a deterministic law.

    Samples that are not finite are left out of every metric and counted in `finite`.
    """

    X: Float[np.ndarray, "T 7 S"]
    V: Float[np.ndarray, "T 6 S"]

    def __len__(self) -> int:
        return self.X.shape[2]

    def finite(self) -> "LawSamples":
        """The finite samples."""
        good = np.isfinite(self.X).all((0, 1)) & np.isfinite(self.V).all((0, 1))
        return LawSamples(self.X[:, :, good], self.V[:, :, good])

    def at(self, times: np.ndarray) -> "LawSamples":
        """The samples at these time indices."""
        return LawSamples(self.X[times], self.V[times])


def group_mean(X: Float[Array, "T 7 S"]) -> Float[Array, "T 7"]:
    """Mean pose μ at each time: the mean of log(μ⁻¹ g) is zero (Ackerman et al. 2013, eq. 4).

    Iterates μ ← μ exp(mean log(μ⁻¹ g)) from the first sample; it is the mean pose if all samples
    lie within a half turn of it.
    """

    def improve(_: Array, mean: Array) -> Array:
        e = relative_log(mean[:, :, None], jnp.moveaxis(X, 1, 0))
        return se3.retract(mean, jnp.mean(jnp.stack(e), axis=2))

    found = jax.lax.fori_loop(0, _NEWTON_STEPS, improve, jnp.moveaxis(X[:, :, 0], 1, 0))
    return jnp.moveaxis(found, 0, 1)


def wasserstein2(squared: Float[np.ndarray, "S R"]) -> float:
    """W₂ of two sets of equally likely samples with these squared distances."""
    import ot  # takes a second, more if torch is installed, so it is imported only for W₂

    S, R = squared.shape
    if min(S, R) == 1:  # one coupling alone
        return float(np.sqrt(np.mean(squared)))
    cost = np.ascontiguousarray(squared, np.float64)
    value = ot.emd2(np.full(S, 1 / S), np.full(R, 1 / R), cost, numItermax=2_000_000)
    return float(np.sqrt(np.maximum(np.asarray(value), 0)))


def compare_laws(
    predicted: LawSamples,
    truth: LawSamples,
    other_truth: LawSamples,
    dt: float,
    *,
    other_predicted: LawSamples | None = None,
    times: int = 50,
    metric: GroundMetric | None = None,
) -> xr.Dataset:
    """All metrics of the `predicted` law (side "law") and of `other_truth` (side "floor").

    Both are compared with `truth` at `times` evenly spaced times up to the last one (all if there
    are fewer); the samples' first time is dt.
    `w2_debiased` needs `other_predicted` (NaN without; its floor is 0 by definition). If no
    predicted sample is finite, the law's side is NaN and its `finite` 0.

    Raises:
        ValueError: numbers of times differ, or the truth is not finite.
    """
    if len({s.X.shape[0] for s in (predicted, truth, other_truth)}) > 1:
        raise ValueError("samples: all laws must be sampled at the same times")
    for samples in (truth, other_truth):
        if len(samples.finite()) < len(samples):
            raise ValueError("samples: the truth must be finite")
    T = truth.X.shape[0]
    index = np.unique(np.linspace(0, T, min(times, T) + 1).round().astype(int)[1:] - 1)
    predicted, truth, other_truth = (s.at(index) for s in (predicted, truth, other_truth))
    squares = (GroundMetric() if metric is None else metric).squares()
    sides = []
    for law in (predicted, other_truth):
        kept = law.finite()
        found = _against(kept, truth, squares) if len(kept) else _nothing(index.size)
        sides.append(found | {"finite": np.asarray(len(kept) / len(law))})
    sides[0]["w2_debiased"] = np.full(index.size, np.nan)
    sides[1]["w2_debiased"] = np.zeros(index.size)
    if other_predicted is not None and len(other_predicted.finite()):
        own = _w2(other_predicted.finite().at(index), predicted.finite(), squares)
        excess = sides[0]["w2"] ** 2 - (sides[1]["w2"] ** 2 + own**2) / 2
        sides[0]["w2_debiased"] = np.sqrt(np.maximum(excess, 0))
    dims = {
        "w2": ("time",),
        "w2_debiased": ("time",),
        "energy_score": ("time",),
        "rmse_mean": ("part", "time"),
        "rmse_samples": ("part", "time"),
        "spread": ("part", "time"),
        "coverage": ("band", "axis", "time"),
        "finite": (),
    }
    return xr.Dataset(
        {n: (("side", *d), np.stack([side[n] for side in sides])) for n, d in dims.items()},
        coords={
            "side": list(SIDES),
            "part": list(PARTS),
            "axis": list(CHANNELS),
            "band": list(BANDS),
            "time": ("time", dt * (index + 1), {"units": "s"}),
        },
    )


def overall(compared: xr.Dataset) -> dict[str, dict[str, float]]:
    """Averages over the whole horizon and any further dimension, such as scenarios.

    For each quantity `value`, `floor` and their `ratio`. RMSE and spread are roots of mean
    squares; the rest are means.
    """
    numbers: dict[str, list[float]] = {}
    for side in SIDES:
        d = compared.sel(side=side)
        scalars = ("w2", "w2_debiased", "energy_score")
        row: dict[str, float] = {n: float(d[n].mean(skipna=False)) for n in scalars}
        for name in ("rmse_mean", "rmse_samples", "spread"):
            for part in PARTS:
                squares = d[name].sel(part=part) ** 2
                row[f"{name}_{part}"] = float(np.sqrt(squares.mean(skipna=False)))
        for band in BANDS:
            share = d["coverage"].sel(band=band).mean(skipna=False)
            row[f"coverage_{100 * band:.0f}"] = float(share)
        row["finite"] = float(d["finite"].mean())
        for name, value in row.items():
            numbers.setdefault(name, []).append(value)
    return {
        name: {"value": value, "floor": floor, "ratio": value / floor if floor > 0 else np.nan}
        for name, (value, floor) in numbers.items()
    }


# ---------------------------------------------------------------------------------- one side


def _against(
    law: LawSamples, truth: LawSamples, squares: tuple[float, ...]
) -> dict[str, np.ndarray]:
    dtype = jnp.result_type(float)
    weights = jnp.asarray(squares, dtype)
    X, V, X_t, V_t = (jnp.asarray(a, dtype) for a in (law.X, law.V, truth.X, truth.V))
    w2, energy, mean_squares = [], [], []
    for n in range(X.shape[0]):
        squared, parts = _squared_distances(X_t[n], V_t[n], X[n], V[n], weights)
        cross = np.asarray(squared)
        own = np.asarray(_squared_distances(X[n], V[n], X[n], V[n], weights)[0])
        w2.append(wasserstein2(cross))
        pairs = max(1, len(law) * (len(law) - 1))
        energy.append(np.sqrt(cross).mean() - np.sqrt(own).sum() / pairs / 2)
        mean_squares.append(np.asarray(parts))
    found = {name: np.asarray(a) for name, a in _moments(X, V, X_t, V_t).items()}
    return found | {
        "w2": np.asarray(w2),
        "energy_score": np.asarray(energy),
        "rmse_samples": np.sqrt(np.stack(mean_squares, axis=1)),
        "coverage": _coverage(X, V, X_t, V_t),
    }


def _w2(a: LawSamples, b: LawSamples, squares: tuple[float, ...]) -> Float[np.ndarray, " _"]:
    dtype = jnp.result_type(float)
    weights = jnp.asarray(squares, dtype)
    arrays = [jnp.asarray(x, dtype) for x in (a.X, a.V, b.X, b.V)]
    return np.array(
        [
            wasserstein2(np.asarray(_squared_distances(*(x[n] for x in arrays), weights)[0]))
            for n in range(a.X.shape[0])
        ]
    )


@jax.jit
def _squared_distances(
    X_a: Float[Array, "7 S"],
    V_a: Float[Array, "6 S"],
    X_b: Float[Array, "7 R"],
    V_b: Float[Array, "6 R"],
    weights: Float[Array, "4"],
) -> tuple[Float[Array, "S R"], Float[Array, "2"]]:
    """d² of all pairs; and the means of ‖log(g⁻¹ g')‖² and ‖ξ - ξ'‖² over them, unweighted."""
    pose = relative_log(X_a[:, :, None], X_b[:, None, :])
    difference = [*pose, *jnp.unstack(V_a[:, :, None] - V_b[:, None, :])]
    total, means = jnp.zeros_like(difference[0]), []
    for group in range(4):
        square = sum(d * d for d in difference[3 * group : 3 * group + 3])
        total = total + weights[group] * square
        means.append(jnp.mean(square))
    return total, jnp.stack([means[0] + means[1], means[2] + means[3]])


@jax.jit
def _moments(
    X: Float[Array, "T 7 S"],
    V: Float[Array, "T 6 S"],
    X_t: Float[Array, "T 7 R"],
    V_t: Float[Array, "T 6 R"],
) -> dict[str, Float[Array, "2 T"]]:
    mean, mean_t = group_mean(X)[:, :, None], group_mean(X_t)[:, :, None]
    V_mean, V_mean_t = jnp.mean(V, axis=2, keepdims=True), jnp.mean(V_t, axis=2, keepdims=True)

    def size(e: Array) -> Array:
        parts = jnp.stack([jnp.sum(e[:6] ** 2, axis=0), jnp.sum(e[6:] ** 2, axis=0)])
        return jnp.sqrt(jnp.mean(parts, axis=2))

    return {
        "rmse_mean": size(_difference(mean, V_mean, mean_t, V_mean_t)),
        "spread": size(_difference(X, V, mean, V_mean)),
    }


def _coverage(
    X: Float[Array, "T 7 S"],
    V: Float[Array, "T 6 S"],
    X_t: Float[Array, "T 7 R"],
    V_t: Float[Array, "T 6 R"],
) -> Float[np.ndarray, "bands 12 T"]:
    """Share of true samples inside the bands of the first 20 k - 1 predicted ones.

    Components are displacements from the mean of both sets together, so that for equal laws true
    and predicted samples are exchangeable and the bands are exact.
    """
    drawn, seen = (np.asarray(e) for e in _displacements(X, V, X_t, V_t))
    count = max((X.shape[2] + 1) // 20 * 20 - 1, 1)
    drawn = np.sort(drawn[:, :, :count], axis=2)
    shares = []
    for band in BANDS:
        # a deterministic law has bands of zero width
        low, high = order_statistics(count, band) if count > 1 else (0, 0)
        inside = (drawn[:, :, low, None] <= seen) & (seen <= drawn[:, :, high, None])
        shares.append(inside.mean(axis=2))
    return np.stack(shares)


@jax.jit
def _displacements(X: Array, V: Array, X_t: Array, V_t: Array) -> tuple[Array, Array]:
    mean = group_mean(jnp.concatenate([X, X_t], axis=2))[:, :, None]
    zero = jnp.zeros_like(V[:, :, :1])
    return _difference(X, V, mean, zero), _difference(X_t, V_t, mean, zero)


def _difference(X: Array, V: Array, X_ref: Array, V_ref: Array) -> Array:
    return displacement(*(a[..., None] for a in (X, V, X_ref, V_ref)))[..., 0]


def _nothing(count: int) -> dict[str, np.ndarray]:
    shapes = {
        "w2": (count,),
        "energy_score": (count,),
        "rmse_mean": (2, count),
        "rmse_samples": (2, count),
        "spread": (2, count),
        "coverage": (len(BANDS), len(CHANNELS), count),
    }
    return {name: np.full(shape, np.nan) for name, shape in shapes.items()}
