"""Feeds a bus with what a rig sends: a calibration that converges, statuses, images with their points."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Bus
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    encode_calibration,
    encode_diagnostics,
    encode_image,
    encode_points,
)
from vical_daemon.config.model import CameraConfig, Config, ImuConfig, RecordConfig, WebConfig
from vical_daemon.estimation.events import Event
from vical_daemon.estimation.guidance import Guidance
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
)
from vical_daemon.estimation.wording import guidance_text
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.web import role as web

RIG, CAMERA = "rig0", "cam0"
T0_NS = 1_700_000_000_000_000_000
NOTHING = Guidance()


def serve_page(
    bus: Bus,
    stop: threading.Event,
    ready: Callable[[str], None],
    target: Path | None = None,
    logs: Path | None = None,
) -> threading.Thread:
    """Start the role web for this rig on a free port; `ready` gets the address, `stop` ends the thread.

    `target` is the file of the board, `logs` the folder of the recordings.
    """
    config = Config(
        rig=RIG,
        target=None if target is None else str(target),
        record=RecordConfig(directory=None if logs is None else str(logs)),
        imus={"imu0": ImuConfig(port="none")},
        cameras={CAMERA: CameraConfig(uri="none")},
        web=WebConfig(enabled=True, port=0),
    )
    options = {"clock": private_clock(), "ready": ready}
    thread = threading.Thread(target=web.run, args=(config, bus, stop), kwargs=options)
    thread.start()
    return thread


def estimate(
    t_s: float,
    rng: np.random.Generator,
    status: Status | None = None,
    guidance: str = "",
    withheld: Sequence[str] = (),
    motion: Guidance = NOTHING,
    events: Sequence[Event] = (),
    reason: str = "",
) -> CalibrationEstimate:
    """An estimate whose sigmas fall as 1/sqrt(t) and whose errors fit them."""
    shrink = 1.0 / np.sqrt(max(t_s, 0.2))
    sigma = np.array([4e-3, 4e-3, 6e-3, 3e-3, 3e-3, 1e-3]) * shrink
    error = sigma * rng.standard_normal(6)
    q = (Rotation.from_euler("zyx", [89, 1.2, 0.3], degrees=True) * Rotation.from_rotvec(error[3:])).as_quat(
        scalar_first=True
    )
    p = np.array([0.08, 0.02, -0.03]) + error[:3]
    camera = CameraEstimate(
        PoseEstimate(p.tolist(), q.tolist(), np.diag(sigma**2).tolist()),
        -0.0052 + 2e-4 * shrink * rng.standard_normal(), 2e-4 * shrink,
        [520.3, 519.9, 321.2, 240.5], [0.3, 0.3, 0.2, 0.2], "radtan", [-0.28, 0.07, 0.0002, 0.0], [1e-3] * 4,
        0.24, 0.22, list(withheld),
    )  # fmt: skip
    imu = ImuEstimate([0.002, -0.001, 0.004], [0.03, -0.02, 0.01], [1e-4 * shrink] * 3, [2e-2 * shrink] * 3)
    status = status or (Status.CONVERGED if t_s > 25 else Status.CONVERGING)
    advice = guidance or guidance_text(motion)
    return CalibrationEstimate(
        T0_NS + int(t_s * 1e9), status, reason, min(t_s / 25, 1.0), advice, t_s, int(20 * t_s),
        int(500 * t_s),
        {CAMERA: camera}, imu, [0.1, 9.8, 0.2], 1.0 + 0.1 * rng.standard_normal(), 0.004,
        list(events), motion,
    )  # fmt: skip


def publish_estimate(bus: Bus, value: CalibrationEstimate) -> None:
    """Publish an estimate of the camera."""
    bus.publish(topics.CALIBRATION.key(RIG, CAMERA), encode_calibration(value, CAMERA))


def publish_status(bus: Bus, level: Level = Level.OK, message: str = "500.0 Hz, 0 lost") -> None:
    """Publish the status of the roles imu (with this level and message) and detect."""
    values = {"samples": "15000", "lost": "0", "rate_hz": "500.02", "jitter_us": "83.4", "state": "streaming"}
    imu = DiagnosticStatus(level, "imu/imu0", message, "6223.12345", values)
    clock = DiagnosticStatus(Level.OK, "clock", "", "", {"offset_ns": "1"})
    bus.publish(topics.STATUS.key(RIG, "imu"), encode_diagnostics(T0_NS, "imu", [imu, clock]))
    camera = DiagnosticStatus(Level.OK, "camera/cam0", "20.0 Hz, 0 lost", "C1", {"exposure_ms": "12.000"})
    bus.publish(topics.STATUS.key(RIG, "camera"), encode_diagnostics(T0_NS, "camera", [camera, clock]))
    values = {"images": "600", "with_points": "590", "dropped": "3", "detection_ms": "11.2"}
    found = DiagnosticStatus(Level.OK, "detect/cam0", "98% of 600 images show points", "", values)
    bus.publish(topics.STATUS.key(RIG, "detect"), encode_diagnostics(T0_NS, "detect", [found, clock]))


def publish_points(bus: Bus, number: int, size: tuple[int, int] = (640, 480)) -> None:
    """Publish corners alone, as from a log without images."""
    grid = np.stack(np.meshgrid(np.arange(1, 9), np.arange(1, 7)), axis=-1).reshape(-1, 2) * 45.0
    payload = encode_points(
        T0_NS + number * 50_000_000, CAMERA, np.arange(48), np.asarray(grid + 100.0, np.float64), None, size
    )
    bus.publish(topics.POINTS.key(RIG, CAMERA), payload)


def publish_image(
    bus: Bus, number: int, *, with_points: bool = True, with_prediction: bool = True, width: int = 640
) -> int:
    """Publish a checkerboard that drifts through the picture, its inner corners as points; its stamp, ns."""
    stamp = T0_NS + number * 50_000_000
    height = width * 3 // 4
    y, x = np.mgrid[0:height, 0:width]
    shift = 30 * np.sin(0.2 * number)
    column, row = np.floor((x - 130 - shift) / 45), np.floor((y - 90) / 45)
    inside = (column >= 0) & (column < 9) & (row >= 0) & (row < 7)
    image = np.where(inside, np.where((column + row) % 2 == 0, 35, 225), 150 - y // 8).astype(np.uint8)
    bus.publish(topics.IMAGE.key(RIG, CAMERA), encode_image(stamp, CAMERA, image, "mono8"))
    if with_points:
        grid = np.stack(np.meshgrid(np.arange(1, 9), np.arange(1, 7)), axis=-1).reshape(-1, 2) * 45.0
        uv = grid + np.array([130 + shift, 90.0]) - 0.5
        payload = encode_points(stamp, CAMERA, np.arange(48), uv, None, (width, height))
        bus.publish(topics.POINTS.key(RIG, CAMERA), payload)
        if with_prediction:
            error = np.asarray(np.random.default_rng(number).normal([0.5, -0.3], 0.4, uv.shape))
            expected = encode_points(stamp, CAMERA, np.arange(48), uv + error)
            bus.publish(topics.PREDICTED.key(RIG, CAMERA), expected)
    return stamp
