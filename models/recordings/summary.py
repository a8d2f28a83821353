"""A summary of a recording in a few lines of text."""

import numpy as np

from .schema import LABELS, SENSORS, STATES, present, variable_units
from .store import Recording


def _range(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    return f"{_short(finite.min())} … {_short(finite.max())}" if finite.size else "missing"


def _short(value: float) -> str:
    """Three digits, or all before the point: pulses are 1100 … 1900, not 1.1e+03."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def summarize(recording: Recording) -> str:
    """Return size, scenarios, ranges of states, commands and sensors, missing channels, notes."""
    dataset = recording.dataset
    lengths = recording.lengths
    runs = int(np.count_nonzero(lengths))
    count = len(recording.scenarios)
    lines = [
        f"{recording.duration:.1f} s at {1 / recording.dt:g} Hz: {runs} run{'s' * (runs != 1)} of "
        f"{count} scenario{'s' * (count != 1)}; vehicle: {recording.vehicle or 'not named'}; "
        f"source: {dataset.attrs.get('source') or '-'}"
    ]
    for scenario, row in zip(recording.scenarios, lengths, strict=True):
        spans = [f"{(n - 1) * recording.dt:.1f}" for n in row if n]
        shown = ", ".join(spans[:6]) + (f", … ({len(spans)} runs)" if len(spans) > 6 else "")
        lines.append(f"  {scenario}: {shown} s")
    for name, (dim, _) in STATES.items():
        values = dataset[name].to_numpy()
        parts = [
            f"{label} {_range(values[..., i])}"
            for i, label in enumerate(LABELS[dim])
            if not label.startswith("q") or name != "X_WB"
        ]
        lines.append(f"{name} ({variable_units(name)}): " + ", ".join(parts))
    for name in recording.commands + present(dataset, SENSORS):
        lines.append(f"{name} ({variable_units(name)}): {_range(dataset[name].to_numpy())}")
    for name, labels in recording.missing.items():
        lines.append(f"missing in at least one run: {', '.join(labels)} of {name}")
    lines.extend(f"- {note}" for note in recording.notes)
    return "\n".join(lines)
