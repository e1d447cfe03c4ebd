"""The first lines of the report: a verdict in plain words, how well all is known, and what would help."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.result import Status
from vical_daemon.estimation.tools.projection_uncertainty import (
    POSITION,
    ROTATION,
    lens_names,
    sigma_if_known,
)
from vical_daemon.estimation.wording import axis_name
from vical_daemon.results.report.values import warnings_of

_WORDS = {
    Status.CONVERGED: "Good.",
    Status.CONVERGING: "Not finished.",
    Status.DEGENERATE: "Incomplete: the motion did not determine every direction.",
    Status.INCONSISTENT: "Do not use: the data contradict each other.",
}
_NOT_YET = "Do not use: there is no result yet."
_DATA_ALONE = 0.8  # of the sigma of the time shift: below, the rest comes from the stamps themselves
_SHARE = 0.5  # of a variance, above which one cause is called the main one


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a person reads first.

    Attributes:
        word: In a few words.
        known: How well each camera is known, one line each.
        advice: What to do, most important first; empty: nothing.
    """

    word: str
    known: list[str]
    advice: list[str]


def verdict(result: Mapping[str, Any]) -> Verdict:
    """Return the verdict on a result (the document of `vical calibrate --json`)."""
    cameras = result.get("cameras") or {}
    status, warnings = str(result.get("status")), warnings_of(dict(result))
    word = _WORDS.get(Status(status), _NOT_YET) if status in set(Status) else _NOT_YET
    if status == Status.CONVERGED and warnings:
        word = "Converged, with reservations."
    several = len(cameras) > 1
    known = [(f"{name}: " if several else "") + _known(camera) for name, camera in cameras.items()]
    held = {
        event.get("camera")
        for event in result.get("events") or []
        if isinstance(event, dict) and event["kind"] == EventKind.FIXED_LENS
    }
    causes = [
        (f"{name}: " if several else "") + main_cause(camera, lens_held=name in held)
        for name, camera in cameras.items()
    ]
    begun = [line if line.split(":")[0] in cameras else line[:1].upper() + line[1:] for line in warnings]
    return Verdict(word, known, begun + causes)


def _known(camera: Mapping[str, Any]) -> str:
    p, r = _blocks(camera)
    parts = [
        ("lever arm", 1e3 * _worst(p), "mm"),
        ("rotation", math.degrees(_worst(r)), "°"),
        ("time shift", 1e3 * float(camera["timeshift_sigma_s"]), "ms"),
    ]
    words = [f"{name} {_with(sigma, unit)}" for name, sigma, unit in parts if sigma > 0]
    if not words:
        return "Nothing was estimated: mounting and time shift were fixed."
    return f"1 sigma in the worst direction: {', '.join(words)}."


def main_cause(camera: Mapping[str, Any], *, lens_held: bool = False) -> str:
    """Say what limits the lever arm most, and so what would improve it.

    Args:
        camera: Of the result.
        lens_held: The lens was held although images contradict it.
    """
    p, _ = _blocks(camera)
    if _worst(p) <= 0:
        return "The lever arm was fixed."
    if lens_share(camera) > _SHARE:
        show = "bring the board to the edges of the image, tilted, near and far"
        return (
            f"{100 * lens_share(camera):.0f} % of the variance of the lever arm comes from the lens: "
            f"{'let vical estimate it' if lens_held else show}."
        )
    R = so3.matrix_from_quat(np.array(camera["T_imu_cam"]["q_wxyz"], dtype=np.float64))
    _, vectors = np.linalg.eigh(p)
    return (
        f"The lever arm is least certain along {axis_name(R.T @ vectors[:, 2])}: more data, with faster "
        "rotation about the other two axes, improves it."
    )


def joint_covariance(camera: Mapping[str, Any]) -> tuple[list[str], FloatArray]:
    """Names and covariance of what is estimated of a camera; empty where the result does not hold it."""
    stored = camera.get("calibration_covariance")
    if not stored:
        return [], np.zeros((0, 0))
    names = [*POSITION, *ROTATION, "timeshift", *lens_names(str(camera["distortion_model"]))]
    whole = np.array(stored, dtype=np.float64).reshape(len(names), len(names))
    use = np.flatnonzero(np.diag(whole) > 0.0)
    return [names[i] for i in use], whole[np.ix_(use, use)]


def lens_share(camera: Mapping[str, Any]) -> float:
    """Share of the variance of the lever arm (worst direction) that the unknown lens adds; 0: not known."""
    order, joint = joint_covariance(camera)
    if "px" not in order or "fx" not in order:
        return 0.0
    whole = sigma_if_known(order, joint, POSITION, ())
    known = sigma_if_known(order, joint, POSITION, lens_names(str(camera.get("distortion_model"))))
    return 1.0 - (known / whole) ** 2 if whole > 0 else 0.0


def limits(result: Mapping[str, Any], camera: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return what limits the accuracy: cause, its size, and what it means; only what the result holds."""
    rows: list[tuple[str, str, str]] = []
    if camera.get("corner_sigma_px"):
        rms = float(camera["reprojection_rms_px"])
        rows.append(
            ("corner noise", f"{camera['corner_sigma_px']:.3f} px", f"per axis; residuals {rms:.3f} px")
        )
    jitter = camera.get("stamp_jitter_s")
    if jitter is not None:
        size = f"{1e6 * jitter:.0f} µs" if jitter else "none found"
        rows.append(("jitter of the image stamps", size, "one sigma, beyond what the motion explains"))
    rows += _stamps(camera) + _shares(camera)
    p, r = _blocks(camera)
    R = so3.matrix_from_quat(np.array(camera["T_imu_cam"]["q_wxyz"], dtype=np.float64))
    for name, block, axes, scale, unit in (
        ("lever arm", p, R.T, 1e3, "mm"),
        ("rotation", r, np.eye(3), 180 / math.pi, "°"),
    ):
        if _worst(block) > 0:
            values, vectors = np.linalg.eigh(block)
            best, worst = np.sqrt(np.maximum(values[[0, 2]], 0.0))
            weak = axis_name(axes @ vectors[:, 2])
            text = f"{_with(scale * worst, unit)} {'along' if unit == 'mm' else 'about'} {weak}"
            best_text = f"strongest: {_with(scale * best, unit)}"
            rows.append((f"motion: {name}, weakest direction", text, best_text))
    nis = result.get("nis_per_dof")
    if nis:
        rows.append(
            ("model", f"NIS {float(nis):.2f}", "1: errors match the sigmas; below 1: the sigmas are cautious")
        )
    return rows


def _stamps(camera: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """How well the time shift is known, and how well the data alone would have it."""
    stated, (order, joint) = float(camera["timeshift_sigma_s"]), joint_covariance(camera)
    if "timeshift" not in order or stated <= 0:
        return []
    k = order.index("timeshift")
    data = math.sqrt(float(joint[k, k]))
    text = f"time shift {_two(1e3 * stated)} ms"
    if data < _DATA_ALONE * stated:
        return [("stamps of the IMU", text, f"{_two(1e3 * data)} ms with exact IMU stamps")]
    return [("stamps", text, "all of it from corners and motion")]


def _shares(camera: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What lens and time shift add to the sigmas of the mounting."""
    order, joint = joint_covariance(camera)
    if not order:
        return []
    lens = lens_names(str(camera.get("distortion_model")))
    rows = []
    for cause, known in (("lens", lens), ("time shift", ("timeshift",))):
        if not any(name in order for name in known):
            rows.append((cause, "fixed", "adds nothing to the sigmas"))
            continue
        arm = [1e3 * sigma_if_known(order, joint, POSITION, k) for k in ((), known)]
        turn = [math.degrees(sigma_if_known(order, joint, ROTATION, k)) for k in ((), known)]
        text = f"lever arm {_two(arm[0])} mm, rotation {_two(turn[0])}°"
        rows.append((cause, text, f"with an exact {cause}: {_two(arm[1])} mm, {_two(turn[1])}°"))
    return rows


def _blocks(camera: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    covariance = np.array(camera["T_imu_cam"]["covariance"], dtype=np.float64).reshape(6, 6)
    return covariance[:3, :3], covariance[3:, 3:]


def _worst(block: FloatArray) -> float:
    return math.sqrt(max(float(np.linalg.eigvalsh(block)[-1]), 0.0))


def _with(value: float, unit: str) -> str:
    return f"{_two(value)}{'' if unit == '°' else ' '}{unit}"


def _two(value: float) -> str:
    """Write a sigma with two significant digits.

    >>> _two(0.01234), _two(3.21), _two(120.0)
    ('0.012', '3.2', '120')
    """
    if value <= 0 or not math.isfinite(value):
        return "0" if value == 0 else str(value)
    return f"{value:.{max(1 - math.floor(math.log10(value)), 0)}f}"
