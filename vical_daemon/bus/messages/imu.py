"""sensor_msgs/Imu: the hot path, one packed template per frame id."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

from vical_daemon.bus.messages.cdr import LITTLE_ENDIAN, CdrReader, MessageError

IMU_TYPE = "sensor_msgs/msg/Imu"
_NS_PER_S = 1_000_000_000
_BODY = struct.Struct(
    "<104x3d72x3d72x"
)  # orientation and its covariance skipped, then value, covariance, ...
EncodeImu = Callable[[int, Sequence[float], Sequence[float]], bytes]
"""Stamp (UNIX ns), angular rate (rad/s), specific force (m/s^2) to a message; see `encode_imu`."""


class ImuMessage(NamedTuple):
    """One inertial sample as it travels (a tuple because millions of them are made).

    Attributes:
        stamp_ns: Instant of the measurement, UNIX ns.
        frame_id: Name of the imu.
        gyro_rps: Angular rate in the imu frame, rad/s.
        specific_force_mps2: Specific force in the imu frame, m/s^2.
    """

    stamp_ns: int
    frame_id: str
    gyro_rps: tuple[float, float, float]
    specific_force_mps2: tuple[float, float, float]


@lru_cache(maxsize=64)
def imu_encoder(frame_id: str) -> EncodeImu:
    """Return `encode_imu` for one imu: all that stays the same is packed once.

    Constant are the frame id, an orientation that is declared unknown (covariance[0] = -1, REP 145), and
    covariances of zeros (unknown).
    """
    raw = frame_id.encode()
    name = struct.pack("<I", len(raw) + 1) + raw + b"\0"
    name += bytes(-(8 + len(name)) % 8)
    front = name + struct.pack("<13d", 0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8)
    unknown = bytes(72)
    pack = struct.Struct(f"<4siI{len(front)}s3d72s3d72s").pack

    def encode(stamp_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> bytes:
        seconds, nanoseconds = divmod(stamp_ns, _NS_PER_S)
        try:
            return pack(
                LITTLE_ENDIAN, seconds, nanoseconds, front, *gyro_rps, unknown, *specific_force_mps2, unknown
            )
        except struct.error as error:
            raise MessageError(f"no Imu message can hold these values: {error}") from None

    return encode


def encode_imu(
    stamp_ns: int, frame_id: str, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]
) -> bytes:
    """Build a sensor_msgs/Imu, byte for byte what a ROS 2 node would send.

    Args:
        stamp_ns: Instant of the measurement, UNIX ns.
        frame_id: Name of the imu.
        gyro_rps: Angular rate in the imu frame, rad/s, 3 numbers.
        specific_force_mps2: Specific force in the imu frame, m/s^2, 3 numbers.

    Raises:
        MessageError: Not 3 numbers each, or a stamp that ROS 2 cannot express.
    """
    return imu_encoder(frame_id)(stamp_ns, gyro_rps, specific_force_mps2)


def decode_imu(data: bytes) -> ImuMessage:
    """Read a sensor_msgs/Imu.

    Raises:
        MessageError: These bytes are no such message, or it holds NaN or infinity.
    """
    reader = CdrReader(data)
    stamp_ns, frame_id = reader.header()
    values = _BODY.unpack_from(data, reader.skip(_BODY.size, 8))
    reader.end()
    if not math.isfinite(sum(values)):
        raise MessageError("Imu message with a value that is not finite")
    return ImuMessage(stamp_ns, frame_id, values[:3], values[3:])
