"""Figures of a diagnosis: dependence of the error on states and commands, axis by axis."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ...models.se3 import AXES, TWIST
from ...training.diagnosis.data.arrays import Data
from ...training.diagnosis.filter.kalman import filtered, make_filter
from ...training.diagnosis.filter.problem import Evaluation
from ...training.diagnosis.filter.transition import Transition
from ...training.diagnosis.pipeline import Finding
from .figures import panels, styled

_WRENCH = ("X", "Y", "Z", "K", "M", "N")
_UNITS = {
    **dict.fromkeys("uvw", "m/s"), **dict.fromkeys("pqr", "°/s"),
    **dict.fromkeys(("roll", "pitch", "heading"), "°"),
    **dict.fromkeys(("east", "north", "height"), "m"),
    **dict.fromkeys(("X", "Y", "Z", "effort"), "N"), **dict.fromkeys("KMN", "N·m"),
    "voltage": "share of nominal", "time": "s",
}  # fmt: skip
_BINS = 12
_EQUAL = 1e-9
"""Relative difference below which values are equal."""
_UNKNOWN = "#d3dae0"
"""Colour of cells whose variable did not vary."""


def in_one_noise(finding: Finding) -> Finding:
    """The finding with the belief's innovations whitened by the noise estimated with the causes.

    The noise estimated with a wrong model absorbs some of its errors and would hide them.
    """
    d, evaluation, noise = finding.data, finding.base, finding.final.noise
    here = d.weight[:, None] > 0
    error = np.where(here, np.asarray(evaluation.predictions.error), 0.0)
    latent = evaluation.predictions.latent
    jacobian = np.where(here[:, :, None], np.asarray(evaluation.predictions.jacobian), 0.0)
    steps = Transition.along(jacobian, d.weight, evaluation.predictions.late, latent)
    inverse = np.asarray(finding.extended.inertia().inverse)
    kalman = make_filter(noise, steps, inverse, d.dt, d.step, jacobian, latent, d.spread)
    z = filtered(error, jacobian, kalman, latent) * d.weight[:, None]
    return replace(finding, base=evaluation._replace(noise=noise, kalman=kalman, z=z))


def run_times(d: Data) -> Float[np.ndarray, "M R"]:
    """Times of the samples since the first predicted one of each run (s)."""
    lasts, starts = (d.step * d.weight).sum(axis=0), np.zeros(len(d.run))
    for run in np.unique(d.run):
        own = np.flatnonzero(d.run == run)
        starts[own[1:]] = np.cumsum(lasts[own[:-1]])
    return d.times + starts


def variables(finding: Finding) -> dict[str, Float[np.ndarray, "N R"]]:
    """Variables at the start of each step that errors may depend on, in the units of `labelled`.

    States, the command of each thruster or of each axis of a wrench, named as in recordings, the
    sum of thrusters' absolute forces, voltage, time in the run, and the run.
    """
    d = finding.data
    qw, qx, qy, qz = (d.X[:-1, i] for i in range(4))
    found = {n: d.V[:-1, i] for i, n in enumerate("uvw")}
    found |= {n: np.degrees(d.V[:-1, 3 + i]) for i, n in enumerate("pqr")}
    angles = {
        "roll": np.arctan2(2 * (qw * qx + qy * qz), 1 - 2 * (qx**2 + qy**2)),
        "pitch": np.arcsin(np.clip(2 * (qw * qy - qx * qz), -1, 1)),
        "heading": np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2)),
    }
    found |= {n: np.degrees(angle) for n, angle in angles.items()}
    found |= {"east": d.X[:-1, 4], "north": d.X[:-1, 5], "height": d.X[:-1, 6]}
    if d.latent:  # velocities and places that the model has made up
        unmeasured = {TWIST[i] for i in d.latent} | {"east", "north"}
        found = {n: values for n, values in found.items() if n not in unmeasured}
    if d.command == "F_Bo_B":
        to_wrench = np.asarray(finding.extended.allocate(jnp.eye(d.u.shape[1])))
        wrench = np.einsum("fi,nir->fnr", to_wrench, d.u)
        found |= dict(zip(_WRENCH, wrench, strict=True))
    else:
        found |= {f"f{i + 1}": d.u[:, i] for i in range(d.u.shape[1])}
    found["effort"] = np.abs(d.u).sum(axis=1)
    found["voltage"] = d.voltage
    found["time"] = run_times(d)[:-1]
    found["run"] = np.broadcast_to(d.run.astype(float), d.voltage.shape)
    return found


def labelled(name: str) -> str:
    """A variable with its unit, for an axis of a figure."""
    unit = _UNITS.get(name, "N" if name[0] == "f" else "")
    unit = f"({unit})" if "/" in unit else unit
    return f"{name} / {unit}" if unit else name


def binned(values: Float[np.ndarray, " n"], most: int = _BINS) -> np.ndarray | None:
    """Bin indices of about equal counts, one bin per value if these are few; None if all equal."""
    if np.ptp(values) <= _EQUAL * max(float(np.abs(values).max()), 1e-3):
        return None
    distinct, bins = np.unique(values, return_inverse=True)
    if len(distinct) <= most:
        return bins
    edges = np.unique(np.quantile(values, np.linspace(0, 1, most + 1)))
    if len(edges) < min(4, most + 1):  # nearly all values are equal
        return np.unique(np.sign(values - np.median(values)), return_inverse=True)[1]
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def error_map(
    z: Float[np.ndarray, "n a"], variables: Mapping[str, Float[np.ndarray, " n"]], most: int = _BINS
) -> Float[np.ndarray, "a k"]:
    """Nats by axis and variable: ½ Σ n m² of means m in bins of equal counts, less half the bins.

    White errors of unit variance give about zero, errors that depend on a variable give more. NaN
    where a variable did not vary.
    """
    found = np.full((z.shape[1], len(variables)), np.nan)
    for k, values in enumerate(variables.values()):
        bins = binned(values, most)
        if bins is None:
            continue
        counts = np.bincount(bins)
        for i in range(z.shape[1]):
            sums = np.bincount(bins, weights=z[:, i], minlength=len(counts))
            nats = (sums**2 / np.maximum(counts, 1)).sum() / 2 - len(counts) / 2
            found[i, k] = max(float(nats), 0.0)
    return found


def draw_map(
    maps: Sequence[Float[np.ndarray, "a k"]],
    titles: Sequence[str],
    variables: Sequence[str],
    axes_of: Sequence[str],
) -> Figure:
    """Maps of nats side by side, on one scale."""
    height = 1.3 + 0.32 * len(axes_of)
    figure, axes = panels(1, len(maps), height, sharey=True)
    top = max(10.0, *(float(np.nanmax(values, initial=0.0)) for values in maps))
    images = []
    for ax, values, title in zip(axes[0], maps, titles, strict=True):
        image = ax.imshow(np.log10(1 + values), vmin=0, vmax=np.log10(1 + top), cmap="PuBu")
        images.append(image)
        ax.set_facecolor(_UNKNOWN)
        ax.set_aspect("auto")
        ax.set_xticks(range(len(variables)), list(variables), rotation=90, fontsize=7.5)
        ax.set_yticks(range(len(axes_of)), axes_of)
        ax.grid(visible=False)
        ax.set_title(title)
    bar = figure.colorbar(images[0], ax=axes[0].tolist(), shrink=0.9)
    ticks = [0, *(10**t for t in range(8) if 10**t <= top)]
    bar.set_ticks(list(np.log10(1 + np.array(ticks))), labels=[f"{t:g}" for t in ticks])
    bar.set_label("nats")
    return figure


def innovations_of(finding: Finding, evaluation: Evaluation) -> Float[np.ndarray, "n 6"]:
    """Whitened innovations of the twist at all existing steps."""
    return evaluation.z[:, 6:].swapaxes(1, 2)[finding.data.weight > 0].astype(float)


def where_they_are(finding: Finding) -> dict[str, Float[np.ndarray, " n"]]:
    """The `variables` at all existing steps."""
    exists = finding.data.weight > 0
    return {name: values[exists] for name, values in variables(finding).items()}


@styled
def map_figure(finding: Finding) -> Figure:
    """Dependence of the error on state and input by axis, for belief and explained model."""
    known = where_they_are(finding)
    evaluations = (finding.base, finding.final)
    maps = [error_map(innovations_of(finding, evaluation), known) for evaluation in evaluations]
    return draw_map(maps, ("Belief", "With the causes"), list(known), AXES)
