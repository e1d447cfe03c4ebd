"""Target-free on data of others: OpenVINS's simulator, and OpenVINS on it, real corners as unknown points."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from vical_mocks.harness.recordings import OPENVINS, Figures, camera_of, read

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.target_free import TargetFreeCalibrator

FloatArray = npt.NDArray[np.float64]
DATA = Path(__file__).parents[2] / "shared" / "data"
TIMES_S = (10.0, 30.0, 60.0, 120.0)


def run(
    folder: Path, truth: dict[str, Any], *, given: bool, lens_fixed: bool, others: dict[float, Figures]
) -> list[str]:
    """Rows of the table: errors, sigmas and NEES at the times of interest and at the end."""
    start = camera_of(folder / "initial.yaml")
    prior = CameraPrior(
        tuple(start.get("resolution", truth.get("resolution", (752, 480)))),
        tuple(start["intrinsics"]),
        "radtan",
        tuple(start["distortion_coeffs"]),
        (start["R"], start["p"]) if given else None,
        start.get("timeshift_cam_imu") if given else None,
    )
    fix = frozenset({"intrinsics"}) if lens_fixed else frozenset()
    options = CalibrationOptions(fix=fix, target_free=True, imu_noise=start["noise"])
    calibrator = TargetFreeCalibrator(options, {"cam0": prior})
    rows, waiting = [], list(TIMES_S)
    spent_s: dict[bool, list[float]] = {False: [], True: []}  # before and after the start
    items = read(folder)
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
    cameras = calibrator.estimate().cameras
    if not cameras:
        return f"| {name} | - | - | - | - |"
    c = cameras["cam0"]
    turn = so3.log(truth["R"].T @ so3.matrix_from_quat(np.array(c.T_imu_cam.q_wxyz)))
    arm = np.array(c.T_imu_cam.p_m) - truth["p"]
    shift = c.timeshift_cam_imu_s - float(truth.get("timeshift_cam_imu", 0.0))
    P = np.array(c.T_imu_cam.covariance)
    error = np.concatenate([arm, turn])
    nees = (error @ np.linalg.solve(P, error) + (shift / c.timeshift_sigma_s) ** 2) / 7
    s = np.sqrt([np.trace(P[3:, 3:]), np.trace(P[:3, :3])])
    theirs = [f" / {x:g}" for x in other] if other else ["", "", ""]
    return (
        f"| {name} | {np.rad2deg(np.linalg.norm(turn)):.3f} ({np.rad2deg(s[0]):.3f}){theirs[0]} "
        f"| {1e3 * np.linalg.norm(arm):.2f} ({1e3 * s[1]:.2f}){theirs[1]} "
        f"| {1e3 * abs(shift):.3f} ({1e3 * c.timeshift_sigma_s:.3f}){theirs[2]} | {nees:.2f} |"
    )


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
    cases = []
    if args.only != "euroc":
        folder = args.data / "openvins_sim_tum"
        truth = folder / "reference.yaml"
        cases += [("OpenVINS's data, nothing known of the mounting", folder, truth, False, False)]
        cases += [("OpenVINS's data, from its start values", folder, truth, True, False)]
    if args.only != "openvins":
        folder = args.data / "euroc_imu_april"
        cases += [
            (
                "EuRoC corners as unknown points, compared with Kalibr",
                folder,
                folder / "reference_kalibr.yaml",
                False,
                True,
            )
        ]
    for title, folder, truth, given, lens_fixed in cases:
        if not folder.is_dir():
            print(f"no recording at {folder}: name the folder with --data", file=sys.stderr)
            return 1
        print(f"\n{title}\n\n{head}")
        others = {} if lens_fixed else OPENVINS
        for line in run(folder, camera_of(truth), given=given, lens_fixed=lens_fixed, others=others):
            print(line, flush=True)
    return 0
