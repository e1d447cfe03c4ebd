"""Disturbances for `benchmarks ablation`: a rig or its data change while it is followed. Is the cause found?

All disturbances of a seed are the same until `AT_S`: that part is followed once, each goes on from a copy.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from vical_mocks.harness.feed import (
    CalibratorSubject,
    Record,
    StartErrors,
    camera_prior,
    finish,
    follow,
    imu_noise,
)
from vical_mocks.points import SimulatedRun, simulate
from vical_mocks.rig import Bump, reference_rig
from vical_mocks.tracks import room_landmarks, simulate_tracks

from benchmarks import gaps, runner
from benchmarks.changes import STEPS
from benchmarks.gaps import AFTER_S, AT_S, Late, Retimed, step
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions

_LOOK_S = 0.5
_WRONG = 5.0  # sigmas: farther off while converged
_BLIND_S = 3.0  # for so long nobody can know of a change
_CHANGES = {
    EventKind.BUMPED,
    EventKind.STARTED_OVER,
    EventKind.TIMESHIFT_STEPPED,
    EventKind.STAMPS_STEPPED,
    EventKind.IMU_CLOCK_SET_BACK,
    EventKind.IMU_CLOCK_REMAPPED,
    EventKind.CLOCK_WANDER,
    EventKind.CLOCK_DRIFT,
}
_MOUNTING = {EventKind.BUMPED, EventKind.STARTED_OVER}
_DELAY = {EventKind.TIMESHIFT_STEPPED, EventKind.STAMPS_STEPPED, EventKind.IMU_CLOCK_REMAPPED}
_DRIFT = {EventKind.CLOCK_WANDER, EventKind.CLOCK_DRIFT}


@dataclass(frozen=True)
class Disturbance:
    """What happens at `AT_S`.

    Attributes:
        expected: Events of which one is to be announced; empty: none of a change.
        changed: What is done to the recording.
        bump: (deg, mm, ms), as in `benchmarks changes`.
        lasts_s: Until when nothing can be said.
        sensor: Whose stamps are later from then on: imu or camera.
        late_s: By how much, by time.
        longer_s: How much longer it is followed.
    """

    expected: frozenset[EventKind] = frozenset()
    changed: gaps.Change = lambda run: run
    bump: tuple[float, float, float] | None = None
    lasts_s: float = 0.0
    sensor: str = ""
    late_s: Late = lambda _t_s: 0.0
    longer_s: float = 0.0


def _drift(rate: float, t_s: float) -> float:
    return rate * max(t_s - AT_S, 0.0)


def _spikes(run: SimulatedRun) -> SimulatedRun:
    """One gyro reading a second is 3 rad/s off."""
    t_s = (run.t_imu_ns - run.options.epoch_ns) * 1e-9
    every = round(1.0 / float(np.median(np.diff(t_s))))
    hit = (t_s >= AT_S) & (np.arange(len(t_s)) % every == 7)
    gyro = run.gyro_rps.copy()
    gyro[hit, 0] += 3.0
    return replace(run, gyro_rps=gyro)


def _junk(share: float, seconds: float, run: SimulatedRun) -> SimulatedRun:
    """For some seconds a share of the corners is anywhere within 60 px."""
    rng = np.random.default_rng(76)
    frames = []
    for f in run.frames:
        if AT_S <= f.t_s < AT_S + seconds:
            off = rng.uniform(-60.0, 60.0, f.uv_px.shape) * (rng.random(len(f.uv_px)) < share)[:, None]
            f = replace(f, uv_px=f.uv_px + off)
        frames.append(f)
    return replace(run, frames=frames)


def _clock(sensor: str, by_s: float, expected: set[EventKind]) -> Disturbance:
    return Disturbance(frozenset(expected), sensor=sensor, late_s=partial(step, by_s))


def _gap(sensors: str, seconds: float, *kinds: EventKind) -> Disturbance:
    return Disturbance(frozenset(kinds), partial(gaps.cut, sensors, seconds), lasts_s=seconds)


DISTURBANCES: dict[str, Disturbance] = {
    "nothing": Disturbance(),
    **{
        name: Disturbance(frozenset(_DELAY if size[:2] == (0.0, 0.0) else _MOUNTING), bump=size)
        for name, size in STEPS.items()
        if any(size)
    },
    "clock drifts by 100 ppm from then on": Disturbance(
        frozenset(_DRIFT), sensor="camera", late_s=partial(_drift, 1e-4), longer_s=10.0
    ),
    "camera clock +0.5 s": _clock("camera", 0.5, _DELAY),
    "imu clock +0.5 s": _clock("imu", 0.5, _DELAY),
    "camera clock +1 h": _clock("camera", 3600.0, _DELAY),
    "imu clock -1 h": _clock("imu", -3600.0, {EventKind.IMU_CLOCK_SET_BACK}),
    "imu stamps +3 ms": _clock("imu", 3e-3, _DELAY),
    "no imu for 2 s": _gap("imu", 2.0, EventKind.IMU_GAP),
    "no images for 2 s": _gap("camera", 2.0, EventKind.IMAGE_GAP),
    "neither for 5 s": _gap("both", 5.0, EventKind.IMU_GAP, EventKind.IMAGE_GAP),
    "imu frozen for 1 s": Disturbance(
        frozenset({EventKind.IMU_REPEATED}), partial(gaps.freeze, "imu", 1.0), lasts_s=1.0
    ),
    "camera frozen for 3 s": Disturbance(
        frozenset({EventKind.IMAGE_REPEATED}), partial(gaps.freeze, "camera", 3.0), lasts_s=3.0
    ),
    "bump in a gap of 5 s": Disturbance(
        frozenset(_MOUNTING), partial(gaps.cut, "both", 5.0), bump=(2.0, 10.0, 0.0), lasts_s=5.0
    ),
    "spikes of the gyro": Disturbance(changed=_spikes),
    "30 % junk corners for 3 s": Disturbance(changed=partial(_junk, 0.3, 3.0), lasts_s=3.0),
    "all corners junk for 1 s": Disturbance(changed=partial(_junk, 1.0, 1.0), lasts_s=1.0),
}
_LONGEST_S = AT_S + AFTER_S + max(d.lasts_s + d.longer_s for d in DISTURBANCES.values())


@lru_cache(maxsize=20)
def _recording(
    bump: tuple[float, float, float] | None, in_gap: bool, target_free: bool, seed: int
) -> SimulatedRun:
    """All as long as the longest: noise depends on the length."""
    bumps: tuple[Bump, ...] = ()
    if bump is not None:
        rng = np.random.default_rng([seed, 71])
        axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        turn, move = np.deg2rad(bump[0]) * axis, 1e-3 * bump[1] * way
        at_s = AT_S + (2.0 if in_gap else 0.0)
        bumps = (Bump(at_s, tuple(turn.tolist()), tuple(move.tolist()), 1e-3 * bump[2]),)
    rig = reference_rig(seed, timeshift_cam_imu_s=0.01, bumps=bumps)
    if target_free:
        marks = room_landmarks(seed, 200)
        return simulate_tracks(seed, _LONGEST_S, rig=rig, landmarks_m=marks)
    return simulate(seed, _LONGEST_S, rig=rig)


@lru_cache(maxsize=4)
def _before(ablated: str, target_free: bool, seed: int) -> bytes:
    """The calibrator just before `AT_S`, and what it had announced; one for each mechanism taken away."""
    del ablated  # only part of the key
    run = _recording(None, False, target_free, seed)
    options = CalibrationOptions(target_free=target_free, imu_noise=imu_noise(run))
    prior = camera_prior(run, seed, StartErrors(), exact_lens=False)
    subject = CalibratorSubject(options, prior, None if target_free else run.points_m)
    record = Record()
    follow(run, subject, record, _LOOK_S, until_s=AT_S - _LOOK_S)
    return pickle.dumps((subject.calibrator, record))


def disturbed(name: str, ablated: str, target_free: bool, seed: int) -> runner.Result:
    """One disturbance of one rig.

    Args:
        name: Of the disturbance.
        ablated: Name of the mechanism that is taken away at present.
        target_free: Tracks in a room instead of a board.
        seed: Of the rig.
    """
    d = DISTURBANCES[name]
    run = _recording(d.bump, d.lasts_s > 0.0, target_free, seed)
    calibrator, record = pickle.loads(_before(ablated, target_free, seed))
    subject = Retimed.__new__(Retimed)
    subject.calibrator, subject.sensor, subject.late_s = calibrator, d.sensor, d.late_s
    subject.epoch_ns = run.options.epoch_ns
    end_s = AT_S + d.lasts_s + AFTER_S + d.longer_s
    run = d.changed(run)
    follow(run, subject, record, _LOOK_S, after_s=AT_S - _LOOK_S, until_s=end_s)
    finish(run, subject, record, end_s)
    return _judged(record, d)


def _judged(record: Record, d: Disturbance) -> runner.Result:
    """Whether the cause was found, what was announced wrongly, and how far off the answer is."""
    announced = {e.kind for t, e in record.events if t >= AT_S}
    early = {e.kind for t, e in record.events if t < AT_S}
    z, lies = 0.0, 0
    for s in record.snapshots:
        error = s.error[:7].copy()
        error[6] -= (1.0 if d.sensor == "imu" else -1.0) * d.late_s(s.t_s) if d.sensor else 0.0
        z = float(np.max(np.abs(error) / np.maximum(np.sqrt(np.diag(s.covariance))[:7], 1e-12)))
        blind = AT_S <= s.t_s < AT_S + d.lasts_s + _BLIND_S
        lies += s.status == "converged" and z > _WRONG and not blind
    ways = [t for t, e in record.events if e.kind in d.expected and t >= AT_S]
    return {
        "found": bool(announced & d.expected) if d.expected else None,
        "delay_s": min(ways) - AT_S if ways else None,
        "false": sorted(str(k) for k in (announced & _CHANGES) - d.expected | (early & _CHANGES)),
        "end_z": z,
        "lies": lies,
        "status": record.snapshots[-1].status if record.snapshots else "none",
    }
