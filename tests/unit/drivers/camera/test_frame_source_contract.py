"""What every frame source keeps to: one class, run against each of them."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from vical_drivers.camera import CameraSettings, open_camera
from vical_drivers.camera.aravis.camera import AravisCamera, list_aravis_cameras
from vical_drivers.camera.v4l2.camera import V4l2Camera
from vical_drivers.errors import DataEndedError, DeviceLostError, MissingLibraryError
from vical_drivers.samples import DeviceInfo, Frame, FrameSource, SourceStats
from vical_mocks import firewire_rig
from vical_mocks.live_rig import LiveRig, LiveRigSettings
from vical_mocks.v4l2_camera import FakeCamera, UvcClockModel
from vical_mocks.v4l2_kernel import FakeKernel

from vical_daemon.vision.image_codec import decode_image, encode_image

H, W = 48, 64
FRAMES = 12


@dataclass
class Stand:
    """A source to test and how it ends."""

    source: FrameSource
    ends: bool = False
    lose: Callable[[], None] | None = None
    cleanup: list[Callable[[], None]] = field(default_factory=list)


def on_fake_kernel(tmp_path: Path, camera: FakeCamera, **settings: object) -> Stand:
    kernel = FakeKernel(tmp_path / "kernel")
    path = kernel.plug(camera)
    source = V4l2Camera(path, CameraSettings(**settings), kernel=kernel, wait=lambda _: None)
    return Stand(source, lose=lambda: kernel.unplug(camera))


def jpeg(number: int, *_: object) -> np.ndarray:
    return np.frombuffer(encode_image(np.full((H, W), number * 9 % 255, np.uint8), "jpeg"), np.uint8)


def v4l2_grey(tmp_path: Path) -> Stand:
    return on_fake_kernel(tmp_path, FakeCamera(), exposure_s=0.004)


def v4l2_yuyv_borrowed(tmp_path: Path) -> Stand:
    camera = FakeCamera(formats={"YUYV": {(W, H): (30.0,)}}, controls=[])
    return on_fake_kernel(tmp_path, camera, borrow=True)


def v4l2_mjpg(tmp_path: Path) -> Stand:
    camera = FakeCamera(formats={"MJPG": {(W, H): (30.0,)}}, picture=jpeg, faults={3: "short"})
    return on_fake_kernel(tmp_path, camera, decoder=decode_image)


def uvc(tmp_path: Path) -> Stand:
    formats = {"YUYV": {(W, H): (30.0,)}}
    camera = FakeCamera(driver="uvcvideo", stamps="first-packet", formats=formats, uvc=UvcClockModel())
    return on_fake_kernel(tmp_path, camera, exposure_s=0.01, encoding="bgr8")


def folder_replay(tmp_path: Path) -> Stand:
    (tmp_path / "data").mkdir()
    lines = ["#timestamp [ns],filename"]
    for k in range(FRAMES + 4):
        stamp_ns = 1_400_000_000_000_000_000 + k * 50_000_000
        (tmp_path / "data" / f"{stamp_ns}.png").write_bytes(encode_image(np.full((H, W), k, np.uint8)))
        lines.append(f"{stamp_ns},{stamp_ns}.png")
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    return Stand(open_camera(f"folder:{tmp_path}", decoder=decode_image), ends=True)


def simulated(_: Path) -> Stand:
    """The camera of the demo: rendered in a process of its own, in real time."""
    if not RIGS:  # it takes seconds to start: one for all tests but that which kills it
        board = {"kind": "checkerboard", "cols": 5, "rows": 4, "row_spacing_m": 0.06, "col_spacing_m": 0.06}
        rig = LiveRig(LiveRigSettings(board=board, camera_rate_hz=20.0), devices=("camera",))
        rig.__enter__()
        RIGS.append(rig)

    def lose() -> None:
        RIGS[0]._processes[0].kill()
        DEAD.append(RIGS.pop())

    return Stand(RIGS[0].camera(), lose=lose)


def aravis(_: Path) -> Stand:
    """A GenICam camera of Aravis' own; a grabber process that dies is replaced, so it cannot stay lost."""
    try:
        list_aravis_cameras(("Fake",))
    except MissingLibraryError as error:
        pytest.skip(str(error))
    settings = CameraSettings(rate_hz=50.0, exposure_s=0.002, width=64, height=48)
    return Stand(AravisCamera("Fake_1", settings, interfaces=("Fake",)))


def iidc(_: Path) -> Stand:
    rig = firewire_rig.FireWireRig(os.environ[firewire_rig.ENVIRONMENT])
    source = open_camera("iidc:", width=640, height=480, rate_hz=60.0, exposure_s=0.003)

    def lose() -> None:
        rig.shared.unplugged = 1

    def back() -> None:
        rig.shared.unplugged = 0

    return Stand(source, lose=lose, cleanup=[back])


RIGS: list[LiveRig] = []
DEAD: list[LiveRig] = []
MAKERS: dict[str, Callable[[Path], Stand]] = {
    maker.__name__: maker
    for maker in (v4l2_grey, v4l2_yuyv_borrowed, v4l2_mjpg, uvc, folder_replay, simulated, aravis)
}
if firewire_rig.ENVIRONMENT in os.environ:  # the process that test_iidc.py starts
    MAKERS["iidc"] = iidc


@pytest.fixture(scope="module", autouse=True)
def _end_of_the_rig() -> Iterator[None]:
    yield
    for rig in RIGS + DEAD:
        rig.__exit__(None, None, None)
    RIGS.clear()
    DEAD.clear()


@pytest.fixture(params=sorted(MAKERS))
def stand(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stand]:
    made = MAKERS[request.param](tmp_path)
    with contextlib.closing(made.source):
        yield made
    for action in made.cleanup:
        action()


def take(source: FrameSource, count: int) -> list[Frame]:
    frames = []
    for _ in range(count):
        frame = source.read(2.0)
        assert frame is not None
        frames.append(frame)
    return frames


class TestFrameSource:
    """The contract of `vical_drivers.samples.FrameSource`."""

    def test_is_a_frame_source_with_an_identity(self, stand: Stand) -> None:
        assert isinstance(stand.source, FrameSource)
        info = stand.source.info
        assert isinstance(info, DeviceInfo)
        assert info.kind == "camera" and info.model and info.serial_number

    def test_frames_are_whole_and_in_order(self, stand: Stand) -> None:
        frames = take(stand.source, FRAMES)
        for frame in frames:
            assert frame.encoding in ("mono8", "bgr8")
            assert frame.image.dtype == np.uint8
            assert frame.image.ndim == (3 if frame.encoding == "bgr8" else 2)
            assert frame.stamp_rule
            assert isinstance(frame.t_exposure_mid_ns, int) and isinstance(frame.t_arrival_ns, int)
        stamps = [f.t_exposure_mid_ns for f in frames]
        assert all(a < b for a, b in itertools.pairwise(stamps))
        steps = [b.sequence - a.sequence for a, b in itertools.pairwise(frames)]
        assert steps == [f.dropped_before + 1 for f in frames[1:]]

    def test_counters_add_up(self, stand: Stand) -> None:
        frames = take(stand.source, FRAMES)
        stats = stand.source.stats()
        assert isinstance(stats, SourceStats)
        assert stats.samples == FRAMES
        assert stats.lost == sum(f.dropped_before for f in frames)
        assert stats.rate_hz > 0

    def test_no_frame_is_none_after_the_timeout(self, stand: Stand) -> None:
        if not stand.ends:
            # some frames may wait already; nobody reads faster than a camera delivers for long
            assert any(stand.source.read(0.0) is None for _ in range(100))
            return
        take(stand.source, FRAMES + 4)
        with pytest.raises(DataEndedError):
            stand.source.read(0.0)

    def test_a_lost_camera_is_told(self, stand: Stand) -> None:
        if stand.lose is None:  # a folder; aravis
            return
        take(stand.source, 2)
        stand.lose()
        with pytest.raises(DeviceLostError):
            drain(stand.source)
        with pytest.raises(DeviceLostError):  # and again, while it stays away
            stand.source.read(0.05)

    def test_closes_twice_and_as_a_context(self, stand: Stand) -> None:
        with stand.source as source:
            assert source is stand.source
            take(source, 1)
        stand.source.close()
        stand.source.close()


def drain(source: FrameSource) -> None:
    for _ in range(1000):
        source.read(0.5)
