"""Two hours in compressed time: estimator, recorder and page in one process, fed as fast as it goes.

    python -m benchmarks soak_compressed --hours 2

A simulated rig waves before a board for the whole time: 100 Hz inertial data, corners at 2 Hz, small images
at 1 Hz. What must stay flat is what a service that nobody looks at would let grow: memory, descriptors,
threads, and the error of the estimate.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.harness.processes import usage
from vical_mocks.points import board_points
from vical_mocks.rig import reference_rig

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.outgoing import publish
from vical_daemon.calibrate.estimators import make_estimator
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import CameraConfig, Config, ImuConfig, RecordConfig
from vical_daemon.logs.mcap import LogFolder
from vical_daemon.record.queue import arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.vision.target import Checkerboard
from vical_daemon.web.state import WebState

_T0_NS = 1_700_000_000_000_000_000
_IMU_HZ, _POINTS_HZ, _STEP_S = 100, 2, 10.0
_SHIFT_S = 0.012


def main(argv: list[str]) -> int:
    """Run, and print memory and errors as they develop."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks soak_compressed", description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="of simulated operation")
    args = parser.parse_args(argv)
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        rows = list(_Daemon(Path(name), args.hours * 3600).run())
    first = next((row for row in rows if row[0] >= 600), rows[0])
    print("| after, min | status | memory, MB | descriptors | threads | lever arm off, mm | shift off, us |")
    print("|---:|---|---:|---:|---:|---:|---:|")
    for row in rows[:: max(len(rows) // 8, 1)] + rows[-1:]:
        t_s, use, status, arm_mm, shift_us = row
        cells = [
            f"{t_s / 60:.0f}",
            status,
            f"{use[0]:.1f}",
            use[1],
            use[2],
            f"{arm_mm:.2f}",
            f"{shift_us:.0f}",
        ]
        print("| " + " | ".join(map(str, cells)) + " |")
    growth = 100 * (rows[-1][1][0] / first[1][0] - 1)
    took_min = (time.monotonic() - begin_s) / 60
    print(f"\n{args.hours:g} h in {took_min:.1f} min; memory {growth:+.1f} % since minute 10.")
    return int(growth > 5.0)


class _Daemon:
    """The roles without their threads, on one bus, driven by the time of the data."""

    def __init__(self, folder: Path, seconds: float) -> None:
        board = folder / "board.yaml"
        board.write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
        record = RecordConfig(
            directory=str(folder / "log"), rotate_s=30, quota_bytes=200_000_000, reserve_bytes=0
        )
        config = Config(
            imus={"imu0": ImuConfig(port="none")},
            cameras={"cam0": CameraConfig(uri="none")},
            target=str(board),
            record=record,
        )
        self.seconds = seconds
        self.rig = reference_rig(7, timeshift_cam_imu_s=_SHIFT_S)
        self.rig.gyro_bias.value(seconds + 60), self.rig.accel_bias.value(seconds + 60)  # grown beforehand
        self.rng = np.random.default_rng(7)
        self.points = board_points()
        self.bus, self.clock = LocalBus(), private_clock()
        self.role = EstimateRole(config, make_estimator(config, None))
        self.page = WebState(config.rig)
        log = LogFolder(folder / "log", quota_bytes=record.quota_bytes, reserve_bytes=0)
        self.recorder = Recorder(config, log, self.clock)
        self.bus.subscribe("vical/**", self._take)
        self.image = self.rng.integers(0, 255, (120, 160), dtype=np.uint8)

    def _take(self, sample: Sample) -> None:
        item = arrival(sample, self.clock)
        if item is not None:
            self.recorder.write(item)
        if "/calibration/" in sample.key or "/status/" in sample.key:
            self.page.take(sample)
        else:
            self.role.take(sample)

    def run(self) -> Any:
        """Yield (time, usage, status, errors) every two minutes of data."""
        self.recorder.tick()
        next_s = 120.0
        for t_s in np.arange(0.0, self.seconds, _STEP_S):
            self._feed(float(t_s))
            publish(self.bus, self.role.step())
            self.recorder.tick()
            self.page.tick()
            if t_s + _STEP_S >= next_s:
                next_s += 120.0
                yield (t_s + _STEP_S, usage(os.getpid()), *self._errors(float(t_s)))
        self.recorder.close()

    def _feed(self, t0_s: float) -> None:
        """Publish ten seconds of data, in the order of their stamps."""
        t_s = t0_s + np.arange(int(_IMU_HZ * _STEP_S)) / _IMU_HZ
        gyro, force = self.rig.imu_reading(t_s)
        root = np.sqrt(_IMU_HZ)
        gyro = gyro + self.rig.densities.gyro * root * self.rng.standard_normal(gyro.shape)
        force = force + self.rig.densities.accel * root * self.rng.standard_normal(force.shape)
        for k, t in enumerate(t_s):
            payload = m.encode_imu(_T0_NS + round(t * 1e9), "imu0", tuple(gyro[k]), tuple(force[k]))
            self.bus.publish(topics.IMU.key("rig0", "imu0"), payload)
            if k % (_IMU_HZ // _POINTS_HZ) == 0:
                self._image(float(t), with_pixels=k % _IMU_HZ == 0)
                publish(self.bus, self.role.step())

    def _image(self, t_s: float, *, with_pixels: bool) -> None:
        uv, seen = self.rig.lens.project(self.rig.points_in_camera(t_s, self.points))
        uv = uv + 0.15 * self.rng.standard_normal(uv.shape)
        stamp_ns = _T0_NS + round(float(self.rig.t_cam(t_s)) * 1e9)
        ids = np.nonzero(seen)[0].astype(np.int64)
        points = m.encode_points(stamp_ns, "cam0", ids, uv[seen], None, self.rig.lens.resolution)
        self.bus.publish(topics.POINTS.key("rig0", "cam0"), points)
        status = m.encode_diagnostics(stamp_ns, "estimate", self.role.statuses())
        self.bus.publish(topics.STATUS.key("rig0", "estimate"), status)
        if with_pixels:
            image = m.encode_image(stamp_ns, "cam0", self.image, "mono8")
            self.bus.publish(topics.IMAGE.key("rig0", "cam0"), image)

    def _errors(self, t_s: float) -> tuple[str, float, float]:
        estimate = self.role.latest
        if estimate is None or "cam0" not in estimate.cameras:
            return "no solution", float("nan"), float("nan")
        known = estimate.cameras["cam0"]
        _, p_imu_cam = self.rig.extrinsics_at(t_s)
        arm_mm = 1e3 * float(np.linalg.norm(np.subtract(known.T_imu_cam.p_m, p_imu_cam)))
        shift_us = 1e6 * abs(known.timeshift_cam_imu_s - float(self.rig.timeshift_at(t_s)))
        return str(estimate.status), arm_mm, shift_us


if __name__ == "__main__":
    import sys

    raise SystemExit(main(sys.argv[1:]))
