"""Figures of the report on what was seen: poses of the board, projection uncertainty, biases, checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.report.board_views import BoardView
from vical_daemon.results.report.figures import AXES, INK, SOFT, Drawing, Y, Z, band, panels, style

_REACH = 6.0  # times the median: top of the scale of the projection uncertainty


def biases(trace: Sequence[dict[str, Any]]) -> Drawing:
    """Draw the biases of gyro and accelerometer over time, with bands of one sigma."""
    known = [p for p in trace if p.get("gyro_bias_rps")]
    t = np.array([p["t_s"] for p in known])
    figure, ((left, right),) = panels(2.7, 1, 2)
    for axes, key, title in (
        (left, "gyro_bias{}_rps", "Gyro bias, mrad/s"),
        (right, "accel_bias{}_mps2", "Accelerometer bias, mm/s²"),
    ):
        value = 1e3 * np.array([p[key.format("")] for p in known])
        sigma = 1e3 * np.array([p[key.format("_sigma")] for p in known])
        for i, axis in enumerate("xyz"):
            band(axes, t, value[:, i], sigma[:, i], AXES[i], axis)
        late = t >= t[0] + 0.06 * (t[-1] - t[0])
        low, high = (value - sigma)[late], (value + sigma)[late]
        margin = 0.08 * float(high.max() - low.min()) + 1e-9
        axes.set_ylim(float(low.min()) - margin, float(high.max()) + margin)
        axes.legend(fontsize=8, frameon=False, ncols=3, labelcolor=INK)
        style(axes, title, "time, s")
    return figure


def held_out(checks: Sequence[dict[str, float]]) -> Drawing:
    """Draw how well the IMU alone predicted images before they were used."""
    t, ratio = (np.array([c[key] for c in checks]) for key in ("t_s", "ratio"))
    figure, ((axes,),) = panels(2.4, width=4.8)
    axes.plot(t, np.sqrt(ratio), ".", color=Z, markersize=4)
    axes.axhline(1.0, color=INK, linewidth=0.8)
    axes.set_ylim(0, max(2.0, 1.1 * float(np.sqrt(ratio.max()))))
    style(axes, "Errors over the expected ones", "time, s")
    return figure


def poses(views: Sequence[BoardView]) -> Drawing:
    """Draw at which distances and angles the board was seen."""
    distance = np.array([v.distance_m for v in views])
    tilt = np.degrees([v.tilt_rad for v in views])
    normal = np.array([v.normal_cam for v in views])
    figure, ((left, right),) = panels(3.2, 1, 2)
    left.plot(tilt, distance, ".", color=Z, markersize=4, alpha=0.6)
    left.set_xlim(0, 90)
    left.set_ylim(0, 1.15 * float(distance.max()))
    style(left, "Distance against tilt of the board", "tilt, deg", "m")
    across, down = (
        np.degrees(np.arctan2(normal[:, 0], -normal[:, 2])),
        np.degrees(np.arctan2(normal[:, 1], -normal[:, 2])),
    )
    right.plot(across, down, ".", color=Y, markersize=4, alpha=0.6)
    for ring in (15, 30, 45):
        angle = np.linspace(0, 2 * np.pi, 90)
        right.plot(ring * np.cos(angle), ring * np.sin(angle), color=SOFT, linewidth=0.6)
    reach = max(50.0, 1.1 * float(np.abs(np.concatenate([across, down])).max()))
    right.set_xlim(-reach, reach)
    right.set_ylim(reach, -reach)
    right.set_aspect("equal")
    style(right, "Where the board faced (15, 30, 45°)", "left - right, deg", "up - down, deg")
    return figure


def projection(maps: Sequence[tuple[str, FloatArray]], size: tuple[int, int]) -> Drawing:
    """Draw maps of the projection uncertainty, px.

    Args:
        maps: Title and sigma over the image, shape (rows, columns), px.
        size: width, height of the image, px.
    """
    width = 4.8
    figure, (row,) = panels(0.8 + 3.5 * size[1] / size[0], 1, len(maps), width=width * len(maps), right=0.45)
    for axes, (title, sigma) in zip(row, maps, strict=True):
        # Corners where no corner of the board was seen would flatten the rest of the map.
        top = min(float(np.nanmax(sigma)), _REACH * float(np.nanmedian(sigma)))
        extent = (0, size[0], size[1], 0)
        shown = axes.imshow(sigma, extent=extent, cmap="viridis", vmin=0, vmax=top, aspect="equal")
        axes.figure.colorbar(shown, ax=axes).ax.tick_params(labelsize=8, colors=INK)
        centres_x = (np.arange(sigma.shape[1]) + 0.5) * size[0] / sigma.shape[1]
        centres_y = (np.arange(sigma.shape[0]) + 0.5) * size[1] / sigma.shape[0]
        levels = np.linspace(float(np.nanmin(sigma)), top, 6)[1:-1]
        if levels[0] < levels[-1]:
            lines = axes.contour(centres_x, centres_y, sigma, levels=levels, colors="white", linewidths=0.7)
            axes.clabel(lines, fontsize=8, fmt="%.2g")
        style(axes, title)
        axes.grid(visible=False)
    return figure
