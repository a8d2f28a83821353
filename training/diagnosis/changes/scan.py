"""Gains of causes in parts of a session, from inner products by block.

With sensitivities J of the whitened innovations z to a cause, a change by θ in a part with the
envelope g moves them by g J θ. All other free parameters (columns N) are profiled out: the gain is

    ½ sᵀ S⁻¹ s,  s = Σ g Jᵀz - C H⁻¹ Nᵀz,  S = Σ g² JᵀJ - C H⁻¹ Cᵀ,  C = Σ g JᵀN,  H = NᵀN,

and sums over every window are differences of cumulative ones. The largest of them over windows is
a scan statistic (Kulldorff 1997), its test one for a change at an unknown time (Andrews 1993).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ....models.effects.library import kind
from ..selection.model_selection import Hypothesis, margin
from .session import Session, Span

_RIDGE = 1e-9
"""Share of a parameter's information that is added to it, so that inverses exist."""
_OF_A_STEP = 12
"""Innovations of a step."""
Sums = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Σ g Jᵀz (W, p), Σ g² JᵀJ (W, p, p) and Σ g JᵀN (W, p, n) of W parts."""


@dataclass(frozen=True)
class Change:
    """A cause in a part of a session.

    Attributes:
        hypothesis: cause and place.
        span: the part.
        gain: nats, with all free parameters profiled out.
        repeated: nats that values fitted to every other block of the session win on the rest.
        cost: nats that noise wins: the logarithm of the number of parts tried, and half of that of
            the number of steps for each parameter (Schwarz 1978).
    """

    hypothesis: Hypothesis
    span: Span
    gain: float
    repeated: float
    cost: float

    @property
    def worth(self) -> float:
        """Nats beyond its cost."""
        return self.gain - self.cost


@dataclass(frozen=True)
class Scan:
    """Search for changes.

    Attributes:
        z: innovations (row 0) and sensitivities at the steps of the session.
        session: with its blocks.
        candidates: rows of each cause that is tried.
        free: rows of parameters that are free in all of the session.
        prior: precision of each row's prior.
    """

    z: Float[np.ndarray, "m T12"]
    session: Session
    candidates: Mapping[Hypothesis, list[int]]
    free: list[int]
    prior: Float[np.ndarray, " m"]

    def best(self, least: float = 0.0, without: Sequence[Hypothesis] = ()) -> Change | None:
        """The change that is worth most, if it is worth `least` nats.

        A simpler cause replaces it unless clearly beaten.
        """
        found = [self.of(h) for h in self.candidates if h not in without]
        top = max(found, key=lambda change: change.worth, default=None)
        if top is None or top.worth <= least:
            return None
        simpler = [
            change
            for change in found
            if change.hypothesis[0] in kind(top.hypothesis[0]).simpler
            and change.worth > top.worth - margin(top.worth)
        ]
        return max(simpler, key=lambda change: change.worth, default=top)

    def of(self, hypothesis: Hypothesis) -> Change:
        """The best part for one cause."""
        own = self.candidates[hypothesis]
        spans, gains = self._spans(own)
        k = int(np.argmax(gains))
        repeated = self._repeated(own, spans[k])
        steps = spans[k].last - spans[k].first
        cost = float(np.log(len(spans)) + len(own) * np.log(steps) / 2)
        return Change(hypothesis, spans[k], float(gains[k]), repeated, cost)

    def with_change(self, change: Change) -> "Scan":
        """The scan with a change among the free parameters."""
        own, m = self.candidates[change.hypothesis], len(self.z)
        envelope = np.repeat(self.session.envelope(change.span), _OF_A_STEP)
        wider = np.concatenate([self.z, self.z[own] * envelope.astype(self.z.dtype)])
        prior = np.concatenate([self.prior, self.prior[own]])
        return replace(self, z=wider, free=[*self.free, *range(m, m + len(own))], prior=prior)

    def constant_gain(self, hypothesis: Hypothesis) -> float:
        """What the cause wins in all of the session; 0 where it is free already."""
        own = [i for i in self.candidates[hypothesis] if i not in self.free]
        if not own:
            return 0.0
        all_blocks = _weighted(self._products(own), np.ones(len(self.session.edges) - 1))
        return float(self._gains(own, all_blocks)[0])

    # -------------------------------------------------------------------------------- parts

    def _by_block(self, span: Span) -> Float[np.ndarray, " K"]:
        """Mean factor of a change in each block."""
        edges = self.session.edges
        return np.add.reduceat(self.session.envelope(span), edges[:-1]) / np.diff(edges)

    def _spans(self, own: list[int]) -> tuple[list[Span], Float[np.ndarray, " W"]]:
        """Every part, and the gains there."""
        session, edges = self.session, self.session.edges.tolist()
        pairs, products = list(session.pairs), self._products(own)
        spans = [Span("window", edges[a], edges[b]) for a, b in pairs]
        if session.ordered:
            count = len(edges) - 1
            later = range(session.shortest, count - session.shortest + 1)
            spans += [Span("onwards", edges[a], edges[count]) for a in later]
            pairs += [(a, count) for a in later]
        if not spans:
            return [Span("window", 0, edges[-1])], np.zeros(1)
        a, b = np.array(pairs).T
        until = [np.concatenate([0 * c[:1], c.cumsum(axis=0)]) for c in products]
        z, J, N = (c[b] - c[a] for c in until)
        gains = self._gains(own, (z, J, N))
        if session.ordered:
            spans.append(Span("drift", 0, edges[-1]))
            drift = self._gains(own, _weighted(products, self._by_block(spans[-1])))
            gains = np.concatenate([gains, drift])
        return spans, gains

    def _products(self, own: list[int]) -> Sums:
        """Those of every block."""
        starts, rows = _OF_A_STEP * self.session.edges[:-1], [0, *own, *self.free]
        found = np.empty((len(starts), len(own), len(rows)))
        for k, i in enumerate(own):
            both = self.z[rows] * self.z[i]
            found[:, k] = np.add.reduceat(both, starts, axis=1, dtype=float).T
        n = 1 + len(own)
        return found[..., 0], found[..., 1:n], found[..., n:]

    def _gains(self, own: list[int], sums: Sums) -> Float[np.ndarray, " W"]:
        """½ sᵀ S⁻¹ s."""
        s, S = self._profiled(own, sums)
        return np.einsum("wi,wi->w", s, np.linalg.solve(S, s[..., None])[..., 0]) / 2

    def _profiled(self, own: list[int], sums: Sums) -> tuple[np.ndarray, np.ndarray]:
        """The sums s (W, p) and S (W, p, p)."""
        s, J, N = sums
        S = J + np.diag(self.prior[own])
        if self.free:
            H, Nz, scale = self._of_free
            C = N / scale
            CH = C @ np.linalg.inv(H)
            s, S = s - CH @ (Nz / scale), S - CH @ C.swapaxes(1, 2)
        floor = _RIDGE * (np.einsum("wii->wi", J) + self.prior[own])
        return s, S + floor[..., None] * np.eye(len(own))

    @cached_property
    def _of_free(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """H, scaled to ones on its diagonal, Nᵀz and the scale, of all of the session."""
        N = self.z[self.free].astype(float)
        H = N @ N.T + np.diag(self.prior[self.free])
        scale = np.sqrt(np.diag(H))
        H = H / np.outer(scale, scale) + _RIDGE * np.eye(len(H))
        return H, N @ self.z[0].astype(float), scale

    def _repeated(self, own: list[int], span: Span) -> float:
        """What values fitted to every other block of the session win on the rest of it."""
        envelope = np.repeat(self.session.envelope(span), _OF_A_STEP)
        columns = np.concatenate([self.z[:1], self.z[own] * envelope, self.z[self.free]])
        block = np.repeat(np.arange(len(self.session.edges) - 1), np.diff(self.session.edges))
        odd = np.repeat(block % 2 == 1, _OF_A_STEP)
        halves = [columns[:, odd].astype(float), columns[:, ~odd].astype(float)]
        products = [half @ half.T for half in halves]
        prior = np.concatenate([self.prior[own], self.prior[self.free]]) / 2
        free, every = list(range(1 + len(own), len(columns))), list(range(1, len(columns)))
        return sum(
            _loss(there, free, _fitted(here, free, prior))
            - _loss(there, every, _fitted(here, every, prior))
            for here, there in (products, products[::-1])
        )


def _fitted(
    G: Float[np.ndarray, "m m"], chosen: list[int], prior: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " k"]:
    """Values of columns that are fitted together, from products with innovations in row 0."""
    if not chosen:
        return np.zeros(0)
    H = G[np.ix_(chosen, chosen)] + np.diag(prior[np.array(chosen) - 1])
    scale = np.sqrt(np.diag(H))
    H = H / np.outer(scale, scale) + _RIDGE * np.eye(len(H))
    return -np.linalg.solve(H, G[chosen, 0] / scale) / scale


def _loss(G: Float[np.ndarray, "m m"], chosen: list[int], x: Float[np.ndarray, " k"]) -> float:
    """Nats of values beyond those of none."""
    return float(x @ G[chosen, 0] + x @ G[np.ix_(chosen, chosen)] @ x / 2)


def _weighted(products: Sums, g: Float[np.ndarray, " K"]) -> Sums:
    """Sums over the blocks of one part with a factor in each."""
    z, J, N = (np.tensordot(f, c, 1)[None] for f, c in zip((g, g**2, g), products, strict=True))
    return z, J, N
