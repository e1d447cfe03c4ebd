"""The picture of `vical imu stream --plot`: what clock mapping does to the intervals between samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

_BEFORE, _AFTER = "#d1495b", "#00798c"


def write(
    path: Path, t_arrival_ns: npt.NDArray[np.int64], t_host_ns: npt.NDArray[np.int64], rate_hz: float
) -> None:
    """Draw intervals over time and their distribution, of arrivals and of stamps.

    Args:
        path: Where to write; the ending chooses the format.
        t_arrival_ns: When the bytes were read, ns, shape (n,).
        t_host_ns: The stamps made of it, ns, shape (n,).
        rate_hz: Nominal rate, drawn as a line.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    since_s = (t_host_ns[1:] - t_host_ns[0]) * 1e-9
    before_ms, after_ms = np.diff(t_arrival_ns) * 1e-6, np.diff(t_host_ns) * 1e-6
    figure, (over_time, spread) = plt.subplots(
        1, 2, figsize=(10, 4), width_ratios=(3, 1), sharey=True, layout="constrained"
    )
    both_ms = np.concatenate([before_ms, after_ms])
    bins = np.linspace(both_ms.min() - 0.1, both_ms.max() + 0.1, 80)
    for interval_ms, colour, name in ((before_ms, _BEFORE, "arrival"), (after_ms, _AFTER, "stamp")):
        std_us = float(np.std(interval_ms)) * 1e3
        over_time.plot(
            since_s, interval_ms, ".", ms=3, color=colour, alpha=0.6, label=f"{name}: std {std_us:.0f} us"
        )
        spread.hist(interval_ms, bins=bins, orientation="horizontal", color=colour, alpha=0.6, log=True)
    over_time.axhline(1e3 / rate_hz, color="0.4", lw=0.8)
    over_time.set(xlabel="time, s", ylabel="interval between samples, ms")
    over_time.legend(loc="upper right")
    spread.set(xlabel="count")
    figure.suptitle("IMU sample intervals, before and after clock mapping")
    figure.savefig(path, dpi=120)
    plt.close(figure)
