"""A comparison of two calibrations in words and columns."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.offline.compare import CameraComparison, Comparison
from vical_daemon.results.compare import FALSE_ALARM
from vical_daemon.results.difference import Difference
from vical_daemon.results.pixel_map import PixelMap

_OPEN_Z = 2.0  # joint sigmas; smaller differences are marked for the eye, no verdict depends on it


def describe(comparison: Comparison, *, with_map: bool) -> str:
    """Return the text of a comparison."""
    lines: list[str] = []
    for camera in comparison.cameras:
        lines += [*_camera(camera, with_map=with_map), ""]
    if comparison.imu is not None:
        lines += [*_imu(*comparison.imu), ""]
    lines += [f"note: {note}" for note in comparison.notes]
    return "\n".join(lines).rstrip()


def _camera(camera: CameraComparison, *, with_map: bool) -> list[str]:
    name = camera.names[0] if camera.names[0] == camera.names[1] else " and ".join(camera.names)
    apart, verdict = camera.difference, camera.verdict
    if apart is None or verdict is None:
        return [f"{name}: not comparable: {camera.why}"]
    chance = f"= {verdict.probability:.2g}" if verdict.probability > 1e-300 else "< 1e-300"
    what = f"changed: {', '.join(verdict.blocks)}" if verdict.changed else "same"
    lines = [
        f"{name}: {what}",
        f"  chi-square {verdict.chi_square:.1f} over {verdict.dof} degrees of freedom, p {chance} "
        f"(changed below {FALSE_ALARM:g})",
    ]
    if apart.common_s > 1.0:
        lines.append(f"  {apart.common_s:.0f} s of data are in both, and counted once")
    lines += ["", f"  {'':<14}{'B minus A':>12}{'sigma':>11}{'z':>13}"]
    lines += _rows(apart)
    if apart.unlike_px > 0.0:
        lines.append(
            f"  lenses of two models, compared as {apart.model}: the fit leaves {apart.unlike_px:.2f} px RMS"
        )
    lines += _about_the_lens(camera)
    for m in camera.maps:
        lines += ["", *_pixels(m, full=with_map)]
    if abs(apart.d[6]) > 0.0 and apart.a.lens is not None:
        px = abs(apart.d[6]) * float(apart.a.lens[0])
        lines.append(f"  the time shifts differ by {px:.2g} px at a rotation rate of 1 rad/s")
    return lines


def _rows(apart: Difference) -> list[str]:
    lines = []
    for block, labels, unit, scale, digits in _table(apart):
        for k, label in labels:
            d, sigma = scale * apart.d[k], scale * apart.sigma[k]
            z = apart.d[k] / apart.sigma[k]
            left_open = "  within 2 sigma" if abs(z) < _OPEN_Z else ""
            name = f"{block} {label}".strip()
            lines.append(f"  {name:<14}{d:>+12.{digits}f}{sigma:>11.{digits}f} {unit:<4}{z:>8.1f}{left_open}")
    return lines


def _table(apart: Difference) -> list[tuple[str, list[tuple[int, str]], str, float, int]]:
    """Block, (index, label) of its errors, unit, scale and digits."""
    table: list[tuple[str, list[tuple[int, str]], str, float, int]] = [
        ("position", list(zip((0, 1, 2), "xyz", strict=True)), "mm", 1e3, 2),
        ("rotation", list(zip((3, 4, 5), "xyz", strict=True)), "deg", float(np.rad2deg(1.0)), 3),
        ("time shift", [(6, "")], "ms", 1e3, 3),
    ]
    if apart.has_lens:
        table.append(("", list(enumerate(("fx", "fy", "cx", "cy"), 7)), "px", 1.0, 2))
        table.append(("", list(enumerate(COEFFICIENTS[apart.model], 11)), "", 1.0, 5))
    return table


def _about_the_lens(camera: CameraComparison) -> list[str]:
    """A lens that was held in one of them and estimated in the other: that is what differs first of all."""
    if camera.lens_px is None:
        return []
    px = f"{camera.lens_px[0]:.2f} ± {camera.lens_px[1]:.2f} px RMS over the image"
    if not camera.held:
        return ["", f"  the lenses alone differ by {px}"]
    held, free = ("A", "B") if camera.held == "a" else ("B", "A")
    off = "" if camera.held_off_px is None else f" (by its images {camera.held_off_px:.2f} px RMS off)"
    return [
        "",
        f"  {held} held its lens at given values{off}, {free} estimated it.",
        f"  The lenses alone differ by {px}.",
        "  Mounting and time shift differ with the lens; compare two of the same lens to see them alone.",
    ]


def _pixels(m: PixelMap, *, full: bool) -> list[str]:
    """The map of one distance: two figures, or all of them."""
    at = f"at {m.distance_m:g} m"
    head = (
        f"  {at}: projections differ by {_rms(m.apart_px):.2f} px RMS, {np.nanmax(m.apart_px):.2f} at most; "
        f"beyond what both sigmas allow: {_rms(m.least_px):.2f} and {np.nanmax(m.least_px):.2f} px"
    )
    if not full:
        return [head]
    if not m.least_px.any():
        return [head, *("  " + "".join(f"{x:8.2f}" for x in row) for row in m.apart_px)]
    lines = [head, f"  {'px, over the image':<{8 * m.apart_px.shape[1] + 2}}  beyond what both sigmas allow"]
    for all_px, least_px in zip(m.apart_px, m.least_px, strict=True):
        lines.append(
            "  " + "".join(f"{x:8.2f}" for x in all_px) + "  |" + "".join(f"{x:8.2f}" for x in least_px)
        )
    return lines


def _rms(px: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(px**2)))


def _imu(d: FloatArray, sigma: FloatArray) -> list[str]:
    lines = ["IMU biases (they walk: not part of the verdict)"]
    for k, (name, axis) in enumerate((n, axis) for n in ("gyro bias", "accel. bias") for axis in "xyz"):
        unit = "rad/s" if k < 3 else "m/s^2"
        lines.append(
            f"  {name + ' ' + axis:<14}{d[k]:>+12.5f}{sigma[k]:>11.5f} {unit:<5}{d[k] / sigma[k]:>7.1f}"
        )
    return lines
