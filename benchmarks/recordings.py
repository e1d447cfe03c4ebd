"""Two recordings of one rig calibrated as one: honest, and as good as both together?

Pairs of simulated recordings with the rig in common; motion, biases and the direction of gravity differ. And
the halves of EuRoC's recording as two recordings, and the whole.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from vical_mocks.harness.feed import (
    CAMERA,
    CalibratorSubject,
    StartErrors,
    camera_prior,
    events_in_order,
    imu_noise,
    matrix_of_quaternion,
    nees,
    points_frame,
)
from vical_mocks.harness.recordings import Items, read
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import BiasWalk, Rig, nominal_gravity, reference_rig
from vical_mocks.rotations import exp_so3, log_so3
from vical_mocks.tracks import simulate_tracks

from benchmarks import euroc_halves
from vical_daemon.estimation.measurements import CalibrationOptions, PointsFrame
from vical_daemon.estimation.result import CameraEstimate
from vical_daemon.vision.target import load_target

SHIFT_S = 0.01
_GYRO_BIAS_RPS, _ACCEL_BIAS_MPS2, _LEAN_RAD = np.deg2rad(1.5), 0.15, 0.3  # by which the second differs


def another(seed: int, *, leans: bool) -> Rig:
    """The rig of `reference_rig` on another day: its own motion and biases; the board `leans` elsewhere."""
    rng = np.random.default_rng([seed, 64])
    gravity = nominal_gravity()
    if leans:
        gravity = exp_so3(_LEAN_RAD * rng.standard_normal(3)) @ gravity
    return reference_rig(
        seed,
        timeshift_cam_imu_s=SHIFT_S,
        gravity_world_mps2=gravity,
        gyro_bias=BiasWalk(_GYRO_BIAS_RPS * rng.standard_normal(3), 2e-5, seed),
        accel_bias=BiasWalk(_ACCEL_BIAS_MPS2 * rng.standard_normal(3), 2e-4, seed + 1),
    )


def calibrate(runs: Sequence[SimulatedRun], *, target_free: bool, lens_known: bool) -> CameraEstimate:
    """Calibrate recordings as one."""
    first = runs[0]
    prior = camera_prior(first, 0, StartErrors(0.05, 5.0), exact_lens=lens_known)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset[str]()
    options = CalibrationOptions(fix=fix, target_free=target_free, imu_noise=imu_noise(first))
    subject = CalibratorSubject(options, prior, None if target_free else first.points_m)
    for number, run in enumerate(runs):
        if number:
            subject.calibrator.next_recording()
        for _, event in events_in_order(run):
            if isinstance(event, int):
                subject.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
            else:
                subject.add_points(points_frame(event))
        subject.finish()
    answer: CameraEstimate = subject.calibrator.estimate().cameras[CAMERA]
    return answer


def compare(camera: CameraEstimate, rig: Rig) -> tuple[float, np.ndarray]:
    """NEES over 7 and the standard deviations [lever arm, mounting, time shift], shape (7,)."""
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = camera.T_imu_cam.covariance
    covariance[6, 6] = camera.timeshift_sigma_s**2
    turn = log_so3(rig.R_imu_cam.T @ matrix_of_quaternion(camera.T_imu_cam.q_wxyz))
    moved = np.subtract(camera.T_imu_cam.p_m, rig.p_imu_cam)
    error = np.concatenate([moved, turn, [camera.timeshift_cam_imu_s - SHIFT_S]])
    return nees(error, covariance, 7) / 7.0, np.sqrt(np.diag(covariance))


def pairs(seeds: range, seconds: float, *, target_free: bool, lens_known: bool) -> str:
    """One row: NEES/7 of first, second and both; sigmas of both over those that the two make together."""
    values, ratios = [], []
    for seed in seeds:
        rigs = reference_rig(seed, timeshift_cam_imu_s=SHIFT_S), another(seed + 1000, leans=not target_free)
        both_rigs = zip((seed, seed + 1000), rigs, strict=True)
        if target_free:
            runs = [simulate_tracks(s, seconds, rig=rig, camera_rate_hz=10.0) for s, rig in both_rigs]
        else:
            runs = [simulate(s, seconds, rig=rig, corner_sigma_px=0.3) for s, rig in both_rigs]
        found = [
            compare(calibrate(chosen, target_free=target_free, lens_known=lens_known), rigs[0])
            for chosen in (runs[:1], runs[1:], runs)
        ]
        values.append([value for value, _ in found])
        one, other, both = (sigma for _, sigma in found)
        ratios.append(both * np.sqrt(one**-2.0 + other**-2.0))
    mean, ratio = np.mean(values, axis=0), np.median(ratios, axis=0)
    name = "no target" if target_free else "lens known" if lens_known else "lens free"
    cells = " | ".join(f"{x:.2f}" for x in mean)
    blocks = " / ".join(f"{np.mean(ratio[s]):.2f}" for s in (slice(0, 3), slice(3, 6), slice(6, 7)))
    return f"| {name} | {len(values)} | {cells} | {np.max(values, axis=0)[2]:.1f} | {blocks} |"


def euroc() -> None:
    """Print how far the halves as two recordings are from the whole, in its sigmas."""
    folder = euroc_halves.FOLDER
    if not folder.is_dir():
        print(f"no recording at {folder}", file=sys.stderr)
        return
    items, points = read(folder), load_target(folder / "target.yaml").points_m
    split = items[0][0] + int(euroc_halves.SPLIT_S * 1e9)
    halves = [[i for i in items if (i[0] < split) == first] for first in (True, False)]
    print(
        "| EuRoC, lens | order | lever arm mm | rotation deg | time shift us | largest, sigmas of the whole |"
    )
    print("|---|---|---|---|---|---|")
    for lens, fix in (("fixed", frozenset({"intrinsics"})), ("free", frozenset[str]())):
        options = CalibrationOptions(fix=fix, imu_noise=euroc_halves.NOISE)
        whole = as_one([items], options, points)
        for order, parts in (("first, second", halves), ("second, first", halves[::-1])):
            print(f"| {lens} | {order} | {_difference(whole, as_one(parts, options, points))} |", flush=True)


def as_one(parts: Sequence[Items], options: CalibrationOptions, points: np.ndarray) -> CameraEstimate:
    """Calibrate stretches of EuRoC's recording as recordings of one rig."""
    subject = CalibratorSubject(options, euroc_halves.PRIOR, points)
    for number, part in enumerate(parts):
        if number:
            subject.calibrator.next_recording()
        for _, item in part:
            if isinstance(item, PointsFrame):
                subject.add_points(PointsFrame(CAMERA, item.t_cam_ns, item.ids, item.uv_px, item.sigma_px))
            else:
                subject.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)  # type: ignore[attr-defined]
        subject.finish()
    answer: CameraEstimate = subject.calibrator.estimate().cameras[CAMERA]
    return answer


def in_sigmas(whole: CameraEstimate, parts: CameraEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Difference [lever arm m, mounting rad, time shift s] and the same over the sigmas of `whole`, (7,)."""
    R = [matrix_of_quaternion(x.T_imu_cam.q_wxyz) for x in (whole, parts)]
    moved, turn = np.subtract(parts.T_imu_cam.p_m, whole.T_imu_cam.p_m), log_so3(R[0].T @ R[1])
    shift_s = parts.timeshift_cam_imu_s - whole.timeshift_cam_imu_s
    sigma = np.sqrt([*np.diag(whole.T_imu_cam.covariance), whole.timeshift_sigma_s**2])
    difference = np.concatenate([moved, turn, [shift_s]])
    return difference, difference / sigma


def _difference(whole: CameraEstimate, parts: CameraEstimate) -> str:
    d, z = in_sigmas(whole, parts)
    arm_mm, turn_deg = 1e3 * np.linalg.norm(d[:3]), np.rad2deg(np.linalg.norm(d[3:6]))
    return f"{arm_mm:.2f} | {turn_deg:.3f} | {1e6 * abs(d[6]):.0f} | {np.abs(z).max():.2f}"


def main(argv: list[str]) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks recordings", description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="pairs of recordings a row")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each recording; 14 without a target")
    parser.add_argument("--first-seed", type=int, default=10)
    args = parser.parse_args(argv)
    seeds = range(args.first_seed, args.first_seed + args.trials)
    print("| | pairs | NEES/7 first | second | both | largest of both | sigmas over the two together |")
    print("|---|---|---|---|---|---|---|", flush=True)
    print(pairs(seeds, args.seconds, target_free=False, lens_known=True), flush=True)
    print(pairs(seeds, args.seconds, target_free=False, lens_known=False), flush=True)
    print(pairs(seeds, 0.7 * args.seconds, target_free=True, lens_known=True), flush=True)
    euroc()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
