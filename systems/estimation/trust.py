"""Statistics of the sensors besides the IMU: what their innovations say of their noise and of
changes.

A sensor whose mean NIS is above its expected value has its noise variance raised by that mean
(covariance matching; Mehra 1970); if several do, the IMU's noise variance is raised instead.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from scipy.stats import chi2

from ...models.sensors import Sensor
from .error_state import INERTIAL, Navigation
from .measurement import Seen, Update
from .readings import each_value, noises, offset_places, parts, sizes

_MOVES_AGAIN = 3.0  # s for which a sensor that was stuck is suspect: it was right before
_MEMORIES = (10.0, 150.0)  # readings over which a sensor's pull is kept
_MATCHED = 50.0  # readings over which NIS are averaged
_CLIPPED = 8.0  # bound on one reading's NIS relative to the mean, against outliers
_GROWTH = 1.05  # of the IMU's variances, per reading while several sensors scatter
_CHANGED = 16.0  # least factor on the variance of a changed sensor's noise
_UNUSUAL = 1.6  # threshold of the mean NIS per value over `_MATCHED` readings, above chance
_UNLIKE = 1e-4  # probability that two innovations of the same mean are not alike
_SMALL = 3.0  # standard deviations of a reading within which an offset does not matter
FEW_READINGS = 8.0  # readings over which innovations are correlated with the one before
_OUTLIER = 3.0  # bound on each normalised innovation in that mean
_WANES = 0.05  # of a random walk's logarithm, per `_ADAPTS` readings
_ADAPTS = 5.0  # readings over which a random walk follows the correlation of innovations


class Trust(NamedTuple):
    """Statistics of the sensors besides the IMU."""

    nis: Float[Array, "n"]
    """Of the last reading."""
    rejected: Float[Array, "n"]
    """Readings in a row that failed the gate."""
    passed: Float[Array, "n"]
    """Readings in a row that passed it."""
    accepted_at: Float[Array, "n"]
    """When a reading was last used (s)."""
    scatter: Float[Array, "n"]
    """Mean NIS per value, at the sensor's configured noise."""
    changed: Float[Array, "n"]
    """1 from a change of a sensor until it is as before."""
    changed_at: Float[Array, "n"]
    """When a sensor was last found to have changed (s)."""
    before: Float[Array, "m"]
    """Its offsets before that."""
    shift: Float[Array, "m"]
    """Change of its offsets then."""
    walk: Float[Array, "m"]
    """Variances that offsets gain per second."""
    last: Float[Array, "m"]
    """Last innovations divided by their standard deviations."""
    second: Float[Array, "m"]
    """Those before them."""
    unlike: Float[Array, "n"]
    """Rejections in a row that were like none of the two before."""
    correlation: Float[Array, "n"]
    """Mean of such products of bounded innovations over the last readings, per value."""
    stuck_at: Float[Array, "n"]
    """When its values were last stuck (s)."""
    pulled: Float[Array, "2 n p"]
    """What a sensor's recent readings have shifted, for each of `_MEMORIES`: the δ that takes it
    back, without offsets."""
    usual: Float[Array, "2 n p p"]
    """Covariance of the pulls of a consistent filter."""
    unconfirmed: Float[Array, "n"]
    """Variance with which a sensor's last accepted reading was predicted, if it decided alone."""
    predicted: Float[Array, "n"]
    """The same of the present reading."""
    imu_factor: Float[Array, ""]
    """Factor on the variances of the IMU's noises."""
    jolted_at: Float[Array, ""]
    """When one of its jolts was last found to be an error (s)."""

    @classmethod
    def start(cls, aids: Sequence[Sensor], dtype: jnp.dtype, errors: int | None = None) -> "Trust":
        """No sensor is suspect; δ has `errors` components, by default without latencies."""
        n, m = len(aids), sum(sizes(aids))
        lasting = INERTIAL + n if errors is None else errors - 2 * m
        zero, one, never = jnp.zeros(n, dtype), jnp.ones(n, dtype), jnp.full(n, -1e9, dtype)
        values, pulled = jnp.zeros(m, dtype), jnp.zeros((2, n, lasting), dtype)
        return cls(
            nis=zero,
            rejected=zero,
            passed=zero,
            accepted_at=zero,
            scatter=one,
            changed=zero,
            changed_at=never,
            before=values,
            shift=values,
            walk=values,
            last=values,
            second=values,
            unlike=zero,
            correlation=zero,
            stuck_at=never,
            pulled=pulled,
            usual=jnp.zeros((*pulled.shape, pulled.shape[-1]), dtype),
            unconfirmed=zero,
            predicted=zero,
            imu_factor=one[0],
            jolted_at=never[0],
        )

    @property
    def _scattered(self) -> Bool[Array, "n"]:
        return self.scatter > _UNUSUAL

    @property
    def noise_factor(self) -> Float[Array, "n"]:
        """Factors on the variances of the sensors' noises.

        A sensor that has changed is known less well than one that is as it says.
        """
        alone = jnp.sum(self._scattered) < 2
        least = jnp.where(self.changed > 0, _CHANGED, 1)
        return jnp.maximum(jnp.where(self._scattered & alone, self.scatter, 1), least)

    def suspect(self, time: Float[Array, ""], within: float) -> Bool[Array, "n"]:
        """Whether a sensor changed `within` the last seconds before a time (s), or was stuck."""
        return (time - self.stuck_at < _MOVES_AGAIN) | (time - self.changed_at < within)


def alike(aids: Sequence[Sensor], trust: Trust, normal: Float[Array, "m"]) -> Bool[Array, "n"]:
    """Whether innovations `normal` differ from one of the two before by no more than noise."""
    found = []
    for i, part in enumerate(parts(aids)):
        now = normal[part]
        squares = [jnp.sum((now - old[part]) ** 2) for old in (trust.last, trust.second)]
        limit = 2 * chi2.isf(_UNLIKE, now.size)
        found.append((squares[0] <= limit) | (squares[1] <= limit) & (trust.rejected[i] > 1))
    return jnp.stack(found)


def counted(
    aids: Sequence[Sensor],
    trust: Trust,
    seen: Seen,
    done: Update,
    plain_nis: Float[Array, "n"],
    gates: tuple[float, ...],
) -> Trust:
    """After an update: the trust with these readings counted.

    `plain_nis` are the NIS without raised noise.

    Innovations in a row are uncorrelated if an offset walks as much as is assumed, and are of one
    sign if it walks more (Mehra 1970).
    """
    nis, accepted, used = done.nis, done.accepted, seen.used
    normal = seen.joined.residual / jnp.sqrt(jnp.diag(seen.S))
    came = each_value(used, aids)
    grows = jnp.clip(normal * trust.last, -1, 1) - _WANES
    unlike = jnp.where(alike(aids, trust, normal) | (trust.rejected < 1), 0, trust.unlike + 1)
    bounded = jnp.clip(normal, -_OUTLIER, _OUTLIER) * jnp.clip(trust.last, -_OUTLIER, _OUTLIER)
    lag = jnp.stack([bounded[part].mean() for part in parts(aids)]) - trust.correlation
    passes = used & (nis <= jnp.asarray(gates, nis.dtype))
    fails = used & ~passes
    confirmed, contradicts = (
        accepted & ~seen.doubted & (trust.unconfirmed <= 0),
        fails | seen.doubted,
    )
    value = plain_nis / jnp.asarray(sizes(aids), nis.dtype)
    value = jnp.minimum(value, _CLIPPED * jnp.maximum(trust.scatter, 1))
    matched = trust.scatter + (value - trust.scatter) / _MATCHED
    several = jnp.sum(trust._scattered) > 1
    small = jnp.median(trust.scatter) <= 1  # one sensor's noise may be other than it says
    shrunk = jnp.where(small, trust.imu_factor / _GROWTH, trust.imu_factor)
    factor = jnp.where(several, trust.imu_factor * _GROWTH, shrunk)
    return trust._replace(
        nis=jnp.where(used, nis, trust.nis),
        rejected=jnp.where(confirmed, 0, trust.rejected + contradicts.astype(nis.dtype)),
        passed=jnp.where(passes, trust.passed + 1, jnp.where(fails, 0, trust.passed)),
        accepted_at=jnp.where(accepted, seen.time, trust.accepted_at),
        scatter=jnp.where(used, matched, trust.scatter),
        walk=jnp.where(came, trust.walk * jnp.exp(grows / _ADAPTS), trust.walk),
        last=jnp.where(came, normal, trust.last),
        second=jnp.where(came, trust.last, trust.second),
        unlike=jnp.where(accepted, 0, jnp.where(fails, unlike, trust.unlike)),
        correlation=jnp.where(used, trust.correlation + lag / FEW_READINGS, trust.correlation),
        imu_factor=jnp.where(used.any(), jnp.clip(factor, 1, 1e4), trust.imu_factor),
    )


def pulls(
    aids: Sequence[Sensor],
    trust: Trust,
    F: Float[Array, "e e"],
    seen: Seen,
    done: Update,
) -> Trust:
    """The trust after an update: a sensor's correction adds to its pulls, which move as errors do
    and are forgotten over each of `_MEMORIES`.

    The innovations of a consistent filter are white with covariance S, which gives the variance of
    what they shift (`usual`).
    """
    S, used = seen.S, seen.used
    memories, n = jnp.asarray(_MEMORIES, S.dtype), trust.pulled.shape[-1]
    F, gain = F[:n, :n], done.gain[:n]
    all_pulled, all_usual = [], []
    for i, part in enumerate(parts(aids)):
        K = gain[:, part]
        kept = jnp.where(used[i], 1 - 1 / memories, 1)[:, None]
        r = jnp.where(used[i], seen.joined.residual[part], 0)
        all_pulled.append(kept * (trust.pulled[:, i] @ F.T) - (K @ r)[None])
        spread = kept[..., None] ** 2 * (F @ trust.usual[:, i] @ F.T)
        all_usual.append(spread + (K @ S[part, part] @ K.T)[None])
    return trust._replace(pulled=jnp.stack(all_pulled, 1), usual=jnp.stack(all_usual, 1))


def trusted(aids: Sequence[Sensor], P: Float[Array, "e e"], x: Navigation) -> Bool[Array, "n"]:
    """Sensors whose offsets, with their deviations, are within their noise."""
    places, _ = offset_places(aids, P.shape[0])
    at, variances = x.sensors[places - INERTIAL], jnp.diag(P)[places]
    small = at**2 + variances <= (_SMALL * noises(aids, at.dtype)) ** 2
    return jnp.stack([small[part].all() for part in parts(aids)])
