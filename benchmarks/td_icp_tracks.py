"""Temporal calibration from tracks whose errors persist, as those of a tracker's templates do."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from vical_mocks.rotations import log_so3
from vical_mocks.tracks import simulate_tracks

from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.temporal.td_icp_result import TdIcpResult
from vical_daemon.estimation.temporal.track_registration import track_registration

FloatArray = npt.NDArray[np.float64]

_FRAMES = (5.0, 30.0)  # correlation length of the errors along a track, images
_PERSISTENT_PX, _WHITE_PX = 0.5, 0.2
_CAMERA_HZ = 20.0


def persistent_errors(
    frames: list[PointsFrame], length: float, sigma_px: float, seed: int
) -> list[PointsFrame]:
    """Add to each track an error of its own that is forgotten after `length` images (first-order Markov)."""
    rng, keep = np.random.default_rng([seed, 51]), float(np.exp(-1.0 / length))
    of: dict[int, FloatArray] = {}
    out = []
    for frame in frames:
        shock = rng.normal(0.0, sigma_px, (len(frame.ids), 2))
        for i, track in enumerate(frame.ids.tolist()):
            before = of.get(track)
            of[track] = shock[i] if before is None else keep * before + np.sqrt(1.0 - keep**2) * shock[i]
        error = np.array([of[track] for track in frame.ids.tolist()]).reshape(-1, 2)
        out.append(PointsFrame(frame.camera, frame.t_cam_ns, frame.ids, frame.uv_px + error))
    return out


def track_trial(seed: int, seconds: float) -> tuple[TdIcpResult, FloatArray, float]:
    """One recording; the answer, its errors [mounting (3), shift], and the correlation length, images."""
    rng = np.random.default_rng([seed, 52])
    length, shift = float(rng.uniform(*_FRAMES)), float(rng.uniform(-0.05, 0.05))
    run = simulate_tracks(
        seed, seconds, timeshift_cam_imu_s=shift, camera_rate_hz=_CAMERA_HZ, corner_sigma_px=_WHITE_PX
    )
    base, lens = int(run.t_imu_ns[0]), run.rig.lens
    plain = [PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px) for f in run.frames]
    frames = [((f.t_cam_ns - base) * 1e-9, f) for f in persistent_errors(plain, length, _PERSISTENT_PX, seed)]
    known = (np.array(lens.intrinsics), np.array(lens.distortion), lens.model)
    result = track_registration((run.t_imu_ns - base) * 1e-9, run.gyro_rps, frames, known)
    turn = (
        log_so3(result.R_imu_cam.T @ run.rig.R_imu_cam) if result.status != "refused" else np.full(3, np.nan)
    )
    return result, np.append(turn, shift - result.timeshift_cam_imu_s), length


def study_tracks(trials: int, seconds: tuple[float, ...] = (15.0, 40.0)) -> None:
    """Are the sigmas honest where errors of the tracks persist for 5 to 30 images?"""
    print(
        f"\n### {trials} sets of tracks (20 Hz, {_PERSISTENT_PX} px that last 5 to 30 images, {_WHITE_PX} px "
        "white)\n\n| length s | solved | RMSE us | reported sigma us | R_imu_cam deg/axis | reported | "
        "ANEES | inside 3 sigma | CPU s |\n|---|---|---|---|---|---|---|---|---|"
    )
    for length in seconds:
        cpu = time.process_time()
        found = [track_trial(s, length)[:2] for s in range(trials)]
        cpu = (time.process_time() - cpu) / trials
        good = [(r, e) for r, e in found if r.status != "refused"]
        index = [0, 1, 2, 6]
        errors = np.array([e for _, e in good])
        covariances = np.array([r.covariance[np.ix_(index, index)] for r, _ in good])
        sigmas = np.sqrt(np.einsum("kii->ki", covariances))
        nees = np.einsum("ki,ki->k", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]) / 4.0
        ok = sum(r.status == "ok" for r, _ in good)
        print(
            f"| {length:.0f} | {ok}/{trials} | {1e6 * np.sqrt(np.mean(errors[:, 3] ** 2)):.0f} | "
            f"{1e6 * np.sqrt(np.mean(sigmas[:, 3] ** 2)):.0f} | "
            f"{np.rad2deg(np.sqrt(np.mean(errors[:, :3] ** 2))):.3f} | "
            f"{np.rad2deg(np.sqrt(np.mean(sigmas[:, :3] ** 2))):.3f} | {nees.mean():.2f} | "
            f"{100 * np.mean(np.abs(errors) < 3.0 * sigmas):.1f} % | {cpu:.1f} |",
            flush=True,
        )
