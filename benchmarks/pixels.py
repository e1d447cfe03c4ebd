"""Pixels in: rendered boards with blur and noise, the real detector, no lens known; are the sigmas honest?"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

import numpy as np
from vical_mocks.camera import CameraSettings, SimulatedCamera
from vical_mocks.harness.boards import APRILGRID, CHECKERBOARD, rig_before
from vical_mocks.harness.feed import PARAMETERS, CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import SimulatedFrame, simulate

from benchmarks import runner
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.vision.detector import BoardDetector
from vical_daemon.vision.target import Target

BOARDS: dict[str, tuple[Target, float]] = {"aprilgrid": (APRILGRID, 0.8), "checkerboard": (CHECKERBOARD, 0.6)}
_UNITS = np.array([1e3] * 3 + [180.0 / np.pi] * 3 + [1e6])


def trial(board: str, seconds: float, exposure_s: float, seed: int) -> runner.Result:
    """One rendered recording, from the picture to the calibration."""
    target, distance_m = BOARDS[board]
    shift_s = float(np.random.default_rng([seed, 91]).uniform(-0.05, 0.05))
    rig = rig_before(target, distance_m, seed, timeshift_cam_imu_s=shift_s)
    run = simulate(seed, seconds, rig=rig)
    settings = CameraSettings(exposure_s=exposure_s)
    film = SimulatedCamera(target, rig.lens, rig.camera_pose_target, settings, seed)
    detector = BoardDetector(target)
    frames: list[SimulatedFrame] = []
    for frame in run.frames:
        found = detector.detect(film.render(frame.t_s), frame.t_cam_ns)
        if found is not None:
            none = np.zeros(len(found.ids), bool)
            frames.append(replace(frame, ids=found.ids, uv_px=found.uv_px, outlier=none))
    run = replace(run, frames=frames, points_m=target.points_m)
    prior = camera_prior(run, seed, StartErrors(0.10, 15.0), exact_lens=False)
    record = feed(run, CalibratorSubject(CalibrationOptions(imu_noise=imu_noise(run)), prior, run.points_m))
    last = record.snapshots[-1] if record.snapshots else None
    return {
        "error": None if last is None else last.error,
        "sigma": None if last is None else np.sqrt(np.diag(last.covariance)),
        "status": record.statuses[-1][1] if record.statuses else "none",
        "images": len(frames),
    }


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks pixels", description=__doc__)
    runner.add_arguments(parser, trials=100, seconds=10.0)
    parser.add_argument("--exposure-s", type=float, default=0.004)
    args = parser.parse_args(argv)
    code = runner.fingerprint(
        "vical_daemon/estimation", "vical_daemon/vision", "mocks/vical_mocks", "benchmarks/pixels.py"
    )
    heads = ["board", "answers", *PARAMETERS[:7], "all 7 within 3 sigma", "all 15", "of all errors", "status"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for board in args.case or BOARDS:
        name = f"pixels_{board}_{args.seconds:g}s_{1e3 * args.exposure_s:g}ms"
        one = partial(trial, board, args.seconds, args.exposure_s)
        print(_row(board, runner.run_trials(name, one, runner.seeds_of(args), args, code)), flush=True)
    return 0


def _row(board: str, results: list[runner.Result]) -> str:
    """RMSE (RMS of the sigmas) of each parameter, and how often all lie within three sigmas."""
    answered = [r for r in results if r["error"] is not None]
    if not answered:
        return f"| {board} | 0/{len(results)} |" + " |" * 11
    error, sigma = (np.array([r[k] for r in answered], np.float64) for k in ("error", "sigma"))
    rms = [np.sqrt((x[:, :7] ** 2).mean(axis=0)) * _UNITS for x in (error, sigma)]
    cells = [f"{e:.3g} ({s:.3g})" for e, s in zip(*rms, strict=True)]
    within = np.abs(error) < 3.0 * sigma
    statuses = sorted({str(r["status"]) for r in results})
    counts = ", ".join(f"{sum(r['status'] == s for r in results)} {s}" for s in statuses)
    return (
        f"| {board} | {len(answered)}/{len(results)} | {' | '.join(cells)} "
        f"| {int(within[:, :7].all(axis=1).sum())} | {int(within.all(axis=1).sum())} | {within.mean():.2%} "
        f"| {counts} |"
    )
