"""The start of a calibration: when, how far off, how sure, at what cost?

    python -m benchmarks start --trials 30
    python -m benchmarks start --case "318" --case "EuRoC, lens free"

Rigs of the zoo with the lens known and not known (in the zoo itself three of ten know it), the reference rig,
the slow rig of seed 318 with several draws of its noise, and the real EuRoC recording begun every five
seconds. With the lens held EuRoC is compared with Kalibr, with the lens free with the answer of the whole
recording: z there contains what is wrong with the model of the lens.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from vical_mocks.harness.feed import (
    CAMERA,
    StartErrors,
    camera_prior,
    error_against_truth,
    events_in_order,
    imu_noise,
    matrix_of_quaternion,
    points_frame,
)
from vical_mocks.harness.recordings import read
from vical_mocks.points import SimulatedFrame, SimulatedRun

from benchmarks import euroc_halves, montecarlo, runner, zoo
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.vision.target import load_target

SECONDS = 12.0
_LOOKS_S = (5.0, 10.0)
_EVERY_S = 5.0
_SLOW = 318
Look = dict[str, Any]
Item = tuple[float, PointsFrame | tuple[int, Any, Any]]


def follow(
    items: Iterator[Item],
    options: CalibrationOptions,
    prior: CameraPrior,
    target: Any,
    truth: Any,
) -> runner.Result:
    """Feed a recording; note the first answer, those at 5 and 10 s, and what the start has cost."""
    calibrator = Calibrator(options, {CAMERA: prior}, target)
    looks: dict[str, Look] = {}
    cpu_s, longest_s, converged_s, t_s = 0.0, 0.0, None, 0.0
    for t_s, item in items:
        if not isinstance(item, PointsFrame):
            calibrator.add_imu(*item)
            continue
        starting, begin = calibrator.filter is None, time.process_time()
        calibrator.add_points(item)
        calibrator.process()
        if starting:
            spent = time.process_time() - begin
            cpu_s, longest_s = cpu_s + spent, max(longest_s, spent)
        estimate = calibrator.estimate()
        if not estimate.cameras:
            continue
        names = ["first"] if not looks else []
        names += [f"{at:g}" for at in _LOOKS_S if t_s >= at and f"{at:g}" not in looks]
        for name in names:
            looks[name] = _look(estimate, t_s, truth)
        if converged_s is None and estimate.status == Status.CONVERGED:
            converged_s = t_s
    calibrator.finish()
    estimate = calibrator.estimate()
    if estimate.cameras:
        looks["end"] = _look(estimate, t_s, truth)
    return {"looks": looks, "cpu_s": cpu_s, "longest_s": longest_s, "converged_s": converged_s}


def _look(estimate: CalibrationEstimate, t_s: float, truth: Any) -> Look:
    """Error and sigma of lever arm (m), mounting (rad) and time shift (s)."""
    camera = estimate.cameras[CAMERA]
    error = truth(t_s, camera)
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = camera.T_imu_cam.covariance
    covariance[6, 6] = camera.timeshift_sigma_s**2
    sigma = np.sqrt(np.diag(covariance))
    nees = float(error @ np.linalg.solve(covariance, error)) / 7.0
    return {"t_s": t_s, "error": error, "sigma": sigma, "nees": nees, "status": str(estimate.status)}


# ---------------------------------------------------------------------- simulated rigs
def simulated(which: str, lens_known: bool, seed: int) -> runner.Result:
    """One simulated rig."""
    if which == "reference":
        case = montecarlo.CASES["reference, lens known" if lens_known else "reference"]
        run = montecarlo.make_run(case, seed, SECONDS)
        start = case.start
    else:
        # the noise of a rig changes with the length of its recording
        length_s = SECONDS + (0.25 * seed if which == "slow" else 0.0)
        run, _ = zoo.draw(_SLOW if which == "slow" else seed, length_s, target_free=False)
        start = StartErrors(0.03, 0.01 * run.rig.lens.resolution[0])
    prior = camera_prior(run, seed, start, exact_lens=lens_known)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset()
    options = CalibrationOptions(fix=fix, imu_noise=imu_noise(run))

    def truth(t_s: float, camera: Any) -> Any:
        R = matrix_of_quaternion(camera.T_imu_cam.q_wxyz)
        p, shift = camera.T_imu_cam.p_m, camera.timeshift_cam_imu_s
        lens = run.rig.lens
        return error_against_truth(run, t_s, p, R, shift, lens.intrinsics, lens.distortion)[:7]

    return follow(_simulated_items(run), options, prior, run.points_m, truth)


def _simulated_items(run: SimulatedRun) -> Iterator[Item]:
    for t_s, event in events_in_order(run):
        if t_s > SECONDS:
            return
        if isinstance(event, SimulatedFrame):
            yield t_s, points_frame(event)
        else:
            yield t_s, (int(run.t_imu_ns[event]), run.gyro_rps[event], run.specific_force_mps2[event])


# ---------------------------------------------------------------------- EuRoC
@cache
def _recording(folder: Path) -> Any:
    return read(folder), load_target(folder / "target.yaml").points_m


def euroc_items(folder: Path, from_s: float, to_s: float) -> Iterator[Item]:
    """A stretch of the recording; times from its beginning."""
    items, _ = _recording(folder)
    for t_ns, item in items:
        t_s = 1e-9 * (t_ns - items[0][0]) - from_s
        if 0.0 <= t_s <= to_s - from_s:
            if isinstance(item, PointsFrame):
                yield t_s, replace(item, camera=CAMERA)
            else:
                yield t_s, (item.stamp_ns, item.gyro_rps, item.specific_force_mps2)


def _pose(camera: Any) -> tuple[Any, Any, float]:
    R = Rotation.from_quat(np.roll(camera.T_imu_cam.q_wxyz, -1))
    return np.array(camera.T_imu_cam.p_m), R, float(camera.timeshift_cam_imu_s)


@cache
def euroc_reference(folder: Path, lens_known: bool) -> tuple[Any, Any, float]:
    """Lever arm, mounting, time shift: Kalibr's with the lens held, else of the whole recording."""
    if lens_known:
        known = yaml.safe_load((folder / "reference_kalibr.yaml").read_text(encoding="utf-8"))["cam0"]
        T = np.array(known["T_cam_imu"])
        R = Rotation.from_matrix(T[:3, :3].T)
        return -T[:3, :3].T @ T[:3, 3], R, float(known["timeshift_cam_imu"])
    options = CalibrationOptions(imu_noise=euroc_halves.NOISE)
    items = [(0, i) for _, i in _recording(folder)[0]]
    return _pose(euroc_halves.calibrate(items, options, _recording(folder)[1]).camera)


def euroc(folder: Path, lens_known: bool, part: int) -> runner.Result:
    """The recording begun `part` times five seconds after its beginning."""
    arm, mounting, shift_s = euroc_reference(folder, lens_known)
    fix = frozenset({"intrinsics"}) if lens_known else frozenset()
    options = CalibrationOptions(fix=fix, imu_noise=euroc_halves.NOISE)

    def truth(_: float, camera: Any) -> Any:
        p, R, s = _pose(camera)
        return np.concatenate([p - arm, (mounting.inv() * R).as_rotvec(), [s - shift_s]])

    begin_s = _EVERY_S * part
    items = euroc_items(folder, begin_s, begin_s + SECONDS)
    return follow(items, options, euroc_halves.PRIOR, _recording(folder)[1], truth)


# ---------------------------------------------------------------------- tables
_COLUMNS = (
    "case",
    "answered",
    "first answer s: median, last",
    "CPU to it s: median, most (longest call)",
    "`converged` s: median (number)",
    "at",
    "lever arm mm: median error, median sigma",
    "mounting deg",
    "time shift us",
    "NEES/7: median, mean",
    "largest z",
    "beyond 5 sigma",
)


def rows(name: str, results: list[runner.Result]) -> None:
    """Print a case: one row at the first answer, at 5 and at 10 s."""
    answered = [r for r in results if r["looks"]]
    first = np.array([r["looks"]["first"]["t_s"] for r in answered] or [np.nan])
    cpu, longest = (np.array([r[k] for r in results]) for k in ("cpu_s", "longest_s"))
    converged = [r["converged_s"] for r in results if r["converged_s"] is not None]
    begin = (
        f"| {name} | {len(answered)}/{len(results)} | {np.median(first):.1f}, {first.max():.1f} "
        f"| {np.median(cpu):.2f}, {cpu.max():.2f} ({np.median(longest):.2f}) "
        f"| {np.median(converged or [np.nan]):.1f} ({len(converged)}) "
    )
    for at in ("first", *(f"{t:g}" for t in _LOOKS_S)):
        looks = [r["looks"][at] for r in answered if at in r["looks"]]
        if not looks:
            continue
        error, sigma = (np.array([x[k] for x in looks]) for k in ("error", "sigma"))
        nees, z = np.array([x["nees"] for x in looks]), np.abs(error) / sigma
        cells = []
        for place, unit in ((slice(0, 3), 1e3), (slice(3, 6), np.rad2deg(1.0)), (slice(6, 7), 1e6)):
            # a rig that sees little must not hide all others: medians of the lengths
            lengths = [unit * float(np.median(np.linalg.norm(x[:, place], axis=1))) for x in (error, sigma)]
            cells.append("{:.3g}, {:.3g}".format(*lengths))
        rest = (
            f"{np.median(nees):.2f}, {np.mean(nees):.2f} | {z.max():.1f} | {int((z > 5.0).any(axis=1).sum())}"
        )
        print(begin + f"| {at} | " + " | ".join(cells) + f" | {rest} |", flush=True)


def cases(folder: Path, trials: int, first_seed: int) -> dict[str, tuple[Any, range]]:
    """By name: what runs one of its trials, and the seeds."""
    seeds = range(first_seed, first_seed + trials)
    found: dict[str, tuple[Any, range]] = {}
    for lens, known in (("lens known", True), ("lens free", False)):
        found[f"zoo, {lens}"] = (partial(simulated, "zoo", known), seeds)
        found[f"reference, {lens}"] = (partial(simulated, "reference", known), seeds)
    found[f"{_SLOW}, lens free"] = (partial(simulated, "slow", False), range(min(trials, 16)))
    if folder.is_dir():
        for lens, known in (("lens held", True), ("lens free", False)):
            found[f"EuRoC, {lens}"] = (partial(euroc, folder, known), range(13))
    return found


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks start", description=__doc__)
    runner.add_arguments(parser, trials=30, seconds=SECONDS)
    parser.add_argument("--folder", type=Path, default=euroc_halves.FOLDER, help="the EuRoC recording")
    args = parser.parse_args(argv)
    code = runner.fingerprint(
        "vical_daemon/estimation", "benchmarks/start.py", "benchmarks/zoo.py", "mocks/vical_mocks"
    )
    print(f"| {' | '.join(_COLUMNS)} |\n{'|---' * len(_COLUMNS)}|")
    for name, (trial, seeds) in cases(args.folder, args.trials, args.first_seed).items():
        if args.case and not any(wanted in name for wanted in args.case):
            continue
        rows(name, runner.run_trials(f"start_{runner.slug(name)}", trial, seeds, args, code))
    return 0
