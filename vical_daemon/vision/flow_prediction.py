"""Where features will be in the next frame: rotated by the gyro, or carried on by the last flow.

Rotation moves a pixel whatever its distance, and it is what moves hand-held pictures most; translation is
left to the search. Needs the camera's intrinsics and how it is turned on the IMU, both roughly (a degree).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from vical_daemon.vision.detection import FloatArray, median

HISTORY_SAMPLES = 400  # two seconds at 200 Hz
_TOLERATED_PX = 2.0  # translation moves pixels too, and only the flow knows
_FOLLOW = 0.2  # share of the newest picture in the errors of gyro and flow: a memory of five pictures
_LEAST_POINTS = 8  # for an affine flow
_NEAR_PX = 25.0  # flow farther from the median belongs to things that move
_ROUND_PX = 1.0  # spread that points have at least: of points on one line the flow across is the mean flow


@dataclass(frozen=True)
class FlowCamera:
    """What is known about the camera.

    Attributes:
        intrinsics: fx fy cx cy, px.
        distortion: The model's coefficients.
        distortion_model: radtan, plumb_bob or equidistant.
        R_imu_cam: Rotation that maps camera vectors into the imu frame, shape (3, 3); None: unknown, the gyro
            is not used.
        timeshift_cam_imu_s: t_imu = t_cam + shift, s.
    """

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    distortion_model: str = "radtan"
    R_imu_cam: FloatArray | None = None
    timeshift_cam_imu_s: float = 0.0

    def matrix(self) -> FloatArray:
        """Camera matrix, shape (3, 3)."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def rays(self, uv_px: FloatArray) -> FloatArray:
        """Undistorted normalised coordinates (x/z, y/z), shape (n, 2)."""
        points = np.ascontiguousarray(uv_px[:, None, :], np.float64)
        undistort = cv2.fisheye.undistortPoints if self._is_fisheye() else cv2.undistortPoints
        return np.asarray(undistort(points, self.matrix(), np.array(self.distortion)), np.float64).reshape(
            -1, 2
        )

    def pixels(self, rays: FloatArray) -> FloatArray:
        """Pixels of rays (n, 3) in front of the camera, shape (n, 2)."""
        xy = np.ascontiguousarray((rays[:, :2] / rays[:, 2:])[:, None, :])
        if self._is_fisheye():
            uv = cv2.fisheye.distortPoints(xy, self.matrix(), np.array(self.distortion))
        else:
            solid = np.concatenate([xy, np.ones((len(xy), 1, 1))], axis=2)
            uv, _ = cv2.projectPoints(
                solid, np.zeros(3), np.zeros(3), self.matrix(), np.array(self.distortion)
            )
        return np.asarray(uv, np.float64).reshape(-1, 2)

    def _is_fisheye(self) -> bool:
        return self.distortion_model == "equidistant"


class FlowPredictor:
    """Predicts feature positions.

    Args:
        camera: What is known about the camera; None: only the flow of the last frames is used.
    """

    def __init__(self, camera: FlowCamera | None = None) -> None:
        self.camera = camera
        self._gyro: deque[tuple[int, FloatArray]] = deque(maxlen=HISTORY_SAMPLES)
        self._affine: FloatArray | None = None
        self._step_s = 0.0
        self._gyro_error_px = self._flow_error_px = 0.0
        # between two pictures, once asked for: (their stamps, rotation)
        self._turn: tuple[tuple[int | None, int | None], FloatArray | None] | None = None

    def add_imu(self, t_imu_ns: int, gyro_rps: tuple[float, float, float]) -> None:
        """Take one gyro sample (rad/s, imu frame); samples that go back in time are ignored."""
        if not self._gyro or t_imu_ns > self._gyro[-1][0]:
            self._gyro.append((t_imu_ns, np.asarray(gyro_rps, np.float64)))

    def predict(self, uv_px: FloatArray, t_before_ns: int | None, t_now_ns: int | None) -> FloatArray:
        """Where points of the last frame will be, shape (n, 2), px."""
        by_flow = self._by_flow(uv_px, t_before_ns, t_now_ns)
        by_gyro = self._by_gyro(uv_px, t_before_ns, t_now_ns)
        if by_gyro is None or self._gyro_error_px > self._flow_error_px + _TOLERATED_PX:
            return by_flow
        return by_gyro

    def _by_gyro(self, uv_px: FloatArray, t_before_ns: int | None, t_now_ns: int | None) -> FloatArray | None:
        if self._turn is None or self._turn[0] != (t_before_ns, t_now_ns):
            self._turn = (t_before_ns, t_now_ns), self.rotation(t_before_ns, t_now_ns)
        rotation = self._turn[1]
        if rotation is None or self.camera is None:
            return None
        rays = self.camera.rays(uv_px)
        turned = np.column_stack([rays, np.ones(len(rays))]) @ rotation.T
        return self.camera.pixels(turned) if np.all(turned[:, 2] > 0.1) else None

    def _by_flow(self, uv_px: FloatArray, t_before_ns: int | None, t_now_ns: int | None) -> FloatArray:
        if self._affine is None:
            return uv_px.copy()
        share = 1.0
        if t_before_ns is not None and t_now_ns is not None and self._step_s > 0:
            share = float(np.clip((t_now_ns - t_before_ns) * 1e-9 / self._step_s, 0.0, 3.0))
        flow = uv_px @ self._affine[:, :2].T + self._affine[:, 2] - uv_px
        return np.asarray(uv_px + share * flow)

    def learn(
        self, before_px: FloatArray, now_px: FloatArray, t_before_ns: int | None, t_now_ns: int | None
    ) -> None:
        """Remember the mean (affine) flow of a frame for the next one, and which foretelling was right."""
        self._compare(before_px, now_px, t_before_ns, t_now_ns)
        self._affine = self._turn = None
        if len(before_px) >= _LEAST_POINTS:
            flow = now_px - before_px
            off = flow - np.array([median(flow[:, 0]), median(flow[:, 1])])
            near = np.hypot(off[:, 0], off[:, 1]) < _NEAR_PX
            if np.count_nonzero(near) >= _LEAST_POINTS:
                self._affine = _affine(before_px[near], now_px[near])
        if t_before_ns is not None and t_now_ns is not None:
            self._step_s = (t_now_ns - t_before_ns) * 1e-9

    def _compare(
        self, before_px: FloatArray, now_px: FloatArray, t_before_ns: int | None, t_now_ns: int | None
    ) -> None:
        """A mounting or a delay that is wrong must not lead astray: the gyro is used while it does better."""
        by_gyro = self._by_gyro(before_px, t_before_ns, t_now_ns)
        if by_gyro is None or self._affine is None or len(before_px) < 8:
            return
        by_flow = self._by_flow(before_px, t_before_ns, t_now_ns)
        gyro, flow = (float(np.median(np.linalg.norm(x - now_px, axis=1))) for x in (by_gyro, by_flow))
        self._gyro_error_px += _FOLLOW * (gyro - self._gyro_error_px)
        self._flow_error_px += _FOLLOW * (flow - self._flow_error_px)

    def linear_flow(self) -> FloatArray:
        """Turn and scale of the last frame's mean flow, shape (2, 2)."""
        return np.eye(2) if self._affine is None else self._affine[:, :2]

    def rotation(self, t_before_ns: int | None, t_now_ns: int | None) -> FloatArray | None:
        """R_now_before of the camera from the gyro; None where samples do not bracket the two instants."""
        if self.camera is None or self.camera.R_imu_cam is None or t_before_ns is None or t_now_ns is None:
            return None
        shift = round(self.camera.timeshift_cam_imu_s * 1e9)
        begin, end = t_before_ns + shift, t_now_ns + shift
        if len(self._gyro) < 2 or end <= begin or self._gyro[0][0] > begin:
            return None
        # The newest sample may lag a little behind the picture: its rate is held.
        if end - self._gyro[-1][0] > 20_000_000:
            return None
        near = self._since(begin)
        times = np.array([t - begin for t, _ in near], np.float64) * 1e-9
        rates = np.array([rate for _, rate in near])
        span = (end - begin) * 1e-9
        inner = times[(times > 0) & (times < span)]
        grid = np.concatenate([[0.0], inner, [span]])
        at = np.column_stack([np.interp(grid, times, rates[:, k]) for k in range(3)])
        R_before_now = np.eye(3)
        for step, rate in zip(np.diff(grid), (at[1:] + at[:-1]) / 2, strict=True):
            R_before_now = R_before_now @ cv2.Rodrigues(rate * step)[0]
        R_imu_cam = self.camera.R_imu_cam
        return np.asarray(R_imu_cam.T @ R_before_now.T @ R_imu_cam)

    def _since(self, t_imu_ns: int) -> list[tuple[int, FloatArray]]:
        """Samples from the last one at or before an instant on, in order: few of the many that are kept."""
        near: list[tuple[int, FloatArray]] = []
        for sample in reversed(self._gyro):
            near.append(sample)
            if sample[0] <= t_imu_ns:
                break
        return near[::-1]

    def undistort(self, uv_px: FloatArray) -> FloatArray:
        """Pixels of the ideal pinhole of the same focal length (for epipolar lines); as given without one."""
        if self.camera is None:
            return uv_px
        fx, fy, cx, cy = self.camera.intrinsics
        return np.asarray(self.camera.rays(uv_px) * np.array([fx, fy]) + np.array([cx, cy]))


def _affine(before: FloatArray, now: FloatArray) -> FloatArray:
    """Least squares fit of now = A (before, 1), shape (2, 3)."""
    centre, goal = before.mean(axis=0), now.mean(axis=0)
    apart = before - centre
    square = apart.T @ apart
    square[[0, 1], [0, 1]] += _ROUND_PX**2  # points on one line
    linear = np.eye(2) + np.linalg.solve(square, apart.T @ (now - goal - apart)).T
    return np.column_stack([linear, goal - linear @ centre])
