"""Reduces a telemetry log to chosen messages, spans and rates; packets are kept byte for byte.

python -m spinndrift.systems.logs.cut_tlog dive.tlog out.tlog.xz --spans 52.8 142.8
"""

import lzma
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import tyro

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from .log_bytes import read_log_bytes
from .packets import Packets, message_id, rows_of, scan

# Rate kept (Hz) within the spans: every message, or every second, third, … of it.
RATES: dict[str, float] = {
    "ATTITUDE_QUATERNION": 50.0,
    "SERVO_OUTPUT_RAW": 100.0,
    "LOCAL_POSITION_NED": 50.0,
    "RAW_IMU": 12.5,
    "SCALED_PRESSURE2": 5.0,
    "RC_CHANNELS": 4.0,
    "EKF_STATUS_REPORT": 2.0,
    "BATTERY_STATUS": 2.0,
    "VISION_POSITION_DELTA": 0.2,
}
# Kept throughout, so that arming, modes and the clock are known between the spans.
ALWAYS = ("HEARTBEAT", "STATUSTEXT", "SYSTEM_TIME", "GPS_GLOBAL_ORIGIN")
PARAMETERS = (
    "BARO1_GND_PRESS",
    "BARO2_GND_PRESS",
    "BARO_SPEC_GRAV",
    "EK3_ACC_P_NSE",
    "EK3_ALT_M_NSE",
    "EK3_SRC1_POSZ",
    "FRAME_CONFIG",
    "INS_ACCEL_FILTER",
    "INS_GYRO_FILTER",
    *(f"MOT_{n}_DIRECTION" for n in range(1, 9)),
    *(f"SERVO{n}_FUNCTION" for n in range(1, 17)),
)


def cut_tlog(
    data: bytes,
    spans: Sequence[tuple[float, float]],
    rates: Mapping[str, float] = RATES,
    always: Collection[str] = ALWAYS,
    parameters: Collection[str] = PARAMETERS,
) -> bytes:
    """Return the chosen packets with their time stamps, in order and byte for byte.

    `spans` are seconds since boot on the vehicle's clock. The messages in `rates` are decimated to
    nearly these rates; `parameters` are kept wherever they were reported.

    Raises:
        UserError: if the log has no message with the vehicle's time, or none in a span.
    """
    packets = scan(data)
    t = _vehicle_time(data, packets)
    keep = np.zeros(t.size, bool)
    for name in always:
        keep |= packets.message == message_id(name)
    for name, rate in rates.items():
        found = np.flatnonzero(packets.message == message_id(name))
        for start, stop in spans:
            inside = found[(t[found] >= start) & (t[found] < stop)]
            every = max(1, round(inside.size / ((stop - start) * rate)))
            keep[inside[::every]] = True
    wanted = {name.encode() for name in parameters}
    rows, index = rows_of(
        data, packets, np.flatnonzero(packets.message == message_id("PARAM_VALUE")), "PARAM_VALUE"
    )
    keep[[i for row, i in zip(rows, index, strict=True) if row["param_id"] in wanted]] = True
    if not any(((t >= a) & (t < b)).any() for a, b in spans):
        raise UserError(f"spans: the log covers {t.min():.1f} to {t.max():.1f} s, none of {spans}")
    chosen = np.flatnonzero(keep)
    return b"".join(data[packets.record[i] : packets.end[i]] for i in chosen)


def _vehicle_time(data: bytes, packets: Packets) -> np.ndarray:
    found = np.flatnonzero(packets.message == message_id("ATTITUDE"))
    rows, index = rows_of(data, packets, found, "ATTITUDE")
    if index.size < 2:
        raise UserError("no ATTITUDE in this log, so nothing tells the vehicle's time")
    stamps = packets.stamps(data)
    offset = np.median(stamps[index] - rows["time_boot_ms"] * 1e-3)
    return stamps - offset


def main(
    source: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    spans: list[tuple[float, float]],
) -> None:
    """Cut a telemetry log to spans of the vehicle's clock (s) and compress it with xz.

    Args:
        source: the log, plain or compressed.
        out: the result, `.tlog.xz`.
        spans: pairs of start and stop (s since boot).
    """
    cut = cut_tlog(read_log_bytes(source).data, spans)
    with atomic_path(out) as partial:
        partial.write_bytes(lzma.compress(cut, preset=9 | lzma.PRESET_EXTREME))


if __name__ == "__main__":
    tyro.cli(main)
