"""Settings of the delayed filter."""

from dataclasses import dataclass

from ...models.config.checks import Vector3, check_numbers, require


@dataclass(frozen=True)
class EkfConfig:
    """Initial covariance and gates of the filter; the sensors' configurations give their noises.

    Attributes:
        position_std: of the initial position in body axes (m).
        attitude_std: of the initial attitude about the body axes (rad).
        velocity_std: of the initial velocity in body axes (m/s).
        imu_factor: the filter multiplies the IMU's noise densities by this factor. It covers
            second-order errors such as bias times attitude error. Over 30 one-minute runs in calm
            water the NEES of attitude is 3.4 ± 0.2 at 1 and that of velocity 2.5 ± 0.1 at 1.5; a
            consistent filter has 3 (`spinndrift check estimator --only calm`, and
            `tests/test_filtering.py` without a DVL).
        horizon: longest latency of a reading (s).
        imu_latency: time by which the IMU's samples are late (s), as those of a link that buffers
            them; readings of the other sensors wait as long.
        latency_std: standard deviation of a constant by which the times of validity of each other
            sensor's readings are too late (s), which is then estimated; 0: they are right.
        timing_std: standard deviation of each of those times around that constant (s).
        gate: probability that a good reading passes the chi-square gate.
        patience: number of consecutive rejections after which something must have changed: the
            sensor, whose offset is then a state, or the filter, whose covariance then grows by
            the squared residual (`systems.estimation.changes`). Fewer do if they are much alike.
        output_rate: estimates per second (Hz).
        silence: time without an accepted reading after which a sensor is not trusted (s).
        lost_velocity: standard deviation of velocity above which the state is lost (m/s).
        lost_attitude: the same for roll, pitch and yaw (rad).
    """

    position_std: Vector3 = (0.02, 0.02, 0.02)
    attitude_std: Vector3 = (0.01, 0.01, 0.03)
    velocity_std: Vector3 = (0.02, 0.02, 0.02)
    imu_factor: float = 1.2
    horizon: float = 0.24
    imu_latency: float = 0.0
    latency_std: float = 0.0
    timing_std: float = 0.0
    gate: float = 0.999
    patience: int = 3
    output_rate: float = 20.0
    silence: float = 3.0
    lost_velocity: float = 0.5
    lost_attitude: float = 0.5

    def __post_init__(self) -> None:
        """Check signs and ranges."""
        check_numbers(self)
        for field in ("position_std", "attitude_std", "velocity_std"):
            require(min(getattr(self, field)) >= 0, self, field, "give zero or more")
        for field in ("imu_latency", "latency_std", "timing_std"):
            require(getattr(self, field) >= 0, self, field, "give zero or more")
        above_zero = ("imu_factor", "horizon", "output_rate", "silence")
        for field in (*above_zero, "lost_velocity", "lost_attitude"):
            require(getattr(self, field) > 0, self, field, "give a number above zero")
        require(0 < self.gate < 1, self, "gate", "give a share between 0 and 1")
        require(self.patience >= 1, self, "patience", "give at least 1")
