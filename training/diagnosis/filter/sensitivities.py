"""Sensitivities of the whitened innovations to effects: probes passed through the same filter."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....models import se3
from ....models.effects.base import Effect
from ....models.effects.extended import Extended
from ....models.effects.library import Library, kind
from ....models.effects.recent import Recent
from ...compile_options import LOOP_EMITTERS, jit_with
from ..data.arrays import Data
from .along_records import Records, settle, with_position
from .innovations import Predictions
from .kalman import Filter
from .varying import Modulated, at_sample, changes_of

LANES, FEW, INSTRUMENTS = 28, 8, 18
"""Probes that one call of the compiled program evaluates in parallel, besides the base."""
FARTHEST = 1e9
"""Standard deviations beyond which no innovation lies, but those of a filter that diverges."""
AHEAD = 4
"""Calls queued or running while one is collected; each holds its probes' innovations in memory."""


@cache
def _threads() -> ThreadPoolExecutor:
    """Threads for compiled calls: one call uses one core."""
    return ThreadPoolExecutor(AHEAD, thread_name_prefix="sensitivities")


def _in_double(run: Callable[..., Any], *given: Any) -> Any:
    """The call in double precision, which may be enabled in the calling thread alone."""
    with jax.enable_x64(True):
        return run(*given)


@jit_with(LOOP_EMITTERS)
def _whitened(
    model: Extended,
    effects: Any,
    predictions: Predictions,
    records: Records,
    filters: tuple[Array, Array, Array],
    instead: tuple[Array, Array] | None,
    lanes: int,
    instruments: bool,
    changes: tuple[Modulated, ...] = (),
    reckoned: tuple[int, ...] = (),
) -> Float[Array, "L N12 R"]:
    """Whitened innovations of lane 0 (the base) and changes of them in the other lanes."""
    every = model.with_effects(effects)
    if not instruments:
        single = _single((every, predictions, records, filters, instead, changes))
        every, predictions, records, filters, instead, changes = single
    first, predictions = predictions.first, predictions._replace(first=None)
    (X, V, u, voltage, step, past, past_step, _), (keep, whiten, weight) = records, filters
    inertia = every.inertia()

    def body(carry: Any, given: Any) -> Any:
        memory, nu, carried, recent = carry
        p, X0, V0, command, volts, h, gap, white, exists, before, number = given
        model = at_sample(every, changes, number)
        dt = h[None, None]
        kept = through(gap, nu) + carried
        if instruments:
            # propagate the state differences that instrument effects imply, then observe them
            away = _apart(model.infer(X0[:, None], V0[:, None], _wide(recent)))
            away = jnp.sum(p.jacobian[:, :, None] * away[None], axis=1)
            ends = se3.retract(p.X[:, None], away[:6]), p.V[:, None] + away[6:]
            recent = recent.after(p.latest)
            direct = _shown(at_sample(every, changes, number + 1), ends, recent, dt, reckoned)
            if instead is not None:  # an accelerometer and its bias have these places
                direct = direct * (1 - instead[0]).at[:3].set(0.0)[:, None, None]
        else:
            x, v = (a[:, None] for a in p.start)
            middle_V = (v + p.V[:, None]) / 2
            middle_X = se3.retract(x, dt / 4 * (v + middle_V))
            memory, level = model.actuate(memory, command[:, None], dt, 1)
            memory, push = model.feel(memory, v, dt)
            a = model.drift(inertia, middle_X, middle_V, level[..., 0], volts[None, None], push)
            direct = dt / 2 * jnp.concatenate([jnp.zeros_like(a), a - a[:, :1]])
        moved = kept if instruments else kept - direct
        nu = jnp.sum(p.jacobian[:, :, None] * moved[None], axis=1) - direct
        nu = nu.at[:, 0].add(p.error)
        if instead is not None:
            passed = jnp.sum(before[:, :, None] * kept[None], axis=1)
            nu = nu - passed
            carried = passed.at[:, 0].add(-instead[0][:, None] * p.error)
        # lane 0, the base, carries the innovation itself
        return (memory, nu, carried, recent), through(white, nu) * exists[None, None]

    zero = jnp.zeros((12, lanes, V.shape[2]), V.dtype)
    memory = () if instruments else settle(every, past[:, :, None], past_step[:, None, None])
    xs = (predictions, X[:-1], V[:-1], u, voltage, step, keep, whiten, weight)
    xs += (None if instead is None else instead[1], jnp.arange(len(u)))
    z = jax.lax.scan(body, (memory, zero, zero, first), xs)[1].astype(jnp.float32)
    return jnp.moveaxis(z, 2, 0).reshape(lanes, -1, z.shape[3])


def _shown(
    model: Extended,
    ends: tuple[Array, Array],
    recent: Recent,
    dt: Array,
    reckoned: tuple[int, ...],
) -> Float[Array, "12 L R"]:
    """Differences between lanes in what is recorded after a step from the same record."""
    X, V = model.observe(*ends, _wide(recent))
    if reckoned:
        X = with_position(X, dt / 2 * se3.rotate(X, V[:3]), reckoned)
    return _apart((X, V))


def _wide(recent: Recent) -> Recent:
    """The same for all lanes."""
    return jax.tree.map(lambda a: a[..., None, :], recent)


def _single(tree: Any) -> Any:
    """Arrays in single precision: enough for changes of a wrench, in 0.7 of the time."""
    return jax.tree.map(lambda a: a.astype(jnp.float32) if eqx.is_inexact_array(a) else a, tree)


def through(M: Float[Array, "12 12 #R"], x: Float[Array, "12 L R"]) -> Float[Array, "12 L R"]:
    """M x, one matrix for all pieces or one for each."""
    if M.shape[2] == 1:
        return jnp.tensordot(M[..., 0], x, 1)
    return jnp.einsum("ijr,jlr->ilr", M, x)


def whitened_sensitivities(
    model: Extended,
    library: Library,
    theta: Float[np.ndarray, " p"],
    probes: Float[np.ndarray, "k p"],
    data: Data,
    predictions: Predictions,
    kalman: Filter,
) -> Float[np.ndarray, "m N12 R"]:
    """Whitened innovations at `theta`, then the changes that each row of `probes` makes in them.

    Rows of `probes` are differences from `theta`. Those of instruments use a compiled program in
    double precision, which poses need, all others one in single precision, `LANES` (or `FEW`) at a
    time. Up to `AHEAD` calls run in parallel.

    Raises:
        FloatingPointError: the filter diverges.
    """
    records, latent, instead = Records.of(data), predictions.latent, None
    predictions = predictions._replace(late=None, latent=None)
    if latent is not None:
        # latent velocities are those of the predictions
        own = np.array(data.latent)
        V = records.V.at[:-1, own].set(predictions.start[1][:, own])
        records = records._replace(V=V.at[-1, own].set(predictions.V[-1, own]))
        if latent.carried is not None:
            instead = jnp.asarray(latent.instead), jnp.asarray(latent.carried)
    filters = (jnp.asarray(kalman.keep), jnp.asarray(kalman.whiten), jnp.asarray(data.weight))
    reads = np.array([kind(e.cause).family == "measurement" for e in library.entries])
    of_instruments = np.any((probes != 0) & reads, axis=1)
    steps = data.u.shape[0] * 12
    found = np.empty((1 + len(probes), steps, data.u.shape[2]), np.float32)
    believed = library.filled(theta[:, None, None])
    running: deque[tuple[np.ndarray, Future[np.ndarray]]] = deque()

    def collect() -> None:
        some, z = running.popleft()
        seen = z.result()
        found[1 + some] = seen[1 : 1 + len(some)]
        found[0] = seen[0]

    for instruments in (False, True):
        rows = np.flatnonzero(of_instruments == instruments)
        size = FEW if len(rows) <= FEW else INSTRUMENTS if instruments else LANES
        alone = not len(probes) and not instruments  # the base is always evaluated
        for first in range(0, max(len(rows), alone), size):
            some = rows[first : first + size]
            chunk = np.zeros((size + 1, library.size))
            chunk[1 : 1 + len(some)] = probes[some]
            by_lane = (theta + chunk).T[:, :, None]
            effects = _of_family(library.filled(by_lane), believed, instruments)
            arguments = predictions, records, filters, instead, size + 1, instruments
            more = changes_of(library, by_lane), data.reckoned
            call = _threads().submit(_in_double, _run, model, effects, *arguments, *more)
            running.append((some, call))
            if len(running) > AHEAD:
                collect()
    while running:
        collect()
    return _converged(found)


def _run(*arguments: Any) -> np.ndarray:
    return np.asarray(_whitened(*arguments))


def _converged(z: Float[np.ndarray, "m N12 R"]) -> Float[np.ndarray, "m N12 R"]:
    if not np.all(np.abs(z[0]) < FARTHEST):
        raise FloatingPointError("the filter of one-step errors diverges")
    return z


def _of_family(
    lanes: tuple[Effect, ...], alike: tuple[Effect, ...], instruments: bool
) -> tuple[Effect, ...]:
    """Effects with values by lane, those of the other family with the same value in all lanes."""
    return tuple(
        a if (a.family == "measurement") == instruments else b
        for a, b in zip(lanes, alike, strict=True)
    )


def _apart(state: tuple[Array, Array]) -> Float[Array, "12 L R"]:
    """Differences of all lanes' states from lane 0's, for angles well below a radian."""
    X, V = state
    inverse = se3.inverse(X[:, :1])
    w, x, y, z = jnp.unstack(inverse[:4])
    a, b, c, d = jnp.unstack(X[:4])
    turned = [w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
              w * d + x * c - y * b + z * a]  # fmt: skip
    moved = se3.rotate_inverse(X[:, :1], X[4:] - X[4:, :1])
    parts = [moved, 2 * jnp.stack(turned), V - V[:, :1]]
    batch = jnp.broadcast_shapes(*(p.shape[1:] for p in parts))
    return jnp.concatenate([jnp.broadcast_to(p, (p.shape[0], *batch)) for p in parts])
