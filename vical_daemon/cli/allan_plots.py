"""The two figures of `vical allan`: measured Allan deviation with its band, and the fitted model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vical_daemon.estimation.tools.noise_densities import AllanCurve, NoiseFit
from vical_daemon.results.report.figures import AXES, SOFT

_UNITS = {"gyro": ("Gyroscope", "rad/s"), "accel": ("Accelerometer", "m/s^2")}


def write_plots(
    folder: Path, curves: dict[str, list[AllanCurve]], fits: dict[str, list[NoiseFit]]
) -> list[Path]:
    """Write gyro.png and accel.png.

    Args:
        folder: Made where it does not exist.
        curves: By sensor (gyro, accel), one per axis.
        fits: The same.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for sensor in curves:
        figure = draw(sensor, curves[sensor], fits[sensor])
        paths.append(folder / f"{sensor}.png")
        figure.savefig(paths[-1], dpi=130)
    return paths


def draw(sensor: str, curves: list[AllanCurve], fits: list[NoiseFit]) -> Figure:
    """Draw one sensor: three axes, bands of one sigma, the model dashed, slopes for the eye."""
    title, unit = _UNITS[sensor]
    figure = Figure(figsize=(8.0, 5.2), layout="constrained")
    axes = figure.subplots()
    for i, (curve, fit) in enumerate(zip(curves, fits, strict=True)):
        sigma = curve.sigma()
        axes.fill_between(
            curve.tau_s, np.maximum(curve.adev - sigma, curve.adev * 0.05), curve.adev + sigma,
            color=AXES[i], alpha=0.2, linewidth=0,
        )  # fmt: skip
        axes.plot(curve.tau_s, curve.adev, color=AXES[i], linewidth=1.4, label=f"{'xyz'[i]}")
        axes.plot(curve.tau_s, fit.model_adev(curve.tau_s), color=AXES[i], linewidth=0.9, linestyle="--")
        axes.plot(
            fit.instability_tau_s, np.min(curve.adev), "o", color=AXES[i], markersize=5, fillstyle="none"
        )
    axes.axvline(1.0, color=SOFT, linewidth=0.8)
    axes.text(1.0, 0.02, " N at 1 s", fontsize=8, color=SOFT, transform=axes.get_xaxis_transform())
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("averaging time, s")
    axes.set_ylabel(f"Allan deviation, {unit}")
    axes.set_title(f"{title}: overlapping Allan deviation (dashed: model)", loc="left", fontweight="bold")
    axes.grid(visible=True, which="both", color="#e3e7ee", linewidth=0.5)
    axes.legend(frameon=False)
    return figure
