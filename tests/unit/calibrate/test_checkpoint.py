"""A restarted process goes on with its estimator, and takes nothing else out of the file."""

from __future__ import annotations

import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.points import SimulatedRun, simulate

from vical_daemon.calibrate import checkpoint
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.checkpoint import OLDEST_S, Checkpoint, file_name
from vical_daemon.config.model import Config, loads
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.result import Status
from vical_daemon.service.wall_clock import private_clock

DEVICES = {"imu/imu0": "I1", "camera/cam0": "C1"}
CLOCK = private_clock()
TEXT = "imus: {imu0: {port: /dev/x}}\ncameras: {cam0: {uri: 'v4l2:/dev/video0'}}\ntarget: t.yaml\n"


FILE_NAME = file_name(loads(TEXT))


@pytest.fixture
def config() -> Config:
    return loads(TEXT)


@pytest.fixture(autouse=True)
def proven(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "PROVEN_S", 0.0)


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate(5, 20.0, timeshift_cam_imu_s=-0.035)


def _calibrator(run: SimulatedRun) -> Calibrator:
    lens = run.rig.lens
    prior = CameraPrior((640, 480), tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=ImuNoise())
    return Calibrator(options, {"cam0": prior}, run.points_m)


def _feed(c: Calibrator, run: SimulatedRun, begin_s: float, end_s: float) -> None:
    begin_ns, end_ns = (int(run.t_imu_ns[0]) + int(1e9 * t) for t in (begin_s, end_s))
    frames = iter([f for f in run.frames if begin_ns <= f.t_cam_ns < end_ns])
    frame = next(frames, None)
    for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True):
        if not begin_ns <= t < end_ns:
            continue
        c.add_imu(int(t), w, f)
        while frame is not None and frame.t_cam_ns <= t:
            c.add_points(PointsFrame("cam0", frame.t_cam_ns, frame.ids, frame.uv_px))
            c.process()
            frame = next(frames, None)


@pytest.fixture(scope="module")
def converged(run: SimulatedRun) -> Calibrator:
    c = _calibrator(run)
    _feed(c, run, 0.0, 12.0)
    assert c.estimate().status is Status.CONVERGED
    return c


@pytest.mark.parametrize(
    "other", ["rig: rover\n", "bus: {socket: /run/b.sock}\n", "calibration: {cameras: [b]}\n"]
)
def test_rigs_that_share_a_folder_keep_their_own(
    tmp_path: Path, config: Config, converged: Calibrator, other: str
) -> None:
    """The second rig to start removed what the first had saved, and overwrote it from then on."""
    cameras = TEXT.replace("}}\ntarget", "}, b: {uri: 'v4l2:/dev/video1'}}\ntarget")
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    second = Checkpoint(tmp_path, loads((cameras if "cameras" in other else TEXT) + other), CLOCK)
    assert second.load(DEVICES) is None
    second.save(converged, DEVICES)
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is not None
    assert len(list(tmp_path.iterdir())) == 1  # each is used once


def test_it_goes_on_where_it_was(
    tmp_path: Path, config: Config, converged: Calibrator, run: SimulatedRun
) -> None:
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    found = Checkpoint(tmp_path, config, CLOCK).load(DEVICES)
    assert found is not None and 0.0 <= found[1] < 5.0
    resumed, straight = found[0], pickle.loads(pickle.dumps(converged))
    assert isinstance(resumed, Calibrator)
    for c in (resumed, straight):
        _feed(c, run, 12.0, 15.0)  # without a gap: what was kept is the whole state, to the last bit
    a, b = resumed.estimate(), straight.estimate()
    assert a.status is Status.CONVERGED and a.frames > 0
    assert a.to_json() == b.to_json()


def test_it_is_small(tmp_path: Path, config: Config, converged: Calibrator) -> None:
    """It had 8 MB, nearly all of them copies of the filter of the last seconds."""
    assert len(pickle.dumps(converged)) > 4e6
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    assert (tmp_path / FILE_NAME).stat().st_size < 4e5
    assert len(pickle.dumps(converged)) > 4e6  # the running one has all it needs


def test_no_save_waits_for_the_disk(
    tmp_path: Path, config: Config, converged: Calibrator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: pytest.fail("the estimator waits; it may be for seconds"))
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is not None


def test_stamps_on_arrival_are_kept(tmp_path: Path, config: Config, converged: Calibrator) -> None:
    late_ns = np.random.default_rng(1).exponential(4e6, 120).astype(np.int64)
    known = {"cam0": (10**18 + 50_000_000 * np.arange(120) + late_ns).tolist()}
    stamps = LiveStamps(known)
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES, stamps)
    found = Checkpoint(tmp_path, config, CLOCK).load(DEVICES)
    assert found is not None and found.image_stamps_ns == known
    assert LiveStamps(found.image_stamps_ns).sigma_s == stamps.sigma_s > 0.0


def test_a_state_of_other_code_is_not_taken(
    tmp_path: Path, config: Config, converged: Calibrator, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert any(checkpoint.CODE.rglob("calibrator.py"))  # the code that a state belongs to
    code = tmp_path / "code"
    code.mkdir()
    monkeypatch.setattr(checkpoint, "CODE", code)
    (code / "filter.py").write_text("GAIN = 1\n")
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    (code / "filter.py").write_text("GAIN = 2\n")
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is None


def test_it_is_used_once_and_not_before_it_has_proven_itself(
    tmp_path: Path, config: Config, converged: Calibrator, monkeypatch: pytest.MonkeyPatch
) -> None:
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    monkeypatch.setattr(checkpoint, "PROVEN_S", 3600.0)
    second = Checkpoint(tmp_path, config, CLOCK)
    assert second.load(DEVICES) is not None
    second.save(converged, DEVICES)  # too soon
    assert not (tmp_path / FILE_NAME).exists()
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is None


def test_a_save_may_cost_one_percent(tmp_path: Path, config: Config, converged: Calibrator) -> None:
    kept = Checkpoint(tmp_path, config, CLOCK)
    kept.save(converged, DEVICES)
    before_ns = (tmp_path / FILE_NAME).stat().st_mtime_ns
    kept.save(converged, DEVICES)  # at once again
    assert (tmp_path / FILE_NAME).stat().st_mtime_ns == before_ns


def test_other_devices_configs_and_boots_start_anew(
    tmp_path: Path, config: Config, converged: Calibrator
) -> None:
    other_config = loads(TEXT.replace("t.yaml", "u.yaml"))
    other_clock = replace(CLOCK, offset_ns=CLOCK.offset_ns + 1)
    later = replace(CLOCK)
    for who, rig, clock in (
        (DEVICES | {"camera/cam0": "C2"}, config, CLOCK),
        ({}, config, CLOCK),
        (DEVICES, other_config, CLOCK),
        (DEVICES, config, other_clock),
    ):
        Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
        assert Checkpoint(tmp_path, rig, clock).load(who) is None
    kept = Checkpoint(tmp_path, config, later)
    kept.save(converged, DEVICES)
    kept._clock = replace(CLOCK, offset_ns=CLOCK.offset_ns + int(1e9 * (OLDEST_S + 1.0)))
    assert kept.load(DEVICES) is None


def test_nothing_is_kept_without_a_folder(config: Config, converged: Calibrator) -> None:
    nowhere = Checkpoint(None, config, CLOCK)
    nowhere.save(converged, DEVICES)
    nowhere.forget()
    assert nowhere.load(DEVICES) is None


class _Evil:
    def __init__(self, *parts: object) -> None:
        self.parts = parts

    def __reduce__(self) -> object:
        return self.parts


def _dotted() -> bytes:
    """Reach through a module of ours for what it imports: STACK_GLOBAL follows dots."""
    words = [b"vical_daemon.estimation.filter.calibration_filter", b"np.load", b"x"]
    module, name, argument = (b"\x8c" + bytes([len(word)]) + word for word in words)
    return b"\x80\x04" + module + name + b"\x93" + argument + b"\x85R."


@pytest.mark.parametrize(
    "body",
    [
        pickle.dumps(_Evil(os.system, ("true",))),
        pickle.dumps(_Evil(np.load, ("x",))),
        pickle.dumps(_Evil(eval, ("1",))),
        pickle.dumps(_Evil(getattr, (np.zeros(1), "tofile"))),
        pickle.dumps(_Evil(getattr, (Status.CONVERGED, "__class__"))),
        _dotted(),
        b"junk",
        b"",
    ],
)
def test_a_file_is_never_a_program(
    body: bytes, tmp_path: Path, config: Config, converged: Calibrator, caplog: pytest.LogCaptureFixture
) -> None:
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    path = tmp_path / FILE_NAME
    head = path.read_bytes().split(b"\n", 1)[0]
    path.write_bytes(head + b"\n" + body)
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is None
    assert "is not used" in caplog.records[-1].getMessage()
    assert len(body) < 10 or "no part of" in caplog.text or "no method of" in caplog.text
    assert "\n" not in caplog.records[-1].getMessage() and not path.exists()


def test_what_others_could_have_written_is_not_read(
    tmp_path: Path, config: Config, converged: Calibrator
) -> None:
    path = tmp_path / FILE_NAME
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    path.chmod(0o666)
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is None
    Checkpoint(tmp_path, config, CLOCK).save(converged, DEVICES)
    path.rename(tmp_path / "other")
    path.symlink_to("other")
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is None
    os.mkfifo(tmp_path / "fifo")
    path.unlink(missing_ok=True)
    (tmp_path / "fifo").rename(path)
    assert Checkpoint(tmp_path, config, CLOCK).load(DEVICES) is None


def test_a_state_that_cannot_be_kept_is_one_line(
    tmp_path: Path, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    kept = Checkpoint(tmp_path, config, CLOCK)
    for _ in range(3):
        kept.save(lambda: None, DEVICES)  # type: ignore[arg-type]
    assert len(caplog.records) == 1 and not (tmp_path / FILE_NAME).exists()
