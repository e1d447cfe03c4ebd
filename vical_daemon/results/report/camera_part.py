"""The part of the report about one camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.geometry.camera_model import RADTAN
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.tools.projection_uncertainty import over_image
from vical_daemon.results.report import coverage_figures, figures, page, scene, values, worst
from vical_daemon.results.report.board_views import BoardView, board_views
from vical_daemon.results.report.residuals import FrameResiduals, cells, gather
from vical_daemon.results.report.verdict import joint_covariance, limits

if TYPE_CHECKING:
    from vical_daemon.results.report.writer import Gallery, Images

_DISTANCES = ((1.0, "1 m"), (float("inf"), "infinity"))
_COVERED = 0.6  # share of the image's cells with corners below which the lens is extrapolated
_COVERAGE_HINT = "Large parts of the image have not seen the board: move it into the corners, for the lens."


class CameraPart:
    """Makes the sections of one camera; what the result does not hold is left out.

    Args:
        result: The document of `vical calibrate --json`.
        name: Of the camera.
        frames: Residuals of every frame, of all cameras.
        size: width, height of the images; None: as the result or the points have it.
        target_m: Points of the board by id, m, shape (n, 3); None: not known.
        images: Where images come from; None: nowhere.
        gallery: Renders the figures.
    """

    def __init__(
        self,
        result: Mapping[str, Any],
        name: str,
        frames: Sequence[FrameResiduals],
        size: tuple[int, int] | None,
        target_m: FloatArray | None,
        images: Images | None,
        gallery: Gallery,
    ) -> None:
        self.result, self.name, self.frames = result, name, frames
        self.camera: dict[str, Any] = dict(result["cameras"][name])
        self.target_m, self.images, self.gallery = target_m, images, gallery
        self.points = gather(frames, name)
        self.size = self._size(size)
        self.K = np.array(self.camera["intrinsics"], dtype=np.float64)
        self.D = np.array(self.camera["distortion"], dtype=np.float64)
        self.model = str(self.camera.get("distortion_model") or RADTAN)
        pose = self.camera["T_imu_cam"]
        self.R = so3.matrix_from_quat(np.array(pose["q_wxyz"], dtype=np.float64))
        self.p = np.array(pose["p_m"], dtype=np.float64)

    def _size(self, size: tuple[int, int] | None) -> tuple[int, int]:
        known = size or self.camera.get("resolution")
        if known and known[0]:
            return int(known[0]), int(known[1])
        if self.points is not None:
            return int(self.points.uv_px[:, 0].max()) + 2, int(self.points.uv_px[:, 1].max()) + 2
        return 640, 480

    @cached_property
    def views(self) -> list[BoardView]:
        """Where the board was; empty where it is not known."""
        if self.target_m is None:
            return []
        return board_views(self.frames, self.name, self.target_m, self.K, self.D, self.model)

    def sections(self) -> list[str]:
        """Return the sections, the most important first."""
        return [
            self._mounting(),
            self._limits(),
            *self._projection(),
            *self._coverage(),
            self._lens(),
            *self._convergence(),
            self._residuals(),
            *self._worst(),
        ]

    def _mounting(self) -> str:
        covariance = np.array(self.camera["T_imu_cam"]["covariance"], dtype=np.float64).reshape(6, 6)
        imu = str((self.result.get("imu") or {}).get("name") or "imu")
        R, p, cam = self.R, self.p, self.name
        drawn = self.gallery.add(f"{cam}-correlation", figures.correlation(covariance), "correlation")
        return page.section(
            f"{cam}: mounting and time shift",
            page.side_by_side(page.table(values.HEAD, values.camera_rows(self.camera)), drawn),
            page.note(f"Pose of {cam} in the frame of {imu}, m: maps points of {cam} to {imu}."),
            page.copyable(values.matrix_text(R, p, f"T_{imu}_{cam}")),
            page.note(
                f"Pose of {imu} in the frame of {cam}, m: maps points of {imu} to {cam} (Kalibr's T_cam_imu)."
            ),
            page.copyable(values.matrix_text(R.T, -R.T @ p, f"T_{cam}_{imu}")),
            page.scene(scene.scene(self.camera["T_imu_cam"], self.target_m, self.views)),
        )

    def _limits(self) -> str:
        rows = limits(self.result, self.camera)
        return page.section(
            f"{self.name}: what limits the accuracy", page.table(("cause", "size", ""), rows, 9)
        )

    def _projection(self) -> list[str]:
        order, covariance = joint_covariance(self.camera)
        if not order:
            return []
        maps, words = [], []
        for distance, title in _DISTANCES:
            sigma = over_image(self.size, distance, self.R, self.K, self.D, self.model, order, covariance)
            if not np.isfinite(sigma).any() or not np.nanmax(sigma) > 0:
                continue
            maps.append((f"Point at {title}: sigma, px", sigma))
            middle = sigma[sigma.shape[0] // 2, sigma.shape[1] // 2]
            words.append(f"at {title} {middle:.2g} px in the middle, {np.nanmax(sigma):.2g} px at worst")
        if not maps:
            return []
        text = (
            "Uncertainty of the pixel of a point that is fixed to the IMU, one sigma in the worst direction, "
            f"from the covariance of mounting and lens: {'; '.join(words)}."
        )
        name = f"{self.name}-projection"
        drawn = self.gallery.add(name, coverage_figures.projection(maps, self.size), "projection uncertainty")
        return [page.section(f"{self.name}: projection uncertainty", f"<p>{text}</p>", drawn)]

    def _coverage(self) -> list[str]:
        if len(self.views) < 2:
            return []
        distance = [v.distance_m for v in self.views]
        tilt = np.degrees([v.tilt_rad for v in self.views])
        text = (
            f"The board was {min(distance):.2f} to {max(distance):.2f} m away and tilted by "
            f"{tilt.min():.0f}° to {tilt.max():.0f}° (half of the images: above {np.median(tilt):.0f}°);"
            f" {len(self.views)} images."
        )
        drawn = self.gallery.add(
            f"{self.name}-poses", coverage_figures.poses(self.views), "poses of the board"
        )
        return [page.section(f"{self.name}: poses of the board", f"<p>{text}</p>", drawn)]

    def _lens(self) -> str:
        return page.section(f"{self.name}: lens", page.table(values.HEAD, values.lens_rows(self.camera)))

    def _convergence(self) -> list[str]:
        from vical_daemon.results.report.writer import trace_of

        trace = trace_of(self.result, self.name)
        sections = []
        if len(trace) > 1:
            drawn = [
                self.gallery.add(
                    f"{self.name}-convergence", figures.convergence(trace), "convergence",
                    "Bands are one sigma, as the filter stated them at that moment.",
                ),
                self.gallery.add(f"{self.name}-sigmas", figures.sigmas(trace), "sigmas over time"),
            ]  # fmt: skip
            sections.append(page.section(f"{self.name}: convergence", *drawn))
        consistency = self.gallery.add(
            f"{self.name}-nis", figures.consistency(self.points, trace), "consistency"
        )
        return [*sections, page.section(f"{self.name}: consistency", consistency)]

    def _residuals(self) -> str:
        title, points = f"{self.name}: residuals and image coverage", self.points
        if points is None or not points.accepted.any():
            return page.section(title, "<p>The residuals of the frames were not kept.</p>")
        cell_map = cells(points, self.size)
        sigma = float(self.camera.get("corner_sigma_px") or 0.0) or points.rms_px
        facts = (
            f"{len(points.ids)} points in {len(points.frame_t_s)} frames, "
            f"{np.count_nonzero(~points.accepted)} refused; RMS {points.rms_px:.3f} px per axis; "
            f"{100 * cell_map.coverage:.0f} % of the image's cells have points."
        )
        add, name = self.gallery.add, self.name
        return page.section(
            title,
            f"<p>{facts}</p>",
            "" if cell_map.coverage > _COVERED else page.warning(_COVERAGE_HINT),
            add(
                f"{name}-map", figures.residual_map(cell_map, self.size), "residuals over the image",
                "Arrows with a pattern mean a wrong lens model; dark cells: blur or too few points.",
            ),
            add(f"{name}-scatter", figures.residual_scatter(points, sigma), "residuals"),
            add(f"{name}-frames", figures.frame_rms(points), "residuals by frame"),
        )  # fmt: skip

    def _worst(self) -> list[str]:
        chosen = worst.worst_frames(self.frames, self.name)
        if not chosen:
            return []
        stamps = [frame.t_ns for frame in chosen]
        found = self.images(self.name, stamps) if self.images is not None else {}
        begin_ns = min(frame.t_ns for frame in self.frames if frame.camera == self.name)
        shots = page.grid(worst.drawn(frame, self.size, begin_ns, found) for frame in chosen)
        text = "Times since the first image. Green: used corners; red: rejected ones."
        return [page.section(f"{self.name}: the images with the largest residuals", page.note(text), shots)]
