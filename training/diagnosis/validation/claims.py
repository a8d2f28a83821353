"""What data left out of the fits say about a verdict's claim.

`adequate` claims of the believed model, `explained` of the extended one, that what it leaves is
noise (Ljung 1999, section 16.6). Against the claim speak forecasts outside their bands, and another
model that forecasts better: refitted coefficients, or the black box, which needs no name. With much
data every difference is significant, so one counts only from a practical size on.

Forecast errors are root sums of squares over position, rotation and velocity, with m, rad and m/s
counted alike; intervals are by bootstrap over folds, the same ones for both models.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..findings.result import Interval, ModelGain
from .validation import GROUPS, Judged, horizons

PRACTICAL = 0.1
"""Share of a forecast error below which a difference between models has no practical size."""
_LOOSE = 0.1
"""Share of records by which bands may hold fewer than they should."""
_DRAWS = 400
LEFT = "left"
"""The model that a verdict is about, with a black box on what it leaves."""
_WORDS = {
    "refitted": "refitted coefficients forecast",
    "black_box": "a black box forecasts",
    LEFT: "a black box on what it leaves forecasts",
}


class Better(NamedTuple):
    """Share of a model's forecast error that another one saves, over a horizon."""

    part: str
    horizon: str
    share: Interval


def names_of_horizons(judged: Judged, longest: float, dt: float) -> list[str]:
    """The horizons (s) as text."""
    return [f"{h * dt:g}" for h in horizons(longest, judged.simulated.every, dt)]


def asserted(judged: Mapping[str, Judged], refit: bool) -> str:
    """The model that a verdict is about: extended if there are causes, else refitted or base."""
    return "extended" if "extended" in judged else "refitted" if refit else "base"


def saved(
    model: Judged, before: Judged, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "h"], Float[np.ndarray, "d h"]]:
    """1 - error / error before, over each horizon, with draws of a bootstrap over folds."""
    return _saved(model.square.sum(axis=1), before.square.sum(axis=1), rng)


def _saved(
    new: Float[np.ndarray, "h F"], old: Float[np.ndarray, "h F"], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    drawn = rng.integers(new.shape[1], size=(_DRAWS, new.shape[1]))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # forecasts may diverge
        value = 1 - np.sqrt(new.sum(axis=1) / old.sum(axis=1))
        draws = 1 - np.sqrt(new[:, drawn].sum(axis=2) / old[:, drawn].sum(axis=2))
    return value, draws.T


def explained(
    judged: Mapping[str, Judged], name: str, at: list[str], seed: int
) -> dict[str, Interval]:
    """Share of the belief's forecast error that a model explains, by horizon."""
    value, draws = saved(judged[name], judged["base"], np.random.default_rng(seed))
    ends = np.nanpercentile(draws, (2.5, 97.5), axis=0) if np.isfinite(draws).any() else draws[:2]
    rows = zip(at, value, ends.T, strict=True)
    return {h: Interval(float(v), (float(e[0]), float(e[1]))) for h, v, e in rows}


def beaten_by(model: Judged, rival: Judged, at: list[str], seed: int) -> Better | None:
    """Where a rival saves most of a model's forecast error, if that is of a practical size.

    Half of that size must lie below the interval.
    """
    best: Better | None = None
    for g, part in enumerate(GROUPS):
        value, draws = _saved(rival.square[:, g], model.square[:, g], np.random.default_rng(seed))
        for h, horizon in enumerate(at):
            if not np.isfinite(draws[:, h]).all() or value[h] < PRACTICAL:
                continue
            low, high = (float(e) for e in np.percentile(draws[:, h], (2.5, 97.5)))
            if low > PRACTICAL / 2 and (best is None or value[h] > best.share.value):
                best = Better(part, horizon, Interval(float(value[h]), (low, high)))
    return best


def outside_bands(
    coverage: Mapping[str, Mapping[str, Interval]],
) -> tuple[str, str, float] | None:
    """The band and horizon of the least share of records inside, if it is far too small."""
    worst: tuple[float, str, str, float] | None = None
    for band, by_horizon in coverage.items():
        wanted = float(band.split()[0]) / 100
        for horizon, share in by_horizon.items():
            lack = wanted - share.value
            if share.interval95[1] < wanted - _LOOSE and (worst is None or lack > worst[0]):
                worst = lack, band, horizon, share.value
    return None if worst is None else worst[1:]


def vetoes(
    judged: Mapping[str, Judged],
    name: str,
    at: list[str],
    coverage: Mapping[str, Mapping[str, Interval]],
    seed: int,
) -> list[str]:
    """What left-out data say against the claim that a model leaves noise alone, in words."""
    found = []
    if not np.isfinite(judged[name].square).all():
        found.append("its forecasts diverge")
    outside = outside_bands(coverage)
    if outside is not None:
        band, horizon, share = outside
        found.append(
            f"forecasts over {horizon} s leave their bands: {100 * share:.0f} % of the records lie "
            f"inside those of {band}"
        )
    for rival, words in _WORDS.items():
        if rival == name or rival not in judged:
            continue
        better = beaten_by(judged[name], judged[rival], at, seed)
        if better is not None:
            found.append(
                f"{words} {better.part} over {better.horizon} s better by "
                f"{100 * better.share.value:.0f} %"
            )
    return found


class Claim(NamedTuple):
    """A verdict's claim: what speaks against it, and what of the belief's error is explained."""

    vetoes: list[str]
    explained: dict[str, Interval]


class Judgement(NamedTuple):
    """All models as judged, with their gains, the longest horizon (s), step (s) and seed."""

    judged: Mapping[str, Judged]
    gain: Mapping[str, ModelGain]
    longest: float
    dt: float
    seed: int

    def of(self, refit: bool, estimated: bool) -> Claim:
        """The claim of the verdict; bands do not know the errors of `estimated` states."""
        name = asserted(self.judged, refit)
        at = names_of_horizons(self.judged["base"], self.longest, self.dt)
        bands = {} if estimated else self.gain[name].coverage
        shares = {} if name == "base" else explained(self.judged, name, at, self.seed)
        return Claim(vetoes(self.judged, name, at, bands, self.seed), shares)


def improves(
    new: Float[np.ndarray, "h g F"], old: Float[np.ndarray, "h g F"], rng: np.random.Generator
) -> bool:
    """Whether a model saves as much as a practical share of the forecast error of one part.

    By the mean logarithm of the ratio of squared errors over parts and horizons, which must clearly
    be below zero.
    """
    parts = [_saved(new[:, g], old[:, g], rng) for g in range(len(GROUPS)) if old[:, g].any()]
    if not parts or not all(np.isfinite(value).all() for value, _ in parts):
        return False  # without errors there is nothing to save
    mean, high = _mean_logarithm(parts)
    return bool(mean < np.log(1 - PRACTICAL) / len(parts) and high < 0)


def better_in_part(new: Judged, old: Judged, at: list[str], seed: int) -> bool:
    """Whether a model saves a practical share of another one's error in a part, and loses none.

    Of position, rotation and velocity at each horizon none may be worse by such a share.
    """
    return beaten_by(old, new, at, seed) is not None and beaten_by(new, old, at, seed) is None


def clearly_better(new: Judged, old: Judged, seed: int) -> bool:
    """Whether a model saves a practical share of another one's forecast error, over all horizons.

    By the mean logarithm of the ratio over the horizons.
    """
    both = saved(new, old, np.random.default_rng(seed))
    if not np.isfinite(both[0]).all():
        return bool(np.isfinite(new.square).all())
    mean, high = _mean_logarithm([both])
    return bool(mean < np.log(1 - PRACTICAL) and high < 0)


def _mean_logarithm(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Mean over parts and horizons of log(error / error before), and the end of its interval.

    Of each part the shares saved (h) with their draws (d, h); the end is that of 97.5 %.
    """
    value, draws = (np.concatenate(shares, axis=-1) for shares in zip(*parts, strict=True))
    mean, drawn = (np.log(np.maximum(1 - a, 1e-12)).mean(axis=-1) for a in (value, draws))
    return float(mean), float(np.nanpercentile(drawn, 97.5))
