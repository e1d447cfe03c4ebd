"""Cameras that announce what they do not know, and drivers that take time: what real ones do to a grabber."""

from __future__ import annotations

import errno

import numpy as np
import pytest
from vical_drivers import errors
from vical_mocks.v4l2_camera import (
    CID_EXPOSURE_ABSOLUTE,
    CID_FOCUS_ABSOLUTE,
    CID_FOCUS_AUTO,
    INTEGER,
    FakeCamera,
    FakeControl,
    webcam_controls,
)

S_PARM = 22
MS = 1_000_000
REALTIME_NS = 1_700_000_000_000_000_000


@pytest.mark.parametrize("code", [errno.EIO, errno.EPIPE, errno.ERANGE])
def test_a_control_that_ends_the_list_hides_no_exposure(open_fake, code: int, caplog) -> None:
    controls = [*webcam_controls(), FakeControl(0x0098091C, "Backlight", INTEGER, 0, 9, 1, broken=code)]
    source = open_fake(FakeCamera(controls=controls), exposure_s=0.004, gain=20)
    frame = source.read(1.0)
    assert (frame.exposure_ns, frame.stamp_rule) == (4 * MS, "eof-readout-exposure/2")
    assert source.controls.get("gain") == 20
    assert "listed=in part" in caplog.text


def test_an_exposure_that_cannot_be_read_is_unknown_and_one_that_cannot_be_set_is_refused(open_fake) -> None:
    def camera(serial_number: str) -> FakeCamera:
        controls = webcam_controls()
        for control in controls:
            control.stalled = errno.EPIPE if control.control_id == CID_EXPOSURE_ABSOLUTE else 0
            control.value = 1 if control.name == "Auto Exposure" else control.value
        return FakeCamera(controls=controls, serial_number=serial_number, port=f"1-{serial_number}")

    source = open_fake(camera("1"))
    assert source.info.details["exposure_s"] == "unknown"
    assert source.read(1.0).stamp_rule == "raw-eof"
    with pytest.raises(errors.DeviceRefusedError, match="the camera answers with an error"):
        open_fake(camera("2"), number=2, exposure_s=0.004)


def test_autofocus_is_switched_off_unless_it_is_named(open_fake, caplog) -> None:
    """It is on in most webcams, and changes the lens by some per cent."""
    camera = FakeCamera()
    open_fake(camera, controls={"focus_absolute": 40})
    assert (camera.control(CID_FOCUS_AUTO).value, camera.control(CID_FOCUS_ABSOLUTE).value) == (0, 40)
    assert "control=focus_automatic_continuous was=on now=off" in caplog.text
    camera = FakeCamera(serial_number="2", port="1-2")
    open_fake(camera, number=2, controls={"focus_auto": 1})
    assert camera.control(CID_FOCUS_AUTO).value == 1


def test_an_autofocus_that_cannot_be_switched_off_does_not_keep_the_camera_from_running(open_fake) -> None:
    controls = webcam_controls()
    controls[-1].stalled = errno.EPIPE
    assert open_fake(FakeCamera(controls=controls)).read(1.0) is not None


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTTY])
def test_a_driver_that_takes_no_rate_runs_as_it_does(open_fake, code: int) -> None:
    source = open_fake(FakeCamera(request_errno={S_PARM: code}), rate_hz=60.0)
    assert source.info.details["rate_hz"] == "30"
    assert source.read(1.0) is not None


def test_a_wall_clock_stamp_does_not_move_with_the_time_that_decoding_takes(open_fake, kernel) -> None:
    """The offset of the clocks is that of the arrival."""

    def slow(data: np.ndarray, *, colour: bool) -> np.ndarray:
        kernel.clock.sleep_until(kernel.clock.now_ns + 25 * MS)
        return np.zeros((480, 640), np.uint8)

    def jpeg(*_: object) -> np.ndarray:
        return np.frombuffer(b"\xff\xd8" + bytes(500) + b"\xff\xd9", np.uint8)

    camera = FakeCamera(
        formats={"MJPG": {(640, 480): (10.0,)}}, picture=jpeg, stamps="soe", stamp_offset_ns=REALTIME_NS
    )
    source = open_fake(camera, exposure_s=0.004, decoder=slow)
    for _ in range(5):
        frame = source.read(1.0)
        truth = camera.truth[frame.sequence]
        assert abs(frame.t_exposure_mid_ns - truth.t_mid_ns) <= 1_000
        assert frame.stamp_rule == "soe(realtime)+exposure/2"
