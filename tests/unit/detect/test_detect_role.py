"""The detect role: points with the stamp of their image, rate limit, junk."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from vical_drivers.samples import Frame

from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import (
    Level,
    decode_points,
    encode_image,
)
from vical_daemon.config.model import Config, loads
from vical_daemon.detect.role import DetectRole
from vical_daemon.vision.detection import Detection

MS = 1_000_000


@pytest.fixture
def config() -> Config:
    return loads(
        "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\n"
        "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [16, 16], rate_hz: 10}}\ntarget: t.yaml\n"
    )


def _frame(t_ms: int, **changes: Any) -> Frame:
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    values = {"t_exposure_mid_ns": t_ms * MS, "t_arrival_ns": 0, "sequence": 0, "image": image}
    return Frame(**(values | {"encoding": "mono8", "stamp_rule": "simulated"} | changes))


class TestDetect:
    def _role(self, config: Config, found: Detection | None) -> DetectRole:
        return DetectRole(config, "cam0", lambda image, t_ns: found)

    def _sample(self, t_ms: int) -> Sample:
        payload = encode_image(t_ms * MS, "cam0", _frame(t_ms).image, "mono8")
        return Sample("vical/rover/camera/cam0/image", payload, 0)

    def test_points_keep_the_stamp_of_their_image(self, config: Config) -> None:
        found = Detection(np.array([3, 5]), np.array([[1.5, 2.5], [3.0, 4.0]]), np.array([0.1, 0.2]))
        ((key, payload),) = self._role(config, found).points(self._sample(1234))
        message = decode_points(payload)
        assert key == "vical/rover/camera/cam0/points" and message.stamp_ns == 1234 * MS
        assert message.image_size == (16, 16) and message.ids.tolist() == [3, 5]
        np.testing.assert_array_equal(message.uv_px, found.uv_px)

    def test_an_image_without_a_board_is_said_too(self, config: Config) -> None:
        role = self._role(config, None)
        ((_, payload),) = role.points(self._sample(1))
        assert len(decode_points(payload).ids) == 0
        assert role.status().values["with_points"] == "0"

    def test_junk_is_counted(self, config: Config) -> None:
        role = self._role(config, None)
        assert role.points(Sample("vical/rover/camera/cam0/image", b"junk", 0)) == []
        assert role.status(3).values["malformed"] == "1" and role.status(3).values["dropped"] == "3"
        assert role.status().level is Level.ERROR  # not one image could be read
        assert role.status().message.startswith("none of 1 images can be read: ")

    def test_rate_limit_counts_in_the_time_of_the_images(self, config: Config) -> None:
        role = self._role(config, None)  # detect_rate_hz is 30
        done = [bool(role.points(self._sample(1000 + 10 * i))) for i in range(100)]
        assert 28 <= sum(done) <= 34
        assert all(self._role(config, None).points(self._sample(t)) for t in range(0, 1000, 100))
