"""The figures of the report, drawn with matplotlib without any window or global state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from scipy.special import chdtr, chdtri

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.results.report.residuals import CameraResiduals, CellMap, per_point_rms

# Okabe and Ito: distinct for the colour-blind, and in grey.
X, Y, Z = "#d55e00", "#009e73", "#0072b2"
AXES, INK, SOFT = (X, Y, Z), "#1d2433", "#8a93a6"
WIDTH = 9.6  # inches
Drawing = list[Figure]
"""Figures of one panel each that belong together."""


def panels(
    height: float,
    rows: int = 1,
    columns: int = 1,
    ratios: Sequence[float] | None = None,
    width: float = WIDTH,
    right: float = 0.12,
) -> tuple[Drawing, npt.NDArray[Any]]:
    """Return figures of one panel each, and their axes, shape (rows, columns), with margins in inches.

    One figure for each panel, so that the page can put them side by side on a desk and one below the other
    on a phone. matplotlib's own layout engine would double the time of every figure.
    """
    left, top, bottom = 0.68, 0.30, 0.45
    shares = np.array(ratios if ratios is not None else [1.0] * columns)
    figures, axes = [], np.empty((rows, columns), dtype=object)
    for row in range(rows):
        for column, share in enumerate(shares / shares.sum()):
            w, h = width * share, height / rows
            figure = Figure(figsize=(w, h))
            box = (left / w, bottom / h, 1 - (left + right) / w, 1 - (top + bottom) / h)
            axes[row, column] = figure.add_axes(box)
            figures.append(figure)
    return figures, axes


def style(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Give a panel its title, labels and colours."""
    axes.set_title(title, loc="left", pad=5, fontsize=10, color=INK, fontweight="bold")
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.grid(visible=True, color="#e3e7ee", linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#c3cad6")


def band(axes: Axes, t: FloatArray, value: FloatArray, sigma: FloatArray, colour: str, label: str) -> None:
    """Draw a curve with its band of one sigma."""
    axes.fill_between(t, value - sigma, value + sigma, color=colour, alpha=0.18, linewidth=0)
    axes.plot(t, value, color=colour, linewidth=1.4, label=label)


def _limit(axes: Axes, t: FloatArray, values: FloatArray, sigmas: FloatArray, share: float) -> None:
    """Set the vertical limits to the bands after the first `share` of the recording.

    The first seconds are known to metres; shown whole, they would flatten everything after them.
    """
    late = t >= t[0] + share * (t[-1] - t[0])
    low, high = values[late] - sigmas[late], values[late] + sigmas[late]
    finite = np.isfinite(low) & np.isfinite(high)
    if finite.any():
        margin = 0.08 * (high[finite].max() - low[finite].min()) + 1e-12
        axes.set_ylim(low[finite].min() - margin, high[finite].max() + margin)


def convergence(trace: Sequence[dict[str, Any]]) -> Drawing:
    """Draw lever arm, rotation and time shift over the recording with bands of one sigma.

    Left: all of it. Right: its second half. Lever arm and rotation are shown relative to their final
    values, so that the three axes share one scale.
    """
    t = np.array([p["t_s"] for p in trace])
    p_mm = 1e3 * np.array([p["p_m"] for p in trace])
    p_sigma = 1e3 * np.array([p["p_sigma_m"] for p in trace])
    q = np.array([p["q_wxyz"] for p in trace])
    back = so3.quat_conjugate(np.broadcast_to(q[-1], q.shape))
    rotation = np.degrees(so3.rotvec_from_quat(so3.quat_multiply(back, q)))
    r_sigma = np.degrees(np.array([p["r_sigma_rad"] for p in trace]))
    shift = 1e3 * np.array([p["timeshift_s"] for p in trace])
    shift_sigma = 1e3 * np.array([p["timeshift_sigma_s"] for p in trace])
    figure, grid = panels(6.9, 3, 2)
    for column in (0, 1):
        for i, axis in enumerate("xyz"):
            band(grid[0, column], t, p_mm[:, i] - p_mm[-1, i], p_sigma[:, i], AXES[i], axis)
            band(grid[1, column], t, rotation[:, i], r_sigma[:, i], AXES[i], axis)
        band(grid[2, column], t, shift, shift_sigma, INK, "time shift")
    style(grid[0, 0], "Lever arm, from its final value", y="mm")
    style(grid[1, 0], "Rotation, from its final value", y="deg")
    style(grid[2, 0], "Time shift", "time, s", "ms")
    for row, title in enumerate(("second half", "second half", "second half")):
        style(grid[row, 1], title, "time, s" if row == 2 else "")
    for column, share in ((0, 0.06), (1, 0.5)):
        _limit(grid[0, column], t, p_mm - p_mm[-1], p_sigma, share)
        _limit(grid[1, column], t, rotation, r_sigma, share)
        _limit(grid[2, column], t, shift[:, None], shift_sigma[:, None], share)
        for panel in grid[:, column]:
            panel.set_xlim(t[0] if column == 0 else 0.5 * (t[0] + t[-1]), t[-1])
    for panel in grid[:2, 0]:
        panel.legend(fontsize=8, frameon=False, labelcolor=INK, ncols=3, loc="upper right")
    return figure


def sigmas(trace: Sequence[dict[str, Any]]) -> Drawing:
    """Draw the standard deviations alone, logarithmic: how fast the answer is getting sharper."""
    t = np.array([p["t_s"] for p in trace])
    figure, grid = panels(2.7, 1, 3)
    row = grid[0]
    groups = (
        (1e3 * np.array([p["p_sigma_m"] for p in trace]), "Sigma of the lever arm", "mm"),
        (np.degrees(np.array([p["r_sigma_rad"] for p in trace])), "Sigma of the rotation", "deg"),
        (1e6 * np.array([[p["timeshift_sigma_s"]] for p in trace]), "Sigma of the time shift", "us"),
    )
    for panel, (values, title, unit) in zip(row, groups, strict=True):
        for i in range(values.shape[1]):
            shown = np.where(values[:, i] > 0, values[:, i], np.nan)
            panel.plot(t, shown, color=AXES[i] if values.shape[1] == 3 else INK, linewidth=1.3)
        if np.nanmax(np.where(values > 0, values, np.nan), initial=0) > 0:
            panel.set_yscale("log")
            panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter(NullFormatter())
        style(panel, title, "time, s", unit)
    return figure


def consistency(points: CameraResiduals | None, trace: Sequence[dict[str, Any]]) -> Drawing:
    """Draw NIS per degree of freedom over time with its 95 % band, and its histogram against chi^2."""
    figure, ((left, right),) = panels(2.9, 1, 2, (1.6, 1.0))
    used = points is not None and bool(np.any(points.frame_dof > 0))
    if points is not None and used:
        use = points.frame_dof > 0
        t, nis, dof = points.frame_t_s[use], points.frame_nis[use], points.frame_dof[use]
        ratio = nis / dof
        left.plot(t, ratio, ".", color=Z, markersize=2.5, alpha=0.6, rasterized=True)
        low, high = chdtri(dof, 0.975) / dof, chdtri(dof, 0.025) / dof
        left.fill_between(t, low, high, color=Y, alpha=0.2, linewidth=0)
        left.set_ylim(0, max(2.0, float(np.percentile(ratio, 99)) * 1.2))
        probability = chdtr(dof, nis)
        right.hist(probability, bins=20, range=(0, 1), color=Z, alpha=0.75)
        right.axhline(len(probability) / 20, color=INK, linewidth=1, linestyle="--")
        style(right, "Rank of NIS: flat is right", "probability", "frames")
    else:
        t = np.array([p["t_s"] for p in trace])
        left.plot(t, [p.get("nis_per_dof", np.nan) for p in trace], color=Z)
        right.set_axis_off()
    left.axhline(1.0, color=INK, linewidth=0.8)
    style(left, "NIS per degree of freedom (band: 95 %)", "time, s")
    return figure


def residual_map(cell_map: CellMap, size: tuple[int, int]) -> Drawing:
    """Draw mean residual arrows, RMS and number of points per cell over the image."""
    height = 0.8 + (WIDTH / 3.0) * size[1] / size[0] * 0.72
    figure, (row,) = panels(max(2.0, height), 1, 3, right=0.35)
    x = 0.5 * (cell_map.x_edges[:-1] + cell_map.x_edges[1:])
    y = 0.5 * (cell_map.y_edges[:-1] + cell_map.y_edges[1:])
    length = np.linalg.norm(cell_map.mean_px, axis=-1)
    reach = float(np.nanpercentile(length, 95)) if np.isfinite(length).any() else 1.0
    cell = cell_map.x_edges[1] - cell_map.x_edges[0]
    row[0].quiver(
        x, y, cell_map.mean_px[..., 0], cell_map.mean_px[..., 1], angles="xy", scale_units="xy",
        scale=max(reach, 1e-6) / (1.2 * cell), color=X, width=0.005,
    )  # fmt: skip
    style(row[0], f"Mean residual; cell: {reach / 1.2:.2g} px")
    extent = (0, size[0], size[1], 0)
    rms = row[1].imshow(cell_map.rms_px, extent=extent, cmap="magma_r", vmin=0, aspect="equal")
    row[1].figure.colorbar(rms, ax=row[1]).ax.tick_params(labelsize=8, colors=INK)
    style(row[1], "RMS residual, px")
    count = np.where(cell_map.count > 0, cell_map.count, np.nan)
    seen = row[2].imshow(count, extent=extent, cmap="viridis", aspect="equal")
    row[2].figure.colorbar(seen, ax=row[2]).ax.tick_params(labelsize=8, colors=INK)
    style(row[2], "Points per cell")
    for panel in row:
        panel.set_xlim(0, size[0])
        panel.set_ylim(size[1], 0)
        panel.set_aspect("equal")
        panel.grid(visible=False)
    return figure


def residual_scatter(points: CameraResiduals, sigma_px: float) -> Drawing:
    """Draw all residuals with their circles, their histogram, and the RMS of each board point."""
    figure, ((left, middle, right),) = panels(3.1, 1, 3)
    kept, refused = points.residual_px[points.accepted], points.residual_px[~points.accepted]
    thin = slice(None, None, max(1, len(kept) // 20000))
    left.plot(kept[thin, 0], kept[thin, 1], ".", color=Z, markersize=1.2, alpha=0.35, rasterized=True)
    left.plot(refused[:, 0], refused[:, 1], "x", color=X, markersize=3, alpha=0.6, rasterized=True)
    angle = np.linspace(0, 2 * np.pi, 100)
    for k in (1, 2, 3):
        left.plot(k * sigma_px * np.cos(angle), k * sigma_px * np.sin(angle), color=INK, linewidth=0.7)
    reach = max(4.5 * sigma_px, float(np.percentile(np.abs(kept), 99.9)) if len(kept) else 0.0)
    left.set_xlim(-reach, reach)
    left.set_ylim(-reach, reach)
    left.set_aspect("equal")
    style(left, "Residuals; circles: 1, 2, 3 sigma", "u, px", "v, px")
    edges = np.linspace(-reach, reach, 60)
    for i, (colour, label) in enumerate(((X, "u"), (Y, "v"))):
        middle.hist(kept[:, i], bins=edges, histtype="step", color=colour, label=label, density=True)
    normal = np.exp(-0.5 * (edges / sigma_px) ** 2) / (sigma_px * np.sqrt(2 * np.pi))
    middle.plot(edges, normal, color=INK, linewidth=0.9, linestyle="--", label="stated")
    middle.legend(fontsize=8, frameon=False, labelcolor=INK)
    style(middle, "Distribution", "px")
    ids, rms, refused_share = per_point_rms(points)
    right.scatter(ids, rms, s=7, c=[X if share > 0.2 else Z for share in refused_share])
    right.set_ylim(bottom=0)
    style(right, "RMS by board point", "point id", "px")
    return figure


def frame_rms(points: CameraResiduals) -> Drawing:
    """Draw the RMS residual of each frame and the share of its points that was refused."""
    figure, ((axes,),) = panels(2.2, width=4.8)
    axes.plot(points.frame_t_s, points.frame_rms_px, ".", color=Z, markersize=2.5, rasterized=True)
    axes.set_ylim(0, float(np.nanpercentile(points.frame_rms_px, 99.5)) * 1.3 + 1e-9)
    style(axes, "RMS residual by frame", "time, s", "px")
    return figure


def correlation(covariance: FloatArray) -> Drawing:
    """Draw the correlation of the six numbers of `T_imu_cam`."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    figure, ((axes,),) = panels(2.9, width=3.4, right=0.4)
    shown = axes.imshow(covariance / np.outer(sigma, sigma), vmin=-1, vmax=1, cmap="RdBu")
    labels = ["px", "py", "pz", "rx", "ry", "rz"]
    axes.set_xticks(range(6), labels)
    axes.set_yticks(range(6), labels)
    axes.figure.colorbar(shown, ax=axes, shrink=0.9).ax.tick_params(labelsize=8, colors=INK)
    style(axes, "Correlation")
    axes.grid(visible=False)
    return figure
