"""The page of `vical compare --report`: verdict, differences in joint sigmas, maps over the image in px."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.report import page
from vical_daemon.results.report.figures import INK, SOFT, Drawing, X, Z, style
from vical_daemon.results.report.provenance import Provenance
from vical_daemon.results.report.verdict import Verdict
from vical_daemon.results.report.writer import Gallery, ReportError, provenance_section
from vical_daemon.service.atomic_file import write_output

_WITHIN_Z = 2.0  # joint sigmas; marked for the eye, no verdict depends on it
_KIND = {"same": "converged", "changed": "inconsistent"}  # their colours
_WORDS = {
    "same": "The same calibration, as far as the two can tell.",
    "changed": "Not the same calibration.",
    "not comparable": "These two cannot be compared.",
}
_SCALE = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "deg"), "s": (1e3, "ms")}


def write_comparison(
    path: Path, document: Mapping[str, Any], sources: tuple[str, str], provenance: Provenance
) -> None:
    """Write the page of one comparison.

    Args:
        path: The HTML file.
        document: As `vical compare --json` prints it.
        sources: What A and B are.
        provenance: What made it.

    Raises:
        ReportError: The file cannot be written.
    """
    gallery = Gallery(None)
    body = [_head(document, sources)]
    for name, camera in document["cameras"].items():
        if camera.get("reason"):
            body.append(page.section(name, page.warning(camera["reason"])))
            continue
        body += _camera(name, camera, gallery)
    if document["imu"] is not None:
        text = page.note("Biases walk from day to day. They are not part of the verdict.")
        body.append(page.section("IMU biases", page.table(_HEAD[:-1], _rows(document["imu"])), text))
    if document["notes"]:
        body.append(page.section("Assumed", *(page.note(note) for note in document["notes"])))
    body.append(provenance_section(provenance))
    try:
        write_output(path, page.document("Two calibrations compared", body))
    except OSError as error:
        raise ReportError(f"{path}: cannot write the report: {error.strerror or error}") from error


def _head(document: Mapping[str, Any], sources: tuple[str, str]) -> str:
    known, advice = [], []
    for name, camera in document["cameras"].items():
        if camera.get("reason"):
            continue
        changed = f"differs in {', '.join(camera['changed'])}" if camera["changed"] else "no difference"
        chance = "less than 1e-300" if camera["probability"] < 1e-300 else f"{camera['probability']:.2g}"
        known.append(
            f"{name}: {changed} (chi-square {camera['chi_square']:.1f} over {camera['dof']}, "
            f"by chance {chance})"
        )
        if camera["lens_held_by"]:
            held, free = ("A", "B") if camera["lens_held_by"] == "a" else ("B", "A")
            px = camera["lens_held_off_px"]
            off = "" if px is None else f" (by its images {px:.2f} px RMS off)"
            advice.append(
                f"{held} held its lens at given values{off}, {free} estimated it. Mounting and time shift "
                "differ with the lens: compare two of the same lens to see them alone."
            )
        if camera["common_s"] > 1.0:
            advice.append(f"{camera['common_s']:.0f} s of data are in both, and counted once.")
    verdict = document["verdict"]
    said = Verdict(_WORDS[verdict], known, advice)
    facts = (f"A: {sources[0]}", f"B: {sources[1]}", f"changed: by chance below {document['false_alarm']:g}")
    return page.head("Two calibrations compared", verdict, said, facts, _KIND.get(verdict, "unknown"))


def _camera(name: str, camera: Mapping[str, Any], gallery: Gallery) -> list[str]:
    rows = camera["directions"]
    parts = [
        gallery.add(f"{name}-directions", directions_figure(rows), "difference in joint sigmas"),
        page.table(_HEAD, [_direction_row(row) for row in rows]),
        page.note(
            "Position and rotation along the directions in which the two together know them best and worst: "
            f"position in the imu frame, rotation in the camera frame. Up to {_WITHIN_Z:g} joint sigmas a "
            "difference is no more than what both calibrations leave open."
        ),
    ]
    if "lens_px" in camera:
        px = f"{camera['lens_px']:.2f} ± {camera['lens_px_sigma']:.2f} px"
        parts.append(page.note(f"The lenses alone differ by {px}, RMS over the image."))
    sections = [page.section(f"{name}: the difference", *parts)]
    maps = [
        gallery.add(
            f"{name}-map-{i}",
            map_figures(m, camera["maps"]),
            f"projections of points at {m['distance_m']:g} m",
            f"Points at {m['distance_m']:g} m: {_px(m['apart_px'])} apart; "
            f"beyond what the sigmas allow {_px(m['least_px'])}.",
        )
        for i, m in enumerate(camera["maps"])
    ]
    if maps:
        text = page.note(
            "First: how far apart A and B project a point that is fixed to the IMU, over the image of A. "
            "Second: the least difference that the sigmas of both allow, 0 if the verdict is `same`."
        )
        sections.append(page.section(f"{name}: in the image", *maps, text))
    return sections


def directions_figure(rows: Sequence[Mapping[str, Any]]) -> Drawing:
    """Draw each difference in joint sigmas; the band holds what both calibrations leave open."""
    width, left, height = 4.8, 1.6, 0.26 * len(rows) + 0.85
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((left / width, 0.5 / height, 1 - (left + 0.15) / width, 1 - 0.85 / height))
    z = np.array([row["z"] for row in rows])
    places = np.arange(len(rows))
    axes.axvspan(-_WITHIN_Z, _WITHIN_Z, color=SOFT, alpha=0.2, linewidth=0)
    axes.axvline(0.0, color=INK, linewidth=0.8)
    axes.hlines(places, 0.0, z, color=SOFT, linewidth=1.0)
    axes.scatter(z, places, c=[Z if abs(x) < _WITHIN_Z else X for x in z], s=26, zorder=3)
    reach = 1.15 * max(3.0, float(np.abs(z).max()))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks(places, [row["name"] for row in rows])
    style(axes, "Difference", "joint sigmas; band: left open by both")
    return [figure]


def map_figures(m: Mapping[str, Any], all_maps: Sequence[Mapping[str, Any]]) -> Drawing:
    """Draw one distance: the difference as it is, and beyond the sigmas, on the scale of all distances."""
    uv = np.array(m["uv_px"], dtype=np.float64)
    top = max(float(np.nanmax(np.array(x["apart_px"], dtype=np.float64))) for x in all_maps)
    figures = []
    for key, title in (("apart_px", "As they are, px"), ("least_px", "Beyond what the sigmas allow, px")):
        figures.append(_heat(uv, np.array(m[key], dtype=np.float64), title, max(top, 1e-9)))
    return figures


def _heat(uv: FloatArray, px: FloatArray, title: str, top: float) -> Figure:
    du, dv = uv[0, 1, 0] - uv[0, 0, 0], uv[1, 0, 1] - uv[0, 0, 1]
    width = 4.8
    shown = width - 0.75
    size = uv[-1, -1] + (du, dv)
    height = shown * float(size[1] / size[0]) + 0.75
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0.6 / width, 0.4 / height, shown / width, 1 - 0.75 / height))
    extent = (-du / 2, uv[-1, -1, 0] + du / 2, uv[-1, -1, 1] + dv / 2, -dv / 2)
    axes.imshow(px, extent=extent, cmap="magma_r", vmin=0.0, vmax=top, aspect="equal")
    for (u, v), value in zip(uv.reshape(-1, 2), px.ravel(), strict=True):
        if math.isfinite(value):
            colour = "#ffffff" if value > 0.5 * top else "#000000"
            axes.text(u, v, _short(value), ha="center", va="center", fontsize=7, color=colour)
    style(axes, title, "u, px", "v, px")
    axes.grid(visible=False)
    return figure


_HEAD = ("", "B minus A", "joint sigma", "z", "direction")


def _direction_row(row: Mapping[str, Any]) -> tuple[str, ...]:
    scale, unit = _SCALE.get(row["unit"], (1.0, row["unit"]))
    axis = "" if row["axis"] is None else "\u00a0".join(f"{x:+.2f}" for x in row["axis"])
    values = (f"{scale * row['value']:+.3g}\u00a0{unit}", f"{scale * row['sigma']:.2g}\u00a0{unit}")
    return (row["name"], *(v.strip() for v in values), f"{row['z']:+.1f}", axis)


def _rows(imu: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, d in imu["differences"].items():
        label, _, unit = name.rpartition("_")
        unit = {"rps": "rad/s", "mps2": "m/s²"}[unit]
        values = (f"{d:+.5f}\u00a0{unit}", f"{imu['joint_sigma'][name]:.5f}\u00a0{unit}")
        rows.append(
            (label.replace("_", " ").replace("accel ", "accelerometer "), *values, f"{imu['z'][name]:+.1f}")
        )
    return rows


def _px(values: Sequence[Sequence[float]]) -> str:
    px = np.array(values, dtype=np.float64)
    return f"{np.sqrt(np.nanmean(px**2)):.2f} px RMS, {np.nanmax(px):.2f} at most"


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 0.0995 else f"{value:.2f}"
