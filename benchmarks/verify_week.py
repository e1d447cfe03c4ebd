"""A week of calm work with `mode: verify`: is there a false alarm?

python -m benchmarks verify_week --trials 20                  as many robots, which see their board
python -m benchmarks verify_week --trials 20 --work driving   robots without a board

Each robot is a rig of the zoo with a calibration from half a minute of hand motion before its board. Then
it works: it moves calmly before the board, or drives along corridors without one, and rests now and then. The
checks are those of the daemon (`calibrate/verification.py`, messages in, answers out); pauses cost nothing,
because the clock is simulated. Each robot makes `--stretches` stretches of data, which are spread over a
week: biases walk, the temperature follows the day, and with it biases, focal length, mounting and time
shift, by far less than what counts. Nothing changes, so every `changed` is a false alarm.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.driving import simulate_drive
from vical_mocks.harness.feed import CAMERA, StartErrors, camera_prior, events_in_order
from vical_mocks.points import SimulatedFrame, SimulatedRun, simulate
from vical_mocks.random_rigs import draw
from vical_mocks.rig import BiasWalk, Rig
from vical_mocks.rotations import exp_so3
from vical_mocks.trajectory import Pause, hand_motion

from benchmarks import runner
from benchmarks.verify import estimate
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import encode_imu, encode_points
from vical_daemon.calibrate.in_use import InUse
from vical_daemon.calibrate.motion import Motion
from vical_daemon.calibrate.stretch import LONGEST_S, Stretch
from vical_daemon.calibrate.verification import Verification
from vical_daemon.config.model import Config, load
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import known_cameras
from vical_daemon.results.verifier import Answer
from vical_daemon.vision.target import Checkerboard

WEEK_S = 7 * 86400.0
STORED_S = 30.0
SUSPECTED, NO_START = "changed once", "no start"
T0_NS = 1_800_000_000 * 10**9
_RIG, _IMU = "rig0", "imu0"
_KELVIN = 8.0  # warmer in the afternoon than at night, either way from the mean
_OF_KELVIN = {
    "gyro_rps": np.deg2rad(0.01),  # an axis; a data sheet's 0.05 deg/s over its range, and more
    "accel_mps2": 2e-3,
    "focal": 1e-5,  # an aluminium mount
    "position_m": 2e-6,  # 0.1 m of aluminium
    "rotation_rad": 1e-6,
    "shift_s": 2e-6,
}


class Robot:
    """One robot and its week.

    Args:
        seed: Of everything.
        target_free: Works without a board.
    """

    def __init__(self, seed: int, *, target_free: bool) -> None:
        self.seed, self.target_free = seed, target_free
        self.first, _ = draw(seed, STORED_S, target_free=False)
        self._rng = np.random.default_rng([seed, 93])
        hours = int(WEEK_S / 3600.0) + 2
        d, root_s = self.first.rig.densities, 60.0  # square root of an hour
        steps = self._rng.standard_normal((hours, 6)) * root_s
        self._walk = np.cumsum(steps * np.repeat([d.gyro_walk, d.accel_walk], 3), axis=0)
        self._ways = {name: self._rng.standard_normal(3) for name in _OF_KELVIN}
        self._phase = self._rng.uniform(0.0, 2.0 * np.pi)

    def stored(self) -> CalibrationEstimate:
        """The calibration from before the week."""
        prior = camera_prior(self.first, self.seed, StartErrors(), exact_lens=True)
        out: CalibrationEstimate = estimate(self.first, prior, target_free=False)
        return out

    def at(self, t_s: float, motion_seed: int) -> Rig:
        """The rig as it is at a time of the week, without its motion."""
        rig = self.first.rig
        kelvin = _KELVIN * np.sin(2.0 * np.pi * t_s / 86400.0 + self._phase)
        off = {name: size * kelvin * self._ways[name] for name, size in _OF_KELVIN.items()}
        walked = np.array(
            [np.interp(t_s / 3600.0, np.arange(len(self._walk)), self._walk[:, k]) for k in range(6)]
        )
        fx, fy, cx, cy = rig.lens.intrinsics
        grown = 1.0 + float(off["focal"][0])
        gyro = rig.gyro_bias.value(0.0) + walked[:3] + off["gyro_rps"]
        accel = rig.accel_bias.value(0.0) + walked[3:] + off["accel_mps2"]
        return replace(
            rig,
            lens=replace(rig.lens, intrinsics=(grown * fx, grown * fy, cx, cy)),
            p_imu_cam=np.asarray(rig.p_imu_cam) + off["position_m"],
            R_imu_cam=rig.R_imu_cam @ exp_so3(off["rotation_rad"]),
            timeshift_cam_imu_s=rig.timeshift_cam_imu_s + float(off["shift_s"][0]),
            gyro_bias=BiasWalk(gyro, rig.densities.gyro_walk, motion_seed),
            accel_bias=BiasWalk(accel, rig.densities.accel_walk, motion_seed + 1_000_003),
        )

    def record(self, t_s: float, number: int, config: Config) -> SimulatedRun:
        """The stretch of data that begins at a time of the week."""
        own = 1000 * self.seed + number
        rig, seconds = self.at(t_s, own), LONGEST_S + 3.0
        pauses = self._rests()
        options = asdict(self.first.options) | {"epoch_ns": T0_NS + round(t_s * 1e9)}
        most_hz = config.calibration.detect_rate_hz if self.target_free else config.verify.image_rate_hz
        options["camera_rate_hz"] = min(options["camera_rate_hz"], most_hz)
        if self.target_free:
            return simulate_drive(own, seconds, rig=rig, pauses=pauses, **options)
        size_m = np.ptp(self.first.points_m, axis=0)[:2]
        t_all_s = np.linspace(0.0, STORED_S, 100)
        distance_m = -float(self.first.rig.camera_pose_target(t_all_s)[1][:, 2].mean())
        rate_dps = float(np.exp(self._rng.uniform(np.log(6.0), np.log(25.0))))
        board = (float(size_m[0]), float(size_m[1]))
        motion = hand_motion(
            own, rate_dps, T_imu_cam=(rig.R_imu_cam, rig.p_imu_cam), board_size_m=board, distance_m=distance_m
        ).with_pauses(pauses)
        rig = replace(rig, trajectory=motion)
        return simulate(own, seconds, rig=rig, points_m=self.first.points_m, **options)

    def _rests(self) -> list[Pause]:
        """In every other stretch the robot rests once."""
        begin_s, length_s = self._rng.uniform([6.0, 2.0], [24.0, 8.0])
        return [Pause(begin_s, begin_s + length_s)] if self._rng.random() < 0.5 else []

    def config(self, folder: Path) -> Config:
        """Its settings, with the board that it has."""
        points, lens, d = self.first.points_m, self.first.rig.lens, self.first.rig.densities
        columns = int(np.count_nonzero(points[:, 1] == points[0, 1]))
        spacing_m = float(points[1, 0] - points[0, 0])
        board = Checkerboard(columns, len(points) // columns, spacing_m, spacing_m)
        (folder / "target.yaml").write_text(board.to_yaml())
        noise = f"gyro_density: {d.gyro}, gyro_walk: {d.gyro_walk}"
        noise += f", accel_density: {d.accel}, accel_walk: {d.accel_walk}"
        width, height = lens.resolution
        (folder / "rig.yaml").write_text(
            f"rig: {_RIG}\nmode: verify\ntarget: target.yaml\n"
            f"imus: {{{_IMU}: {{port: /dev/null, rate_hz: 100, "
            f"noise: {{{noise}}}}}}}\n"
            f"cameras: {{{CAMERA}: {{uri: /dev/null, size: [{width}, {height}], "
            f"lens: {{distortion_model: {lens.model}}}}}}}\n"
            f"calibration: {{mode: {'target_free' if self.target_free else 'target'}}}\n"
        )
        config = load(folder / "rig.yaml")
        imu = replace(config.imus[_IMU], rate_hz=self.first.options.imu_rate_hz)  # others than a GX3's, too
        return replace(config, imus={_IMU: imu})


def messages(run: SimulatedRun, key: str) -> Iterator[tuple[float, Sample]]:
    """What IMU and detector send, with the time of the recording, s."""
    imu_key = topics.IMU.key(_RIG, _IMU)
    for t_s, event in events_in_order(run):
        if isinstance(event, SimulatedFrame):
            size = run.rig.lens.resolution
            payload = encode_points(event.t_cam_ns, CAMERA, event.ids, event.uv_px, None, size)
            yield t_s, Sample(key, payload, 0)
        else:
            gyro, force = run.gyro_rps[event].tolist(), run.specific_force_mps2[event].tolist()
            yield t_s, Sample(imu_key, encode_imu(int(run.t_imu_ns[event]), _IMU, gyro, force), 0)


class Week:
    """One robot at work: stretch after stretch, and what the checks say.

    Args:
        robot: The robot.
        config: Its settings.
        verification: Its checks.
    """

    def __init__(self, robot: Robot, config: Config, verification: Verification) -> None:
        self._robot, self._config, self._verification = robot, config, verification
        self.answers: list[str] = []
        self.cpu_s = 0.0
        self.looks = 0

    def stretch(self, t_s: float, number: int) -> None:
        """One stretch of data, as the role takes it."""
        checks, imu_key = self._verification, topics.IMU.key(_RIG, _IMU)
        run = self._robot.record(t_s, number, self._config)
        topic = topics.TRACKS if self._robot.target_free else topics.POINTS
        motion = Motion(run.options.imu_rate_hz)
        stretch: Stretch | None = None
        for now_s, sample in messages(run, topic.key(_RIG, CAMERA)):
            if stretch is None:  # the role listens to the IMU alone
                if sample.key == imu_key:
                    motion.take(sample, now_s)
                if motion.looked:
                    if not np.isfinite(motion.moved_s):
                        return
                    stretch = Stretch(imu_key, motion, now_s, checks.used_s)
                continue
            begin_s, before = time.process_time(), self._state()
            checks.take(sample)
            stretch.take(sample, now_s)
            ended = checks.step()
            self.cpu_s += time.process_time() - begin_s
            if ended:
                self._note(before)
                return
            if stretch.over(now_s, checks.used_s):
                break
        begin_s, before = time.process_time(), self._state()
        checks.end_stretch()
        self.cpu_s += time.process_time() - begin_s
        if checks.used_s == 0.0:
            self._note(before)

    def _state(self) -> tuple[int, float, bool, bool]:
        checks = self._verification
        return checks.checks, checks.used_s, checks.suspected, checks.probability(CAMERA) is not None

    def _note(self, before: tuple[int, float, bool, bool]) -> None:
        """Note how a check ended."""
        checks, (count, used_s, suspected, started) = self._verification, before
        self.looks += round(used_s)
        if checks.checks > count:
            self.answers.append(str(checks.answers[CAMERA].verdict))
        elif checks.suspected and not suspected:
            self.answers.append(SUSPECTED)
        else:
            self.answers.append(str(Answer.CANNOT_TELL) if started else NO_START)


def trial(work: str, stretches: int, seed: int) -> runner.Result:
    """One robot and its week."""
    robot = Robot(seed, target_free=work == "driving")
    stored = robot.stored()
    out: dict[str, Any] = {"stored": str(stored.status)}
    if not stored.cameras or stored.status is Status.INCONSISTENT:
        return out
    known = known_cameras(rig_from_estimate(stored), "store")
    with tempfile.TemporaryDirectory() as folder:
        config = robot.config(Path(folder))
        week = Week(robot, config, Verification(config, InUse("store", known, {}, stored)))
        for number in range(stretches):
            week.stretch(WEEK_S * number / stretches, number)
    share = config.verify.cpu_percent / 100.0
    return out | {
        "answers": week.answers,
        "stretches": stretches,
        "looks": week.looks,
        "cpu_s": week.cpu_s,
        "period_s": week.cpu_s / stretches / share,
    }


def print_summary(results: list[runner.Result]) -> None:
    """One row for all robots."""
    words = (str(Answer.HOLDS), SUSPECTED, str(Answer.CHANGED), str(Answer.CANNOT_TELL), NO_START)
    own = [r for r in results if "answers" in r]
    answers = [a for r in own for a in r["answers"]]
    stretches = sum(r["stretches"] for r in own)
    print("| robots | stretches of data | looks | " + " | ".join(words) + " | CPU s a stretch |")
    print("|---|---|---|" + "---|" * (len(words) + 1))
    cells = [len(own), stretches, sum(r["looks"] for r in own), *(answers.count(word) for word in words)]
    cells.append(f"{sum(r['cpu_s'] for r in own) / max(stretches, 1):.2f}")
    print("| " + " | ".join(map(str, cells)) + " |")


def main(argv: list[str]) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks verify_week", description=__doc__)
    runner.add_arguments(parser, trials=20, seconds=WEEK_S)
    parser.add_argument("--work", choices=("board", "driving"), default="board")
    parser.add_argument("--stretches", type=int, default=40, help="stretches of data of each robot")
    args = parser.parse_args(argv)
    code = runner.fingerprint("vical_daemon", "benchmarks/verify_week.py", "mocks/vical_mocks")
    name = f"verify_week_{args.work}_{args.stretches}"
    work = partial(trial, args.work, args.stretches)
    results = runner.run_trials(name, work, runner.seeds_of(args), args, code)
    print_summary(results)
    for seed, r in zip(runner.seeds_of(args), results, strict=True):
        wrong = [a for a in r.get("answers", []) if a in (SUSPECTED, str(Answer.CHANGED))]
        if wrong:
            print(f"seed {seed}: {wrong} of {len(r['answers'])} checks")
    return 0
