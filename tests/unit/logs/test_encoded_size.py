"""The size of images is read from their headers, in folders and in logs of compressed images."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from vical_daemon.bus.messages import decode_compressed_image, encode_compressed_image, encode_imu
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.encoded_size import encoded_size
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.vision.image_codec import decode_image

PICTURE = np.random.default_rng(1).integers(0, 255, (48, 64), np.uint8)


def jpeg(picture=PICTURE, *options: int) -> bytes:
    return bytes(cv2.imencode(".jpg", picture, list(options))[1].tobytes())


def with_orientation(data: bytes, turned: int) -> bytes:
    """A JPEG with an EXIF tag (0x0112) that asks for a turned display, as phones write it."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, turned, 0, 0)
    body = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]


@pytest.mark.parametrize(
    "data",
    [
        jpeg(),
        jpeg(cv2.cvtColor(PICTURE, cv2.COLOR_GRAY2BGR)),
        jpeg(PICTURE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        with_orientation(jpeg(), 6),
        jpeg()[:2] + b"\xff\xe2\xff\xff" + bytes(65_533) + jpeg()[2:],  # a large preview
        cv2.imencode(".png", PICTURE)[1].tobytes(),
        cv2.imencode(".png", PICTURE.astype(np.uint16) * 257)[1].tobytes(),
        cv2.imencode(".pgm", PICTURE)[1].tobytes(),
        b"P5\n# taken by hand\n64 48\n255\n" + PICTURE.tobytes(),
        cv2.imencode(".ppm", cv2.cvtColor(PICTURE, cv2.COLOR_GRAY2BGR))[1].tobytes(),
        cv2.imencode(".bmp", PICTURE)[1].tobytes(),
    ],
)
def test_sizes_are_those_of_the_decoded_image(data: bytes) -> None:
    assert encoded_size(data) == (64, 48)
    assert decode_image(np.frombuffer(data, np.uint8)).shape == (48, 64)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        jpeg()[:20],
        b"\x89PNG\r\n\x1a\n",
        b"GIF89a" + bytes(30),
        b"P5",
        b"P5 9",
        b"BM" + bytes(9),
    ],
)
def test_damaged_and_other_images_have_none(data: bytes) -> None:
    assert encoded_size(data) is None


@pytest.mark.parametrize(("place", "kind"), [("data", "jpg"), (".", "jpg"), ("data", "pgm"), (".", "bmp")])
def test_a_folder_of_images(tmp_path, write_asl, place, kind) -> None:
    folder = write_asl(tmp_path / "a", corners=False)
    camera = folder / "mav0/cam0"
    (camera / place).mkdir(exist_ok=True)
    stamps = [1_600_000_000_000_000_000 + 50_000_000 * k for k in range(20)]
    for t in stamps:
        (camera / place / f"{t}.{kind}").write_bytes(cv2.imencode(f".{kind}", PICTURE)[1].tobytes())
    lines = "".join(f"{t},{t}.{kind}\n" for t in stamps)
    (camera / "data.csv").write_text("#timestamp [ns],filename\n" + lines)
    recording = open_recording(folder, check=False)
    assert recording.cameras["cam0"].resolution == (64, 48)
    first = next(payload for key, payload in recording.messages() if "/camera/" in key)
    image = decode_image(np.frombuffer(decode_compressed_image(first).data, np.uint8))
    assert image.shape == (48, 64) and (kind == "jpg" or (image == PICTURE).all())


def test_images_without_a_list_are_dated_by_their_names(tmp_path, write_asl) -> None:
    """As `kalibr_bagcreater` reads them; merely numbered images have no stamps."""
    folder = write_asl(tmp_path / "a", corners=False)
    camera = folder / "mav0/cam0"
    stamps = [1_600_000_000_000_000_000 + 50_000_000 * k for k in range(20)]
    for t in stamps:
        (camera / f"{t}.jpg").write_bytes(jpeg())
    recording = open_recording(folder, check=False)
    assert [stamp_of(p) for key, p in recording.messages() if "/camera/" in key] == stamps
    for k, t in enumerate(stamps):
        (camera / f"{t}.jpg").rename(camera / f"{k:06d}.jpg")
    assert not open_recording(folder, check=False).cameras


def test_a_log_of_compressed_images(tmp_path, a_motion) -> None:
    t_ns, gyro, force = a_motion(seconds=5.0)
    with LogWriter(tmp_path / "a.mcap") as writer:
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True):
            writer.write("vical/rig0/imu/imu0", encode_imu(t, "imu0", w, f), t)
        for t in t_ns[::5].tolist():
            writer.write(
                "vical/rig0/camera/cam0/image/compressed",
                encode_compressed_image(t, "cam0", "jpeg", jpeg()),
                t,
            )
    assert open_recording(tmp_path / "a.mcap", check=False).cameras["cam0"].resolution == (64, 48)
