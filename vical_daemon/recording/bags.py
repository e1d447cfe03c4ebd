"""Reads ROS 1 bags and ROS 2 bag folders through rosbags; every message comes out as ROS 2 CDR."""

from __future__ import annotations

from collections.abc import Iterator

from vical_daemon.messages import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    POINTS_TYPE,
    TRACKS_TYPE,
)
from vical_daemon.messages.schemas import typestore
from vical_daemon.recording.logs import LogRecording, RawMessage
from vical_daemon.recording.model import RecordingError


class BagRecording(LogRecording):
    """A ``.bag`` file of ROS 1, or a folder with ``metadata.yaml`` of ROS 2."""

    def _raw(self) -> Iterator[RawMessage]:
        self.warnings.clear()
        from rosbags.highlevel import AnyReader

        ros1 = self.path.suffix == ".bag"

        try:
            with AnyReader([self.path], default_typestore=None if ros1 else typestore()) as reader:
                for connection, log_time_ns, data in reader.messages():
                    payload = bytes(data) if reader.is2 else _to_cdr(data, connection.msgtype)
                    yield RawMessage(connection.topic, connection.msgtype, log_time_ns, payload)
        except (RecordingError, GeneratorExit):
            raise
        except Exception as error:  # rosbags raises whatever its parsers raise on damaged files
            first = " ".join(str(error).split()).rstrip(".") or type(error).__name__
            raise RecordingError(
                f"{self.path} cannot be read as a bag: {first[:200]}; try rosbag reindex or ros2 bag reindex"
            ) from None


_WANTED = frozenset({IMU_TYPE, IMAGE_TYPE, COMPRESSED_IMAGE_TYPE, POINTS_TYPE, TRACKS_TYPE})


def _to_cdr(data: bytes, type_name: str) -> bytes:
    """Return a ROS 1 message as CDR (its header loses `seq`); of types that are of no use nothing."""
    if type_name not in _WANTED:
        return b""
    return bytes(typestore().ros1_to_cdr(data, type_name))
