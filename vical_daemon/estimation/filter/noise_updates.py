"""Updates of the noise models and of the lens check from an image, before the image corrects the state."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vical_daemon.estimation.filter.image_update import ImageFit, whitened
from vical_daemon.estimation.filter.linearise import Image, Linear
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.noise.lens_agreement import LensAgreement

if TYPE_CHECKING:
    from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter


def learn(f: CalibrationFilter, image: Image, lin: Linear, fit: ImageFit) -> None:
    """Take what an image says about shared errors, lens and jumps.

    Args:
        f: The filter, still as predicted; its `shared`, `agreement` and `jumped` learn.
        image: The image.
        lin: The image about the prediction.
        fit: Its correction, not yet accepted.
    """
    where = f.layout.cameras[image.camera]
    # a fit far from straight is linearised elsewhere
    rows = whitened(image, lin, fit) if lin.curved.size else fit.rows
    if f.jumped is not None:
        f.jumped.correct(f.S, fit.S, fit.dx)
    shared, agreement = f.shared.get(image.camera), f.agreement.get(image.camera)
    if shared is not None:
        ways, innovation = rows if lin.curved.size else (fit.ways, fit.r)
        level = f.consistency[image.camera].level
        by_shared = ways @ lin.by_shared
        shared.learn(image.t_cam_s, innovation, by_shared, (by_shared.T @ ways) @ lin.spread, level)
    if where.intrinsics is not None and where.distortion is not None and agreement is not None:
        by_lens = lin.by_error[:, where.intrinsics.start : where.distortion.stop]
        _ask_lens(f, agreement, image.camera, lin, rows, by_lens)


def _ask_lens(
    f: CalibrationFilter,
    agreement: LensAgreement,
    name: str,
    lin: Linear,
    rows: tuple[FloatArray, FloatArray],
    by_lens: FloatArray,
) -> None:
    """What an image would have the lens be: with the target as in its file until it is known not to be."""
    ways, innovation = rows
    shape, mean = f.layout.target_shape, f.mean
    if shape is not None and "target_shape" not in f.off:
        innovation = innovation + ways @ (lin.by_error[:, shape] @ mean.target_shape)
    by_pose = ways @ lin.by_error[:, :6]
    agreement.learn(f.state.t_s, innovation, by_pose, ways @ by_lens, mean.cameras[name])
