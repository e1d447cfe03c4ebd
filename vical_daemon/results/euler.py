"""Roll, pitch and yaw of a mounting with their sigmas, for display only."""

from __future__ import annotations

import math
from collections.abc import Sequence

_STEP_RAD = 1e-6


def euler_deg(q_wxyz: Sequence[float]) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in degrees (R = Rz(yaw) Ry(pitch) Rx(roll)).

    >>> [round(a) for a in euler_deg([math.cos(0.5), 0.0, 0.0, math.sin(0.5)])]
    [0, 0, 57]
    """
    w, x, y, z = q_wxyz
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def euler_sigma_deg(q_wxyz: Sequence[float], covariance: Sequence[Sequence[float]]) -> list[float]:
    """Return the sigmas of roll, pitch and yaw, deg: J C J^T with J by differences (large near pitch 90).

    Args:
        q_wxyz: The rotation, of length 1.
        covariance: Of the pose, 6 x 6: position, then the local rotation error, rad.
    """
    w, x, y, z = q_wxyz
    h = 0.5 * _STEP_RAD
    turned = ([w - x * h, x + w * h, y + z * h, z - y * h],
              [w - y * h, x - z * h, y + w * h, z + x * h],
              [w - z * h, x + y * h, y - x * h, z + w * h])  # fmt: skip
    angles = euler_deg(q_wxyz)
    rows = [[_wrapped(b - a) / _STEP_RAD for a, b in zip(angles, euler_deg(q), strict=True)] for q in turned]
    cov = [row[3:] for row in covariance[3:]]
    variances = [
        sum(rows[i][k] * cov[i][j] * rows[j][k] for i in range(3) for j in range(3)) for k in range(3)
    ]
    return [math.sqrt(max(variance, 0.0)) for variance in variances]


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0
