"""A recording through the roles: everything reaches the estimator, everything announced comes out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from vical_daemon.bus.messages import COMPRESSED_IMAGE_TYPE, encode_compressed_image
from vical_daemon.calibrate.estimators import Estimator
from vical_daemon.cli import calibration_text
from vical_daemon.cli.calibrate import conclude
from vical_daemon.cli.errors import CliError
from vical_daemon.config.priors import Initial, read_initial
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.logs import Stream, open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.offline import calibrate
from vical_daemon.offline.calibration_job import make_job, suspects
from vical_daemon.offline.errors import InputError, size_unknown


def test_all_that_was_announced_on_the_way_is_told_at_the_end(
    shortest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Announcer:
        def __init__(self, inner: Estimator) -> None:
            self._inner, self.calls = inner, 0

        def estimate(self):
            self.calls += 1
            return replace(
                self._inner.estimate(), events=[Event(EventKind.OTHER, said=f"event {self.calls}")]
            )

        def __getattr__(self, name: str):
            return getattr(self._inner, name)

    make = calibrate.make_estimator
    monkeypatch.setattr(calibrate, "make_estimator", lambda *a: Announcer(make(*a)))
    job = make_job(
        open_recording(shortest),
        read_initial(shortest / "initial.yaml"),
        target=str(shortest / "target.yaml"),
    )
    outcome = calibrate.run_job(job, lambda share, estimate: None)
    events = outcome.estimate.events
    assert len(events) > 2
    assert [event.said for event in events] == [f"event {k + 1}" for k in range(len(events))]
    text = calibration_text.describe(calibrate.document(job, outcome))
    assert all(event.said in text for event in events)


def test_the_roles_add_nothing_to_what_the_estimator_is_fed(
    short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every sample and every frame reaches the estimator, by stamp, bit for bit."""
    fed: list[tuple] = []

    class Listener:
        def __init__(self, inner: Estimator) -> None:
            self._inner = inner

        def add_imu(self, t_imu_ns, gyro_rps, specific_force_mps2) -> None:
            fed.append((t_imu_ns, *gyro_rps, *specific_force_mps2))

        def add_points(self, frame) -> None:
            fed.append((frame.t_cam_ns, frame.ids.tobytes(), frame.uv_px.tobytes()))

        waiting = 0

        def process(self) -> list:
            return []

        finish = process

        def __getattr__(self, name: str):
            return getattr(self._inner, name)

    make = calibrate.make_estimator
    monkeypatch.setattr(calibrate, "make_estimator", lambda *a: Listener(make(*a)))
    recording = open_recording(short)
    job = make_job(recording, read_initial(short / "initial.yaml"), target=str(short / "target.yaml"))
    calibrate.run_job(job, lambda share, estimate: None)
    samples = recording.imu_arrays("imu0")
    expected = [
        (int(t), *map(float, g), *map(float, a))
        for t, g, a in zip(samples.t_ns, samples.gyro_rps, samples.specific_force_mps2, strict=True)
    ]
    assert [entry for entry in fed if len(entry) == 7] == expected
    frames = [(f.t_cam_ns, f.ids.tobytes(), f.uv_px.tobytes()) for f in recording.points_frames("cam0")]
    assert [entry for entry in fed if len(entry) == 3] == frames
    assert [entry[0] for entry in fed] == sorted(entry[0] for entry in fed)


def test_only_the_part_that_was_asked_for_is_used(short: Path) -> None:
    recording = open_recording(short)
    job = make_job(
        recording,
        read_initial(short / "initial.yaml"),
        target=str(short / "target.yaml"),
        skip_s=2.5,
        seconds=3.0,
    )
    begin_ns = recording.begin_ns + 2_500_000_000
    everything = [(key, payload) for key, payload in recording.messages()]
    expected = [
        item for item in everything if begin_ns <= (stamp_of(item[1]) or 0) <= begin_ns + 3_000_000_000
    ]
    assert 500 < len(expected) < len(everything) / 2
    assert list(job.messages()) == expected
    assert job.duration_s == 3.0
    job.seconds = None
    assert job.duration_s == pytest.approx(recording.duration_s - 2.5)
    assert list(job.messages())[-1] == everything[-1]


def test_a_second_camera_that_hardly_sees_the_target_is_suspected(shortest: Path) -> None:
    recording, initial = open_recording(shortest), read_initial(shortest / "initial.yaml")
    job = make_job(recording, initial, target=str(shortest / "target.yaml"))
    assert "--camera" not in suspects(job)
    job.cameras["cam1"] = job.cameras["cam0"]
    assert suspects(job).endswith("hardly sees the target: --camera NAME takes one of them alone")
    outcome, nothing = SimpleNamespace(wrong_target="cam1: 7 orientations"), {"reason": "", "guidance": ""}
    args, result = SimpleNamespace(report=None, output=None), {"cameras": {}, "status": "waiting", **nothing}
    with pytest.raises(
        CliError, match=r"cam1: 7 orientations; all wait for a camera .*: --camera NAME takes"
    ):
        conclude(args, job, outcome, result, ())
    job.config = replace(job.config, target=None)  # without a target each camera is on its own
    assert "--camera" not in suspects(job)


@pytest.mark.parametrize(
    ("size", "says"),
    [("[480, 640]", "are width and height swapped?"), ("[320, 240]", "correct `resolution`")],
)
def test_corners_that_lie_outside_of_the_stated_images_are_named(
    shortest: Path, tmp_path: Path, size: str, says: str
) -> None:
    """A folder of corners has no image size of its own; a wrong one was taken, and the result `converged`."""
    given = tmp_path / "initial.yaml"
    width_height = re.compile(r"resolution: \[.*\]")
    given.write_text(width_height.sub(f"resolution: {size}", (shortest / "initial.yaml").read_text()))
    with pytest.raises(InputError, match=r"cam0: points lie at up to \(\d+, \d+\) px, outside") as error:
        make_job(open_recording(shortest), read_initial(given), target=str(shortest / "target.yaml"))
    assert str(error.value).endswith(says)


@pytest.mark.parametrize(
    ("kind", "says"), [("points", "the image size is not in the recording"), ("compressed", "like H.264")]
)
def test_an_image_size_that_is_not_known_is_told_with_the_reason(kind: str, says: str) -> None:
    """A bag of H.264 images: only the size was asked for, and with it no image was read."""
    text = size_unknown(Stream("k", kind, "cam0", "", 9, 0, 1, 10.0, 0.1))
    assert says in text and "`cam0: {resolution: [width, height]}`" in text


def test_images_that_cannot_be_read_are_counted(shortest: Path, tmp_path: Path) -> None:
    whole = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
    source = open_recording(shortest)
    with LogWriter(tmp_path / "a.mcap") as writer:
        for n, (key, payload) in enumerate(source.messages(source.imus.values())):
            stamp_ns = stamp_of(payload) or 0
            writer.write(key, payload, stamp_ns)
            if n % 20 == 0:
                data = whole if n % 100 else whole[:40]
                image = encode_compressed_image(stamp_ns, "cam0", "png", data)
                writer.write(
                    "vical/rig0/camera/cam0/image/compressed", image, stamp_ns, COMPRESSED_IMAGE_TYPE
                )
    recording = open_recording(tmp_path / "a.mcap")
    job = make_job(recording, Initial(), target=str(shortest / "target.yaml"))
    outcome = calibrate.run_job(job, lambda share, estimate: None)
    broken = -(-recording.imu_samples // 100)
    assert outcome.left_out["images_unreadable"] == broken
    text = calibration_text.describe(calibrate.document(job, outcome))
    assert f"{broken} images unreadable" in text
