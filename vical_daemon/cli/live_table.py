"""The live picture of a calibration, for `vical demo` and `vical watch`: estimate ± sigma and status."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate
from vical_daemon.estimation.wording import digits_that_show
from vical_daemon.results.euler import euler_deg, euler_sigma_deg

if TYPE_CHECKING:
    from rich.console import RenderableType

Row = tuple[str, str, str, str]  # name, estimate, sigma, unit
Estimates = Mapping[tuple[str, str], CalibrationEstimate]  # by rig and camera
Health = Mapping[tuple[str, str], tuple[str, str]]  # by rig and component: level and message
_LEVELS = {"ok": "green", "warn": "yellow", "error": "red", "stale": "red"}


def rows(camera: CameraEstimate) -> list[Row]:
    """Return name, estimate, sigma and unit of everything that is estimated about one camera."""
    pose = camera.T_imu_cam
    sigma = [math.sqrt(max(pose.covariance[i][i], 0.0)) for i in range(6)]
    table = [
        (f"position {axis}", *_with_sigma(1e3 * p, 1e3 * s, 2), "mm")
        for axis, p, s in zip("xyz", pose.p_m, sigma[:3], strict=True)
    ]
    angles, angle_sigmas = euler_deg(pose.q_wxyz), euler_sigma_deg(pose.q_wxyz, pose.covariance)
    table += [
        (name, *_with_sigma(angle, s, 3), "deg")
        for name, angle, s in zip(("roll", "pitch", "yaw"), angles, angle_sigmas, strict=True)
    ]
    shift, shift_sigma = camera.timeshift_cam_imu_s, camera.timeshift_sigma_s
    table.append(("time shift", *_with_sigma(1e3 * shift, 1e3 * shift_sigma, 3), "ms"))
    if any(camera.intrinsics_sigma):
        for name, value, s in zip(
            ("fx", "fy", "cx", "cy"), camera.intrinsics, camera.intrinsics_sigma, strict=True
        ):
            table.append((name, *_with_sigma(value, s, 2), "px"))
    return table


def _with_sigma(value: float, sigma: float, digits: int) -> tuple[str, str]:
    shown = digits_that_show(sigma, digits)
    return f"{value:.{shown}f}", f"{sigma:.{shown}f}"


def one_line(camera: str, estimate: CalibrationEstimate) -> str:
    """Return one line of progress, for logs and pipes."""
    known = estimate.cameras.get(camera)
    text = f"{estimate.duration_s:6.1f} s  {camera}  {estimate.status:<12} {estimate.progress:4.0%}"
    if known is not None:
        sigma_mm = 1e3 * max(math.sqrt(max(known.T_imu_cam.covariance[i][i], 0.0)) for i in range(3))
        digits = digits_that_show(sigma_mm, 1)
        p = " ".join(f"{1e3 * v:.{digits}f}" for v in known.T_imu_cam.p_m)
        shift, shift_sigma = _with_sigma(1e3 * known.timeshift_cam_imu_s, 1e3 * known.timeshift_sigma_s, 2)
        text += f"  p {p} ± {sigma_mm:.{digits}f} mm  shift {shift} ± {shift_sigma} ms"
    return text + (
        f"  {estimate.guidance or estimate.reason}" if estimate.guidance or estimate.reason else ""
    )


def picture(
    camera: str, estimate: CalibrationEstimate, health: list[str], silent_s: float | None = None
) -> RenderableType:
    """Return the table of one camera with a bar and what to do next.

    Args:
        camera: Its name.
        estimate: The last one.
        health: Lines to put below.
        silent_s: How long ago the estimates stopped, s; None: they go on.
    """
    from rich.console import Group
    from rich.padding import Padding
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    table = Table(title=f"{camera} in the imu frame", title_justify="left", box=None, pad_edge=False)
    for name, side in (("", "left"), ("estimate", "right"), ("± sigma", "right"), ("", "left")):
        table.add_column(name, justify=side)  # type: ignore[arg-type]
    known = estimate.cameras.get(camera)
    for row in rows(known) if known is not None else []:
        table.add_row(*row)
    colour = {"converged": "green", "degenerate": "yellow", "inconsistent": "red"}.get(
        estimate.status, "cyan"
    )
    if estimate.reason and colour == "green":  # known, but nothing follows it now
        colour = "yellow"
    stale = "" if silent_s is None else f"stale, {silent_s:.0f} s old, was "
    head = Text.assemble(
        (f"{stale}{estimate.status}", f"bold {'red' if stale else colour}"),
        f"  {estimate.duration_s:.1f} s, {estimate.frames} frames, {estimate.imu_samples} IMU samples, "
        f"NIS/dof {estimate.nis_per_dof:.2f}",
    )
    # padded, it ends its line: what follows would stand on the same line, cut off
    bar = Padding(ProgressBar(total=1.0, completed=min(max(estimate.progress, 0.0), 1.0), width=40), 0)
    advice = Text(estimate.guidance or estimate.reason, style="yellow")
    return Group(head, bar, advice, table, *(Text(line, style="dim") for line in health))


def screen(
    estimates: Estimates, health: Health, silent: Mapping[tuple[str, str], float] | None = None
) -> RenderableType:
    """Return what `vical watch` shows: every camera, then what each component says of itself.

    Args:
        estimates: The last ones.
        health: Level and message of each component.
        silent: Cameras whose estimates have stopped, with the age of the last one, s.
    """
    from rich.console import Group
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    parts: list[RenderableType] = []
    for (rig, camera), estimate in sorted(estimates.items()):
        table_of_camera = picture(camera, estimate, [], (silent or {}).get((rig, camera)))
        parts += [Text(f"rig {rig}", style="bold"), Padding(table_of_camera, (0, 0, 1, 0))]
    if not parts:
        parts.append(Text("waiting for a calibration; is `vical run` (vical.target) running?"))
    table = Table(box=None, pad_edge=False, show_header=False)
    for (rig, name), (level, message) in sorted(health.items()):
        table.add_row(Text(rig, style="dim"), name, Text(level, style=_LEVELS.get(level, "")), message)
    return Group(*parts, table)
