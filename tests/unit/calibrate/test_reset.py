"""`reset`, as the page sends it, makes the estimate role begin anew, and so does another device."""

import contextlib
import threading
import time
from pathlib import Path

import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.bus.messages import (
    CheckState,
    DiagnosticStatus,
    Level,
    VerifyResult,
    decode_calibration,
    encode_diagnostics,
    encode_imu,
    encode_string,
    encode_verification,
)
from vical_daemon.calibrate import role as estimate
from vical_daemon.calibrate.persistence import CalibrationPersistence
from vical_daemon.cli import command
from vical_daemon.cli.errors import CliError
from vical_daemon.config.model import CameraConfig, Config, ImuConfig, StoreConfig
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.estimation.wording import event_text
from vical_daemon.results.store import CalibrationStore
from vical_daemon.service.wall_clock import private_clock


class Run:
    """A running estimate role, and what it publishes."""

    def __init__(self, bus: LocalBus) -> None:
        self.bus, self.counts, self.events = bus, [], []
        self._t_ns = 10**18
        bus.subscribe(topics.CALIBRATION.key("rig0", "cam0"), self._take)

    def _take(self, sample) -> None:
        estimate = decode_calibration(sample.payload).estimate
        self.counts.append(estimate.imu_samples)
        self.events += [event_text(event) for event in estimate.events]

    def feed(self) -> None:
        for _ in range(5):
            self._t_ns += 4_000_000
            noise = 1e-3 * (self._t_ns // 4_000_000 % 7)  # a sensor that repeats itself counts as frozen
            payload = encode_imu(self._t_ns, "imu0", (noise, 0.0, 0.0), (0.0, noise, 9.8))
            self.bus.publish(topics.IMU.key("rig0", "imu0"), payload)

    def until(self, true) -> None:
        end = time.monotonic() + 60
        while not true():
            assert time.monotonic() < end
            self.feed()
            time.sleep(0.02)


@pytest.fixture
def config(tmp_path):
    board = tmp_path / "board.yaml"
    board.write_text(
        "{target_type: checkerboard, targetCols: 8, targetRows: 6, "
        "rowSpacingMeters: 0.05, colSpacingMeters: 0.05}"
    )
    return Config(
        imus={"imu0": ImuConfig(port="none")},
        cameras={"cam0": CameraConfig(uri="none")},
        target=str(board),
        store=StoreConfig(directory=str(tmp_path / "store")),
    )


@pytest.fixture
def running(config, monkeypatch):
    monkeypatch.setattr(CalibrationPersistence.priors, "__defaults__", (0.0,))  # do not wait for devices
    bus, stop = LocalBus(), threading.Event()
    run = Run(bus)
    options = {"clock": private_clock()}
    thread = threading.Thread(target=estimate.run, args=(config, bus, stop), kwargs=options)
    thread.start()
    with contextlib.ExitStack() as stack:
        stack.callback(thread.join, 60)
        stack.callback(stop.set)
        yield run


def test_reset_forgets_everything(running):
    key = topics.COMMAND.key("rig0", "estimate")
    running.until(lambda: running.counts and running.counts[-1] > 100)
    running.bus.publish(key, encode_string("dance"))
    running.bus.publish(key, b"")
    before = running.counts[-1]
    running.until(lambda: running.counts[-1] > before)
    assert min(running.counts[-2:]) >= before  # neither an unknown word nor an empty message resets
    running.bus.publish(key, encode_string("reset"))
    running.until(lambda: running.counts[-1] < before)
    assert running.counts[-1] < before


def test_another_device_begins_anew_and_is_told(running):
    def status(serial: str) -> None:
        payload = encode_diagnostics(1, "imu", [DiagnosticStatus(Level.OK, "imu/imu0", "", serial)])
        running.bus.publish(topics.STATUS.key("rig0", "imu"), payload)

    status("I1")
    running.until(lambda: running.counts and running.counts[-1] > 100)
    before = running.counts[-1]
    status("I2")
    running.until(lambda: running.counts[-1] > before)  # once may be a damaged message
    before = running.counts[-1]
    status("I2")
    status("I2")
    running.until(lambda: running.counts[-1] < before)
    running.until(lambda: running.events)
    text = "imu/imu0 is another device now (serial I2, not I1): the calibration starts over"
    assert running.events == [text]


@pytest.mark.parametrize(
    ("word", "answer"), [("accept", "not accepted: there is no"), ("discard", "not discarded: there is no")]
)
def test_a_command_is_answered_on_the_bus_and_in_the_terminal(running, word, answer):
    running.until(lambda: running.counts and running.counts[-1] > 100)
    sent = []
    asking = threading.Thread(target=lambda: sent.append(command.send(running.bus, "rig0", word, 60.0)))
    asking.start()
    running.until(lambda: sent)
    asking.join()
    assert sent[0].startswith(answer)
    assert running.events == sent


def test_a_command_without_anybody_who_listens_says_so():
    with pytest.raises(CliError, match="no answer from rig0"):
        command.send(LocalBus(), "rig0", "accept", 0.05)
    with pytest.raises(CliError, match="no answer from rig0: is the role record running"):
        command.send(LocalBus(), "rig0", "record-stop")


@pytest.mark.parametrize(("level", "problem"), [(Level.OK, ""), (Level.ERROR, "the disk is full")])
def test_a_recording_that_does_not_begin_is_no_success(monkeypatch, level, problem):
    monkeypatch.setattr(command, "_STATUS_S", 0.0)
    bus = LocalBus()
    status = [DiagnosticStatus(level, "record", problem)]
    bus.publish(topics.STATUS.key("rig0", "record"), encode_diagnostics(1, "record", status))
    assert command.send(bus, "rig0", "record-stop") == "sent: record-stop to rig0"
    if problem:
        with pytest.raises(CliError, match="not recording: the disk is full"):
            command.send(bus, "rig0", "record-start")
    else:
        assert command.send(bus, "rig0", "record-start") == "sent: record-start to rig0"


def test_a_command_is_for_the_rig_of_the_config():
    """The bus may be another rig's: of the service, or of a site."""
    bus = LocalBus()
    status = encode_diagnostics(1, "record", [DiagnosticStatus(Level.OK, "record", "")])
    bus.publish(topics.STATUS.key("robot1", "record"), status)
    assert command._rig(bus, "") == command._rig(bus, "robot1") == "robot1"
    with pytest.raises(CliError, match="rig robot2 is not on this bus, only robot1"):
        command._rig(bus, "robot2")


@pytest.mark.parametrize("word", ["check", "calibrate", "verify"])
def test_commands_of_the_other_mode_are_refused_while_calibrating(running, word):
    running.until(lambda: running.bus.latest(topics.STATUS.key("rig0", "estimate")))
    with pytest.raises(CliError, match=f"`{word}` has no effect on rig0: it needs `mode: verify`"):
        command.send(running.bus, "rig0", word)


@pytest.mark.parametrize("word", ["accept", "discard", "reset"])
def test_commands_of_the_other_mode_are_refused_while_verifying(word, monkeypatch):
    monkeypatch.setattr(command, "_BUSY_S", 0.05)  # that nobody answers takes a minute to tell
    bus = LocalBus()
    status = [DiagnosticStatus(Level.OK, "estimate", "verify: resting")]
    bus.publish(topics.STATUS.key("rig0", "estimate"), encode_diagnostics(1, "estimate", status))
    commands = bus.subscribe(topics.COMMAND.key("rig0", "estimate"), depth=8)

    def enter(state: CheckState) -> None:
        payload = encode_verification(VerifyResult(1, "cam0", state))
        bus.publish(topics.VERIFY.key("rig0", "cam0"), payload)

    enter(CheckState.RESTING)
    with pytest.raises(CliError, match=f"`{word}` has no effect on rig0, which verifies"):
        command.send(bus, "rig0", word)
    assert commands.recv(0.0) is None
    enter(CheckState.CALIBRATING)  # the estimator runs, and takes them
    with contextlib.suppress(CliError):  # nobody answers here
        command.send(bus, "rig0", word, 0.05)
    assert commands.recv(0.0) is not None


def test_a_device_that_is_opened_late_gets_what_is_stored_for_it(running, config):
    """The role begins without serial numbers; it starts again from what is stored once they come."""
    covariance = [[1e-8 * (i == j) for j in range(6)] for i in range(6)]
    pose = PoseEstimate([0.08, 0.02, -0.03], [1.0, 0.0, 0.0, 0.0], covariance)
    lens = ([500.0, 500.0, 320.0, 240.0], [1.0] * 4, "radtan", [0.1, 0.0, 0.0, 0.0], [0.01] * 4)
    camera = CameraEstimate(pose, 0.01, 1e-5, *lens, 0.2)
    known = CalibrationEstimate(
        1, Status.CONVERGED, "", 1.0, "", 60.0, 600, 6000, {"cam0": camera}, None, [0.0] * 3, 1.0, 0.0
    )
    CalibrationStore(Path(config.store.directory)).save("I1", "C1", "cam0", known, 1)
    stored = running.bus.subscribe(topics.STORED.key("rig0", "cam0"))
    running.until(lambda: running.counts and running.counts[-1] > 100)
    before = running.counts[-1]
    for role, name, serial in (("imu", "imu/imu0", "I1"), ("camera", "camera/cam0", "C1")):
        payload = encode_diagnostics(1, role, [DiagnosticStatus(Level.OK, name, "", serial)])
        running.bus.publish(topics.STATUS.key("rig0", role), payload)
    running.until(lambda: running.counts[-1] < before)
    sample = stored.recv(1.0)
    assert sample is not None
    assert decode_calibration(sample.payload).estimate.cameras["cam0"].T_imu_cam.p_m == [0.08, 0.02, -0.03]
