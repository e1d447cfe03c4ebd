"""Temporal calibration: RMSE and the bound, honest sigmas, outliers, holes, several sensors, real data.

The thesis' Table 3.1 is 100 trials on each of four trajectories; tables 3.2 and 3.3 are a hand-held camera
and imu, and several sensors of one robot.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from vical_mocks.rotations import exp_so3
from vical_mocks.trajectory import hand_motion

from benchmarks.td_icp_streams import study_handheld, study_joint, study_real
from benchmarks.td_icp_tracks import study_tracks
from benchmarks.td_icp_trials import DEG, HEADER, IMU_HZ, TRAJECTORIES, row_of, simulate_gyro, trial
from benchmarks.td_icp_wrong import study_wrong


def study_main(trials: int) -> None:
    """Table 3.1: four trajectories, 10 s at 15 Hz, 0.1 deg, delays up to 2 s."""
    print(f"\n### {trials} trials, 10 s, 15 Hz, 0.1 deg, GX3 gyro, true delay within 2 s, any mounting\n")
    print(HEADER)
    everything = []
    for name, make in TRAJECTORIES.items():
        rows = [trial(make(s), s) for s in range(trials)]
        everything += rows
        print(row_of(name, rows), flush=True)
    print(row_of("all", everything))


def study_robust(trials: int) -> None:
    """Outliers, a hole, short, slow and noisy recordings."""
    print(f"\n### {trials} trials of hand motion at 60 deg/s under stress\n\n{HEADER}")
    cases: dict[str, dict[str, float]] = {
        "30 % outliers and a 1 s hole": {"outliers": 0.3, "hole_s": 1.0},
        "5 s": {"seconds": 5.0},
        "30 Hz": {"camera_hz": 30.0},
        "0.2 deg": {"sigma": 0.2 * DEG},
    }
    for name, changes in cases.items():
        print(row_of(name, [trial(hand_motion(s, 60.0), s, **changes) for s in range(trials)]), flush=True)
    print(row_of("20 deg/s", [trial(hand_motion(s, 20.0), s) for s in range(trials)]), flush=True)


def figure_start(path: Path) -> None:
    """Draw what the coarse start sees: disagreement of turn angles over the delay, true delay +1.3 s."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from vical_daemon.estimation.geometry.so3 import quat_from_matrix
    from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
    from vical_daemon.estimation.temporal.rotation_start import shift_costs
    from vical_daemon.estimation.temporal.rotation_turns import camera_turns

    shift, rng, motion = 1.3, np.random.default_rng(1), hand_motion(1, 60.0)
    t_imu = np.arange(0.0, 16.0, 1.0 / IMU_HZ)
    curve = GyroCurve.integrate(t_imu, simulate_gyro(motion, t_imu, rng)[0], np.zeros(3))
    t = np.arange(3.0, 13.0, 1.0 / 15.0)
    figure, axes = plt.subplots(figsize=(7.0, 3.2))
    for outliers, label in ((0.0, "no outliers"), (0.3, "30 % of the orientations wrong")):
        R = motion.R_world_imu(t) @ exp_so3(rng.normal(0.0, 0.1 * DEG, (len(t), 3)))
        bad = rng.random(len(t)) < outliers
        R[bad] = R[bad] @ exp_so3(rng.normal(0.0, 0.7, (int(bad.sum()), 3)))
        turns = camera_turns(t - shift, quat_from_matrix(R))
        delays = np.arange(-4.0, 4.0, 0.01)
        cost = shift_costs(curve, t - shift, turns, delays, 0.25 * float(np.quantile(turns.angle, 0.4)))
        axes.plot(delays, cost, label=label, linewidth=1.0)
    axes.axvline(shift, color="grey", linewidth=0.6)
    axes.set_xlabel("delay tried, s")
    axes.set_ylabel("mean robust disagreement")
    axes.legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(f"wrote {path}")


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks td_icp", description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--study", default="main,robust,wrong,handheld,joint,tracks,real")
    parser.add_argument("--data", type=Path, default=Path("../shared/data/euroc_imu_april"))
    parser.add_argument("--figure", type=Path, help="only draw the figure of the coarse start there")
    args = parser.parse_args(list(argv))
    if args.figure is not None:
        figure_start(args.figure)
        return 0
    studies = {
        "main": lambda: study_main(args.trials),
        "robust": lambda: study_robust(args.trials),
        "wrong": lambda: study_wrong(args.trials),
        "handheld": lambda: study_handheld(args.trials),
        "joint": lambda: study_joint(args.trials),
        "tracks": lambda: study_tracks(min(args.trials, 30)),
        "real": lambda: study_real(args.data),
    }
    for name in args.study.split(","):
        if name not in studies:
            print(f"no study {name!r}; there are: {', '.join(studies)}")
            return 2
        studies[name]()
    return 0
