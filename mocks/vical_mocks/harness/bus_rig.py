"""A simulated rig as it shows on the bus: its config, its messages, and two answers compared."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.config.model import Config, load
from vical_daemon.estimation.result import CalibrationEstimate
from vical_daemon.vision.target import Checkerboard
from vical_mocks.harness.bus_junk import RIG
from vical_mocks.points import SimulatedRun

Message = tuple[int, str, bytes]


def config_text(folder: Path, camera: str) -> str:
    """The rig, calibrating one of its cameras."""
    return f"""\
rig: {RIG}
imus: {{imu0: {{port: /dev/null, rate_hz: 100}}}}
cameras:
  cam0: {{uri: /dev/null, size: [640, 480]}}
  cam1: {{uri: /dev/null, size: [160, 120]}}
calibration: {{cameras: [{camera}]}}
target: {folder}/target.yaml
bus: {{tcp_port: 0}}
record: {{directory: {folder}/log, reserve_bytes: 0, rotate_s: 10}}
"""


def load_config(folder: Path, camera: str = "cam0") -> Config:
    """Write the config and its target, and read it as the service does."""
    (folder / "target.yaml").write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    path = folder / f"{camera}.yaml"
    path.write_text(config_text(folder, camera))
    return load(path)


def good_messages(run: SimulatedRun, begin_ns: int) -> Iterator[Message]:
    """Everything that the rig sends, in the order of its stamps: stamp, key, payload."""
    shift_ns = begin_ns - run.options.epoch_ns
    rng = np.random.default_rng(3)
    out: list[Message] = []
    for t, w, f in zip(run.t_imu_ns.tolist(), run.gyro_rps, run.specific_force_mps2, strict=True):
        payload = m.encode_imu(t + shift_ns, "imu0", tuple(w), tuple(f))
        out.append((t + shift_ns, topics.IMU.key(RIG, "imu0"), payload))
    for frame in run.frames:
        t = frame.t_cam_ns + shift_ns
        points = m.encode_points(t, "cam0", frame.ids, frame.uv_px, None, run.rig.lens.resolution)
        out.append((t, topics.POINTS.key(RIG, "cam0"), points))
        picture = rng.integers(0, 256, (120, 160), dtype=np.uint8)
        out.append((t, topics.IMAGE.key(RIG, "cam1"), m.encode_image(t, "cam1", picture, "mono8")))
    return iter(sorted(out, key=lambda message: message[:2]))


def away_sigmas(one: CalibrationEstimate, other: CalibrationEstimate) -> float:
    """Largest difference of two answers about cam0, in sigmas of the first."""
    a, b = one.cameras["cam0"], other.cameras["cam0"]
    move = np.subtract(b.T_imu_cam.p_m, a.T_imu_cam.p_m)
    qa, qb = np.array(a.T_imu_cam.q_wxyz), np.array(b.T_imu_cam.q_wxyz)
    (wa, va), (wb, vb) = (qa[0], qa[1:]), (qb[0], qb[1:])
    turn = 2 * np.sign(wa * wb + va @ vb) * (wa * vb - wb * va - np.cross(va, vb))
    shift = b.timeshift_cam_imu_s - a.timeshift_cam_imu_s
    sigma = np.sqrt([*np.diag(a.T_imu_cam.covariance), a.timeshift_sigma_s**2])
    return float(np.max(np.abs([*move, *turn, shift]) / sigma))
