"""Model selection in the filter: are the target, the IMU and fixed lenses as given? See `model_mixture`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.imu_scale import ENTRIES, numbers_of
from vical_daemon.estimation.model.priors import (
    APART_SIGMA_M,
    ENTRY_SIGMA,
    FILTER_START,
    LAG_SIGMA_S,
    OFF,
    SIZE_SIGMA,
)
from vical_daemon.estimation.model.retract import retract
from vical_daemon.estimation.model.state import CameraState, Layout
from vical_daemon.estimation.selection import model_mixture
from vical_daemon.estimation.selection.model_mixture import (
    Block,
    Weights,
    lens_block,
    mixture,
    not_zero,
    term_block,
)

IMU, LAG, SIZE_EFFECT = "imu_intrinsics", "accel_lag", "size_effect"
SIZE, TARGET = "target_scale", "target_shape"
IN_DOUBT = {
    IMU: "sigmas are small; it is not clear yet whether the IMU's scale and alignment are as specified",
    SIZE: "sigmas are small; it is not clear yet whether the target has the size in its file",
    TARGET: "sigmas are small; it is not clear yet whether the target has the shape in its file",
}


def imu_and_lenses(
    layout: Layout, numbers: FloatArray, cameras: Mapping[str, CameraState]
) -> dict[str, Block]:
    """Imu and fixed lenses, as far as they are estimated; `numbers` of the imu: see `imu_scale`."""
    found: dict[str, Block] = {}
    if layout.gyro_matrix is not None and layout.accel_matrix is not None:
        where = slice(layout.gyro_matrix.start, layout.accel_matrix.stop)
        found[IMU] = Block.of(where, numbers[:ENTRIES], ENTRY_SIGMA)
    if layout.accel_positions is not None:
        found[SIZE_EFFECT] = Block.of(layout.accel_positions, numbers[ENTRIES:-1], APART_SIGMA_M)
    if layout.accel_lag is not None:
        where = slice(layout.accel_lag, layout.accel_lag + 1)
        found[LAG] = Block.of(where, numbers[-1:], LAG_SIGMA_S)
    for name, lens in layout.held.items():
        now = np.concatenate([cameras[name].intrinsics, cameras[name].distortion])
        found[lens_block(name)] = Block.of_lens(layout.lens(name), lens, now)
    return found


def lens_term(layout: Layout, name: str, camera: CameraState, *, held: bool = False) -> Block:
    """The term that a free lens has beyond its model; `held`: what is reported is the lens without it."""
    end = layout.lens(name).stop
    sigma = np.array([FILTER_START.distortion])
    return Block(slice(end - 1, end), camera.distortion[-1:], sigma, np.zeros(1), held=held)


def blocks(f: CalibrationFilter) -> dict[str, Block]:
    """What a filter estimates apart from the calibration, by its name in `CalibrationOptions.estimate`."""
    layout, state = f.layout, f.state
    found = imu_and_lenses(layout, numbers_of(state), state.cameras)
    for name, camera in state.cameras.items():
        if camera.term and layout.lens_free(name):
            found[term_block(name)] = lens_term(layout, name, camera)
    if layout.target_scale is not None:
        where = slice(layout.target_scale, layout.target_scale + 1)
        found[SIZE] = Block.of(where, np.array([state.target_scale - 1.0]), SIZE_SIGMA)
    if layout.target_shape is not None and layout.target_modes is not None:
        found[TARGET] = Block.of(layout.target_shape, state.target_shape, layout.target_modes.sigma_m)
    return found


def lenses_known(f: CalibrationFilter) -> FloatArray:
    """Square root of the reported covariance if the errors of all fixed lenses were known."""
    return model_mixture.lenses_known(f.S, blocks(f)) if f.layout.held else f.S


def factor(f: CalibrationFilter) -> float:
    """Reported variances over the filter's own (see `consistency`)."""
    return max((c.factor for c in f.consistency.values()), default=1.0)


def misfit(f: CalibrationFilter) -> float:
    """By how much images miss by more than their noise although all blocks are free.

    Then it is the images (a lens that is held and wrong), and what they say of imu and target is worth less
    by as much again.
    """
    return max((c.scale for c in f.consistency.values()), default=1.0)


def weights(f: CalibrationFilter) -> Weights:
    """Probability of each hypothesis; a hypothesis is named by the blocks that are as specified."""
    doubtful = {name: block for name, block in blocks(f).items() if name not in f.off}
    return model_mixture.hypotheses(f.S, doubtful, factor(f) * misfit(f))


def in_doubt(f: CalibrationFilter, shares: Weights | None = None, *, believed: bool = False) -> str:
    """Name of a block for which the data speak, though not yet surely: they soon will. Empty: none.

    Images that do not fit may never decide it; the reported covariance then covers both. A result that was
    believed stays so until the block is more likely off than not: of many looks, one sees 5 % by chance.
    `shares` are `weights`, if they are known.
    """
    if misfit(f) != 1.0:
        return ""
    doubtful, shares = blocks(f).keys() - f.off, weights(f) if shares is None else shares
    enough = 0.5 if believed else OFF
    return next((n for n in IN_DOUBT if n in doubtful and not_zero(shares, n) > enough), "")


def averaged(
    f: CalibrationFilter, shares: Weights | None = None, asked: Collection[str] = ()
) -> CalibrationFilter:
    """Return the filter to be reported: mean and covariance over all models.

    Args:
        f: The filter.
        shares: See `in_doubt`.
        asked: See `mixture`.
    """
    step, S = mixture(f.S, blocks(f), weights(f) if shares is None else shares, factor(f), asked)
    if S is f.S and not step.any():
        return f
    return replace(f, state=retract(f.state, f.layout, step), S=S)
