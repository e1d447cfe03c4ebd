"""Whether independent calibrations of one rig agree, and which of them does not.

Each calibration is compared with the information-weighted mean of the others:
d = x_i - x_rest, cov(d) = P_i + P_rest, d' cov(d)^-1 d ~ chi-square. The probability is the smallest over
the quantities times their number (Bonferroni), so correlations between quantities do not matter. The worst is
left out until all others agree (data snooping, Baarda 1968). Those left out are then compared once more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc, gammaln

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.estimation.significance import CALIBRATIONS_DISAGREE

LEVER_ARM, ROTATION, TIME_SHIFT, LENS = "lever arm", "rotation", "time shift", "lens"


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a calibration.

    Attributes:
        value: m, rad (from a common reference), s, or px and coefficients, shape (n,).
        covariance: Of it, shape (n, n).
    """

    value: FloatArray
    covariance: FloatArray


Calibration = Mapping[tuple[str, str], Quantity]
"""By camera and name of the quantity; what was held fixed is missing."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One quantity of a calibration, compared with the others.

    Attributes:
        camera: Name.
        what: `LEVER_ARM`, `ROTATION`, `TIME_SHIFT` or `LENS`.
        value: By how much it differs: m, rad, s, or px and coefficients.
        sigma: Of that, with what both leave open.
        log_probability: Of a difference so large by chance, natural logarithm.
    """

    camera: str
    what: str
    value: list[float]
    sigma: list[float]
    log_probability: float

    @property
    def probability(self) -> float:
        """Of a difference so large by chance; 0 where a float cannot hold it."""
        return float(np.exp(self.log_probability))


@dataclass(frozen=True, slots=True)
class Agreement:
    """How one calibration compares with the others that agree with each other.

    Attributes:
        agrees: None: it cannot be compared, because it or all others are missing.
        log_probability: Of its largest difference by chance, times their number, natural logarithm.
        differences: All of them.
    """

    agrees: bool | None
    log_probability: float = 0.0
    differences: list[Difference] = field(default_factory=list)

    @property
    def probability(self) -> float:
        """Of its largest difference by chance; 0 where a float cannot hold it."""
        return float(np.exp(self.log_probability))


def calibrations(
    estimates: Sequence[Mapping[str, CameraEstimate] | None], *, common_clock: bool
) -> list[Calibration | None]:
    """Bring results into the form that is compared.

    Args:
        estimates: By camera; None: there is no result.
        common_clock: Time shifts are compared, too.
    """
    references: dict[str, FloatArray] = {}
    for estimate in estimates:
        for name, camera in (estimate or {}).items():
            references.setdefault(name, so3.matrix_from_quat(np.array(camera.T_imu_cam.q_wxyz)))
    return [
        _quantities(estimate, references, common_clock=common_clock) if estimate else None
        for estimate in estimates
    ]


def _quantities(
    estimate: Mapping[str, CameraEstimate], references: Mapping[str, FloatArray], *, common_clock: bool
) -> Calibration:
    found: dict[tuple[str, str], Quantity] = {}
    for name, camera in estimate.items():
        P = np.array(camera.T_imu_cam.covariance)
        R = so3.matrix_from_quat(np.array(camera.T_imu_cam.q_wxyz))
        lens = np.array([*camera.intrinsics, *camera.distortion])
        lens_sigma = np.array([*camera.intrinsics_sigma, *camera.distortion_sigma])
        candidates = {
            LEVER_ARM: Quantity(np.array(camera.T_imu_cam.p_m), P[:3, :3]),
            ROTATION: Quantity(so3.log(references[name].T @ R), P[3:, 3:]),
        }
        if common_clock:
            shift, sigma_s = camera.timeshift_cam_imu_s, camera.timeshift_sigma_s
            candidates[TIME_SHIFT] = Quantity(np.array([shift]), np.array([[sigma_s**2]]))
        if len(lens) == len(lens_sigma):
            for k, (value, sigma) in enumerate(zip(lens, lens_sigma, strict=True)):
                part = f"{LENS} {('fx', 'fy', 'cx', 'cy')[k]}" if k < 4 else f"{LENS} k{k - 3}"
                candidates[part] = Quantity(np.array([value]), np.array([[sigma**2]]))
        found |= {(name, what): q for what, q in candidates.items() if (np.diag(q.covariance) > 0.0).all()}
    return found


def agreements(found: Sequence[Calibration | None]) -> list[Agreement]:
    """Compare each calibration with those of the others that agree.

    Two that disagree with each other, and nothing else: both are said to disagree.

    Args:
        found: Independent calibrations; None: there is none.
    """
    known = [k for k, calibration in enumerate(found) if calibration]
    limit = np.log(CALIBRATIONS_DISAGREE / max(len(known), 1))
    kept = list(known)
    while len(kept) > 2:
        compared = {k: _compare(found, k, kept) for k in kept}
        worst = min(kept, key=lambda k: compared[k].log_probability)
        if compared[worst].log_probability >= limit:
            break
        kept.remove(worst)
    result = [Agreement(None) for _ in found]
    for k in known:
        one = _compare(found, k, kept)
        if one.differences:
            result[k] = replace(one, agrees=bool(one.log_probability >= limit))
    return result


def _compare(found: Sequence[Calibration | None], k: int, kept: Sequence[int]) -> Agreement:
    """One against the mean of the others that are kept."""
    one, differences = found[k] or {}, []
    for key, own in one.items():
        others = [(found[j] or {}).get(key) for j in kept if j != k]
        present = [q for q in others if q is not None]
        if not present:
            continue
        information = [np.linalg.inv(q.covariance) for q in present]
        P_rest = np.linalg.inv(np.sum(information, axis=0))
        rest = P_rest @ np.sum([W @ q.value for W, q in zip(information, present, strict=True)], axis=0)
        d, P = own.value - rest, own.covariance + P_rest
        square = float(d @ np.linalg.solve(P, d))
        sigma = np.sqrt(np.diag(P))
        differences.append(Difference(*key, d.tolist(), sigma.tolist(), _log_chance(square, len(d))))
    if not differences:
        return Agreement(None)
    smallest = min(d.log_probability for d in differences) + np.log(len(differences))
    return Agreement(True, min(float(smallest), 0.0), differences)


def _log_chance(square: float, dof: int) -> float:
    """Logarithm of the probability that chi-square is larger; far out its asymptote, where floats end."""
    chance = float(chdtrc(dof, square))
    if chance > 1e-280:
        return float(np.log(chance))
    return float((0.5 * dof - 1.0) * np.log(0.5 * square) - 0.5 * square - gammaln(0.5 * dof))
