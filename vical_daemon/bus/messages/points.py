"""vical_msgs/TargetPoints and FeatureTracks: the points found in one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.bus.messages.cdr import CdrReader, CdrWriter, MessageError
from vical_daemon.estimation.measurements import FloatArray, IntArray, PointsFrame

POINTS_TYPE = "vical_msgs/msg/TargetPoints"
TRACKS_TYPE = "vical_msgs/msg/FeatureTracks"


@dataclass(frozen=True, slots=True)
class PointsMessage:
    """Points of one image as they travel; the same layout for target points and feature tracks.

    Attributes:
        stamp_ns: Stamp of the image, UNIX ns.
        frame_id: Name of the camera.
        image_size: width, height, px; (0, 0) if the source does not know it.
        ids: Point or feature ids, shape (n,), int64.
        uv_px: Raw distorted pixel coordinates (u right, v down), shape (n, 2).
        sigma_px: One-sigma per axis, shape (n,), or None if the detector does not report it.
    """

    stamp_ns: int
    frame_id: str
    image_size: tuple[int, int]
    ids: IntArray
    uv_px: FloatArray
    sigma_px: FloatArray | None = None

    def to_frame(self) -> PointsFrame:
        """Return the points in the form that the estimator takes."""
        return PointsFrame(self.frame_id, self.stamp_ns, self.ids, self.uv_px, self.sigma_px)


def encode_points(
    stamp_ns: int,
    camera: str,
    ids: IntArray,
    uv_px: FloatArray,
    sigma_px: FloatArray | None = None,
    image_size: tuple[int, int] = (0, 0),
) -> bytes:
    """Build a vical_msgs/TargetPoints or FeatureTracks (they share one layout).

    Args:
        stamp_ns: Stamp of the image, UNIX ns.
        camera: Name of the camera, becomes the frame id.
        ids: Point or feature ids, shape (n,).
        uv_px: Raw distorted pixel coordinates, shape (n, 2).
        sigma_px: One-sigma per axis, shape (n,), or None.
        image_size: width, height, px.

    Raises:
        MessageError: Shapes contradict each other.
    """
    n = len(ids)
    if np.shape(uv_px) != (n, 2) or (sigma_px is not None and np.shape(sigma_px) != (n,)):
        raise MessageError(f"{n} ids, but points of shape {np.shape(uv_px)}")
    writer = CdrWriter()
    writer.header(stamp_ns, camera)
    writer.scalar("I", image_size[0])
    writer.scalar("I", image_size[1])
    writer.sequence(ids, "<i8")
    writer.sequence(uv_px)
    writer.sequence(np.empty(0) if sigma_px is None else sigma_px)
    return writer.finish()


def decode_points(data: bytes) -> PointsMessage:
    """Read a vical_msgs/TargetPoints or FeatureTracks; the arrays are read-only views of the message.

    Raises:
        MessageError: These bytes are no such message, or it holds NaN, infinity or a sigma <= 0.
    """
    reader = CdrReader(data)
    stamp_ns, camera = reader.header()
    image_size = (reader.scalar("I"), reader.scalar("I"))
    ids, uv, sigma = reader.sequence("<i8"), reader.sequence(), reader.sequence()
    reader.end()
    n = len(ids)
    if len(uv) != 2 * n or len(sigma) not in (0, n):
        raise MessageError(f"{n} ids, {len(uv)} coordinates and {len(sigma)} sigmas do not fit together")
    if not np.isfinite(uv).all() or not np.isfinite(sigma).all() or (sigma <= 0).any():
        raise MessageError("points message with a value that is not finite, or a sigma that is not positive")
    return PointsMessage(stamp_ns, camera, image_size, ids, uv.reshape(n, 2), sigma if len(sigma) else None)
