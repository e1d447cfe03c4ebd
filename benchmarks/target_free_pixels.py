"""Target-free from pictures: a rendered room, the real tracker, and no target; are the sigmas honest?"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from vical_mocks.harness.feed import PARAMETERS, CalibratorSubject, StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import SimulatedRun
from vical_mocks.rig import reference_rig
from vical_mocks.room import RoomCamera
from vical_mocks.tracks import simulate_tracks

from benchmarks import runner
from vical_daemon.estimation.measurements import CalibrationOptions
from vical_daemon.vision.tracks import FeatureTracker, TrackOptions

_UNITS = np.array([1e3] * 3 + [180.0 / np.pi] * 3 + [1e6])
_LENS_KNOWN = {True: StartErrors(), False: StartErrors(0.05, 5.0)}


def recording(seed: int, seconds: float) -> SimulatedRun:
    """Motion, inertial data and instants of the pictures."""
    rng = np.random.default_rng([seed, 81])
    rig = reference_rig(seed, timeshift_cam_imu_s=float(rng.uniform(-0.05, 0.05)))
    return simulate_tracks(seed, seconds, rig=rig)


def track(features: int, seconds: float, seed: int) -> runner.Result:
    """What the tracker finds in the pictures of one recording: ids and pixels of each, and its CPU time."""
    cv2.setNumThreads(1)
    run = recording(seed, seconds)
    room = RoomCamera(run.rig.lens, run.rig.camera_pose_target, seed=seed)
    tracker = FeatureTracker(TrackOptions(max_features=features))
    found: list[tuple[list[int], list[list[float]]]] = []
    spent: list[float] = []
    for frame in run.frames:
        picture = room.render(frame.t_s)
        begin = time.process_time()
        detection = tracker.detect(picture, frame.t_cam_ns)
        spent.append(time.process_time() - begin)
        found.append(([], []) if detection is None else (detection.ids.tolist(), detection.uv_px.tolist()))
    return {"found": found, "front_ms": 1e3 * float(np.median(spent))}


def trial(lens_known: bool, tracks: list[runner.Result], seconds: float, seed: int) -> runner.Result:
    """One room, one motion."""
    run, seen = recording(seed, seconds), tracks[seed]
    frames = [
        replace(f, ids=np.array(ids, np.int64), uv_px=np.array(uv), outlier=np.zeros(len(ids), bool))
        for f, (ids, uv) in zip(run.frames, seen["found"], strict=True)
        if ids
    ]
    run = replace(run, frames=frames)
    prior = camera_prior(run, seed, _LENS_KNOWN[lens_known], exact_lens=lens_known)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset[str]()
    options = CalibrationOptions(fix=fix, imu_noise=imu_noise(run), target_free=True)
    record = feed(run, CalibratorSubject(options, prior, None))
    lies = sum(
        bool((np.abs(s.error[:7]) > 5.0 * np.sqrt(np.diag(s.covariance)[:7])).any())
        for s in record.snapshots
        if s.status == "converged"
    )
    last = record.snapshots[-1] if record.snapshots else None
    return {
        "error": None if last is None else last.error[:7],
        "sigma": None if last is None else np.sqrt(np.diag(last.covariance)[:7]),
        "status": record.statuses[-1][1] if record.statuses else "none",
        "lies": lies,
        "front_ms": seen["front_ms"],
        "back_ms": 1e3 * record.cpu_s / max(record.frames, 1),
    }


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks target_free_pixels", description=__doc__)
    runner.add_arguments(parser, trials=10, seconds=30.0)
    parser.add_argument("--features", type=int, default=60)
    args = parser.parse_args(argv)
    eyes = runner.fingerprint("vical_daemon/vision", "mocks/vical_mocks", "benchmarks/target_free_pixels.py")
    code = eyes + runner.fingerprint("vical_daemon/estimation")
    size = f"{args.features}_{args.seconds:g}s"
    look = partial(track, args.features, args.seconds)
    seeds = range(args.first_seed + args.trials)
    tracks = runner.run_trials(f"pixels_tracks_{size}", look, seeds, args, eyes)
    heads = ["lens", "trials", *PARAMETERS[:7], "z above 3", "false `converged`", "ms: tracker + back end"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for known in (True, False):
        name = f"pixels_{'known' if known else 'free'}_{size}"
        results = runner.run_trials(
            name, partial(trial, known, tracks, args.seconds), runner.seeds_of(args), args, code
        )
        print(_row("known" if known else "5 % off", results), flush=True)
    return 0


def _row(name: str, results: list[runner.Result]) -> str:
    """RMSE (RMS of the sigmas) of each parameter over the trials that gave an answer."""
    answered = [r for r in results if r["error"] is not None]
    if not answered:
        return f"| {name} | 0/{len(results)} |" + " |" * 10
    error, sigma = (np.array([r[k] for r in answered], np.float64) for k in ("error", "sigma"))
    rms = [np.sqrt((x**2).mean(axis=0)) * _UNITS for x in (error, sigma)]
    cells = [f"{e:.3g} ({s:.3g})" for e, s in zip(*rms, strict=True)]
    beyond = int((np.abs(error / sigma) > 3.0).sum())
    front, back = (float(np.median([r[k] for r in results])) for k in ("front_ms", "back_ms"))
    return (
        f"| {name} | {len(answered)}/{len(results)} | {' | '.join(cells)} | {beyond} of {error.size} "
        f"| {sum(r['lies'] > 0 for r in results)} | {front:.1f} + {back:.1f} |"
    )
