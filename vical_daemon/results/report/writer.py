"""Writes the report: one HTML file, figures drawn into it, optionally also as PNG files."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.report import page, values
from vical_daemon.results.report.provenance import Provenance, collect
from vical_daemon.results.report.residuals import FrameResiduals
from vical_daemon.results.report.verdict import verdict
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.results.report.figures import Drawing

Images = Callable[[str, Sequence[int]], Mapping[int, bytes]]
"""Returns JPEG files by stamp, given the camera and the stamps (ns) that are wanted; may leave out any."""

_TITLE = "Camera-IMU calibration"


class ReportError(ValueError):
    """The report cannot be made or written; the message has the reason."""


class Gallery:
    """Renders figures once: into the page as SVG and, where asked for, into a folder as PNG."""

    def __init__(self, png_folder: Path | None) -> None:
        self._folder = png_folder

    def add(self, name: str, drawing: Drawing, alt: str, caption: str = "") -> str:
        """Return a drawing as HTML; `name` is that of its PNG files."""
        from matplotlib import rc_context

        texts = []
        for number, panel in enumerate(drawing, start=1):
            part = f"{name}-{number}" if len(drawing) > 1 else name
            if self._folder is not None:
                panel.savefig(self._folder / f"{part}.png", dpi=130)
            stream = io.BytesIO()
            with rc_context({"svg.fonttype": "none", "svg.hashsalt": part}):  # text stays text; files repeat
                panel.savefig(stream, format="svg", dpi=110, metadata={"Date": None}, transparent=True)
            texts.append(stream.getvalue().decode())
        return page.figure(name, texts, alt, caption)


def write_report(
    path: Path,
    result: Mapping[str, Any],
    frames: Sequence[FrameResiduals] | None = None,
    *,
    image_sizes: Mapping[str, tuple[int, int]] | None = None,
    target_m: FloatArray | None = None,
    images: Images | None = None,
    provenance: Provenance | None = None,
    png_folder: Path | None = None,
) -> None:
    """Write the report of one calibration.

    Args:
        path: The HTML file.
        result: The document of `vical calibrate --json`, with `trace` (of the first camera, or a
            dictionary of traces by camera name).
        frames: Residuals of every frame; None: the report says that they were not kept.
        image_sizes: width, height by camera; None: `resolution` in the result, else from the points.
        target_m: Points of the board by id, target frame, m, shape (n, 3); None: not known, or target-free.
        images: Where the images with the largest residuals come from; None: only their corners are drawn.
        provenance: What made the result; None: collected now, without inputs.
        png_folder: Figures also as PNG files there (made where it does not exist).

    Raises:
        ReportError: No camera in the result, or the file cannot be written.
    """
    from vical_daemon.results.report.camera_part import CameraPart

    cameras = result.get("cameras") or {}
    if not cameras:
        raise ReportError(
            f"no report: the calibration has no solution ({result.get('reason') or 'too little data'})"
        )
    try:
        if png_folder is not None:
            png_folder.mkdir(parents=True, exist_ok=True)
        gallery = Gallery(png_folder)
        body = [_head(result)]
        for name in cameras:
            size = (image_sizes or {}).get(name)
            body += CameraPart(result, name, frames or (), size, target_m, images, gallery).sections()
        body += _inputs_section(result)
        body += _imu_section(result, gallery)
        rows = values.event_rows(result.get("events") or [])
        if rows:
            body.append(page.section("Events", page.table(("time", "event"), rows, 9)))
        body.append(provenance_section(provenance or collect()))
        write_output(path, page.document(_TITLE, body))
    except OSError as error:
        raise ReportError(f"{path}: cannot write the report: {error.strerror or error}") from error


def _head(result: Mapping[str, Any]) -> str:
    facts = [f"{float(result.get('duration_s') or 0):.1f} s of data"]
    facts += [f"{int(result[k])} {label}" for k, label in _COUNTS if result.get(k)]
    if result.get("cpu_s"):
        facts.append(f"{float(result['cpu_s']):.1f} s of CPU")
    facts.append(f"{100 * float(result.get('rejected_fraction') or 0):.2f} % of the points rejected")
    return page.head(_TITLE, str(result.get("status", "unknown")), verdict(result), facts)


_COUNTS = (("frames", "frames"), ("imu_samples", "IMU samples"))


def _imu_section(result: Mapping[str, Any], gallery: Gallery) -> list[str]:
    """Biases now and over time, and the predictions of the IMU alone against its stated noise."""
    from vical_daemon.results.report import coverage_figures

    parts = [page.table(values.HEAD, values.imu_rows(dict(result)))]
    trace = trace_of(result, next(iter(result["cameras"])))
    if sum(bool(point.get("gyro_bias_rps")) for point in trace) > 1:
        drawn = coverage_figures.biases(trace)
        parts.append(gallery.add("biases", drawn, "biases over time", "Bands are one sigma."))
    sections = [page.section("IMU and gravity", *parts)]
    checks = result.get("held_out") or []
    if len(checks) > 1:
        text = values.held_out_text(checks, (result.get("imu") or {}).get("noise"))
        drawn = coverage_figures.held_out(checks)
        check = gallery.add("held-out", drawn, "images predicted by the IMU alone")
        sections.append(page.section("Held-out check, and the IMU against its stated noise", text, check))
    return sections


def trace_of(result: Mapping[str, Any], camera: str) -> list[dict[str, Any]]:
    """Return the trace of one camera; `traces` has those of all where there are several."""
    trace = (result.get("traces") or {}).get(camera) or result.get("trace") or []
    if isinstance(trace, dict):
        trace = trace.get(camera) or []
    return [p for p in trace if p.get("camera", camera) == camera]


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
    return [page.section("Recordings", page.table(head, rows, 1))]


def provenance_section(provenance: Provenance) -> str:
    """Return what is needed to make a page again."""
    parts = []
    if provenance.command:
        parts.append(page.preformatted(provenance.command))
    if provenance.files:
        rows = [(name, f"{size:,}", digest) for name, size, digest in provenance.files]
        parts.append(page.table(("input", "bytes", "SHA-256"), rows, 9))
    if provenance.settings:
        settings = [(name, value or "nothing") for name, value in provenance.settings.items()]
        parts.append(page.table(("setting", "value"), settings, 9))
    versions = ", ".join(f"{k} {v}" for k, v in provenance.versions.items())
    parts.append(page.note(f"Made {provenance.made_at} with {versions}."))
    return page.section("To reproduce", *parts)
