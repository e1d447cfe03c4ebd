"""Predicted points: what the filter expected of an image before it used it, published and never measured."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.calibrate.predictions import Predictions
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import loads
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.logs import open_recording
from vical_daemon.logs.mcap import LogWriter

CONFIG = loads(
    "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
    "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [640, 480], rate_hz: 10}}\ntarget: t.yaml\n"
)


def test_the_newest_image_is_published_once_and_without_what_has_no_prediction() -> None:
    predictions = Predictions("rover")
    nowhere = SimpleNamespace(camera="cam0", t_ns=1, ids=np.arange(2), predicted_px=np.zeros((0, 2)))
    predictions.take([nowhere, SimpleNamespace(camera="cam1")])
    assert predictions.messages() == []
    uv = np.array([[1.0, 2.0], [np.nan, np.nan], [5.0, 6.0]])
    frames = [
        SimpleNamespace(camera="cam0", t_ns=t, ids=np.array([4, 5, 6]), predicted_px=uv) for t in (7, 8)
    ]
    predictions.take(frames)
    ((key, payload),) = predictions.messages()
    found = m.decode_points(payload)
    assert key == "vical/rover/camera/cam0/predicted"
    assert (found.stamp_ns, found.frame_id, found.ids.tolist()) == (8, "cam0", [4, 6])
    assert found.uv_px.tolist() == [[1.0, 2.0], [5.0, 6.0]]
    assert predictions.messages() == []


def test_a_calibrated_filter_knows_where_the_corners_will_be() -> None:
    rig = reference_rig(11, timeshift_cam_imu_s=0.02)
    run = simulate(11, 14.0, rig=rig, camera_rate_hz=10.0, corner_sigma_px=0.2)
    prior = CameraPrior((640, 480), intrinsics=(515.0, 515.0, 320.0, 240.0))
    role = EstimateRole(CONFIG, Calibrator(CalibrationOptions(), {"cam0": prior}, run.points_m))
    key = topics.PREDICTED.key("rover", "cam0")
    predicted, used = [], 0
    frames = iter(run.frames)
    frame = next(frames)
    seen = {}
    for t, gyro, force in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True):
        while frame is not None and frame.t_cam_ns <= t:
            seen[frame.t_cam_ns] = dict(zip(frame.ids.tolist(), frame.uv_px, strict=True))
            role._order.push(frame.t_cam_ns, _as_frame(frame))
            frame, used = next(frames, None), used + 1
        role._order.push(int(t), m.decode_imu(m.encode_imu(int(t), "imu0", tuple(gyro), tuple(force))))
        predicted += [m.decode_points(payload) for at, payload in role.step() if at == key]
    assert 20 <= len(predicted) <= 14 * 5 + 1
    errors = [
        np.linalg.norm(uv - seen[message.stamp_ns][number])
        for message in predicted[-10:]
        for number, uv in zip(message.ids.tolist(), message.uv_px, strict=True)
    ]
    assert 0.1 < np.median(errors) < 2.0  # not the measured ones, and not far from them


def _as_frame(frame: object) -> object:
    return m.decode_points(m.encode_points(frame.t_cam_ns, "cam0", frame.ids, frame.uv_px)).to_frame()  # type: ignore[attr-defined]


def test_a_recording_takes_predictions_for_no_measurement(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(200):
            t = 10**18 + 10_000_000 * k
            log.write(
                topics.IMU.key("rover", "imu0"), m.encode_imu(t, "imu0", (0.0,) * 3, (0.0, 0.0, 9.8)), t
            )
            points = m.encode_points(t, "cam0", np.arange(3), np.full((3, 2), float(k)))
            log.write(topics.PREDICTED.key("rover", "cam0"), points, t)
            if k % 10 == 0:
                log.write(topics.POINTS.key("rover", "cam0"), points, t)
    recording = open_recording(path, check=False)
    assert [stream.kind for stream in recording.streams] == ["imu", "points"]
    assert sum(1 for _ in recording.points_frames("cam0")) == 20
