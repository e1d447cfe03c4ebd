"""Writes the report: figures as data URIs in one HTML file, optionally also as PNG files."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.report import page, values
from vical_daemon.results.report.provenance import Provenance, collect
from vical_daemon.results.report.residuals import CameraResiduals, FrameResiduals, cells, gather

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ReportError(ValueError):
    """The report cannot be made or written; the message has the reason."""


@dataclass(frozen=True, slots=True)
class ClockSeries:
    """How a device's samples arrived against its fitted clock.

    Attributes:
        name: Of the device.
        t_s: Time of each sample, s, shape (n,).
        residual_us: Arrival minus fitted time, us, shape (n,).
    """

    name: str
    t_s: FloatArray
    residual_us: FloatArray


class _Gallery:
    """Renders figures once: into the page as SVG and, where asked for, into a folder as PNG."""

    def __init__(self, png_folder: Path | None) -> None:
        self._folder = png_folder

    def add(self, name: str, drawn: Figure, alt: str, caption: str = "") -> str:
        from matplotlib import rc_context

        if self._folder is not None:
            drawn.savefig(self._folder / f"{name}.png", dpi=130)
        stream = io.BytesIO()
        with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):  # text stays text; files repeat
            drawn.savefig(stream, format="svg", dpi=150, metadata={"Date": None})
        encoded = base64.b64encode(stream.getvalue()).decode("ascii")
        return page.figure(f"data:image/svg+xml;base64,{encoded}", alt, caption)


def write_report(
    path: Path,
    result: Mapping[str, Any],
    frames: Sequence[FrameResiduals] | None = None,
    *,
    image_sizes: Mapping[str, tuple[int, int]] | None = None,
    clocks: Sequence[ClockSeries] = (),
    provenance: Provenance | None = None,
    png_folder: Path | None = None,
    title: str = "Camera-IMU calibration",
) -> None:
    """Write the report of one calibration.

    Args:
        path: The HTML file.
        result: The document of `vical calibrate --json`, with `trace` (of the first camera, or a
            dictionary of traces by camera name).
        frames: Residuals of every frame; None: the report says that they were not kept.
        image_sizes: width, height by camera; None: `resolution` in the result, else from the points.
        clocks: Arrival against fitted clock, per device.
        provenance: What made the result; None: collected now, without inputs.
        png_folder: Figures also as PNG files there (made where it does not exist).
        title: Heading.

    Raises:
        ReportError: No camera in the result, or the file cannot be written.
    """
    cameras = result.get("cameras") or {}
    if not cameras:
        raise ReportError(
            f"no report: the calibration has no solution ({result.get('reason') or 'too little data'})"
        )
    try:
        if png_folder is not None:
            png_folder.mkdir(parents=True, exist_ok=True)
        gallery = _Gallery(png_folder)
        body = [_head(result, title), page.warnings(values.warnings_of(dict(result)))]
        for name, camera in cameras.items():
            points = gather(frames or (), name)
            size = _image_size(name, camera, points, image_sizes or {})
            body += _camera_sections(name, camera, _trace(result, name), points, size, gallery)
        body += _inputs_section(result)
        body.append(page.section("IMU and gravity", page.table(values.HEAD, values.imu_rows(dict(result)))))
        body += _clock_section(clocks, gallery)
        body.append(_provenance_section(provenance or collect()))
        path.write_text(page.document(title, body), encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{path}: cannot write the report: {error.strerror or error}") from error


def _head(result: Mapping[str, Any], title: str) -> str:
    facts = [f"{float(result.get('duration_s') or 0):.1f} s of data"]
    facts += [f"{int(result[k])} {label}" for k, label in _COUNTS if result.get(k)]
    if result.get("cpu_s"):
        facts.append(f"{float(result['cpu_s']):.1f} s of CPU")
    facts.append(f"{100 * float(result.get('rejected_fraction') or 0):.2f} % of the points refused")
    facts.append(f"NIS per degree of freedom {float(result.get('nis_per_dof') or 0):.2f}")
    return page.header(title, str(result.get("status", "unknown")), str(result.get("reason") or ""), facts)


_COUNTS = (("frames", "frames"), ("imu_samples", "inertial samples"))


def _trace(result: Mapping[str, Any], camera: str) -> list[dict[str, Any]]:
    trace = result.get("trace") or []
    if isinstance(trace, dict):
        trace = trace.get(camera) or []
    return [p for p in trace if p.get("camera", camera) == camera]


def _image_size(
    name: str, camera: Mapping[str, Any], points: CameraResiduals | None, sizes: Mapping[str, tuple[int, int]]
) -> tuple[int, int]:
    size = sizes.get(name) or camera.get("resolution")
    if size:
        return int(size[0]), int(size[1])
    if points is not None:
        return int(points.uv_px[:, 0].max()) + 2, int(points.uv_px[:, 1].max()) + 2
    return 640, 480


def _camera_sections(
    name: str,
    camera: Mapping[str, Any],
    trace: list[dict[str, Any]],
    points: CameraResiduals | None,
    size: tuple[int, int],
    gallery: _Gallery,
) -> list[str]:
    from vical_daemon.results.report import figures

    covariance = np.array(camera["T_imu_cam"]["covariance"], dtype=np.float64).reshape(6, 6)
    extrinsics = page.side_by_side(
        page.table(values.HEAD, values.camera_rows(dict(camera))),
        gallery.add(f"{name}-correlation", figures.correlation(covariance), "correlation of T_imu_cam"),
    )
    parts = [
        page.section(f"{name}: where it sits and how late it is", extrinsics),
        page.section(f"{name}: lens", page.table(values.HEAD, values.lens_rows(dict(camera)))),
    ]
    if len(trace) > 1:
        drawn = [
            gallery.add(
                f"{name}-convergence", figures.convergence(trace), "convergence",
                "Bands are one sigma, as the filter stated them at that moment.",
            ),
            gallery.add(f"{name}-sigmas", figures.sigmas(trace), "standard deviations over time"),
        ]  # fmt: skip
        parts.append(page.section(f"{name}: convergence", *drawn))
    consistency = gallery.add(f"{name}-nis", figures.consistency(points, trace), "consistency")
    parts.append(page.section(f"{name}: consistency", consistency))
    parts.append(page.section(f"{name}: residuals", *_residual_figures(name, camera, points, size, gallery)))
    return parts


def _residual_figures(
    name: str,
    camera: Mapping[str, Any],
    points: CameraResiduals | None,
    size: tuple[int, int],
    gallery: _Gallery,
) -> list[str]:
    from vical_daemon.results.report import figures

    if points is None or not points.accepted.any():
        return ["<p>The residuals of the frames were not kept.</p>"]
    cell_map = cells(points, size)
    sigma = float(camera.get("corner_sigma_px") or 0.0) or points.rms_px
    facts = (
        f"{len(points.ids)} points in {len(points.frame_t_s)} frames, "
        f"{np.count_nonzero(~points.accepted)} refused; RMS {points.rms_px:.3f} px per axis; "
        f"{100 * cell_map.coverage:.0f} % of the image's cells have points."
    )
    empty = "" if cell_map.coverage > 0.6 else _COVERAGE_HINT
    return [
        f"<p>{facts}</p>",
        page.warnings([empty] if empty else []),
        gallery.add(
            f"{name}-map", figures.residual_map(cell_map, size), "residuals over the image",
            "Arrows with a pattern mean a wrong lens model; dark cells: blur or too few points.",
        ),
        gallery.add(f"{name}-scatter", figures.residual_scatter(points, sigma), "residuals"),
        gallery.add(f"{name}-frames", figures.frame_rms(points), "residuals by frame"),
    ]  # fmt: skip


_COVERAGE_HINT = (
    "Large parts of the image never saw the board: move it into the corners to pin the lens down."
)


def _inputs_section(result: Mapping[str, Any]) -> list[str]:
    """Of several recordings, what each gave; the time axis of the figures runs on over all of them."""
    if not result.get("inputs"):
        return []
    rows = []
    for part in result["inputs"]:
        biases = [part.get("gyro_bias_rps") or [], part.get("accel_bias_mps2") or []]
        texts = [
            "  ".join(f"{v:.{digits}f}" for v in bias) for bias, digits in zip(biases, (6, 4), strict=True)
        ]
        frames = str(part["frames"]) if part["used"] else "not in the result"
        rows.append((part["path"], f"{part['begin_s']:.1f}", f"{part['duration_s']:.1f}", frames, *texts))
    head = ("recording", "begins, s", "length, s", "frames", "gyro bias, rad/s", "accelerometer bias, m/s²")
    return [page.section("Recordings", page.table(head, rows, numeric_from=1))]


def _clock_section(clocks: Sequence[ClockSeries], gallery: _Gallery) -> list[str]:
    from vical_daemon.results.report import figures

    drawn = [
        gallery.add(f"clock-{c.name}", figures.clock(c.t_s, c.residual_us, c.name), f"clock of {c.name}")
        for c in clocks
        if len(c.t_s) > 1
    ]
    return [page.section("Clocks", *drawn)] if drawn else []


def _provenance_section(provenance: Provenance) -> str:
    parts = []
    if provenance.command:
        parts.append(page.preformatted(provenance.command))
    if provenance.files:
        rows = [(name, f"{size:,}", digest) for name, size, digest in provenance.files]
        parts.append(page.table(("input", "bytes", "SHA-256"), rows, numeric_from=9))
    if provenance.settings:
        settings = [(name, value or "nothing") for name, value in provenance.settings.items()]
        parts.append(page.table(("setting", "value"), settings, numeric_from=9))
    versions = ", ".join(f"{k} {v}" for k, v in provenance.versions.items())
    parts.append(f'<p class="note">Made {provenance.made_at} with {versions}.</p>')
    return page.section("To reproduce", *parts)
