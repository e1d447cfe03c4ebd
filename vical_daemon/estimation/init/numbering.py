"""Are the points of the target numbered alike, in all images and by all cameras?

The target of a camera that numbers them another way is turned: the attitude of the rig by this camera differs
by one rotation from that by another. Rotations between images do not show it, so that each camera alone fits.

A checkerboard with an even sum of columns and rows looks the same upside down. One image cannot tell which
end is up, so a detector may number it one way in one image and the other way in the next (`HalfTurns`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry.so3 import nearest_rotation
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.imu_model import products, rotation_steps
from vical_daemon.estimation.init.motion_restart import ahead
from vical_daemon.estimation.init.velocity_gravity_init import RotationsKnown
from vical_daemon.estimation.measurements import LEAST_POINTS, FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.state import State

_TURNED_RAD = math.pi / 4
"""Half of the smallest turn, a quarter, that brings the points of a square target onto others."""
_TOGETHER_S = 0.05
"""Images that are no further apart show the rig in the same attitude: to 6 deg at 2 rad/s."""
_NEXT_NS = 400_000_000  # a hand turns a camera by less than 90 degrees in 0.4 s, as the detector assumes
_CLEARLY = 0.5
"""The other numbering moves the points by less than half as much: they jump by half the board."""


class Turned(NamedTuple):
    """By one camera the target is turned against what it is by another.

    Attributes:
        first: A camera.
        other: The one by which the target is turned.
        angle_rad: By how much.
    """

    first: str
    other: str
    angle_rad: float

    @property
    def half(self) -> bool:
        """Whether it is about half a turn: some targets look the same then."""
        return self.angle_rad > math.pi - _TURNED_RAD

    def __str__(self) -> str:
        """Say what is wrong, and what to do."""
        return (
            f"{self.first} and {self.other} number the points of the target differently: by {self.other} "
            f"it is turned by {math.degrees(self.angle_rad):.0f} deg; "
            "give the same point the same id in all cameras"
        )


def numbered_differently(known: Mapping[str, RotationsKnown]) -> Turned | None:
    """Return a camera that numbers the points unlike the first one; None: none is seen to.

    Args:
        known: By camera: poses of the target, mounting and time shift by rotations.
    """
    first, *others = known
    for name in others:
        turn = _turn(known[first], known[name])
        angle = 0.0 if turn is None else _angle(turn)
        if angle > _TURNED_RAD:
            return Turned(first, name, angle)
    return None


def late_numbered_differently(
    known: CalibrationFilter, name: str, state: State, buffer: ImuBuffer
) -> Turned | None:
    """Likewise for a camera that joins others later, by their attitude and the gyro since then.

    Args:
        known: The filter at an instant before.
        name: The camera.
        state: With the attitude by its images, not before the filter's.
        buffer: Inertial readings; where some are missing in between, nobody knows: None.
    """
    there = None if buffer.gap_within(known.state.t_s, state.t_s) else ahead(known, buffer, state.t_s)
    if there is None:
        return None
    angle_rad = _angle(there.state.R_world_imu.T @ state.R_world_imu)
    first = next(other for other in known.state.cameras if other not in known.absent)
    return Turned(first, name, angle_rad) if angle_rad > _TURNED_RAD else None


def _angle(R: FloatArray) -> float:
    return math.acos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))


def _turn(a: RotationsKnown, b: RotationsKnown) -> FloatArray | None:
    """Mean rotation of the target by one camera to that by the other; None: they never see it together."""
    t_a, R_a = _attitudes(a)
    t_b, R_b = _attitudes(b)
    nearest = np.abs(t_b[:, None] - t_a).argmin(axis=1)
    together = np.abs(t_b - t_a[nearest]) < _TOGETHER_S
    if not together.any():
        return None
    turns = R_b[together] @ np.swapaxes(R_a[nearest[together]], 1, 2)
    return nearest_rotation(turns.mean(axis=0))


def _attitudes(known: RotationsKnown) -> tuple[FloatArray, FloatArray]:
    """Instants, imu clock, s, shape (n,), and attitudes of the imu in the target's frame, shape (n, 3, 3)."""
    camera = known.camera
    t_s = np.array([p.t_cam_s for p in known.poses]) + camera.timeshift_s
    return t_s, np.array([p.R_target_cam @ camera.R_imu_cam.T for p in known.poses])


class HalfTurns:
    """Numbers the points of each image as those before it, on a board that looks the same upside down.

    It does not turn by 180 degrees between two images: the numbering that continues the one before is right.
    After a gap it is the one by which the board stands in the image as the gyro says.

    Args:
        target_m: Points of the target, m, shape (n, 3).
        alike: A half turn maps the target onto itself; otherwise images are left as they are.
    """

    def __init__(self, target_m: FloatArray, *, alike: bool) -> None:
        self._target_m, self.alike = target_m, alike
        self._last: dict[str, PointsFrame] = {}

    def numbered(
        self, frame: PointsFrame, t_cam_s: float, f: CalibrationFilter | None, buffer: ImuBuffer | None
    ) -> PointsFrame:
        """Return an image with the numbers that continue those before.

        Args:
            frame: As detected; ids within the target.
            t_cam_s: Its stamp, s since the base of the buffer.
            f: The filter, after the image before; None: there is none yet.
            buffer: Readings.
        """
        if not self.alike or len(frame.ids) < LEAST_POINTS:
            return frame
        last, other = self._last.get(frame.camera), self._turned(frame)
        if last is not None and 0 < frame.t_cam_ns - last.t_cam_ns <= _NEXT_NS:
            turned = self._moved_px(last, other) < _CLEARLY * self._moved_px(last, frame)
        else:
            turned = self._upside_down(frame, t_cam_s, f, buffer)
        self._last[frame.camera] = other if turned else frame
        return self._last[frame.camera]

    def from_the_other_end(self, camera: str, frames: Frames) -> Frames:
        """Number images of a camera, up to its newest one, from the other end; those of others are left."""
        self._last[camera] = self._turned(self._last[camera])
        return [(t_s, self._turned(f) if f.camera == camera else f) for t_s, f in frames]

    def _turned(self, frame: PointsFrame) -> PointsFrame:
        """The same image, numbered from the other end."""
        ids = (len(self._target_m) - 1 - frame.ids)[::-1]
        sigma = None if frame.sigma_px is None else frame.sigma_px[::-1]
        return replace(frame, ids=ids, uv_px=frame.uv_px[::-1], sigma_px=sigma)

    def _upside_down(
        self, frame: PointsFrame, t_cam_s: float, f: CalibrationFilter | None, buffer: ImuBuffer | None
    ) -> bool:
        """Whether the board stands on its head, by the attitude that the gyro gives."""
        if f is None or buffer is None or frame.camera in f.absent:
            return False
        camera = f.state.cameras[frame.camera]
        t_s = t_cam_s + camera.timeshift_s
        until_s = min(t_s, buffer.newest_s)
        if until_s < f.state.t_s or buffer.gap_within(f.state.t_s, until_s):
            return False
        segment = buffer.segment(f.state.t_s, until_s)
        if segment is None:
            return False
        rates = (segment.gyro - f.state.gyro_bias) @ f.state.gyro_matrix.T
        turn = products(rotation_steps(rates[None], np.diff(segment.t_s)))[0, -1]
        R_cam_target = (f.state.R_world_imu @ turn @ camera.R_imu_cam).T
        board = self._target_m[frame.ids, :2] - self._target_m[frame.ids, :2].mean(axis=0)
        seen = (frame.uv_px - frame.uv_px.mean(axis=0)).T @ board  # how its axes stand in the image
        return bool((seen * R_cam_target[:2, :2]).sum() < 0.0)

    def _moved_px(self, a: PointsFrame, b: PointsFrame) -> float:
        """Median distance of the points of an image from where the board was in another one, px.

        The two may show different parts of the board: an affine map takes the board into the first image.
        """
        board = np.append(self._target_m[:, :2], np.ones((len(self._target_m), 1)), axis=1)
        to_image, *_ = np.linalg.lstsq(board[a.ids], a.uv_px, rcond=None)
        return float(np.median(np.linalg.norm(b.uv_px - board[b.ids] @ to_image, axis=1)))
