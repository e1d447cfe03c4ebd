"""Whether a fixed lens of another camera is why there is no start: with another lens there would be one."""

from __future__ import annotations

from copy import copy

from vical_daemon.estimation.geometry.camera_model import project_jacobians
from vical_daemon.estimation.init.readout_start import lens_fit
from vical_daemon.estimation.init.target_poses import poses_of
from vical_daemon.estimation.measurements import FloatArray, Frames, PointsFrame
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.significance import SURE_SIGMAS, chi_square_limit


def blamed(held: CameraState, other: CameraState) -> str:
    """Say that a fixed lens is why there is no start; `other`: the camera with a lens that fits."""
    return (
        f"the fixed lens (fx {held.intrinsics[0]:.0f} px) is not this camera's: with fx "
        f"{other.intrinsics[0]:.0f} px and its own distortion images and gyro agree; "
        "correct it, or let vical estimate it"
    )


def other_lens(frames: Frames, held: CameraState, target: FloatArray) -> CameraState | None:
    """Return a camera with a lens that fits images surely better than the fixed one; None: there is none.

    Args:
        frames: (stamp in s, points), in order, as a global shutter sees them.
        held: The camera with the lens that is fixed.
        target: Points of the target, m, shape (n, 3).
    """
    fit = lens_fit(frames, held, target)
    if fit is None:
        return None
    gain = _squares(fit.views, held, target) - fit.squares
    if not gain > chi_square_limit(len(fit.theta), SURE_SIGMAS) * fit.corner_sigma_px**2:
        return None
    camera = copy(held)
    fit.take_into(camera)
    return camera


def _squares(views: list[PointsFrame], lens: CameraState, target: FloatArray) -> float:
    """Sum of the squared distances of points from where a lens projects them with the best poses, px^2.

    A view that shows no pose with this lens does not count: the sum is rather too small.
    """
    total = 0.0
    for view, found in zip(views, poses_of([(0.0, v) for v in views], lens, target), strict=True):
        if found is not None:
            x = target[view.ids] @ found.pose.R_cam_target.T + found.pose.p_cam_target
            uv_px = project_jacobians(x, lens.intrinsics, lens.distortion, lens.distortion_model)[0]
            total += float(((view.uv_px - uv_px) ** 2).sum())
    return total
