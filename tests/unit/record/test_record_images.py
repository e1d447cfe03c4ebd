"""Images in logs: as they came, or compressed per camera; what cannot be compressed stays as it came."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.config.model import loads
from vical_daemon.logs.mcap import LogFolder, LogReader
from vical_daemon.record.images import ImageCompressor
from vical_daemon.record.queue import arrival
from vical_daemon.record.recorder import Recorder
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.vision.image_codec import decode_image

STAMP_NS = 1_700_000_000_123_456_789
RNG = np.random.default_rng(5)
SMOOTH = (np.add.outer(np.arange(60), np.arange(80)) + RNG.integers(0, 3, (60, 80))).astype(np.uint8)


def compressor(kind: str) -> ImageCompressor:
    return ImageCompressor(
        loads(f"rig: r\ncameras: {{cam0: {{uri: /dev/video0, record_as: {kind}}}}}\ntarget: t")
    )


def taken(kind: str, image: np.ndarray, encoding: str) -> m.CompressedImageMessage:
    raw = m.encode_image(STAMP_NS, "cam0", image, encoding)
    key, payload = compressor(kind).as_recorded("vical/r/camera/cam0/image", raw)
    assert key == "vical/r/camera/cam0/image/compressed"
    message = m.decode_compressed_image(payload)
    assert (message.stamp_ns, message.frame_id) == (STAMP_NS, "cam0")
    return message


def test_png_is_the_same_picture_and_smaller() -> None:
    message = taken("png", SMOOTH, "mono8")
    assert message.format == "png" and len(message.data) < 0.8 * SMOOTH.size
    assert np.array_equal(decode_image(np.frombuffer(message.data, np.uint8)), SMOOTH)


def test_colours_keep_their_order() -> None:
    colour = np.stack([SMOOTH, SMOOTH // 2, 255 - SMOOTH], axis=-1)
    message = taken("jpeg", colour, "bgr8")
    back = decode_image(np.frombuffer(message.data, np.uint8), colour=True)
    assert message.format == "jpeg" and np.abs(back.astype(int) - colour).mean() < 8.0


def test_sixteen_bits_stay_sixteen_bits() -> None:
    assert taken("jpeg", SMOOTH.astype(np.uint16) * 200, "mono16").format == "png"


@pytest.mark.parametrize(
    ("key", "payload", "failures"),
    [
        ("vical/r/camera/cam1/image", m.encode_image(STAMP_NS, "cam1", SMOOTH, "mono8"), 0),
        ("vical/r/imu/imu0", m.encode_imu(STAMP_NS, "imu0", (0.0,) * 3, (0.0,) * 3), 0),
        ("vical/r/camera/cam0/image", m.encode_image(STAMP_NS, "cam0", SMOOTH, "bayer_rggb8"), 1),
        ("vical/r/camera/cam0/image", b"junk", 1),
    ],
)
def test_the_rest_stays_as_it_came(key: str, payload: bytes, failures: int) -> None:
    images = compressor("png")
    assert images.as_recorded(key, payload) == (key, payload)
    assert images.failures == failures


def test_the_log_holds_what_can_be_opened_and_says_what_failed(tmp_path) -> None:
    config = loads(
        f"rig: rig0\nrecord: {{directory: {tmp_path}, reserve_bytes: 0}}\n"
        "cameras: {cam0: {uri: /dev/video0, record_as: png}}\ntarget: t"
    )
    recorder = Recorder(config, LogFolder(tmp_path), private_clock())
    recorder.tick()
    key = topics.IMAGE.key("rig0", "cam0")
    raw = m.encode_image(STAMP_NS, "cam0", SMOOTH, "bayer_rggb8")
    for payload in (m.encode_image(STAMP_NS, "cam0", SMOOTH, "mono8"), raw, b"junk"):
        recorder.write(arrival(Sample(key, payload, 0), private_clock()))
    recorder.close()
    found = {x.channel.topic: x for path in tmp_path.glob("*.mcap") for x in LogReader(path).messages()}
    assert set(found) == {f"/{key}", f"/{key}/compressed"}
    assert found[f"/{key}/compressed"].channel.type_name == "sensor_msgs/msg/CompressedImage"
    assert found[f"/{key}"].payload == raw
    assert recorder._images.failures == 1 and recorder.malformed == 1
