"""An hour of simulated time, with a board or without: memory, cost and honesty do not change with age."""

from __future__ import annotations

import argparse
import gc
import time
from pathlib import Path

import numpy as np
from vical_mocks.harness.feed import (
    CalibratorSubject,
    Record,
    StartErrors,
    camera_prior,
    events_in_order,
    imu_noise,
    points_frame,
)
from vical_mocks.points import SimulatedFrame, SimulatedRun, board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.measurements import CalibrationOptions

_REPORTS = 7


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def main(argv: list[str]) -> int:
    """Run one recording and report now and then."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks hour", description=__doc__)
    parser.add_argument("--target-free", action="store_true")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--camera-rate-hz", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(argv)
    rig = reference_rig(args.seed, timeshift_cam_imu_s=0.01)
    make = simulate_tracks if args.target_free else simulate
    run = make(args.seed, args.seconds, rig=rig, camera_rate_hz=args.camera_rate_hz)
    prior = camera_prior(run, args.seed, StartErrors(0.05, 5.0), exact_lens=False)
    options = CalibrationOptions(imu_noise=imu_noise(run), target_free=args.target_free)
    subject = CalibratorSubject(options, prior, None if args.target_free else board_points())
    heads = ["after min", "resident MB", "CPU ms an image", "status", "largest z", "arm mm", "turn deg"]
    heads.append("announced")
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    record, due, frames = Record(), np.linspace(args.seconds / 60.0, args.seconds, _REPORTS).tolist(), 0
    begin = time.process_time()
    for t_s, event in events_in_order(run):
        if isinstance(event, SimulatedFrame):
            subject.add_points(points_frame(event))
            frames += 1
        else:
            subject.add_imu(int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])
        if due and t_s >= due[0]:
            due.pop(0)
            print(_row(subject, run, record, t_s, 1e3 * (time.process_time() - begin) / frames), flush=True)
            begin, frames = time.process_time(), 0
    return 0


def _row(subject: CalibratorSubject, run: SimulatedRun, record: Record, t_s: float, cost_ms: float) -> str:
    answer = subject.look(run, t_s, record)
    news = ", ".join(str(event.kind) for _, event in record.events)
    record.events.clear()
    if answer is None:
        return f"| {t_s / 60:.0f} | {resident_mb():.0f} | {cost_ms:.1f} | no answer | | | | {news} |"
    sigma = np.sqrt(np.diag(answer.covariance))
    worst = float(np.abs(answer.error / sigma).max())
    arm, turn = 1e3 * np.linalg.norm(answer.error[:3]), np.rad2deg(np.linalg.norm(answer.error[3:6]))
    return (
        f"| {t_s / 60:.0f} | {resident_mb():.0f} | {cost_ms:.1f} | {answer.status} | {worst:.1f} "
        f"| {arm:.2f} | {turn:.4f} | {news} |"
    )
