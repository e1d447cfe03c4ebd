"""A simulated camera: renders the board through the full lens, with motion blur, shutter and noise.

World is the target's frame. Every sub-exposure maps each pixel's true ray onto the board by the plane's
homography, so lens and perspective are exact; the texture's symmetric blur does the anti-aliasing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import RectBivariateSpline

from vical_mocks.board_art import draw_board
from vical_mocks.lens import Lens
from vical_mocks.texture import FULL_SCALE, BoardTexture

FloatArray = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
PoseFunction = Callable[[npt.ArrayLike], tuple[FloatArray, FloatArray]]
"""Times in s, shape (n,) -> R_world_cam (n, 3, 3) and p_world_cam (n, 3), m."""

MIN_SLOPE = 1e-9
RAY_TOLERANCE_PX = 1e-3


@dataclass(frozen=True)
class CameraSettings:
    """How the sensor behind the lens behaves.

    Attributes:
        exposure_s: Exposure time, s; 0: no motion blur.
        readout_s: First to last row, s; 0: global shutter. The middle row is exposed at the instant given.
        lens_blur_px: Gaussian sigma of the optics and pixel, px (quantised to a quarter of an octave).
        gain: Grey levels of a perfectly white surface.
        noise_dn: Read noise, grey levels, one sigma.
        shot_noise: Variance added per grey level of signal, grey levels.
        vignetting: Share of light lost in the image's corners.
        blur_step_px: Distance between sub-exposures; halved, the picture does not change visibly.
        max_subframes: Upper bound on sub-exposures.
    """

    exposure_s: float = 0.004
    readout_s: float = 0.0
    lens_blur_px: float = 0.55
    gain: float = 255.0
    noise_dn: float = 1.5
    shot_noise: float = 0.01
    vignetting: float = 0.0
    blur_step_px: float = 0.8
    max_subframes: int = 24


class SimulatedCamera:
    """Renders a board as a moving camera sees it.

    Args:
        target: The board: anything with the attributes of an AprilGrid or checkerboard (see `board_art`).
        lens: Intrinsics and distortion.
        pose: Pose of the camera in the target's frame over time.
        settings: Shutter, blur, noise.
        seed: Of the pixel noise.
    """

    def __init__(
        self,
        target: object,
        lens: Lens,
        pose: PoseFunction,
        settings: CameraSettings | None = None,
        seed: int = 0,
    ) -> None:
        self.lens = lens
        self.settings = settings if settings is not None else CameraSettings()
        self._pose = pose
        self._art = draw_board(target)
        self._texture = BoardTexture(self._art)
        self._rng = np.random.default_rng(seed)
        self._rays, self._blind = pixel_rays(lens)
        self._border = _border_rays(self._rays, lens.resolution)
        self._shade = _vignette(lens, self.settings.vignetting) * np.float32(self.settings.gain / FULL_SCALE)

    def render(self, t_s: float) -> Image:
        """Take a picture exposed around `t_s` (the trajectory's clock), shape (height, width), uint8."""
        image = self.render_clean(t_s)
        noise = self.settings
        if noise.noise_dn > 0 or noise.shot_noise > 0:
            grain = self._rng.standard_normal(image.shape, dtype=np.float32)
            variance = image * np.float32(noise.shot_noise)
            variance += np.float32(noise.noise_dn**2)
            image += grain * cv2.sqrt(variance)
        picture: Image = cv2.convertScaleAbs(np.maximum(image, 0.0))  # rounds and saturates
        return picture

    def render_clean(self, t_s: float) -> npt.NDArray[np.float32]:
        """The picture without noise and rounding, grey levels, shape (height, width) float32."""
        width, height = self.lens.resolution
        offsets = self._sub_exposures(t_s)
        total = np.zeros((height, width), np.float32)
        for offset in offsets:
            sample = self._expose(t_s + float(offset))
            cv2.accumulate(sample, total)
        total *= self._shade
        total *= np.float32(1.0 / len(offsets))
        return total

    def corner_blur_px(self, t_s: float) -> float:
        """Longest path of any corner of the board over the exposure, px (0 when nothing is visible)."""
        if self.settings.exposure_s <= 0:
            return 0.0
        half = self.settings.exposure_s / 2
        before, seen_before = self.project(self._board_grid(), t_s - half)
        after, seen_after = self.project(self._board_grid(), t_s + half)
        both = seen_before & seen_after
        return float(np.max(np.linalg.norm(after - before, axis=1)[both])) if both.any() else 0.0

    def project(
        self, points_m: FloatArray, t_s: float | FloatArray
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """True pixels of board points at `t_s` (one instant, or one per point), and whether they are seen."""
        t = np.broadcast_to(np.asarray(t_s, np.float64), (len(points_m),))
        if np.ndim(t_s) == 0:
            R, p = self._pose(np.array([float(np.asarray(t_s))]))
            in_cam = (points_m - p[0]) @ R[0]
            facing = np.broadcast_to(p[:, 2] * self._art.front > 0, (len(points_m),))
        else:
            R, p = self._pose(t)
            in_cam = np.einsum("nji,nj->ni", R, points_m - p)
            facing = p[:, 2] * self._art.front > 0
        uv, inside = self.lens.project(in_cam)
        return uv, inside & facing

    def _board_grid(self) -> FloatArray:
        x0, y0, x1, y1 = self._art.paper_m
        x, y = np.meshgrid(np.linspace(x0, x1, 4), np.linspace(y0, y1, 4))
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def _sub_exposures(self, t_s: float) -> FloatArray:
        """Offsets of the sub-exposures, s: centres of equal parts, so their mean is exactly zero."""
        steps = math.ceil(self.corner_blur_px(t_s) / self.settings.blur_step_px)
        count = int(np.clip(steps, 1, self.settings.max_subframes))
        return ((np.arange(count) + 0.5) / count - 0.5) * self.settings.exposure_s

    def _expose(self, t_s: float) -> npt.NDArray[np.uint16]:
        """One instantaneous picture, texture units."""
        width, height = self.lens.resolution
        rows = np.arange(height) if self.settings.readout_s > 0 else np.array([(height - 1) / 2])
        offset = (rows / max(height - 1, 1) - 0.5) * self.settings.readout_s
        R, p = self._pose(t_s + offset)
        texture, to_texel = self._texture.at_scale(self._footprint_m(R[len(R) // 2], p[len(p) // 2]))
        homographies = to_texel @ _rays_to_board(R, p)
        if p[len(p) // 2, 2] * self._art.front <= 0:
            return np.full((height, width), self._texture.surround_level, np.uint16)
        if len(rows) == 1:
            texels = cv2.perspectiveTransform(self._rays, homographies[0])
        else:
            texels = np.concatenate(
                [
                    cv2.perspectiveTransform(ray[None], homography)
                    for ray, homography in zip(self._rays, homographies, strict=True)
                ]
            ).reshape(height, width, 2)
        self._hide_what_is_behind(texels, homographies)
        picture: npt.NDArray[np.uint16] = cv2.remap(
            texture, texels, None, cv2.INTER_LINEAR, borderValue=self._texture.surround_level
        )
        return picture

    def _hide_what_is_behind(self, texels: npt.NDArray[np.float32], homographies: FloatArray) -> None:
        """Rays that meet the board's plane behind the camera, or that the lens does not have, see nothing."""
        texels[self._blind] = -1e6
        slope = self._border @ np.swapaxes(homographies[:, 2], 0, 1)
        if np.min(slope) > MIN_SLOPE:
            return
        third = homographies[:, 2].astype(np.float32)
        behind = (
            self._rays[..., 0] * third[:, :1] + self._rays[..., 1] * third[:, 1:2] + third[:, 2:] <= MIN_SLOPE
        )
        texels[behind] = -1e6

    def _footprint_m(self, R: FloatArray, p: FloatArray) -> float:
        """Board length that the lens blur covers in the middle of what is seen of the board, m."""
        x0, y0, x1, y1 = self._art.paper_m
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
        depth = max(float(((middle - p) @ R)[2]), 0.02)
        fx, fy = self.lens.intrinsics[:2]
        return self.settings.lens_blur_px * depth / math.sqrt(fx * fy)


def _rays_to_board(R_world_cam: FloatArray, p_world_cam: FloatArray) -> FloatArray:
    """Homographies from rays (x, y, 1) to board coordinates, shape (n, 3, 3).

    A ray d meets z = 0 at p - R d * p_z / (R d)_z; multiplied by (R d)_z and signed so that the third
    component is positive where the meeting point lies in front of the camera.
    """
    z = p_world_cam[:, 2, None]
    row_x = p_world_cam[:, 0, None] * R_world_cam[:, 2] - z * R_world_cam[:, 0]
    row_y = p_world_cam[:, 1, None] * R_world_cam[:, 2] - z * R_world_cam[:, 1]
    stacked = np.stack([row_x, row_y, R_world_cam[:, 2]], axis=1)
    return np.asarray(stacked * np.where(z > 0, -1.0, 1.0)[:, None])


@lru_cache(maxsize=4)
def pixel_rays(lens: Lens) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Ray (x/z, y/z) of each pixel, shape (height, width, 2), and the pixels that have none."""
    width, height = lens.resolution
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    uv = np.stack([u, v], axis=-1)
    with np.errstate(all="ignore"):
        rays = _interpolated_rays(lens)
        wrong = ~(np.linalg.norm(lens.project(rays)[0] - uv, axis=-1) < RAY_TOLERANCE_PX)
        if wrong.any():  # a lens too wild to interpolate, or one that does not reach the corners
            rays = lens.unproject(uv)
            wrong = ~(np.linalg.norm(lens.project(rays)[0] - uv, axis=-1) < RAY_TOLERANCE_PX)
    rays[wrong] = (0.0, 0.0, 1.0)
    table = np.ascontiguousarray(rays[..., :2], np.float32)
    table.setflags(write=False)
    wrong.setflags(write=False)
    return table, wrong


def _interpolated_rays(lens: Lens) -> FloatArray:
    """Rays of all pixels by splines through every fourth one: a tenth of the time, the same to 1e-3 px."""
    width, height = lens.resolution
    across = np.linspace(0, width - 1, max(width // 4, 6))
    down = np.linspace(0, height - 1, max(height // 4, 6))
    u, v = np.meshgrid(across, down)
    coarse = np.nan_to_num(lens.unproject(np.stack([u, v], axis=-1)), posinf=0.0, neginf=0.0)
    fine = [
        RectBivariateSpline(down, across, coarse[..., k])(np.arange(height), np.arange(width)) for k in (0, 1)
    ]
    return np.stack([*fine, np.ones((height, width))], axis=-1)


def _border_rays(rays: npt.NDArray[np.float32], resolution: tuple[int, int]) -> FloatArray:
    """Rays of the outermost pixels, shape (n, 3): any linear function is smallest on one of them."""
    width, height = resolution
    edge = np.ones((height, width), bool)
    edge[1:-1, 1:-1] = False
    return np.column_stack([rays[edge].astype(np.float64), np.ones(int(edge.sum()))])


def _vignette(lens: Lens, loss: float) -> npt.NDArray[np.float32]:
    """Brightness over the image: 1 at the principal point, 1 - loss in the farthest corner."""
    width, height = lens.resolution
    cx, cy = lens.intrinsics[2:]
    u, v = np.meshgrid(np.arange(width) - cx, np.arange(height) - cy)
    r2 = u * u + v * v
    return np.asarray(1.0 - loss * r2 / r2.max(), np.float32)
