"""Pixel formats against OpenCV's conversions, and damaged images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from vical_drivers.camera.formats import FORMATS, CorruptImageError, FrameDecoder
from vical_mocks.v4l2_camera import FakeCamera

from vical_daemon.vision.image_codec import decode_image, encode_image

H, W = 48, 64


@pytest.fixture
def scene() -> np.ndarray:
    """A smooth coloured picture, (H, W, 3) BGR."""
    y, x = np.mgrid[0:H, 0:W]
    planes = [128 + 90 * np.sin(x / 9 + k) * np.cos(y / (7 + k)) for k in range(3)]
    return np.stack(planes, axis=2).astype(np.uint8)


def decode(name: str, data: np.ndarray, encoding: str, **more: object) -> np.ndarray:
    raw = np.ascontiguousarray(data).view(np.uint8).reshape(-1)
    return FrameDecoder(FORMATS[name], W, H, encoding=encoding, **more)(raw)


def packed(scene: np.ndarray, order: str) -> np.ndarray:
    ycc = cv2.cvtColor(scene, cv2.COLOR_BGR2YUV_I420)
    luma = ycc[:H]
    u = ycc[H : H + H // 4].reshape(H // 2, W // 2).repeat(2, axis=0)
    v = ycc[H + H // 4 :].reshape(H // 2, W // 2).repeat(2, axis=0)
    parts = {"Y0": luma[:, 0::2], "Y1": luma[:, 1::2], "U": u, "V": v}
    return np.stack([parts[p] for p in order.split()], axis=2).reshape(H, 2 * W)


@pytest.mark.parametrize(
    ("name", "order", "code"),
    [
        ("YUYV", "Y0 U Y1 V", cv2.COLOR_YUV2BGR_YUYV),
        ("UYVY", "U Y0 V Y1", cv2.COLOR_YUV2BGR_UYVY),
        ("YVYU", "Y0 V Y1 U", cv2.COLOR_YUV2BGR_YVYU),
    ],
)
def test_packed_yuv_as_opencv_converts_it(scene, name: str, order: str, code: int) -> None:
    data = packed(scene, order)
    expected = cv2.cvtColor(data.reshape(H, W, 2), code)
    assert np.abs(decode(name, data, "bgr8").astype(int) - expected).max() <= 2
    luma = cv2.cvtColor(scene, cv2.COLOR_BGR2YUV_I420)[:H]
    assert np.array_equal(decode(name, data, "mono8"), luma)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("NV12", cv2.COLOR_YUV2BGR_NV12),
        ("NV21", cv2.COLOR_YUV2BGR_NV21),
        ("YU12", cv2.COLOR_YUV2BGR_I420),
    ],
)
def test_planar_yuv_as_opencv_converts_it(scene, name: str, code: int) -> None:
    planar = cv2.cvtColor(scene, cv2.COLOR_BGR2YUV_I420)
    u, v = planar[H : H + H // 4].reshape(-1), planar[H + H // 4 :].reshape(-1)
    chroma = {"NV12": np.stack([u, v], 1), "NV21": np.stack([v, u], 1), "YU12": np.concatenate([u, v])}
    data = np.concatenate([planar[:H].reshape(-1), chroma[name].reshape(-1)])
    expected = cv2.cvtColor(data.reshape(H * 3 // 2, W), code)
    assert np.abs(decode(name, data, "bgr8").astype(int) - expected).max() <= 2
    assert np.array_equal(decode(name, data, "mono8"), planar[:H])
    with pytest.raises(CorruptImageError):
        decode(name, data[:-10], "bgr8")


def mosaic(scene: np.ndarray, order: str) -> np.ndarray:
    raw = np.empty((H, W), np.uint8)
    for place, colour in enumerate(order):
        here = (slice(place // 2, None, 2), slice(place % 2, None, 2))
        raw[here] = scene[..., "BGR".index(colour)][here]
    return raw


@pytest.mark.parametrize("name", ["BA81", "GBRG", "GRBG", "RGGB"])
def test_bayer_gives_back_the_scene(scene, name: str) -> None:
    raw = mosaic(scene, FORMATS[name].order)
    bgr = decode(name, raw, "bgr8").astype(int)
    assert np.abs(bgr - scene)[2:-2, 2:-2].max() <= 6
    opencv = {"BA81": cv2.COLOR_BayerRG2BGR, "GBRG": cv2.COLOR_BayerGR2BGR,
              "GRBG": cv2.COLOR_BayerGB2BGR, "RGGB": cv2.COLOR_BayerBG2BGR}[name]  # fmt: skip
    assert np.abs(bgr - cv2.cvtColor(raw, opencv))[2:-2, 2:-2].max() <= 1
    mono = decode(name, raw, "mono8").astype(float)
    expected = (scene[..., 0] + 2.0 * scene[..., 1] + scene[..., 2]) / 4
    assert np.abs(mono - expected)[2:-2, 2:-2].max() < 8


def test_bayer_to_mono_leaves_no_chequer_on_flat_colour() -> None:
    flat = np.full((H, W, 3), (10, 100, 250), np.uint8)
    mono = decode("RGGB", mosaic(flat, "RGGB"), "mono8")
    assert np.ptp(mono) == 0


@pytest.mark.parametrize(("name", "bits"), [("Y10", 10), ("Y12", 12), ("Y16", 16)])
def test_deep_grey(name: str, bits: int) -> None:
    ramp = np.linspace(0, (1 << bits) - 1, H * W).astype(np.uint16).reshape(H, W)
    assert np.array_equal(decode(name, ramp, "mono16"), ramp << (16 - bits))
    assert np.array_equal(decode(name, ramp, "mono8"), (ramp >> (bits - 8)).astype(np.uint8))


def test_rgb_and_stride(scene) -> None:
    assert np.array_equal(decode("BGR3", scene, "bgr8"), scene)
    assert np.array_equal(decode("RGB3", scene[:, :, ::-1], "bgr8"), scene)
    grey = cv2.cvtColor(scene, cv2.COLOR_BGR2GRAY).astype(int)
    assert np.abs(decode("BGR3", scene, "mono8").astype(int) - grey).max() <= 1
    padded = np.zeros((H, W + 16), np.uint8)
    padded[:, :W] = scene[:, :, 0]
    for data in (padded.reshape(-1), padded.reshape(-1)[:-16]):  # the last row may lack its padding
        assert np.array_equal(decode("GREY", data, "mono8", stride=W + 16), scene[:, :, 0])
    with pytest.raises(CorruptImageError, match="bytes where"):
        decode("GREY", scene[:-1, :, 0], "mono8")


def test_jpeg_through_the_given_decoder(scene) -> None:
    data = np.frombuffer(encode_image(scene, "jpeg", quality=95), np.uint8)
    padded = np.concatenate([data, np.zeros(100, np.uint8)])
    bgr = decode("MJPG", padded, "bgr8", decoder=decode_image)
    assert np.abs(bgr.astype(int) - scene).mean() < 3
    assert decode("MJPG", data, "mono8", decoder=decode_image).shape == (H, W)
    for damaged in (data[:-20], data[10:], np.zeros(50, np.uint8), data[:2]):
        with pytest.raises(CorruptImageError):
            decode("MJPG", damaged, "mono8", decoder=decode_image)
    other_size = np.frombuffer(encode_image(scene[:32], "jpeg"), np.uint8)
    with pytest.raises(CorruptImageError, match="JPEG of 64 x 32"):
        decode("MJPG", other_size, "mono8", decoder=decode_image)
    with pytest.raises(ValueError, match="needs an image decoder"):
        FrameDecoder(FORMATS["MJPG"], W, H)


def test_png_is_lossless_and_bad_images_are_refused(scene) -> None:
    data = np.frombuffer(encode_image(scene), np.uint8)
    assert np.array_equal(decode_image(data, colour=True), scene)
    with pytest.raises(ValueError, match="no image"):
        decode_image(np.zeros(10, np.uint8))
    with pytest.raises(ValueError, match="png or jpeg"):
        encode_image(scene, "gif")


def test_corrupt_mjpg_frames_are_skipped_by_the_grabber(open_fake, scene) -> None:
    def picture(number: int, *_: object) -> np.ndarray:
        data = np.frombuffer(encode_image(scene, "jpeg"), np.uint8)
        return data[: data.size // 2] if number in (2, 3) else data

    formats = {"MJPG": {(W, H): (30.0,)}}
    source = open_fake(FakeCamera(formats=formats, picture=picture, controls=[]), decoder=decode_image)
    frames = [source.read(1.0) for _ in range(4)]
    assert [(f.sequence, f.dropped_before) for f in frames] == [(0, 0), (1, 0), (4, 2), (5, 0)]
    assert source.stats().checksum_errors == 2
    assert frames[0].image.shape == (H, W)


@pytest.mark.parametrize(
    ("asked", "chosen"),
    [
        ({"rate_hz": 30.0}, "MJPG"),  # YUYV manages 10 Hz at this size only
        ({"rate_hz": 10.0}, "YUYV"),
        ({"rate_hz": 30.0, "width": 320, "height": 240}, "YUYV"),
    ],
)
def test_the_cheapest_format_that_reaches_the_rate_is_chosen(open_fake, asked, chosen: str) -> None:
    big, small = (1280, 960), (320, 240)
    formats = {"MJPG": {big: (30.0, 10.0), small: (30.0,)}, "YUYV": {big: (10.0, 5.0), small: (30.0,)}}
    settings = {"width": 1280, "height": 960} | asked
    source = open_fake(FakeCamera(formats=formats), decoder=decode_image, **settings)
    assert source.info.details["pixel_format"] == chosen
    assert source.info.details["rate_hz"] == f"{asked['rate_hz']:g}"


def test_mjpg_is_not_chosen_without_a_decoder(open_fake) -> None:
    formats = {"MJPG": {(64, 48): (30.0,)}, "YUYV": {(64, 48): (5.0,)}}
    assert open_fake(FakeCamera(formats=formats), rate_hz=30.0).info.details["pixel_format"] == "YUYV"
