"""Commits to an alternative model above 99 % and announces it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.model.held_lens import FixedLens
from vical_daemon.estimation.model.priors import KNOWN_OFF_SIGMA, KNOWN_SIZE_SIGMA, OFF, SURE
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.model.unscented import root, solve_lower
from vical_daemon.estimation.noise.shared_errors import MEMORY
from vical_daemon.estimation.selection.model_mixture import Block, Weights, lens_block, not_zero, term_block
from vical_daemon.estimation.selection.model_selection import (
    IMU,
    LAG,
    SIZE,
    SIZE_EFFECT,
    TARGET,
    blocks,
    factor,
    weights,
)
from vical_daemon.estimation.significance import EVERY_S

_KINDS = {
    IMU: EventKind.IMU_INTRINSICS,
    LAG: EventKind.ACCEL_LAG,
    SIZE_EFFECT: EventKind.ACCEL_POSITIONS,
    SIZE: EventKind.TARGET_SIZE,
    TARGET: EventKind.TARGET_SHAPE,
}


def known_off(block: str, values: FloatArray, sigmas: FloatArray) -> Event:
    """The announcement for a block of `model_selection` that is off, with the entry that is most surely so.

    Args:
        block: Its name.
        values: Its states; for `SIZE` relative, for `LAG` s, for `SIZE_EFFECT` m, for `TARGET` m at the
            edges.
        sigmas: Their standard deviations.
    """
    surest = int(np.argmax(np.abs(values) / sigmas))
    value = float(values[surest])
    signed = block in (SIZE, LAG)
    return Event(_KINDS[block], value=value if signed else abs(value), sigma=float(sigmas[surest]))


def lens_off(camera: str, lens: FixedLens, block: Block, covariance: FloatArray, known: CameraState) -> Event:
    """The announcement for a fixed lens that is not as given.

    Args:
        camera: Name of the camera.
        lens: The lens as given.
        block: Its block.
        covariance: Of its values, shape (n, n).
        known: The camera as estimated.
    """
    off_px, sigma_px = lens.displacement_px(
        block.values, covariance, known.distortion_model, known.resolution
    )
    return Event(EventKind.FIXED_LENS, camera, off_px, sigma_px)


def _widen(f: CalibrationFilter, block: Block, sigma: float) -> None:
    """Take the prior of a block back, but for that of one which is known to be off.

    With c what the prior's information falls by and E the entries:
    (P^-1 - c E E')^-1 = P + P E (I/c - E' P E)^-1 E' P, and the mean moves by P E (I/c - E' P E)^-1 E' x.
    """
    entries = f.S[block.where]
    c = float(block.sigma[0]) ** -2.0 - sigma**-2.0
    L = root(np.eye(len(entries)) / c - entries @ entries.T)
    W = solve_lower(L, entries @ f.S.T).T
    dx = W @ solve_lower(L, block.values)
    f.inflate_covariance(W)
    f.step(dx)


_KNOWN_SIGMA = {IMU: KNOWN_OFF_SIGMA, SIZE: KNOWN_SIZE_SIGMA}


@dataclass(slots=True)
class ModelAcceptance:
    """Asks once a second what is known not to be as specified."""

    _next_s: float = -np.inf

    def look(self, f: CalibrationFilter) -> dict[str, Event]:
        """Return what is to be announced, by the name of the block."""
        if f.state.t_s < self._next_s:
            return {}
        self._next_s = f.state.t_s + EVERY_S
        shares = weights(f)
        every, images = blocks(f), max(c.images for c in f.consistency.values())
        known = [
            name
            for name in every
            if name not in f.off and not_zero(shares, name) > SURE and images >= _needed(f, name, shares)
        ]
        return {name: _off(f, name) for name in known}


def _needed(f: CalibrationFilter, name: str, shares: Weights) -> int:
    """Images before a block is announced.

    Images that do not fit can look like a lag; their misfit must be measured first. A wrong fixed lens can
    look like any of the blocks; the first images may show either.
    """
    held = [lens_block(camera) for camera in f.layout.held]
    if name in held:
        return 0
    if name == LAG or any(not_zero(shares, other) > OFF for other in held):
        return MEMORY
    return MEMORY // 4 if held else 0


def _off(f: CalibrationFilter, name: str) -> Event:
    """Let a block stand by itself; return the announcement."""
    block = blocks(f)[name]
    f.off.add(name)
    camera = next((c for c in f.layout.cameras if name in (lens_block(c), term_block(c))), "")
    if name == term_block(camera):
        return Event(EventKind.LENS_TERM_MISSING, camera)
    if block.held:
        rows = f.S[block.where]
        covariance = factor(f) * (rows @ rows.T)
        return lens_off(camera, f.layout.held[camera], block, covariance, f.state.cameras[camera])
    if name in _KNOWN_SIGMA:
        _widen(f, blocks(f)[name], _KNOWN_SIGMA[name])
    if name == TARGET:  # what stretches said of the lens, they said with the target as in its file
        f.agreement = {camera: agreement.anew() for camera, agreement in f.agreement.items()}
    block = blocks(f)[name]
    return known_off(name, block.values, np.sqrt(factor(f)) * f.sigmas()[block.where])
