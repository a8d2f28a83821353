"""Unmodelled structure: regressors that a wrench could depend on, tried group by group.

A group is a few columns φ_k of one kind of action (a wrench on an axis, along a thruster, in the
directions of W, or moving water) on one set of inputs. Each column passes the innovations' filter,

    J_(n+1) = A_n ((I - K_n) J_n - d/2) - d/2,   d = dt φ_n (∂V'/∂wrench or ∂V'/∂flow),

so that its gain is in the same held-out nats as that of a cause. The fit is a ridge regression, its
prior that of most evidence; groups with nodes (time constants, frequencies) take the best node of
the other folds. Groups are added one by one to those before (group orthogonal matching pursuit).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ....models.dynamics import Flow
from ....models.effects.extended import Extended
from ....models.effects.inertia import times
from ....models.effects.unknown import Unknown
from ....models.se3 import AXES
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.sensitivities import through
from ..selection.hypotheses import Chance
from ..selection.model_selection import CLEAR

LANES = 24
PIECES = 60
"""Columns that one call of the compiled program takes, and most pieces that are used."""
_PRIORS = (0.3, 3.0, 30.0)
_LEAST, _ROBUST = 8.0, 2.5
"""Nats below which a gain is not tested further, and standard errors between runs below which it
must be as clear as a cause's (`model_selection.CLEAR`)."""


@dataclass(frozen=True)
class Group:
    """Columns that are accepted or rejected together.

    Attributes:
        effect: that has these columns as its terms (of a memory: with the first node's parameters).
        action: `wrench`, `thruster`, `thrusters` (a wrench on all axes), `force` or `flow` (in W).
        variables: inputs, by their names in recordings.
        columns: of the wrench (N, component of the action, k, R) for a range of pieces.
        nodes: columns of each alternative.
        labels: the effect's first parameters at each node: time constant (s) and frequency (Hz) of
            a memory, backlash (N) or rate limit (N/s) of thrusters, two exchanged thrusters.
    """

    effect: Unknown
    action: str
    variables: tuple[str, ...]
    columns: Callable[[np.ndarray], Float[np.ndarray, "N c k R"]]
    nodes: tuple[tuple[int, ...], ...]
    labels: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Matched:
    """A group's gain: nats by run while its fold is left out, and the best node.

    Noise alone wins more than `threshold` with probability α, and as much as this with `p_value`.
    """

    group: Group
    heldout: Float[np.ndarray, " runs"]
    node: int
    threshold: float
    p_value: float = 1.0

    @property
    def gain(self) -> float:
        """Held-out nats."""
        return float(self.heldout.sum())


@eqx.filter_jit
def _through(
    d: Float[Array, "N 6 L R"],
    jacobian: Array,
    keep: Array,
    whiten: Array,
    weight: Array,
    step: Array,
    carried: Array | None = None,
) -> Float[Array, "N 12 L R"]:
    """Whitened sensitivities to accelerations d."""

    def body(state: tuple[Array, Array], given: tuple) -> tuple[tuple[Array, Array], Array]:
        a, A, gap, white, exists, h, before = given
        nu, passed = state
        direct = h[None, None] / 2 * jnp.concatenate([jnp.zeros_like(a), a])
        kept = through(gap, nu) + passed
        nu = jnp.sum(A[:, :, None] * (kept - direct)[None], axis=1) - direct
        if before is not None:
            passed = jnp.sum(before[:, :, None] * kept[None], axis=1)
            nu = nu - passed
        return (nu, passed), through(white, nu) * exists[None, None]

    zero = jnp.zeros((12, *d.shape[2:]), d.dtype)
    xs = (d, jacobian, keep, whiten, weight, step, carried)
    return jax.lax.scan(body, (zero, zero), xs)[1].astype(jnp.float32)


def _carried(evaluation: Evaluation, pieces: np.ndarray) -> Array | None:
    """`Latent.carried` of some pieces, where there is any."""
    latent = evaluation.predictions.latent
    if latent is None or latent.carried is None:
        return None
    return jnp.asarray(latent.carried[..., pieces])


class Screen:
    """Tests of groups, jointly with the columns already accepted, on some of the pieces."""

    def __init__(
        self,
        problem: DiagnosisProblem,
        evaluation: Evaluation,
        free: Float[np.ndarray, "m N12 R"] | None,
        whole: bool = False,
    ):
        """On all pieces if `whole`, else on so many of each fold that `PIECES` are not exceeded."""
        self.problem, self.evaluate = problem, evaluation
        data = problem.data
        labels = np.unique(data.fold)
        each = len(data.fold) if whole else max(1, PIECES // len(labels))
        chosen: list[int] = []
        for label in labels:
            own = np.flatnonzero(data.fold == label)
            at = np.unique(np.linspace(0, len(own) - 1, each).round().astype(int))
            chosen += own[at].tolist()
        self.kept = np.array(sorted(chosen))
        self.fold = data.fold[self.kept]
        self.cluster = data.cluster[self.kept]
        k = evaluation.kalman.of(self.kept)
        self.filters = (
            jnp.asarray(np.asarray(evaluation.predictions.jacobian)[..., self.kept]),
            jnp.asarray(k.keep),
            jnp.asarray(k.whiten),
            jnp.asarray(data.weight[:, self.kept]),
            jnp.asarray(data.own_steps(self.kept)),
            _carried(evaluation, self.kept),
        )
        # correlated innovations count for fewer, as in the filter that sensitivities pass
        z = evaluation.z[..., self.kept] / np.sqrt(evaluation.kalman.memory)[:, None]
        z = z.astype(np.float32).reshape(len(data.u) * 12, -1)
        self.z = z[None] if free is None else np.concatenate([z[None], free[..., self.kept]])
        self.inverse = np.linalg.inv(problem.mass(evaluation.theta))

    def sensitivities(self, group: Group) -> Float[np.ndarray, "k N12 R"]:
        """Changes of the whitened innovations by each column of a group."""
        return self.whitened(self.accelerations(group, group.columns(self.kept)))

    def whitened(self, a: Float[np.ndarray, "N 6 k R"]) -> Float[np.ndarray, "k N12 R"]:
        """Changes of the whitened innovations by accelerations dV/dt."""
        parts = []
        for first in range(0, a.shape[2], LANES):
            some = a[:, :, first : first + LANES]
            width = some.shape[2]
            padded = np.zeros((*some.shape[:2], LANES, some.shape[3]))
            padded[:, :, :width] = some
            z = np.asarray(_through(jnp.asarray(padded), *self.filters))
            parts.append(np.moveaxis(z[:, :, :width], 2, 0).reshape(width, -1, z.shape[3]))
        return np.concatenate(parts)

    def accelerations(self, group: Group, phi: np.ndarray) -> Float[np.ndarray, "N 6 k R"]:
        """dV/dt of each column."""
        if group.action == "wrench":
            return self.inverse[:, AXES.index(group.effect.acts_on)][:, None, None] * phi
        if group.action == "thruster":
            model = self.problem.model
            unit = np.eye(len(model.inverse))[:, int(group.effect.acts_on) - 1]
            wrench = self.inverse @ np.asarray(model.allocate(jnp.asarray(unit)))
            return wrench[:, None, None] * phi
        if group.action == "thrusters":
            return np.einsum("ij,njkr->nikr", self.inverse, phi)
        F = self._of_world(self.inverse[:, :3]) if group.action == "force" else self.water[0]
        return np.einsum("nijr,njkr->nikr", F, phi)

    def _of_world(self, inverse: Float[np.ndarray, "6 3"]) -> Float[np.ndarray, "N 6 3 R"]:
        X = self.problem.data.X[:-1][..., self.kept].swapaxes(0, 1)
        unit = np.eye(3)[:, :, None, None] + np.zeros((1, 1, *X.shape[1:]))
        turned = se3.rotate_inverse(jnp.asarray(X)[:, None], jnp.asarray(unit))
        return np.einsum("ij,jknr->nikr", inverse, np.asarray(turned))

    @cached_property
    def water(self) -> tuple[Float[np.ndarray, "N 6 3 R"], Float[np.ndarray, "N 6 3 R"]]:
        """dV/dt for velocity (m/s) and for acceleration (m/s²) of the water in W, one each."""
        still = np.zeros((len(self.problem.data.u), 3, len(self.kept)))
        both = self._of_water(still)[1]
        return both[:, :, :3], both[:, :, 3:]

    def in_current(
        self, v_WC_W: Float[np.ndarray, "N 3 R"]
    ) -> tuple[Float[np.ndarray, "N 6 R"], Float[np.ndarray, "N 6 3 R"]]:
        """dV/dt that a current (m/s) adds to that in still water, and its slope there."""
        moving, slope = self._of_water(v_WC_W)
        return moving - self._of_water(np.zeros_like(v_WC_W))[0], slope[:, :, :3]

    def _of_water(
        self, v_WC_W: Float[np.ndarray, "N 3 R"]
    ) -> tuple[Float[np.ndarray, "N 6 R"], Float[np.ndarray, "N 6 6 R"]]:
        d = self.problem.data
        given = (d.X[:-1][..., self.kept], d.V[:-1][..., self.kept], d.u[..., self.kept], v_WC_W)
        arrays = (jnp.asarray(a.swapaxes(0, 1)) for a in given)
        drift, slope = _of_water(self.problem.model, *arrays)
        return np.moveaxis(np.asarray(drift), 1, 0), np.moveaxis(np.asarray(slope), 2, 0)

    # ------------------------------------------------------------------------------ matching

    def match(
        self, group: Group, alpha: float, rng: np.random.Generator, draws: int = 24
    ) -> Matched:
        """Held-out gain of a group, and the gain that noise alone exceeds with probability α.

        That threshold is infinite where the gain is small, and larger where runs disagree.
        """
        J = self.sensitivities(group)
        columns = np.concatenate([self.z, J]).astype(np.float64)
        free = len(self.z)
        G = np.einsum("iar,jar->rij", columns, columns, optimize=True)
        labels, index = np.unique(self.fold, return_inverse=True)
        folds = np.zeros((len(labels), *G.shape[1:]))
        np.add.at(folds, index, G)
        size = np.sqrt(np.maximum(np.diag(folds.sum(axis=0)), 1e-12))
        picks = self._held_out(folds, free, group, size)[1]
        total = folds.sum(axis=0)
        share = group.effect.is_share
        node = int(np.argmax([self._fit(total, free, n, size, share)[1] for n in group.nodes]))
        # by run: each with the weights of its own fold
        runs, of_run = np.unique(self.cluster, return_inverse=True)
        heldout = np.zeros(len(runs))
        for f in range(len(labels)):
            w0, w = picks[f]
            own = index == f
            before = np.einsum("rij,i,j->r", G[own], w0, w0)
            after = np.einsum("rij,i,j->r", G[own], w, w)
            np.add.at(heldout, of_run[own], (before - after) / 2)
        gain = float(heldout.sum())
        if not draws:
            return Matched(group, heldout, node, 0.0)
        if gain <= _LEAST:
            return Matched(group, heldout, node, np.inf)
        chance = self._null(folds, free, group, size, rng, draws)
        # self-normalised: runs with much excitation win much, whatever the structure
        robust = min(_ROBUST, 0.8 * np.sqrt(len(heldout))) * np.sqrt(np.sum(heldout**2))
        above = 1.0 if gain > robust else CLEAR
        return Matched(
            group, heldout, node, above * chance.exceeded(alpha), chance.beyond(gain / above)
        )

    def sparse(self, group: Group, most: int = 4) -> tuple[float, ...]:
        """The few columns that orthogonal matching takes first (Pati et al. 1993)."""
        columns = np.concatenate([self.z, self.sensitivities(group)]).astype(np.float64)
        free = len(self.z)
        T = np.einsum("iar,jar->ij", columns, columns, optimize=True)
        size = np.sqrt(np.maximum(np.diag(T), 1e-12))
        chosen: list[int] = []
        gain = self._fit(T, free, (), size)[1]
        while len(chosen) < most:
            rest = [k for k in range(len(T) - free) if k not in chosen]
            gains = [self._fit(T, free, (*chosen, k), size)[1] for k in rest]
            best = int(np.argmax(gains))
            # a further term must pay for itself, and more than a twentieth of all so far
            if chosen and gains[best] - gain < max(5.0, 0.05 * gains[best]):
                break
            gain = gains[best]
            chosen.append(rest[best])
        return tuple(float(k) for k in sorted(chosen))

    def _fit(
        self, T: np.ndarray, free: int, node: tuple[int, ...], size: np.ndarray, share: bool = False
    ) -> tuple[np.ndarray, float]:
        """Weights of all columns (1 for z), and the log evidence on T, for the best prior.

        Where the node's weight is a `share` and comes out negative, it is none, without evidence.
        """
        c = np.array([*range(1, free), *(free + k for k in node)], int)
        if not len(c):
            w = np.zeros(len(T))
            w[0] = 1
            return w, 0.0
        s = size[c]
        H, g = T[np.ix_(c, c)] / s[:, None] / s, T[c, 0] / s
        values, vectors = np.linalg.eigh(H)
        values = np.maximum(values, 0)
        q = vectors.T @ g
        best: tuple[float, np.ndarray] | None = None
        for prior in _PRIORS:
            # the weight of a column of unit norm has the variance 100 prior²
            precision = 1 / (prior**2 * 100)
            x = -q / (values + precision)
            evidence = float(
                (q**2 / (values + precision)).sum() / 2 - np.log1p(values / precision).sum() / 2
            )
            if best is None or evidence > best[0]:
                best = evidence, vectors @ x / s
        assert best is not None
        w = np.zeros(len(T))
        w[0], w[c] = 1, best[1]
        if share and np.any(w[[free + k for k in node]] < 0):
            return self._fit(T, free, (), size)[0], -np.inf
        return w, best[0]

    def _held_out(
        self, folds: np.ndarray, free: int, group: Group, size: np.ndarray
    ) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
        total, gains, picks = folds.sum(axis=0), np.zeros(len(folds)), []
        for f, T in enumerate(folds):
            rest = total - T if len(folds) > 1 else total
            fits = [self._fit(rest, free, n, size, group.effect.is_share) for n in group.nodes]
            w = max(fits, key=lambda fit: fit[1])[0]
            w0 = self._fit(rest, free, (), size)[0]
            gains[f] = (w0 @ T @ w0 - w @ T @ w) / 2
            picks.append((w0, w))
        return gains, picks

    def _null(
        self, folds: np.ndarray, free: int, group: Group, size: np.ndarray,
        rng: np.random.Generator, draws: int,
    ) -> Chance:  # fmt: skip
        """The gain in white innovations: mean and spread over draws, as an exponential tail."""
        gains = []
        roots = []
        for T in folds:
            values, vectors = np.linalg.eigh(T[1:, 1:])
            roots.append(vectors * np.sqrt(np.maximum(values, 0)))
        for _ in range(draws if len(group.nodes) == 1 else draws // 3):
            drawn = folds.copy()
            for f, root in enumerate(roots):
                g = root @ rng.standard_normal(root.shape[1])
                drawn[f, 0, 1:] = drawn[f, 1:, 0] = g
            gains.append(self._held_out(drawn, free, group, size)[0].sum())
        gains = np.array(gains)
        scale = max(float(gains.std()), 1.0)
        return Chance(max(float(gains.mean()), 0.0), scale)


@eqx.filter_jit
def _of_water(
    model: Extended, X: Array, V: Array, u: Array, v_WC_W: Array
) -> tuple[Float[Array, "6 N R"], Float[Array, "6 6 N R"]]:
    """dV/dt in a current, and its slope in velocity and acceleration of the water."""
    F = model.allocate(u)
    inverse = model.inertia().inverse

    def drift(both: Array) -> Array:
        return times(inverse, model.balance(X, V, F, Flow(both[:3], both[3:]))[1])

    current = jnp.concatenate([v_WC_W, jnp.zeros_like(v_WC_W)])
    unit = jnp.broadcast_to(jnp.eye(6, dtype=X.dtype)[:, :, None, None], (6, *current.shape))
    columns = jax.vmap(lambda e: jax.jvp(drift, (current,), (e,))[1])(unit)
    return drift(current), jnp.moveaxis(columns, 0, 1)
