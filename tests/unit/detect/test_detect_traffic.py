"""Whatever images come, the detect role goes on: it refuses, counts, and restarts its detector."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import Level
from vical_daemon.config.model import Config, loads
from vical_daemon.detect import role as detect
from vical_daemon.detect import wanted
from vical_daemon.detect.role import DetectRole
from vical_daemon.service import notify
from vical_daemon.vision.target import AprilGrid, Checkerboard

MS = 1_000_000
NOW = 1_800_000_000_000_000_000
IMAGE = topics.IMAGE.key("rover", "cam0")


@pytest.fixture
def config() -> Config:
    return loads(
        "rig: rover\nimus: {imu0: {port: /dev/x}}\n"
        "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [64, 48]}}\ntarget: t.yaml\n"
    )


def image(t_ns: int, size: tuple[int, int] = (64, 48)) -> Sample:
    payload = m.encode_image(t_ns, "cam0", np.zeros((size[1], size[0]), np.uint8), "mono8")
    return Sample(IMAGE, payload, 0)


class TestDetect:
    @pytest.mark.parametrize("stamp", [0, -(10**9), 2**31 * 10**9 - 1])
    def test_a_stamp_of_nonsense_does_not_stop_the_images(self, config: Config, stamp: int) -> None:
        role = DetectRole(config, "cam0", lambda picture, t_ns: None)
        done = 0
        for k in range(60):
            if k % 20 == 10:
                role.points(image(stamp))
            done += bool(role.points(image(NOW + k * 50 * MS)))
        assert done == 60

    def test_images_of_another_size_are_refused_and_named(self, config: Config) -> None:
        """A camera that came back on USB 2 at half size: its pixels are those of another lens."""
        role = DetectRole(config, "cam0", lambda picture, t_ns: None)
        sizes = [(64, 48)] * 3 + [(1, 1), (64, 48)] + [(32, 24)] * 6
        done = [bool(role.points(image(NOW + k * 100 * MS, size))) for k, size in enumerate(sizes)]
        assert done == [True] * 3 + [False, True] + [False] * 6
        status = role.status()
        assert status.level is Level.ERROR and status.values["of_another_size"] == "7"
        assert status.message == "images are 32 x 24 px, not 64 x 48 as in the config: not used"
        assert role.points(image(NOW + 2000 * MS))
        assert role.status().level is Level.OK

    def test_a_wrong_target_file_is_told_in_the_status_and_the_journal(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        events: list[tuple[str, str]] = []
        monkeypatch.setattr(notify, "event", lambda name, text, **_: events.append((name, text)))
        reports: list[Any] = []

        def make(_config: Config, _predictor: Any, report: Any) -> Any:
            reports.append(report)
            return lambda picture, t_ns: None

        monkeypatch.setattr(detect, "make_detector", make)
        role = DetectRole(config, "cam0")
        role.points(image(NOW))
        reports[0]("the tags stand in rows of 6, the target file states tagCols: 5")
        status = role.status()
        assert status.level is Level.ERROR and status.message.startswith("the tags stand in rows of 6")
        assert events == [("wrong_target", f"cam0: {status.message}")]

    @pytest.mark.parametrize(
        ("board", "words"),
        [
            (Checkerboard(9, 6, 0.05, 0.05), "a checkerboard with 9 x 6 inner corners"),
            (AprilGrid(6, 5, 0.08, 0.3), "an AprilGrid with 6 x 5 tags"),
        ],
    )
    def test_the_board_that_is_in_no_image_is_named(
        self, config: Config, tmp_path: Path, board: Checkerboard | AprilGrid, words: str
    ) -> None:
        (tmp_path / "t.yaml").write_text(board.to_yaml())
        role = DetectRole(replace(config, path=tmp_path / "vical.yaml"), "cam0")
        for k in range(50):
            role.points(image(NOW + k * 100 * MS))
        assert "looks_for" not in role.status().values
        role.points(image(NOW + 50 * 100 * MS))
        status = role.status()
        assert status.level is Level.WARN and status.values["looks_for"] == words
        assert status.message == f"0% of 51 images show points; looked for: {words}"

    def test_a_computer_that_is_too_slow_is_named(self, config: Config) -> None:
        role = DetectRole(config, "cam0", lambda picture, t_ns: None)
        for k in range(60):
            role.points(image(NOW + k * 100 * MS))
        assert "dropped:" not in role.status(dropped=3).message
        status = role.status(dropped=70)
        assert status.level is Level.WARN
        assert "; 70 were dropped: this computer is too slow for them (" in status.message

    def test_a_detector_that_raises_is_made_anew(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        events: list[str] = []
        monkeypatch.setattr(notify, "event", lambda name, text, **_: events.append(text))

        def raises(picture: Any, t_ns: int) -> None:
            if t_ns == NOW:
                raise RuntimeError("(-215:Assertion failed)\nin function 'cornerSubPix'")

        role = DetectRole(config, "cam0", raises)
        assert role.points(image(NOW)) == []
        assert role.points(image(NOW + 100 * MS))
        assert role.status().values["failures"] == "1"
        (text,) = events
        assert "cornerSubPix" in text and len(text.splitlines()) == 1

    def test_a_detector_that_hangs_is_not_called_alive(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        hang, stop, bus = threading.Event(), threading.Event(), LocalBus()
        monkeypatch.setattr(detect, "STUCK_S", 0.1)
        monkeypatch.setattr(detect, "make_detector", lambda *_: lambda picture, t_ns: hang.wait(60) and None)
        detectors = detect._Detectors(config, bus, stop)
        detectors.thread.start()
        bus.publish(IMAGE, image(NOW).payload)
        end_s = time.monotonic() + 30
        while detectors.statuses()[0].level is not Level.STALE:
            assert time.monotonic() < end_s
            time.sleep(0.01)
        hang.set()
        while detectors.statuses()[0].level is Level.STALE:
            assert time.monotonic() < end_s
            time.sleep(0.01)
        stop.set()
        detectors.close()

    def test_with_mode_verify_it_works_only_while_images_are_wanted(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        stop, bus = threading.Event(), LocalBus()
        seen: list[int] = []
        monkeypatch.setattr(detect, "make_detector", lambda *_: lambda picture, t_ns: seen.append(t_ns))
        monkeypatch.setattr(wanted, "FRESH_S", 0.5)
        detectors = detect._Detectors(replace(config, mode="verify"), bus, stop)
        detectors.thread.start()
        key, count = topics.VERIFY.key("rover", "cam0"), 0

        def send(seconds: float, rate_hz: float | None) -> int:
            """Send images, 20 per second of their stamps, each after a wish; return how many were used."""
            nonlocal count
            before, end_s = len(seen), time.monotonic() + seconds
            while time.monotonic() < end_s:
                if rate_hz is not None:
                    result = m.VerifyResult(1, "cam0", m.CheckState.CHECKING, image_rate_hz=rate_hz)
                    bus.publish(key, m.encode_verification(result))
                bus.publish(IMAGE, image(NOW + count * 50 * MS).payload)
                count += 1
                time.sleep(0.02)
            return len(seen) - before

        assert send(0.3, None) == 0
        assert send(2.0, 10.0) > 0
        gaps = np.diff(seen)
        assert gaps.mean() > 90 * MS  # about 10 of 20 per second
        send(0.3, 0.0)
        assert send(0.3, 0.0) == 0
        bus.publish(key, b"\x00\x01\x00\x00junk")
        assert send(2.0, 10.0) > 0
        send(0.7, None)  # whoever asked has gone
        assert send(0.3, None) == 0
        stop.set()
        detectors.close()
