"""Target-free on data of others: OpenVINS's simulator, and OpenVINS on it, real corners as unknown points."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from vical_mocks.harness.recordings import OPENVINS, Figures, camera_of, read

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.estimation.target_free import TargetFreeCalibrator

FloatArray = npt.NDArray[np.float64]
DATA = Path(__file__).parents[2] / "shared" / "data"
TIMES_S = (10.0, 30.0, 60.0, 120.0)


class Case(NamedTuple):
    """One recording, and how it is calibrated.

    Attributes:
        title: Of its table.
        folder: Of the recording, below that of the data.
        truth: File of the reference.
        given: The mounting and time shift of its start file are used.
        lens_fixed: The lens of its start file is held.
    """

    title: str
    folder: str
    truth: str
    given: bool
    lens_fixed: bool


CASES = {
    "openvins, nothing known": Case(
        "OpenVINS's data, nothing known of the mounting", "openvins_sim_tum", "reference.yaml", False, False
    ),
    "openvins": Case(
        "OpenVINS's data, from its start values", "openvins_sim_tum", "reference.yaml", True, False
    ),
    "euroc": Case(
        "EuRoC corners as unknown points, compared with Kalibr",
        "euroc_imu_april",
        "reference_kalibr.yaml",
        False,
        True,
    ),
}


class Errors(NamedTuple):
    """How far a calibration is off.

    Attributes:
        error: Of position m, rotation rad, time shift s; shape (7,).
        sigma: Of each; shape (7,).
        nees: Over the seven degrees of freedom.
    """

    error: FloatArray
    sigma: FloatArray
    nees: float


def make_calibrator(case: Case, data: Path) -> TargetFreeCalibrator:
    """A calibrator with what is known of the camera before."""
    folder = data / case.folder
    truth, start = camera_of(folder / case.truth), camera_of(folder / "initial.yaml")
    prior = CameraPrior(
        tuple(start.get("resolution", truth.get("resolution", (752, 480)))),
        tuple(start["intrinsics"]),
        "radtan",
        tuple(start["distortion_coeffs"]),
        (start["R"], start["p"]) if case.given else None,
        start.get("timeshift_cam_imu") if case.given else None,
    )
    fix = frozenset({"intrinsics"}) if case.lens_fixed else frozenset()
    options = CalibrationOptions(fix=fix, target_free=True, imu_noise=start["noise"])
    return TargetFreeCalibrator(options, {"cam0": prior})


def run(case: Case, data: Path, others: dict[float, Figures]) -> list[str]:
    """Rows of the table: errors, sigmas and NEES at the times of interest and at the end."""
    truth = camera_of(data / case.folder / case.truth)
    calibrator = make_calibrator(case, data)
    rows, waiting = [], list(TIMES_S)
    spent_s: dict[bool, list[float]] = {False: [], True: []}  # before and after the start
    items = read(data / case.folder)
    for t_ns, item in items:
        if isinstance(item, PointsFrame):
            started, before_s = calibrator.latest is not None, time.process_time()
            calibrator.add_points(replace(item, camera="cam0"))
            calibrator.process()
            spent_s[started].append(time.process_time() - before_s)
        else:
            calibrator.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)  # type: ignore[attr-defined]
        while waiting and (t_ns - items[0][0]) * 1e-9 >= waiting[0]:
            rows.append(row(f"{waiting[0]:g} s", calibrator, truth, others.get(waiting.pop(0))))
    calibrator.finish()
    cost = f"start {sum(spent_s[False]):.1f} s CPU, then {1e3 * np.mean(spent_s[True]):.1f} ms a frame"
    rows.append(row(f"end, {calibrator.estimate().status}, {cost}", calibrator, truth, None))
    return rows


def row(
    name: str,
    calibrator: TargetFreeCalibrator,
    truth: dict[str, Any],
    other: Figures | None,
) -> str:
    """One line: errors (sigma) of rotation, lever arm and time shift; OpenVINS's; NEES of the seven."""
    found = errors(calibrator.estimate(), truth)
    if found is None:
        return f"| {name} | - | - | - | - |"
    arm_mm, turn_deg, shift_ms = sizes(found.error)
    arm_sigma, turn_sigma, shift_sigma = sizes(found.sigma)
    theirs = [f" / {x:g}" for x in other] if other else ["", "", ""]
    return (
        f"| {name} | {turn_deg:.3f} ({turn_sigma:.3f}){theirs[0]} "
        f"| {arm_mm:.2f} ({arm_sigma:.2f}){theirs[1]} "
        f"| {shift_ms:.3f} ({shift_sigma:.3f}){theirs[2]} | {found.nees:.2f} |"
    )


def errors(estimate: CalibrationEstimate, truth: dict[str, Any]) -> Errors | None:
    """How far a calibration is off; None: there is none."""
    if not estimate.cameras:
        return None
    c = estimate.cameras["cam0"]
    turn = so3.log(truth["R"].T @ so3.matrix_from_quat(np.array(c.T_imu_cam.q_wxyz)))
    arm = np.array(c.T_imu_cam.p_m) - truth["p"]
    shift = c.timeshift_cam_imu_s - float(truth.get("timeshift_cam_imu", 0.0))
    P = np.zeros((7, 7))
    P[:6, :6], P[6, 6] = c.T_imu_cam.covariance, c.timeshift_sigma_s**2
    error = np.array([*arm, *turn, shift])
    return Errors(error, np.sqrt(np.diag(P)), float(error @ np.linalg.solve(P, error)) / 7)


def sizes(x: FloatArray) -> Figures:
    """Lever arm mm, rotation deg and time shift ms of errors or sigmas, shape (7,)."""
    turn, arm = np.linalg.norm(x[3:6]), np.linalg.norm(x[:3])
    return 1e3 * float(arm), float(np.rad2deg(turn)), 1e3 * abs(float(x[6]))


def main(argv: list[str]) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks target_free", description=__doc__)
    parser.add_argument(
        "--data", type=Path, default=DATA, help="folder with openvins_sim_tum, euroc_imu_april"
    )
    parser.add_argument("--only", choices=("openvins", "euroc"))
    args = parser.parse_args(argv)
    head = "| after | rotation deg (sigma) / OpenVINS | lever arm mm | time shift ms | NEES / 7 |"
    head += "\n|---|---|---|---|---|"
    for case in CASES.values():
        if args.only and not case.folder.startswith(args.only):
            continue
        if not (args.data / case.folder).is_dir():
            print(f"no recording at {args.data / case.folder}: name the folder with --data", file=sys.stderr)
            return 1
        print(f"\n{case.title}\n\n{head}")
        for line in run(case, args.data, {} if case.lens_fixed else OPENVINS):
            print(line, flush=True)
    return 0
