"""Temporal calibration when something is wrong, and beside a running filter."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from vical_mocks.points import board_points, simulate
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import exp_so3
from vical_mocks.trajectory import hand_motion

from benchmarks.td_icp_trials import DEG, GYRO, IMU_HZ, WALK, simulate_gyro
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.estimation.temporal.td_icp import TdIcpOptions, td_icp
from vical_daemon.estimation.temporal.td_icp_watch import DelayWatch

FloatArray = npt.NDArray[np.float64]

# What is done to a recording, and the words that a refusal must hold; empty: it must be solved.
WRONG = {
    "camera 0.75 s early": "",
    "camera 0.75 s late": "",
    "gyro in deg/s": "degrees per second",
    "gyro divided by 57.3": "divided",
    "camera stamps stretched 5 %": "stamps",
    "camera stamps shrunk 5 %": "stamps",
    "camera stamps stretched 1 %": "stamps",
    "imu stamps stretched 5 %": "stamps",
    "one gyro axis reversed": "mirrored",
    "two gyro axes swapped": "mirrored",
    "orientations inverted": "inverted",
    "another recording": "no delay|direction|only",
}


def _recording(seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    rng, motion = np.random.default_rng([seed, 21]), hand_motion(seed, 60.0)
    t_imu = np.arange(3.0, 17.0, 1.0 / IMU_HZ)
    gyro, _ = simulate_gyro(motion, t_imu, rng)
    t = np.arange(5.0, 15.0, 1.0 / 15.0)
    R = motion.R_world_imu(t) @ exp_so3(rng.normal(0.0, 1.5, 3))
    return t_imu, gyro, t, R @ exp_so3(rng.normal(0.0, 0.1 * DEG, (len(t), 3)))


def _spoiled(seed: int, what: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    t_imu, gyro, t, R = _recording(seed)
    stretch = {"stretched 5 %": 1.05, "shrunk 5 %": 0.95, "stretched 1 %": 1.01}
    factor = next((f for words, f in stretch.items() if what.endswith(words)), 1.0)
    if what.startswith("imu"):
        t_imu = t_imu[0] + factor * (t_imu - t_imu[0])
    else:
        t = t[0] + factor * (t - t[0])
    t = t + {"camera 0.75 s early": -0.75, "camera 0.75 s late": 0.75}.get(what, 0.0)
    gyro = gyro * {"gyro in deg/s": 1.0 / DEG, "gyro divided by 57.3": DEG}.get(what, 1.0)
    if what == "one gyro axis reversed":
        gyro = gyro * np.array([1.0, -1.0, 1.0])
    elif what == "two gyro axes swapped":
        gyro = gyro[:, [0, 2, 1]]
    elif what == "orientations inverted":
        R = np.swapaxes(R, 1, 2)
    elif what == "another recording":
        R = _recording(seed + 10_000)[3]
    return t_imu, gyro, t, R


def study_wrong(trials: int) -> None:
    """Input that must be refused with the right reason, or solved all the same."""
    print(f"\n### {trials} recordings of 10 s, hand motion at 60 deg/s, with something wrong\n")
    print("| what is wrong | expected | solved | refused | with the right reason | slowest CPU s |")
    print("|---|---|---|---|---|---|")
    options = TdIcpOptions(gyro_density=GYRO, gyro_walk=WALK)
    for what, words in WRONG.items():
        solved = refused = named = 0
        slowest = 0.0
        for seed in range(trials):
            data = _spoiled(seed, what)
            cpu = time.process_time()
            result = td_icp(*data, 0.1 * DEG, options)
            slowest = max(slowest, time.process_time() - cpu)
            truth = -float(what.endswith("late")) * 0.75 + float(what.endswith("early")) * 0.75
            close = abs(result.timeshift_cam_imu_s - truth) < 4.0 * result.timeshift_sigma_s
            solved += result.status == "ok" and close
            refused += result.status == "refused"
            named += result.status == "refused" and any(w in result.reason for w in words.split("|"))
        expected = f"`{words.split('|')[0]}`" if words else "solved"
        right = f"{named}" if words else ""
        print(f"| {what} | {expected} | {solved} | {refused} | {right} | {slowest:.2f} |", flush=True)


def _believed(rig_seed: int, shift_s: float) -> CalibrationEstimate:
    """A converged calibration with the true lens and this time shift."""
    lens = reference_rig(rig_seed).lens
    pose = PoseEstimate([0.0] * 3, [1.0, 0.0, 0.0, 0.0], (np.eye(6) * 1e-8).tolist())
    unsure = [0.0] * 4
    camera = CameraEstimate(
        pose, shift_s, 2e-5, list(lens.intrinsics), unsure, lens.model, list(lens.distortion), unsure, 0.2
    )
    return CalibrationEstimate(
        0, Status.CONVERGED, "", 1.0, "", 1.0, 2, 3, {"cam0": camera}, None, [0.0, 0.0, -9.8], 1.0, 0.0
    )


def study_online(seconds: float = 150.0) -> None:
    """The watch beside a filter: what it costs, what it sees of a delay that drifts or that is wrong."""
    print(
        f"\n### Monitor of a running filter, {seconds:.0f} s, board at 20 Hz, a window of 10 s in every 30\n"
    )
    print("| imu Hz | drift ppm | filter off by ms | windows | drift found ppm | warns | % of a core |")
    print("|---|---|---|---|---|---|---|")
    for hz, ppm, wrong_ms in ((100.0, 0, 0.0), (100.0, 0, 1.0), (100.0, 50, 0.0), (1000.0, 0, 0.0)):
        run = simulate(2, seconds, rig=reference_rig(2), camera_rate_hz=20.0, imu_rate_hz=hz)
        start = int(run.t_imu_ns[0])
        watch = DelayWatch(
            board_points(), ["cam0"], TdIcpOptions(gyro_density=GYRO, gyro_walk=WALK, gyro_log_sigma=0.7)
        )
        frames = [
            # the camera's clock loses `ppm` microseconds a second: its delay grows
            PointsFrame("cam0", f.t_cam_ns - round(1e-6 * ppm * (f.t_cam_ns - start)), f.ids, f.uv_px)
            for f in run.frames
        ]
        imu = [(int(t), tuple(map(float, w))) for t, w in zip(run.t_imu_ns, run.gyro_rps, strict=True)]
        estimate = _believed(2, run.rig.timeshift_cam_imu_s + 1e-3 * wrong_ms)
        cpu, k, next_ns = time.process_time(), 0, start
        for frame in frames:
            while k < len(imu) and imu[k][0] <= frame.t_cam_ns:
                watch.add_imu(*imu[k])
                k += 1
            watch.add_points(frame)
            if frame.t_cam_ns >= next_ns:
                next_ns += 200_000_000
                watch.look(estimate)
        share = (time.process_time() - cpu) / seconds
        verdict = watch.verdicts["cam0"]
        report = verdict.report
        drift = "" if report is None else f"{1e6 * report.drift:+.1f} +- {1e6 * report.drift_sigma:.1f}"
        warns = "yes" if verdict.warning else "no"
        print(
            f"| {hz:.0f} | {ppm} | {wrong_ms:.1f} | {verdict.windows} | {drift} | {warns} | "
            f"{100 * share:.1f} |",
            flush=True,
        )
