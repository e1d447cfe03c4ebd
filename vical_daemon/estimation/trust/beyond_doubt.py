"""What turned out not to be as stated is announced; no hypothesis that it is stands beside it any longer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.retract import retract
from vical_daemon.estimation.trust.hypotheses import (
    IMU,
    LAG,
    OFF,
    SIZE,
    SURE,
    TARGET,
    Block,
    blocks,
    factor,
    lens_block,
    not_zero,
    weights,
)
from vical_daemon.estimation.trust.lens_agreement import LensAgreement
from vical_daemon.estimation.unscented import root, solve_lower

KNOWN_OFF_SIGMA = 1e-2
"""Prior of the entries of an IMU that is known to be off, or where its matrices are asked for."""
KNOWN_SIZE_SIGMA = 0.1
"""Of the size of a target that is known to be off, or where it is asked for, relative."""
_EVERY_S = 1.0
_MEASURED = 400  # images
_SEEN = 100  # images, as many as `consistency` wants
_PIXELS = 4  # of the entries of a lens are in px


def imu_told(entries: FloatArray, sigmas: FloatArray) -> str:
    """The announcement for an IMU, with the entry that is off beyond all others."""
    off, sigma = _surest(entries, sigmas)
    return (
        f"scale or alignment of the imu is off, by {100.0 * off:.2f} +- {100.0 * sigma:.2f} %: "
        "allowed for from now on"
    )


def size_told(off: float, sigma: float | None = None) -> str:
    """The announcement for a target larger (off > 0) or smaller than stated; without a sigma: roughly."""
    how = "larger" if off > 0 else "smaller"
    figure = (
        f"some {100 * abs(off):.0f} %" if sigma is None else f"{100 * abs(off):.2f} +- {100 * sigma:.2f} %"
    )
    return f"the target is {figure} {how} than stated: measure it; its size is estimated from now on"


def target_told(shape_m: FloatArray, sigmas_m: FloatArray) -> str:
    """The announcement for a target, with the mode that is off beyond all others."""
    off, sigma = _surest(shape_m, sigmas_m)
    return (
        f"the target is not as stated, by {1e3 * off:.2f} +- {1e3 * sigma:.2f} mm at its edges: "
        "its shape is estimated from now on"
    )


def lag_told(lag_s: FloatArray, sigma_s: FloatArray) -> str:
    """The announcement for an accelerometer whose delay is not that of the gyro."""
    late = "behind" if lag_s[0] > 0 else "ahead of"
    size_ms, sigma_ms = 1e3 * abs(float(lag_s[0])), 1e3 * float(sigma_s[0])
    return f"the accelerometer is {size_ms:.2f} +- {sigma_ms:.2f} ms {late} the gyro: allowed for from now on"


def _surest(values: FloatArray, sigmas: FloatArray) -> tuple[float, float]:
    surest = int(np.argmax(np.abs(values) / sigmas))
    return abs(float(values[surest])), float(sigmas[surest])


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
    f.loosen(W)
    f.state = retract(f.state, f.layout, dx)


_TOLD = {
    IMU: imu_told,
    LAG: lag_told,
    SIZE: lambda off, sigma: size_told(float(off[0]), float(sigma[0])),
    TARGET: target_told,
}
_KNOWN_SIGMA = {IMU: KNOWN_OFF_SIGMA, SIZE: KNOWN_SIZE_SIGMA}


@dataclass(slots=True)
class BeyondDoubt:
    """Asks once a second what is known not to be as stated."""

    _next_s: float = -np.inf

    def look(self, f: CalibrationFilter) -> dict[str, str]:
        """Return what is to be announced, by the name of the block."""
        if f.state.t_s < self._next_s:
            return {}
        self._next_s = f.state.t_s + _EVERY_S
        shares = weights(f)
        every, images = blocks(f), max(c.images for c in f.consistency.values())
        known = [
            name
            for name in every
            if name not in f.off and not_zero(shares, name) > SURE and images >= _needed(name, every, shares)
        ]
        return {name: _off(f, name) for name in known}


def _needed(name: str, every: dict[str, Block], shares: dict[tuple[str, ...], float]) -> int:
    """Images before a block is announced.

    A lag is small beside what images that do not fit do: only once that is measured is it known. So is
    whatever seems to be off beside a lens that is held and wrong; and in the first images that may be either.
    """
    held = [other for other, block in every.items() if block.held]
    if name in held:
        return 0
    if name == LAG or any(not_zero(shares, other) > OFF for other in held):
        return _MEASURED
    return _SEEN if held else 0


def _lens_told(f: CalibrationFilter, name: str, block: Block) -> str:
    """The announcement for a lens that is held, with the entry that is off beyond all others."""
    camera = next(c for c in f.layout.held if lens_block(c) == name)
    sigmas = np.sqrt(factor(f)) * f.sigmas()[block.where]
    at = int(np.argmax(np.abs(block.values) / np.hypot(sigmas, block.stated)))
    entry = f.layout.held[camera].names(f.state.cameras[camera].distortion_model)[at]
    off = (
        f"{block.values[at]:+.1f} +- {sigmas[at]:.1f} px"
        if at < _PIXELS
        else f"{block.values[at]:+.3f} +- {sigmas[at]:.3f}"
    )
    return (
        f"the fixed lens of {camera} is not this camera's: {entry} is off by {off}; "
        "the sigmas allow for it: leave the lens free to be rid of it (no `fix` of intrinsics)"
    )


def _off(f: CalibrationFilter, name: str) -> str:
    """Let a block stand by itself; return the announcement."""
    block = blocks(f)[name]
    f.off.add(name)
    if block.held:
        return _lens_told(f, name, block)
    if name in _KNOWN_SIGMA:
        _widen(f, blocks(f)[name], _KNOWN_SIGMA[name])
    if name == TARGET:  # what stretches said of the lens, they said with the target as stated
        f.agreement = {camera: LensAgreement(agreement.model) for camera, agreement in f.agreement.items()}
    block = blocks(f)[name]
    return _TOLD[name](block.values, np.sqrt(factor(f)) * f.sigmas()[block.where])
