"""A delay that moves in some way: do rotations alone (`DelayWatch`) warn where the filter does not?

The daemon runs both; the watch changes no estimate. So nothing is taken away here: both are
run, and what each announces is compared.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from vical_mocks.harness.feed import (
    Record,
    Snapshot,
    StartErrors,
    camera_prior,
    feed,
    imu_noise,
)
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import reference_rig

from benchmarks import runner
from benchmarks.gaps import Late, Retimed
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, PointsFrame
from vical_daemon.estimation.temporal.td_icp import TdIcpOptions
from vical_daemon.estimation.temporal.td_icp_watch import DelayWatch

SECONDS = 120.0
_AT_S = 30.0
_WRONG = 4.0  # sigmas of the time shift, while converged
_OWN = {EventKind.CLOCK_DRIFT, EventKind.CLOCK_WANDER, EventKind.TIMESHIFT_STEPPED, EventKind.BUMPED}


def _drift(rate: float, t_s: float) -> float:
    return rate * max(t_s - _AT_S, 0.0)


def _wave(size_s: float, period_s: float, t_s: float) -> float:
    return size_s * float(np.sin(2.0 * np.pi * t_s / period_s))


def _step(size_s: float, t_s: float) -> float:
    return size_s if t_s >= _AT_S else 0.0


MOVES: dict[str, Late] = {
    "constant": lambda _t_s: 0.0,
    "drifts by 20 ppm from 30 s on": partial(_drift, 2e-5),
    "drifts by 100 ppm from 30 s on": partial(_drift, 1e-4),
    "swings by 0.5 ms in 60 s": partial(_wave, 5e-4, 60.0),
    "swings by 2 ms in 60 s": partial(_wave, 2e-3, 60.0),
    "steps by 1 ms at 30 s": partial(_step, 1e-3),
    "steps by 5 ms at 30 s": partial(_step, 5e-3),
}


class Watched(Retimed):
    """The calibrator and the watch, as the daemon runs them; the camera's stamps move."""

    sensor = "camera"
    delay: DelayWatch
    warned_s: float | None = None

    def add_imu(self, t_ns: int, gyro: Any, force: Any) -> None:
        """See `Subject`."""
        super().add_imu(t_ns, gyro, force)
        self.delay.add_imu(t_ns, gyro)

    def add_points(self, frame: PointsFrame) -> None:
        """See `Subject`."""
        super().add_points(frame)
        self.delay.add_points(replace(frame, t_cam_ns=self.stamp("camera", frame.t_cam_ns)))

    def look(self, run: SimulatedRun, t_s: float, record: Record) -> Snapshot | None:
        """See `Subject`; the watch compares itself with the estimate."""
        shot = super().look(run, t_s, record)
        self.delay.look(self.calibrator.estimate())
        if self.warned_s is None and any(v.warning for v in self.delay.verdicts.values()):
            self.warned_s = t_s
        return shot


def watched(move: str, seed: int) -> runner.Result:
    """One rig whose delay moves: what was announced, by whom and when, and when the answer was wrong."""
    run = simulate(seed, SECONDS, rig=reference_rig(seed, timeshift_cam_imu_s=0.01))
    noise = imu_noise(run)
    options = CalibrationOptions(imu_noise=noise)
    subject = Watched(options, camera_prior(run, seed, StartErrors(), exact_lens=False), run.points_m)
    subject.late_s, subject.epoch_ns = MOVES[move], run.options.epoch_ns
    gyro = TdIcpOptions(gyro_density=noise.gyro_density, gyro_walk=noise.gyro_walk, gyro_log_sigma=0.7)
    subject.delay = DelayWatch(run.points_m, ["cam0"], gyro)
    record = feed(run, subject, 0.5)
    own = sorted((t, str(e.kind)) for t, e in record.events if e.kind in _OWN)
    wrong = []
    for s in record.snapshots:
        sigma_s = max(float(np.sqrt(s.covariance[6, 6])), 1e-12)
        z = abs(s.error[6] + MOVES[move](s.t_s)) / sigma_s
        if s.status == "converged" and z > _WRONG:
            wrong.append(s.t_s)
    return {
        "warned_s": subject.warned_s,
        "announced": own,
        "wrong_s": 0.5 * len(wrong),
        "first_wrong_s": min(wrong, default=None),
        "windows": subject.delay.verdicts["cam0"].windows,
    }


def main(argv: list[str]) -> int:
    """Print a row for each rig."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks ablation_watch", description=__doc__)
    parser.add_argument("--trials", type=int, default=2)
    args = parser.parse_args(argv)
    print("| the delay | rig | filter announces (s) | converged and wrong s (first) | rotations warn at s |")
    print("|---|---|---|---|---|")
    for move in MOVES:
        for seed in range(args.trials):
            r = watched(move, seed)
            said = ", ".join(f"{kind} {t:.0f}" for t, kind in r["announced"]) or "-"
            first = "" if r["first_wrong_s"] is None else f" ({r['first_wrong_s']:.0f})"
            print(
                f"| {move} | {seed} | {said} | {r['wrong_s']:.0f}{first} | {r['warned_s'] or '-'} |",
                flush=True,
            )
    return 0
