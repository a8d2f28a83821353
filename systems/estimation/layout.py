"""The constants of the delayed filter: its sensors and settings, and the layout of its arrays."""

import math
from dataclasses import replace
from itertools import accumulate

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import chi2

from ...models.config.checks import require
from ...models.sensors import Imu, Sensor
from . import error_state, inertial
from .config import EkfConfig
from .readings import sizes

SAMPLE = 7
"""Columns of a slot: has sample, force 3, mean rate 3 | has reading, values, for each sensor | rate
at the end 3 | `inertial.LEFT_OPEN`."""


class Layout(eqx.Module):
    """Sensors, settings and what follows from them.

    `aids` are the sensors that are fused, besides the IMU: all that `observes` something.
    """

    imu: Imu = eqx.field(static=True)
    aids: tuple[Sensor, ...] = eqx.field(static=True)
    config: EkfConfig = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Check that readings arrive within the horizon and that no noise is zero."""
        for sensor in self.aids:
            remedy = "give more than zero: a filter divides by it"
            require(min(sensor.noise_std) > 0, sensor, "noise", remedy)
            longest = sensor.latencies[1] + 2 * self.period
            require(
                not sensor.late or self.slots * self.period >= longest - 1e-9,
                self.config,
                "horizon",
                f"give at least the {type(sensor).__name__}'s latest latency and two samples, "
                f"{longest:.3g} s",
            )
            replaced = 1 / sensor.rate + sensor.latencies[0]
            require(
                self.config.imu_latency <= max(0.0, replaced - self.period) + 1e-9,
                self.config,
                "imu_latency",
                f"give at most {replaced - self.period:.3g} s: the {type(sensor).__name__}'s next "
                "reading may come by then",
            )

    def _shown_for(self, sensor: Sensor) -> float:
        """Shortest time for which a reading is there after the samples of its time (s)."""
        earliest, latest = sensor.latencies
        return 1 / sensor.rate + earliest - max(latest, self.config.imu_latency)

    @property
    def period(self) -> float:
        """Time between inertial samples (s)."""
        return 1 / self.imu.rate

    @property
    def slots(self) -> int:
        """Number of buffered samples."""
        return math.ceil(self.config.horizon * self.imu.rate - 1e-9)

    @property
    def flags(self) -> np.ndarray:
        """Column of each sensor's flag in a slot; its values follow."""
        return np.array([*accumulate((n + 1 for n in sizes(self.aids)), initial=SAMPLE)][:-1])

    @property
    def rate_column(self) -> int:
        """Column of the rate in a slot, after the sensors' values."""
        return SAMPLE + sum(sizes(self.aids)) + len(self.aids)

    @property
    def slot(self) -> int:
        """Number of columns of a slot."""
        return self.rate_column + 3 + inertial.LEFT_OPEN

    @property
    def errors(self) -> int:
        """Number of components of the error state."""
        return error_state.INERTIAL + self._lasting + 2 * sum(sizes(self.aids))

    @property
    def _lasting(self) -> int:
        """Number of the sensors' slow errors and latencies."""
        return len(self.aids) * (2 if self.config.latency_std > 0 else 1)

    @property
    def shown(self) -> int:
        """Number of those components whose covariance is shown: all but latencies, offsets and
        drifts.
        """
        return error_state.INERTIAL + len(self.aids)

    @property
    def gates(self) -> tuple[float, ...]:
        """Largest NIS of good readings of each sensor."""
        return tuple(float(chi2.ppf(self.config.gate, size)) for size in sizes(self.aids))

    def samples_at_once(self, most: int) -> int:
        """Largest divisor of `most` so that `take_in` of so many samples misses no reading."""
        shortest = min(self._shown_for(each) for each in self.aids)
        fit = [
            n for n in range(1, most + 1) if most % n == 0 and n * self.period <= shortest + 1e-9
        ]
        return max(fit, default=1)

    @property
    def noisy_imu(self) -> Imu:
        """The IMU with its noise raised by `imu_factor`."""
        f, imu = self.config.imu_factor, self.imu
        return replace(
            imu,
            accelerometer_density=f * imu.accelerometer_density,
            gyroscope_density=f * imu.gyroscope_density,
        )

    def deviations(self) -> Float[Array, "e"]:
        """Standard deviations of the initial error."""
        c = self.config
        slow = (each.slow_error[0] for each in self.aids)
        biases = (self.imu.gyroscope_bias,) * 3 + (self.imu.accelerometer_bias,) * 3
        late = (c.latency_std,) * (self._lasting - len(self.aids))
        none = (0.0,) * (2 * sum(sizes(self.aids)))
        stds = (*c.position_std, *c.attitude_std, *c.velocity_std, *biases, *slow, *late, *none)
        return jnp.asarray(stds, jnp.result_type(float))
