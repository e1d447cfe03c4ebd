"""Orientations and lenses of the cameras of a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.init.camera_start import starting_camera
from vical_daemon.estimation.init.intrinsics_start import LensFit, estimate_intrinsics
from vical_daemon.estimation.measurements import CameraPrior, PointsFrame
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.temporal.camera_orientations import Orientations, target_orientations
from vical_daemon.estimation.temporal.td_icp_input import OrientationStream
from vical_daemon.estimation.temporal.track_orientations import track_orientations
from vical_daemon.logs import Recording, Stream
from vical_daemon.logs.channel import stamp_of
from vical_daemon.offline.errors import InputError, OptionError, Warn, ignore, size_unknown

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
GIVEN = "--initial"


@dataclass(frozen=True, slots=True)
class LensUsed:
    """The lens with which orientations were taken from images, and where it is from."""

    lens: CameraState
    origin: str

    def to_json(self) -> dict[str, Any]:
        """Return it as `vical td-icp --json` prints it, with the names of `vical calibrate`."""
        return {
            "intrinsics": self.lens.intrinsics.tolist(),
            "distortion_model": self.lens.distortion_model,
            "distortion": self.lens.distortion.tolist(),
            "origin": self.origin,
        }


def seconds(t_ns: IntArray, base_ns: int) -> FloatArray:
    """Stamps in seconds since a base: what is small enough for a float to keep every nanosecond."""
    return np.asarray((t_ns - base_ns) * 1e-9, dtype=np.float64)


def camera_stream(
    recording: Recording,
    stream: Stream,
    prior: CameraPrior | None,
    target: str | None,
    base_ns: int,
    warn: Warn = ignore,
) -> tuple[OrientationStream, LensUsed]:
    """Orientations of one camera of a recording, and the lens they were taken with.

    Args:
        recording: The data.
        stream: The camera.
        prior: What is known about its lens; None: nothing.
        target: Target file, needed unless the stream holds tracks.
        base_ns: Subtracted from stamps.
        warn: Takes what is unusual.

    Raises:
        InputError: Something needed is not there.
    """
    lens = lens_of(stream, prior)
    if stream.kind == "tracks":
        if prior is None or prior.intrinsics is None:
            raise OptionError(f"{stream.name}: tracks need the lens: give --initial with its intrinsics")
        chains = track_orientations(
            recording.points_frames(stream.name), lens.intrinsics, lens.distortion, lens.distortion_model
        )
        if not chains:
            raise InputError(f"{stream.name}: too few features carry over from frame to frame")
        found = max(chains, key=lambda chain: len(chain.t_cam_ns))
        return _stream(stream.name, found, base_ns), LensUsed(lens, GIVEN)
    guess = prior is None or prior.intrinsics is None
    found, fit = board_poses(recording, stream, lens, target, warn)
    start = "a guess from the image size" if guess else GIVEN
    origin = f"estimated from {len(fit.views)} views of the board, starting from {start}" if fit else start
    return _stream(stream.name, found, base_ns), LensUsed(lens, origin)


def track_frames(
    recording: Recording, stream: Stream, prior: CameraPrior | None, base_ns: int
) -> tuple[list[tuple[float, PointsFrame]], LensUsed]:
    """Tracks with their stamps in seconds, and the lens.

    Raises:
        InputError: The lens is not known.
    """
    if prior is None or prior.intrinsics is None:
        raise OptionError(f"{stream.name}: tracks need the lens: give --initial with its intrinsics")
    frames = [((f.t_cam_ns - base_ns) * 1e-9, f) for f in recording.points_frames(stream.name)]
    return frames, LensUsed(lens_of(stream, prior), GIVEN)


def board_poses(
    recording: Recording,
    stream: Stream,
    lens: CameraState,
    target: str | None,
    warn: Warn = ignore,
    every_s: float = 0.0,
) -> tuple[Orientations, LensFit | None]:
    """Find the board in a camera's frames, improve the lens by them, and return the camera's poses.

    Args:
        recording: The data.
        stream: The camera, images or points.
        lens: Start; improved in place.
        target: Target file.
        warn: Takes what is unusual.
        every_s: The board is looked for in images that are at least so far apart, s.

    Raises:
        InputError: No target, or it does not fit the data.
    """
    if target is None:
        raise OptionError(f"{stream.name}: give the board with --target")
    from vical_daemon.vision.target import load_target

    points_m = load_target(Path(target)).points_m
    frames = _frames(recording, stream, target, warn, every_s)
    if not any(len(f.ids) for f in frames):
        raise InputError(f"{stream.name}: the target was found in no image; is it the right target file?")
    if max(int(f.ids.max()) for f in frames if len(f.ids)) >= len(points_m):
        raise InputError(
            f"{stream.name}: point ids go beyond the target's {len(points_m)} points; wrong target file?"
        )
    fit = estimate_intrinsics(lens, frames, points_m)
    found = target_orientations(frames, points_m, lens.intrinsics, lens.distortion, lens.distortion_model)
    if not len(found.t_cam_ns):
        count = sum(len(f.ids) > 0 for f in frames)
        raise InputError(
            f"{stream.name}: the points in its {count} images fit no pose of the board in {target}; is it "
            "another board?"
        )
    return found, fit


def lens_of(stream: Stream, prior: CameraPrior | None) -> CameraState:
    """Return what is known about a camera's lens, or a guess from the image size.

    Raises:
        InputError: Not even the image size is known.
    """
    if prior is None:
        if stream.resolution is None:
            raise OptionError(f"{stream.name}: {size_unknown(stream)}")
        prior = CameraPrior(resolution=stream.resolution)
    elif prior.resolution == (0, 0) and prior.intrinsics is None:
        if stream.resolution is None:
            raise OptionError(f"{stream.name}: --initial gives neither resolution nor intrinsics")
        prior = CameraPrior(resolution=stream.resolution, distortion_model=prior.distortion_model)
    return starting_camera(prior)


def _stream(name: str, found: Orientations, base_ns: int) -> OrientationStream:
    return OrientationStream(name, seconds(found.t_cam_ns, base_ns), found.R_world_cam, found.covariance)


def _frames(
    recording: Recording, stream: Stream, target: str, warn: Warn, every_s: float
) -> list[PointsFrame]:
    if stream.kind == "points":
        return [f for f in recording.points_frames(stream.name) if len(f.ids)]
    from vical_daemon.vision.detector import BoardDetector
    from vical_daemon.vision.target import load_target
    from vical_daemon.vision.target_check import TargetCheck

    board = load_target(Path(target))
    check = TargetCheck(board, lambda text: warn(f"{stream.name}: {text}"))
    detect = BoardDetector(board, check=check).detect
    frames, unreadable, next_ns = [], 0, -math.inf
    for _, payload in recording.messages([stream]):
        if (stamp_of(payload) or 0) < next_ns:
            continue
        try:
            stamp_ns, image = image_of(payload, stream.kind)
        except ValueError:  # damaged, or larger than an image can be: as the service, which counts them
            unreadable += 1
            continue
        next_ns = stamp_ns + 0.9e9 * every_s  # a period of the images does not divide it evenly
        found = detect(image, stamp_ns)
        if found is not None and len(found.ids):
            frames.append(PointsFrame(stream.name, stamp_ns, found.ids, found.uv_px, found.sigma_px))
    if unreadable:
        warn(f"{stream.name}: {unreadable} unreadable images left out")
    return frames


def image_of(payload: bytes, kind: str) -> tuple[int, Any]:
    """Return the stamp, ns, and the pixels of an image message of a kind (image or compressed)."""
    from vical_daemon.bus.messages import decode_compressed_image, decode_image

    if kind == "image":
        raw = decode_image(payload)
        return raw.stamp_ns, raw.pixels()
    from vical_daemon.vision import image_codec

    packed = decode_compressed_image(payload)
    return packed.stamp_ns, image_codec.decode_image(np.frombuffer(packed.data, np.uint8))
