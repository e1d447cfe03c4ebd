"""`vical camera` on the fake kernel: list, stream, snapshot, controls, and what errors look like."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from vical_drivers.camera import opening
from vical_drivers.camera.v4l2 import camera as v4l2
from vical_mocks.v4l2_camera import FakeCamera, UvcClockModel
from vical_mocks.v4l2_kernel import FakeKernel

from vical_daemon.cli import main

Plug = Callable[..., str]


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeKernel:
    """Every camera that is opened without a kernel finds this one."""
    fake = FakeKernel(tmp_path)
    monkeypatch.setattr(v4l2, "LinuxKernel", lambda: fake)
    monkeypatch.setattr(v4l2, "wait_for_camera", lambda seconds: None)
    monkeypatch.setattr(opening, "LinuxKernel", lambda: fake)
    monkeypatch.setattr(opening, "SCHEMES", ("v4l2",))
    monkeypatch.setattr(opening, "_list_by_library", lambda scheme: [])
    return fake


def test_list(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    kernel.plug(FakeCamera(driver="uvcvideo", uvc=UvcClockModel()))
    assert main(["camera", "list"]) == 0
    assert "video-index0" in capsys.readouterr().out
    assert main(["camera", "list", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["details"]["uri"].startswith("v4l2:/")
    assert found["serial_number"] == "SN0001"


def test_list_of_nothing_says_what_to_try(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["camera", "list"]) == 0
    assert "plugged in" in capsys.readouterr().out


def test_stream_as_json(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    path = kernel.plug(FakeCamera(faults={2: "lost"}))
    words = ["camera", "stream", path, "--frames", "5", "--exposure", "0.004", "--readout", "0.008", "--json"]
    assert main(words) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["sequence"] for line in lines[:-1]] == [0, 1, 3, 4, 5]
    assert lines[2]["dropped_before"] == 1
    assert lines[0]["stamp_rule"] == "eof-readout-exposure/2"
    assert lines[0]["exposure_ns"] == 4_000_000
    summary = lines[-1]["summary"]
    assert (summary["frames"], summary["dropped"]) == (5, 1)
    assert summary["rate_hz"] == pytest.approx(30.0, rel=1e-3)
    assert kernel.open_descriptors == 0


def test_stream_for_people(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    path = kernel.plug(FakeCamera())
    assert main(["camera", "stream", path, "--frames", "2", "--size", "1280x1024", "--rate", "60"]) == 0
    shown = capsys.readouterr()
    assert "1280x1024 mono8" in shown.out and "2 frames, 0 dropped" in shown.out
    assert "pixel_format GREY" in shown.err


def test_stream_waits_for_a_camera_that_was_unplugged(
    kernel: FakeKernel, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = FakeCamera(faults={1: "unplug"})
    path = kernel.plug(camera)

    def plug_again(_: float) -> None:
        camera.faults = {}
        if not (kernel.dev / "video0").exists():
            kernel.plug(camera)

    monkeypatch.setattr(v4l2, "wait_for_camera", plug_again)
    assert main(["camera", "stream", path, "--frames", "3", "--json"]) == 0
    shown = capsys.readouterr()
    assert "went away" in shown.err
    assert json.loads(shown.out.splitlines()[-1])["summary"]["reconnects"] == 1


def test_snapshot(kernel: FakeKernel, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = kernel.plug(FakeCamera())
    picture = tmp_path / "one.png"
    assert main(["camera", "snapshot", path, "-o", str(picture), "--skip", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sequence"] == 2
    assert cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE).shape == (480, 640)
    assert main(["camera", "snapshot", path, "-o", str(tmp_path / "one.gif")]) == 2


def test_controls(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    path = kernel.plug(FakeCamera())
    words = ["camera", "controls", path, "--set", "gain_automatic=0", "--set", "gain=9"]
    assert main([*words, "--json"]) == 0
    values = {c["name"]: c["value"] for c in json.loads(capsys.readouterr().out)}
    assert values["gain"] == 9
    assert main(words) == 0
    assert "1 (Manual Mode), 3 (Aperture Priority Mode)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--size", "big"], 2, "give it like 640x480"),
        (["--set", "gain"], 2, "give it like focus_absolute=0"),
        (["--size", "800x600"], 1, "it offers: GREY (640x480 1280x1024)"),
        (["--exposure", "9"], 1, "out of range"),
    ],
)
def test_mistakes_are_one_line(
    kernel: FakeKernel, capsys: pytest.CaptureFixture[str], words: list[str], code: int, said: str
) -> None:
    path = kernel.plug(FakeCamera())
    assert main(["camera", "stream", path, "--frames", "1", *words]) == code
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert kernel.open_descriptors == 0


def test_permission_and_absence_are_one_line(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    path = kernel.plug(FakeCamera(open_errno=errno.EACCES))
    assert main(["camera", "stream", path]) == 1
    assert "no permission to open it" in capsys.readouterr().err
    assert main(["camera", "stream", "/dev/video77"]) == 1
    assert "no such device" in capsys.readouterr().err
    assert main(["camera", "stream", "firefly"]) == 1
    assert "not a device path" in capsys.readouterr().err


def test_silence_ends_with_a_hint(kernel: FakeKernel, capsys: pytest.CaptureFixture[str]) -> None:
    path = kernel.plug(FakeCamera(faults=dict.fromkeys(range(10_000), "lost")))
    assert main(["camera", "stream", path, "--timeout", "0.01"]) == 1
    assert "triggered from outside" in capsys.readouterr().err


def test_a_folder_with_unix_stamps_shows_ages_that_can_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64), np.uint8))
    lines = [f"{1_403_636_579_763_555_584 + k * 50_000_000},a.png" for k in range(3)]
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    assert main(["camera", "stream", f"folder:{tmp_path}", "--frames", "3", "--json"]) == 0
    frames = [json.loads(line) for line in capsys.readouterr().out.splitlines()][:-1]
    ages_s = [(f["t_arrival_ns"] - f["t_exposure_mid_ns"]) * 1e-9 for f in frames]
    assert all(0 <= age_s < 60 for age_s in ages_s)
