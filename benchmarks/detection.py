"""Detectors on rendered pictures: corner errors, reported sigmas, share found; feature tracks."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field

import cv2
import numpy as np
from vical_mocks.camera import SimulatedCamera
from vical_mocks.harness.boards import APRILGRID, CHECKERBOARD, DISTORTION, film
from vical_mocks.lens import Lens
from vical_mocks.rig import Rig, reference_rig
from vical_mocks.room import RoomCamera

from vical_daemon.vision.detector import BoardDetector
from vical_daemon.vision.flow_prediction import FlowCamera, FlowPredictor
from vical_daemon.vision.target import AprilGrid, Target
from vical_daemon.vision.tracks import FeatureTracker

STEP_S = 0.05
GROSS_PX = 1.0


@dataclass
class Score:
    """What one sequence gave."""

    seen: int = 0
    errors: list[np.ndarray] = field(default_factory=list)
    sigmas: list[np.ndarray] = field(default_factory=list)
    opencv: list[np.ndarray] = field(default_factory=list)
    opencv_found: int = 0
    opencv_seen: int = 0
    blur_px: list[float] = field(default_factory=list)


def main(argv: list[str]) -> int:
    """Run and print Markdown tables."""
    parser = argparse.ArgumentParser(prog="benchmarks detection", description=__doc__)
    parser.add_argument("--frames", type=int, default=12, help="per sequence")
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    _boards(args.frames)
    _hidden(args.frames)
    _tracks(args.frames)
    return 0


def _boards(frames: int) -> None:
    print(
        "\n| board | distance m | exposure ms | noise | blur px | corners found | error rms px | bias px | "
        "gross | error²/sigma² | OpenCV found | OpenCV rms px |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    cases: list[tuple[Target, float]] = [(APRILGRID, 0.8), (APRILGRID, 1.6)]
    cases += [(CHECKERBOARD, 0.6)]
    for target, distance in cases:
        for exposure, noise in ((0.0, 1.5), (0.003, 1.5), (0.015, 1.5), (0.003, 6.0)):
            camera = film(target, distance, exposure_s=exposure, noise_dn=noise)
            score = _run(camera, target, frames)
            print(
                f"| {target.kind} | {distance} | {exposure * 1e3:g} | {noise:g} | {_row(score)} |", flush=True
            )


def _run(camera: SimulatedCamera, target: Target, frames: int) -> Score:
    score, detector = Score(), BoardDetector(target)
    for k in range(frames):
        t_s = k * STEP_S
        image = camera.render(t_s)
        uv, seen = camera.project(target.points_m, t_s)
        score.blur_px.append(camera.corner_blur_px(t_s))
        found = detector.detect(image, round(t_s * 1e9))
        if k % 3 == 0:
            count, theirs = _opencv(image, target, uv)
            score.opencv_found += count
            score.opencv_seen += int(seen.sum())
            score.opencv.append(theirs)
        score.seen += int(seen.sum())
        if found is not None:
            score.errors.append(found.uv_px - uv[found.ids])
            score.sigmas.append(np.asarray(found.sigma_px))
    return score


def _opencv(image: np.ndarray, target: Target, truth: np.ndarray) -> tuple[int, np.ndarray]:
    """OpenCV's own detectors for comparison.

    Returns:
        How many corners it found, and their errors where its order is known (checkerboard, best of the two
        orders; its tag corners need the refinement that is compared here anyway), shape (n,).
    """
    if isinstance(target, AprilGrid):
        options = cv2.aruco.DetectorParameters()
        options.markerBorderBits = 2
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        _, ids, _ = cv2.aruco.ArucoDetector(family, options).detectMarkers(image)
        return 0 if ids is None else 4 * len(ids), np.zeros(0)
    found, uv = cv2.findChessboardCornersSB(image, (target.cols, target.rows))
    if not found:
        return 0, np.zeros(0)
    corners = np.asarray(uv, float).reshape(-1, 2)
    errors = [np.linalg.norm(order - truth, axis=1) for order in (corners, corners[::-1])]
    return len(corners), min(errors, key=np.median)


def _row(score: Score) -> str:
    errors, sigmas = np.concatenate(score.errors), np.concatenate(score.sigmas)
    fine = np.linalg.norm(errors, axis=1) < GROSS_PX
    rms, bias = np.sqrt(np.mean(errors[fine] ** 2)), np.abs(errors[fine].mean(axis=0)).max()
    ratio = np.mean(np.mean(errors[fine] ** 2, axis=1) / sigmas[fine] ** 2)
    theirs = np.concatenate(score.opencv)
    opencv = f"{score.opencv_found / score.opencv_seen:.0%} | "
    opencv += f"{np.sqrt(np.mean(theirs[theirs < GROSS_PX] ** 2) / 2):.3f}" if len(theirs) else "–"
    return (
        f"{np.mean(score.blur_px):.1f} | {len(errors) / score.seen:.1%} | {rms:.4f} | {bias:.4f} | "
        f"{int(np.sum(~fine))} | {ratio:.2f} | {opencv}"
    )


def _hidden(frames: int) -> None:
    """A bar moves over the board: nothing wrong may come out."""
    print(
        "\n| board, a bar moving over it | frames with points | corners found | errors above 1 px | "
        "worst px | OpenCV frames | OpenCV errors above 1 px |"
    )
    print("|---|---|---|---|---|---|---|")
    for target in (APRILGRID, CHECKERBOARD):
        camera, detector = film(target, 0.9, seed=2, exposure_s=0.003), BoardDetector(target)
        errors, theirs, with_points, with_theirs, total = [], [np.zeros(0)], 0, 0, 0
        for k in range(2 * frames):
            t_s = k * STEP_S
            image = camera.render(t_s)
            left = (7 * k) % 640
            image[:, left : left + 90] = 120
            uv, seen = camera.project(target.points_m, t_s)
            total += int((seen & ~((uv[:, 0] > left - 3) & (uv[:, 0] < left + 93))).sum())
            found = detector.detect(image, round(t_s * 1e9))
            if found is not None:
                with_points += 1
                errors.append(np.linalg.norm(found.uv_px - uv[found.ids], axis=1))
            count, wrong = _opencv(image, target, uv)
            with_theirs += count > 0
            theirs.append(wrong)
        ours, other = np.concatenate(errors), np.concatenate(theirs)
        print(
            f"| {target.kind} | {with_points} of {2 * frames} | {len(ours) / total:.1%} | "
            f"{int(np.sum(ours > GROSS_PX))} | {ours.max():.2f} | {with_theirs} | "
            f"{int(np.sum(other > GROSS_PX))} of {len(other)} |",
            flush=True,
        )


def _tracks(frames: int) -> None:
    """Feature tracks in a textured room against the true places of what was first seen."""
    print(
        "\n| feature tracks | features | track length | error median px | above 2 px | error²/sigma² | ms |"
    )
    print("|---|---|---|---|---|---|---|")
    rig = reference_rig(1, lens=Lens(distortion=DISTORTION))
    room = RoomCamera(rig.lens, rig.camera_pose_target)
    pictures = [room.render(k * STEP_S) for k in range(frames)]
    for name, predictor in (("last flow", FlowPredictor()), ("gyro", _gyro(rig, frames))):
        tracker, first, errors, ratios, spent, alive = FeatureTracker(predictor=predictor), {}, [], [], [], []
        for k, picture in enumerate(pictures):
            begin = time.thread_time()
            found = tracker.detect(picture, 10**12 + round(k * STEP_S * 1e9))
            spent.append((time.thread_time() - begin) * 1e3)
            if found is None:
                continue
            alive.append(len(found.ids))
            fresh = np.array([i not in first for i in found.ids])
            first.update(
                zip(found.ids[fresh], room.surface_points(found.uv_px[fresh], k * STEP_S), strict=True)
            )
            points = np.array([first[i] for i in found.ids[~fresh]]).reshape(-1, 3)
            error = found.uv_px[~fresh] - room.project(points, k * STEP_S)
            errors.append(np.linalg.norm(error, axis=1))
            ratios.append(np.mean(error**2, axis=1) / np.asarray(found.sigma_px)[~fresh] ** 2)
        error, ratio = np.concatenate(errors), np.concatenate(ratios)
        known = np.isfinite(error)
        error, ratio = error[known], ratio[known][error[known] < 2]
        print(
            f"| {name} | {np.mean(alive):.0f} | {sum(alive) / len(first):.1f} | {np.median(error):.2f} | "
            f"{np.mean(error > 2):.1%} | {ratio.mean():.2f} | {np.median(spent):.1f} |",
            flush=True,
        )


def _gyro(rig: Rig, frames: int) -> FlowPredictor:
    lens = rig.lens
    predictor = FlowPredictor(FlowCamera(lens.intrinsics, lens.distortion, lens.model, rig.R_imu_cam))
    instants = np.arange(-0.1, frames * STEP_S + 0.1, 0.01)
    for t_s, rate in zip(instants, rig.trajectory.omega_imu_rps(instants), strict=True):
        predictor.add_imu(10**12 + round(t_s * 1e9), tuple(rate))
    return predictor
