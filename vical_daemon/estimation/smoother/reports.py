"""The verdict on each image of an adjusted window, in the form that roles and reports know."""

from __future__ import annotations

import numpy as np

from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.smoother.normal import Problem, View


def window_reports(problem: Problem, view: View) -> list[FrameReport]:
    """Residuals of every image with landmarks in it, in order of time.

    Args:
        problem: Of the adjusted window.
        view: Its values at the observations it used.

    Returns:
        One report an image, without predictions: a window is adjusted after its images.
    """
    window = problem.window
    seen, ok, e = view.seen, view.valid, problem.pixel_errors(view)[0]
    residual = np.where(ok[:, None], -e * problem.noise.sigma_px, np.nan)
    out = []
    ends = np.append(seen.frame_begin[1:], len(seen.frame))
    for frame, begin, end in zip(seen.frames_with, seen.frame_begin, ends, strict=True):
        rows = seen.by_frame[begin:end]
        image = window.frames[int(frame)][1]
        squares = float((e[rows][ok[rows]] ** 2).sum())
        out.append(
            FrameReport(
                image.t_cam_ns,
                image.camera,
                window.landmarks.ids[seen.landmark[rows]],
                seen.uv[rows],
                residual[rows],
                ok[rows],
                True,
                squares,
                2 * int(ok[rows].sum()),
                problem.noise.sigma_px,
            )
        )
    return out
