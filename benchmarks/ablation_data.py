"""What `benchmarks ablation` runs the estimation on: real halves, random rigs, rigs with one fault.

Every function takes a seed and gives what is needed to compare two versions of the estimation on it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from vical_mocks.harness.feed import (
    CalibratorSubject,
    Record,
    StartErrors,
    camera_prior,
    feed,
    imu_noise,
)
from vical_mocks.harness.recordings import Items, camera_of, read
from vical_mocks.points import SimulatedRun
from vical_mocks.random_rigs import draw

from benchmarks import euroc_halves, montecarlo, runner, target_free
from benchmarks.gaps import Change
from vical_daemon.estimation.measurements import CalibrationOptions, PointsFrame
from vical_daemon.estimation.target_free import TargetFreeCalibrator
from vical_daemon.vision.target import load_target

SECONDS = 25.0
_DOF = 7


# ---------------------------------------------------------------------- real data
@lru_cache(maxsize=1)
def _halves() -> tuple[list[Any], Any]:
    items = euroc_halves.read(euroc_halves.FOLDER)
    split = items[0][0] + int(euroc_halves.SPLIT_S * 1e9)
    parts = [[i for i in items if (i[0] < split) == first] for first in (True, False)]
    return parts, load_target(euroc_halves.FOLDER / "target.yaml").points_m


def euroc(mode: str) -> runner.Result:
    """Disagreement of the halves of the real recording; `mode`: lens fixed, free, or tracks: free, and
    no board."""
    halves, points = _halves()
    fix = frozenset({"intrinsics"}) if mode == "fixed" else frozenset[str]()
    options = CalibrationOptions(fix=fix, imu_noise=euroc_halves.NOISE, target_free=mode == "tracks")
    if mode == "tracks":
        a, b = (_tracks(h, options) for h in halves)
    else:
        a, b = (euroc_halves.calibrate(h, options, points).camera for h in halves)
    cells = [x.strip() for x in euroc_halves.row("", a, b).split("|")[2:-1]]
    arm_mm, turn_deg, shift_us, z, lens = cells
    lens_z = [float(x) for x in lens.split("/")] if lens != "-" else [0.0, 0.0]
    sigma_mm = 1e3 * np.sqrt(np.trace(np.add(a.T_imu_cam.covariance, b.T_imu_cam.covariance)[:3, :3]))
    return {
        "arm_mm": float(arm_mm),
        "turn_deg": float(turn_deg),
        "shift_us": float(shift_us),
        "z": float(z),
        "lens_z": lens_z,
        "sigma_mm": float(sigma_mm),
    }


def _give(calibrator: Any, item: Any) -> None:
    """An image or a reading of a recording with one camera."""
    if isinstance(item, PointsFrame):
        calibrator.add_points(replace(item, camera="cam0"))
        calibrator.process()
    else:
        calibrator.add_imu(item.stamp_ns, item.gyro_rps, item.specific_force_mps2)


def _tracks(items: list[Any], options: CalibrationOptions) -> Any:
    c = TargetFreeCalibrator(options, {"cam0": euroc_halves.PRIOR})
    for _, item in items:
        _give(c, item)
    c.finish()
    return c.estimate().cameras["cam0"]


@lru_cache(maxsize=2)
def _recorded(folder: str) -> Items:
    return read(target_free.DATA / folder)


def recording(name: str) -> runner.Result:
    """One case of `benchmarks target_free`: errors against its reference every second."""
    case = target_free.CASES[name]
    items, truth = _recorded(case.folder), camera_of(target_free.DATA / case.folder / case.truth)
    calibrator = target_free.make_calibrator(case, target_free.DATA)
    out: runner.Result = {"t_s": [], "error": [], "sigma": [], "nees": [], "status": []}
    events, begin_s = set[str](), time.process_time()
    due_ns = begin_ns = items[0][0]
    for t_ns, item in items:
        _give(calibrator, item)
        if t_ns < due_ns and t_ns != items[-1][0]:
            continue
        due_ns += 1_000_000_000
        estimate = calibrator.estimate()
        events |= {str(e.kind) for e in estimate.events}
        found = target_free.errors(estimate, truth)
        if found is not None:
            out["t_s"].append(1e-9 * (t_ns - begin_ns))
            out["error"].append(found.error)
            out["sigma"].append(found.sigma)
            out["nees"].append(_DOF * found.nees)
            out["status"].append(str(estimate.status))
    return out | {"events": sorted(events), "cpu_s": time.process_time() - begin_s}


# ---------------------------------------------------------------------- random rigs
@lru_cache(maxsize=12)
def _drawn(target_free: bool, seed: int) -> tuple[SimulatedRun, bool]:
    return draw(seed, SECONDS, target_free=target_free)


def random_rig(target_free: bool, seed: int) -> runner.Result:
    """One rig of `benchmarks zoo`."""
    run, known = _drawn(target_free, seed)
    prior = camera_prior(run, seed, StartErrors(0.03, 0.01 * run.rig.lens.resolution[0]), exact_lens=known)
    fix = frozenset({"intrinsics"}) if known else frozenset[str]()
    options = CalibrationOptions(fix=fix, target_free=target_free, imu_noise=imu_noise(run))
    subject = CalibratorSubject(options, prior, None if target_free else run.points_m)
    return kept(feed(run, subject))


def kept(record: Record) -> runner.Result:
    """Error, sigma and status every second."""
    shots = record.snapshots
    return {
        "t_s": [s.t_s for s in shots],
        "error": [s.error for s in shots],
        "sigma": [np.sqrt(np.diag(s.covariance)) for s in shots],
        "nees": [montecarlo.nees(s.error, s.covariance, _DOF) for s in shots],
        "status": [s.status for s in shots],
        "events": sorted({str(e.kind) for _, e in record.events}),
        "cpu_s": record.cpu_s,
    }


# ---------------------------------------------------------------------- one fault each
@dataclass(frozen=True)
class Fault:
    """A rig that is not as it says.

    Attributes:
        case: As in `benchmarks montecarlo`.
        changed: What else is done to its recording.
        noise_stated: Times the imu's noise densities that are stated.
    """

    case: montecarlo.Case
    changed: Change = lambda run: run
    noise_stated: float = 1.0


def _bent(run: SimulatedRun) -> SimulatedRun:
    """Pixels by one more power of the radius than the model has: 2 px in the corners of the image."""
    width, height = run.rig.lens.resolution
    centre = 0.5 * np.array([width, height])

    def bent(uv: Any) -> Any:
        off = (uv - centre) / np.linalg.norm(centre)
        return uv + 2.0 * off * ((off**2).sum(axis=1) ** 3)[:, None]

    return replace(run, frames=[replace(f, uv_px=bent(f.uv_px)) for f in run.frames])


def _drawn_aside(run: SimulatedRun) -> SimulatedRun:
    """A detector that is drawn by up to 0.01 px a patch of the image, for ever."""
    rng = np.random.default_rng(75)
    aside = 0.005 * rng.standard_normal((8, 6, 2))
    size = np.array(run.rig.lens.resolution) / np.array([8, 6])

    def drawn(uv: Any) -> Any:
        patch = np.clip((uv / size).astype(int), 0, [7, 5])
        return uv + aside[patch[:, 0], patch[:, 1]]

    return replace(run, frames=[replace(f, uv_px=drawn(f.uv_px)) for f in run.frames])


def _clipped(run: SimulatedRun) -> SimulatedRun:
    """The gyro's range ends where one reading in ten of the largest lies."""
    limit = float(np.quantile(np.abs(run.gyro_rps).max(axis=1), 0.9))
    return replace(run, gyro_rps=np.clip(run.gyro_rps, -limit, limit))


_CASES = montecarlo.CASES
FAULTS: dict[str, Fault] = {
    **{
        name: Fault(_CASES[name])
        for name in (
            "skew 100 ppm",
            "stamp jitter 1 ms",
            "whole images off by 0.3 px",
            "crooked board",
            "board 3 % smaller than stated",
            "imu 0.3 % off",
            "accelerometer 0.3 ms late",
            "lens held, not this camera's",
            "5 % outliers, 30 % half-hidden",
        )
    },
    "drift 20 ppm": Fault(montecarlo.Case(skew_ppm=20.0)),
    "lens model misses": Fault(montecarlo.Case(), _bent),
    "detector's own error": Fault(montecarlo.Case(simulation={"corner_sigma_px": 0.05}), _drawn_aside),
    "corner noise changes": Fault(montecarlo.Case(simulation={"corner_sigma_px": 0.2, "noise_spread": 0.8})),
    "gyro clips": Fault(montecarlo.Case(), _clipped),
    "slow motion": Fault(montecarlo.Case(rig={"mean_rate_dps": 10.0}, simulation={"camera_rate_hz": 10.0})),
    "imu noise stated 10 times too small": Fault(montecarlo.Case(), noise_stated=0.1),
    **{
        f"free: {name.removeprefix('target-free, ')}": Fault(_CASES[name])
        for name in (
            "target-free, stamp jitter 1 ms",
            "target-free, 3 % outliers",
            "target-free, accelerometer 0.3 ms late",
            "target-free, imu 0.3 % off",
            "target-free, skew 100 ppm",
        )
    },
}


@lru_cache(maxsize=24)
def _faulty(name: str, seed: int) -> SimulatedRun:
    fault = FAULTS[name]
    return fault.changed(montecarlo.make_run(fault.case, seed, SECONDS))


def faulty_rig(name: str, seed: int) -> runner.Result:
    """The reference rig with one fault."""
    fault, run = FAULTS[name], _faulty(name, seed)
    if fault.noise_stated == 1.0:
        return kept(feed(run, montecarlo.make_subject(fault.case, run, seed, "vical")))
    noise, s = imu_noise(run), fault.noise_stated
    stated = replace(
        noise,
        gyro_density=s * noise.gyro_density,
        accel_density=s * noise.accel_density,
    )
    prior = camera_prior(run, seed, StartErrors(), exact_lens=False)
    return kept(feed(run, CalibratorSubject(CalibrationOptions(imu_noise=stated), prior, run.points_m)))
