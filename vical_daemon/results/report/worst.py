"""The images that fit worst, with their residuals drawn."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from html import escape

import numpy as np

from vical_daemon.results.report.residuals import FrameResiduals

COUNT = 5
APART_S = 1.0
"""Shortest time between two of them, s: neighbours show the same."""
_ARROW_PX = 14.0  # of an image 640 px wide: length at which the RMS residual is drawn
_SCALES = (5, 10, 20, 50, 100)


def worst_frames(frames: Iterable[FrameResiduals], camera: str) -> list[FrameResiduals]:
    """Return the images with the largest RMS residual among those that were used, worst first."""
    ranked = [(rms(f), f) for f in frames if f.camera == camera and f.dof > 0]
    ranked = sorted((entry for entry in ranked if np.isfinite(entry[0])), key=lambda entry: -entry[0])
    chosen: list[FrameResiduals] = []
    for _, frame in ranked:
        if all(abs(frame.t_ns - other.t_ns) >= APART_S * 1e9 for other in chosen):
            chosen.append(frame)
        if len(chosen) == COUNT:
            break
    return chosen


def rms(frame: FrameResiduals) -> float:
    """RMS of the accepted residuals of an image, per axis, px; not-a-number without any."""
    kept = np.asarray(frame.residual_px)[np.asarray(frame.accepted, dtype=bool)]
    kept = kept[np.isfinite(kept).all(axis=1)]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")


def drawn(frame: FrameResiduals, size: tuple[int, int], begin_ns: int, images: Mapping[int, bytes]) -> str:
    """Return one image with its residuals as HTML; without the image the corners alone.

    Args:
        frame: The image.
        size: width, height of the image, px.
        begin_ns: Stamp of the first image, ns.
        images: JPEG files by stamp, of any size.
    """
    width, height = size
    unit, value = width / 640.0, rms(frame)
    factor = min(_SCALES, key=lambda k: abs(np.log(k * max(value, 1e-3) / (_ARROW_PX * unit))))
    jpeg = images.get(frame.t_ns)
    picture = ""
    if jpeg is not None:
        source = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"
        picture = f'<image href="{source}" x="-0.5" y="-0.5" width="{width}" height="{height}"/>'
    paths = {"kept": "", "refused": ""}
    for (u, v), (du, dv), good in zip(frame.uv_px, frame.residual_px, frame.accepted, strict=True):
        r = 2.5 * unit
        ring = (
            f"M{u - r:.1f},{v:.1f}a{r:.1f},{r:.1f} 0 1 0 {2 * r:.1f},0a{r:.1f},{r:.1f} 0 1 0 {-2 * r:.1f},0"
        )
        line = f"M{u:.1f},{v:.1f}l{factor * du:.1f},{factor * dv:.1f}" if np.isfinite(du + dv) else ""
        paths["kept" if good else "refused"] += ring + line
    marks = "".join(f'<path class="{kind}" d="{path}"/>' for kind, path in paths.items() if path)
    refused = int(np.count_nonzero(~np.asarray(frame.accepted, dtype=bool)))
    caption = (
        f"{(frame.t_ns - begin_ns) * 1e-9:.2f} s: RMS {value:.2f} px, {len(frame.ids)} corners"
        f"{f', {refused} refused' if refused else ''}; residuals drawn {factor} times as long"
    )
    return (
        f'<figure class="shot"><svg viewBox="-0.5 -0.5 {width} {height}" role="img" '
        f'aria-label="image with residuals">{picture}{marks}</svg>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
