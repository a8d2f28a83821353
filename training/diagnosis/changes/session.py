"""Parts of a session in which a cause may act."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from ..data.arrays import Data
from ..findings.result import When

Kind = Literal["window", "onwards", "drift"]
BLOCK, SHORTEST = 0.5, 1.0
"""Least length (s) of a block, and of a part."""
_FEWEST, _MOST = 4, 120
"""Least number of samples in a block, and most blocks of a run."""


@dataclass(frozen=True)
class Span:
    """A part of a session: steps `first` to `last` of it, without the last.

    A `window` lies within a run; `onwards` lasts to the end of the session; a `drift` grows from
    none at its start to all at its end.
    """

    kind: Kind
    first: int
    last: int


@dataclass(frozen=True)
class Session:
    """The steps of all runs in the order of the session, and blocks of them.

    Attributes:
        piece, sample: piece of each step and its number there (T,).
        run: of each step (T,).
        time: of each step since the start of its run (s) (T,).
        clock: since the first step of the session; of its run where the order is unknown (s) (T,).
        edges: first step of each block, and the end (K + 1,).
        ordered: whether the order of runs is known; else every part lies within a run.
        labels: of the runs.
    """

    piece: Int[np.ndarray, " T"]
    sample: Int[np.ndarray, " T"]
    run: Int[np.ndarray, " T"]
    time: Float[np.ndarray, " T"]
    clock: Float[np.ndarray, " T"]
    edges: Int[np.ndarray, " K1"]
    ordered: bool
    labels: tuple[str, ...]

    @classmethod
    def of(cls, data: Data) -> "Session":
        """The steps of some data."""
        sample, piece = np.nonzero(data.weight)
        zero = np.zeros(data.weight.shape[1])
        began = zero if data.began is None else data.began[0]
        started = zero if data.started is None else data.started
        ordered = data.started is not None or len(np.unique(data.run)) == 1
        time = began[piece] + data.times[sample, piece]
        clock, run = started[piece] + time, data.run[piece]
        order = np.lexsort((clock, run)) if not ordered else np.argsort(clock, kind="stable")
        run, clock = run[order], clock[order]
        starts = np.flatnonzero(np.diff(run, prepend=-1))
        size = max(round(BLOCK / data.dt), _FEWEST)
        edges: list[int] = []
        for first, end in itertools.pairwise([*starts.tolist(), len(run)]):
            count = min(max((end - first) // size, 1), _MOST)
            edges += np.linspace(first, end, count + 1).astype(int)[:-1].tolist()
        return cls(
            piece[order], sample[order], run, time[order], clock - (clock[0] if ordered else 0.0),
            np.array([*edges, len(run)]), ordered,
            data.labels or tuple(f"run {k + 1}" for k in range(data.run.max() + 1)),
        )  # fmt: skip

    def runs(self) -> Iterator[tuple[int, int]]:
        """First block of each run, and the one after its last."""
        run = self.run[self.edges[:-1]]
        inner = (np.flatnonzero(np.diff(run)) + 1).tolist()
        yield from zip([0, *inner], [*inner, len(run)], strict=True)

    @property
    def shortest(self) -> int:
        """Least number of blocks of a part."""
        length = float(np.median(np.diff(self.edges)))
        step = float(np.median(np.diff(self.time)))
        return max(round(SHORTEST / (length * step)), 2)

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """First block of every window within a run, and the one after its last."""
        least = self.shortest
        return [
            (a, b)
            for first, end in self.runs()
            for a in range(first, end - least + 1)
            for b in range(a + least, end + 1)
        ]

    def envelope(self, span: Span) -> Float[np.ndarray, " T"]:
        """Factor of a change at each step."""
        if span.kind == "drift":
            return self.clock / max(self.clock[-1], 1e-9)
        inside = np.zeros(len(self.run))
        inside[span.first : span.last] = 1.0
        return inside

    def at_samples(self, envelope: Float[np.ndarray, " T"], data: Data) -> Float[np.ndarray, "M R"]:
        """A factor by step at every sample of the data, held after a piece's last step."""
        found = np.zeros((data.weight.shape[0] + 1, data.weight.shape[1]))
        found[self.sample, self.piece] = envelope
        count = data.weight.sum(axis=0).astype(int)
        for r, n in enumerate(count):
            found[n:, r] = found[max(n - 1, 0), r]
        return found

    def at_steps(self, z: Float[np.ndarray, "m N12 R"]) -> Float[np.ndarray, "m T 12"]:
        """Innovations or sensitivities in the order of the session."""
        by_step = z.reshape(len(z), -1, 12, z.shape[2])
        return by_step.transpose(0, 1, 3, 2)[:, self.sample, self.piece]

    def when(self, span: Span) -> When:
        """Where a part begins and ends, in words too."""
        first, last = self.run[span.first], self.run[span.last - 1]
        start, end = float(self.time[span.first]), float(self.time[span.last - 1])
        begins = self.labels[first]
        one = f" of {begins}" if len(self.labels) > 1 else ""
        if span.kind == "drift":
            minutes = self.clock[-1] / 60
            return When(
                "drift", begins, start, str(self.labels[last]), end,
                f"growing over the {minutes:.1f} min of the data",
            )  # fmt: skip
        if span.kind == "onwards":
            text = f"from {start:.1f} s{one} on"
        elif span.last < len(self.run) and self.run[span.last] == first:
            end = float(self.time[span.last])
            text = f"{start:.1f} to {end:.1f} s{one}"
        elif span.first == 0 or self.run[span.first - 1] != first:
            text = f"all{one}"
        else:
            text = f"from {start:.1f} s{one} to its end"
        return When(span.kind, begins, start, str(self.labels[last]), end, text)
