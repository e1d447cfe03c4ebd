"""What turned out not to be as stated is announced; no hypothesis that it is stands beside it any longer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vical_daemon.estimation.calibration_filter import CalibrationFilter
from vical_daemon.estimation.hypotheses import (
    ENTRY_SIGMA,
    IMU,
    LAG,
    TARGET,
    Block,
    blocks,
    factor,
    surely_off,
)
from vical_daemon.estimation.lens_agreement import LensAgreement
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.retract import retract
from vical_daemon.estimation.unscented import root, solve_lower

KNOWN_OFF_SIGMA = 1e-2
"""Prior of the entries of an IMU that is known to be off, or where its matrices are asked for."""
_EVERY_S = 1.0
_MEASURED = 400  # images


def imu_told(entries: FloatArray, sigmas: FloatArray) -> str:
    """The announcement for an IMU, with the entry that is off beyond all others."""
    off, sigma = _surest(entries, sigmas)
    return (
        f"scale or alignment of the imu is off, by {100.0 * off:.2f} +- {100.0 * sigma:.2f} %: "
        "allowed for from now on"
    )


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


def _widen(f: CalibrationFilter, block: Block) -> None:
    """Take the prior of the entries back, but for that of an IMU which is known to be off.

    With c what the prior's information falls by and E the entries:
    (P^-1 - c E E')^-1 = P + P E (I/c - E' P E)^-1 E' P, and the mean moves by P E (I/c - E' P E)^-1 E' x.
    """
    entries = f.S[block.where]
    c = ENTRY_SIGMA**-2.0 - KNOWN_OFF_SIGMA**-2.0
    L = root(np.eye(len(entries)) / c - entries @ entries.T)
    W = solve_lower(L, entries @ f.S.T).T
    dx = W @ solve_lower(L, block.values)
    f.loosen(W)
    f.state = retract(f.state, f.layout, dx)


_TOLD = {IMU: imu_told, LAG: lag_told, TARGET: target_told}


@dataclass(slots=True)
class BeyondDoubt:
    """Asks once a second what is known not to be as stated."""

    _next_s: float = -np.inf

    def look(self, f: CalibrationFilter) -> dict[str, str]:
        """Return what is to be announced, by the name of the block."""
        if f.state.t_s < self._next_s:
            return {}
        self._next_s = f.state.t_s + _EVERY_S
        return {name: _off(f, name) for name in blocks(f) if self._known(f, name)}

    @staticmethod
    def _known(f: CalibrationFilter, name: str) -> bool:
        """A lag is small beside what images that do not fit do: only once that is measured is it known."""
        if name in f.off or (name == LAG and max(c.images for c in f.consistency.values()) < _MEASURED):
            return False
        return surely_off(f, name)


def _off(f: CalibrationFilter, name: str) -> str:
    """Let a block stand by itself; return the announcement."""
    f.off.add(name)
    if name == IMU:
        _widen(f, blocks(f)[name])
    if name == TARGET:  # what stretches said of the lens, they said with the target as stated
        f.agreement = {camera: LensAgreement(agreement.model) for camera, agreement in f.agreement.items()}
    block = blocks(f)[name]
    return _TOLD[name](block.values, np.sqrt(factor(f)) * f.sigmas()[block.where])
