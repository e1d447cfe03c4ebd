"""A textured room to look at: flat, printed rectangles at several distances, with exact depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vical_mocks.camera import PoseFunction, pixel_rays
from vical_mocks.lens import Lens

FloatArray = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Panel:
    """A rectangle with something to see on it.

    Attributes:
        origin_m: Corner, world frame, m, shape (3,).
        axes: Unit vectors along its edges, shape (2, 3).
        size_m: Edge lengths, m.
        texel_m: Size of a texel, m; about half of what a pixel sees from where the camera is.
    """

    origin_m: FloatArray
    axes: FloatArray
    size_m: tuple[float, float]
    texel_m: float

    def to_plane(self, p_world: FloatArray, rays_world: Floats) -> tuple[Floats, Floats, Floats]:
        """Where rays (..., 3) from a point meet the panel: coordinates on it (m), and distance along the ray.

        The distance is inf where the ray misses the rectangle or points away.
        """
        normal = np.cross(self.axes[0], self.axes[1])
        frame = np.array([normal, *self.axes])
        begin = frame @ (p_world - self.origin_m)
        along = frame.astype(rays_world.dtype) @ rays_world.reshape(-1, 3).T
        slope, right, down = along.reshape(3, *rays_world.shape[:-1])
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -begin[0] / slope
            right, down = begin[1] + distance * right, begin[2] + distance * down
            width, height = self.size_m
            hit = (distance > 1e-3) & (right >= 0) & (right <= width) & (down >= 0) & (down <= height)
        return right, down, np.where(hit, distance, np.inf)


def room_panels(side: int = -1) -> list[Panel]:
    """Walls and a few boards 0.7 to 3 m from where the reference rig moves; it looks along -side z."""
    s = -float(side)
    x, y, z = np.eye(3)
    z = s * z

    def panel(
        corner: Sequence[float], a: FloatArray, b: FloatArray, size: tuple[float, float], texel: float
    ) -> Panel:
        start = corner[0] * x + corner[1] * y + corner[2] * z
        return Panel(start, np.stack([a, b]), size, texel)

    tilt = (x + 0.6 * z) / np.linalg.norm(x + 0.6 * z)
    lean = (y - 0.5 * z) / np.linalg.norm(y - 0.5 * z)
    return [
        panel((-2.5, -2.0, 2.0), x, y, (5.0, 4.0), 0.0025),
        panel((-1.6, -2.0, -2.0), z, y, (4.0, 4.0), 0.0025),
        panel((1.9, -2.0, -2.0), z, y, (4.0, 4.0), 0.0025),
        panel((-2.5, 1.1, -2.0), x, z, (5.0, 4.0), 0.0025),
        panel((-2.5, -1.3, -2.0), x, z, (5.0, 4.0), 0.0025),
        panel((-0.6, -0.35, 0.35), tilt, y, (0.45, 0.4), 0.0008),
        panel((0.45, 0.15, 0.2), x, lean, (0.5, 0.35), 0.0007),
        panel((0.3, -0.6, 0.7), x, y, (0.4, 0.45), 0.001),
    ]


class RoomCamera:
    """Renders a room of panels as a moving camera sees it.

    Args:
        lens: Intrinsics and distortion.
        pose: R_world_cam, p_world_cam over time.
        panels: What there is; None: `room_panels`.
        exposure_s: Exposure time.
        subframes: Instants averaged over the exposure.
        noise_dn: Pixel noise, grey levels, one sigma.
        seed: Of textures and noise.
    """

    def __init__(
        self,
        lens: Lens,
        pose: PoseFunction,
        panels: Sequence[Panel] | None = None,
        exposure_s: float = 0.0,
        subframes: int = 1,
        noise_dn: float = 2.0,
        seed: int = 0,
    ) -> None:
        self.lens = lens
        self._pose = pose
        self._panels = list(panels) if panels is not None else room_panels()
        self._exposure_s, self._subframes, self._noise_dn = exposure_s, subframes, noise_dn
        self._rng = np.random.default_rng([seed, 1])
        self._textures = [
            _texture(p, np.random.default_rng([seed, 2, i])) for i, p in enumerate(self._panels)
        ]
        rays, blind = pixel_rays(lens)
        self._rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1), np.float32)], axis=2)
        self._blind = blind

    def render(self, t_s: float) -> Image:
        """Take a picture exposed around `t_s`, shape (height, width), uint8."""
        total = np.zeros(self._blind.shape, np.float32)
        for k in range(self._subframes):
            total += self._expose(t_s + ((k + 0.5) / self._subframes - 0.5) * self._exposure_s)
        total /= self._subframes
        total += self._rng.standard_normal(total.shape, dtype=np.float32) * np.float32(self._noise_dn)
        return np.asarray(np.clip(np.rint(total), 0, 255), np.uint8)

    def surface_points(self, uv_px: FloatArray, t_s: float) -> FloatArray:
        """World points that pixels show at `t_s`, shape (n, 3); nan where a pixel shows nothing."""
        R, p = self._pose(np.array([t_s]))
        rays = self.lens.unproject(uv_px) @ R[0].T
        distance = np.min([panel.to_plane(p[0], rays)[2] for panel in self._panels], axis=0)
        return np.asarray(p[0] + np.where(np.isfinite(distance), distance, np.nan)[:, None] * rays)

    def project(self, points_m: FloatArray, t_s: float) -> FloatArray:
        """Pixels of world points at `t_s`, shape (n, 2); nan where not in view (hidden ones are given)."""
        R, p = self._pose(np.array([t_s]))
        uv, inside = self.lens.project((points_m - p[0]) @ R[0])
        return np.where(inside[:, None], uv, np.nan)

    def _expose(self, t_s: float) -> npt.NDArray[np.float32]:
        R, p = self._pose(np.array([t_s]))
        rays = self._rays @ R[0].T.astype(np.float32)
        nearest = np.full(self._blind.shape, np.inf, np.float32)
        picture = np.full(self._blind.shape, 60.0, np.float32)
        for panel, texture in zip(self._panels, self._textures, strict=True):
            right, down, distance = panel.to_plane(p[0], rays)
            front = distance < nearest
            if not front.any():
                continue
            at = [np.where(front, m / panel.texel_m - 0.5, -1.0).astype(np.float32) for m in (right, down)]
            seen = cv2.remap(texture, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            picture[front] = seen[front]
            nearest[front] = distance[front]
        picture[self._blind] = 0.0
        return picture


def _texture(panel: Panel, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Overlapping grey patches of many sizes, slightly blurred: corners everywhere, at every scale."""
    shape = (int(panel.size_m[1] / panel.texel_m) + 1, int(panel.size_m[0] / panel.texel_m) + 1)
    image = np.full(shape, 120.0, np.float32)
    for _ in range(900):
        size = np.exp(rng.uniform(np.log(10), np.log(max(shape) / 6)))
        centre = (rng.uniform(0, shape[1]), rng.uniform(0, shape[0]))
        box = (centre, (size, size * rng.uniform(0.4, 1.6)), float(rng.uniform(0, 180)))
        cv2.fillConvexPoly(image, np.round(cv2.boxPoints(box)).astype(np.int32), float(rng.uniform(20, 235)))
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.3), np.float32)
