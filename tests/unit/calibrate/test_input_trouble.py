"""Devices that deliver nothing new: what the published estimate says of them, and that it recovers."""

from __future__ import annotations

import numpy as np
import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import Sample
from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    decode_calibration,
    decode_diagnostics,
    encode_diagnostics,
    encode_imu,
    encode_points,
)
from vical_daemon.calibrate.input_trouble import InputTrouble
from vical_daemon.calibrate.worker import EstimateRole
from vical_daemon.config.model import loads
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.guidance import Guidance, Verb
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status

CONFIG = (
    "rig: rover\nimus: {imu0: {port: /dev/x, rate_hz: 100}}\ncameras:\n"
    "  cam0: {uri: 'v4l2:/dev/video0', size: [16, 16], rate_hz: 10}\n"
    "  cam1: {uri: 'v4l2:/dev/video1', size: [16, 16], rate_hz: 10}\ntarget: t.yaml\n"
)
POSE = PoseEstimate([0.1, 0.2, 0.3], [1.0, 0.0, 0.0, 0.0], np.eye(6).tolist())
KNOWN = CameraEstimate(POSE, 0.01, 1e-4, [5.0, 5.0, 4.0, 3.0], [0.0] * 4, "radtan", [0.0] * 4, [0.0] * 4, 0.2)
MOVE = Guidance(Verb.TURN, ("x",))


class Rig:
    """The role over the real estimator, whose answer is that cam0 has converged, fed second by second."""

    def __init__(self) -> None:
        prior = CameraPrior((16, 16), (5.0, 5.0, 8.0, 8.0))
        estimator = Calibrator(CalibrationOptions(), dict.fromkeys(("cam0", "cam1"), prior), np.eye(4, 3))
        estimator.estimate = self.estimate  # type: ignore[method-assign]
        self.without: frozenset[str] = frozenset()
        estimator.do_without = self.do_without  # type: ignore[method-assign]
        self.role = EstimateRole(loads(CONFIG), estimator)
        self.now_s, self.rng = 100.0, np.random.default_rng(0)
        self.status = Status.CONVERGED

    def do_without(self, cameras: frozenset[str]) -> None:
        self.without = cameras

    def estimate(self) -> CalibrationEstimate:
        return CalibrationEstimate(
            1, self.status, "", 1.0, "turn", 1.0, 2, 3, {"cam0": KNOWN}, None, [], 1.0, 0.0, [], MOVE
        )

    def say(self, name: str, level: Level, message: str, **values: str) -> None:
        role = name.partition("/")[0]
        payload = encode_diagnostics(0, role, [DiagnosticStatus(level, name, message, values=values)])
        self.role.take(Sample(topics.STATUS.key("rover", role), payload, 0))

    def run(
        self, seconds: float, imu: str = "new", cam0: str = "new", cam1: str = ""
    ) -> dict[str, CalibrationEstimate]:
        """What is published after so long with these devices: `new`, `same` (frozen) or nothing of each."""
        sent = {}
        for _ in range(round(10 * seconds)):
            self.now_s += 0.1
            for k in range(10 if imu else 0):
                gyro = self.rng.normal(size=3) if imu == "new" else np.full(3, 0.1)
                payload = encode_imu(round((self.now_s + 0.01 * k) * 1e9), "imu0", gyro, (0.0, 0.0, 9.8))
                self.role.take(Sample("vical/rover/imu/imu0", payload, 0))
            for name, how in (("cam0", cam0), ("cam1", cam1)):
                if how:
                    uv = self.rng.uniform(0.0, 16.0, (4, 2)) if how == "new" else np.full((4, 2), 8.0)
                    payload = encode_points(round(self.now_s * 1e9), name, np.arange(4), uv)
                    self.role.take(Sample(f"vical/rover/camera/{name}/points", payload, 0))
            sent |= dict(self.role.step(self.now_s))
        names = ("cam0", "cam1")
        return {n: decode_calibration(sent[f"vical/rover/calibration/{n}"]).estimate for n in names}


@pytest.mark.parametrize(
    ("devices", "says"),
    [
        ({"imu": ""}, "nothing from imu0 for 9 s: the port is gone"),
        ({"imu": "same"}, "nothing new from imu0 for 9 s: it delivers the same again and again"),
        ({"cam0": ""}, "nothing from cam0 for 9 s"),
        ({"cam0": "same"}, "nothing new from cam0 for 9 s: it delivers the same again and again"),
    ],
)
def test_a_result_stays_and_says_that_nothing_follows_it(devices: dict[str, str], says: str) -> None:
    rig = Rig()
    live = rig.run(2.0)["cam0"]
    assert (live.status, live.reason, live.guidance) == (Status.CONVERGED, "", "turn")
    if devices == {"imu": ""}:
        rig.say("imu/imu0", Level.ERROR, "the port is gone")
    at_rest = rig.run(9.0, **{"imu": "new", "cam0": "new"} | devices)["cam0"]
    assert at_rest.status is Status.CONVERGED and at_rest.progress == 1.0
    assert at_rest.reason == says
    assert not at_rest.guidance and not at_rest.next_motion  # no motion would be seen
    status = rig.role.statuses()[0]
    device = "imu/imu0" if "imu" in devices else "camera/cam0"
    assert status.level is Level.WARN and says in status.message
    assert device in status.values["silent"].split(", ")
    rig.say("imu/imu0", Level.OK, "100.0 Hz, 0 lost")
    back = rig.run(1.0)["cam0"]
    assert (back.reason, back.guidance, back.next_motion) == ("", "turn", MOVE)
    assert device not in rig.role.statuses()[0].values["silent"]


def test_a_camera_that_is_not_connected_is_named_on_its_own_topic_alone() -> None:
    rig = Rig()
    rig.say("camera/cam1", Level.ERROR, "/dev/video1 does not exist")
    rig.say("camera/cam0", Level.OK, "10.0 Hz, 0 lost")
    sent = rig.run(8.0)
    assert (sent["cam0"].status, sent["cam0"].reason, sent["cam0"].guidance) == (Status.CONVERGED, "", "turn")
    assert (sent["cam1"].status, sent["cam1"].progress) == (Status.WAITING, 0.0)
    assert sent["cam1"].reason == "nothing from cam1 yet, after 8 s: /dev/video1 does not exist"
    assert rig.without == {"cam1"}
    rig.run(0.5, cam1="new")
    assert not rig.without


@pytest.mark.parametrize("status", [Status.WAITING, Status.CONVERGED])
def test_a_target_file_that_is_wrong_is_named_where_people_look(status: Status) -> None:
    """Beside "the target has not been seen yet: show the whole board", nobody looks at the target file."""
    rig, text = Rig(), "AprilTags are in view, the target file states a checkerboard"
    rig.status = status
    rig.say("detect/cam0", Level.ERROR, text, wrong_target=text)
    sent = rig.run(1.0)
    assert (sent["cam0"].status, sent["cam0"].reason, sent["cam0"].guidance) == (status, text, "turn")
    assert sent["cam1"].reason == ""


def test_the_board_that_is_looked_for_is_named_where_none_was_found() -> None:
    rig, board = Rig(), "a checkerboard with 9 x 6 inner corners"
    rig.status = Status.WAITING
    rig.say("detect/cam0", Level.WARN, "0% of 60 images show points", looks_for=board)
    reason = rig.run(1.0)["cam0"].reason
    assert reason.endswith(f"; cam0 looks for {board}, as the target file says")
    rig.say("detect/cam0", Level.OK, "2% of 61 images show points")
    assert "looks for" not in rig.run(1.0)["cam0"].reason


def test_what_waits_in_the_queue_of_a_busy_estimator_is_not_missing() -> None:
    trouble = InputTrouble("imu0", {"cam0": 10.0})
    trouble.look(0.0)
    trouble.imu_came(new=True)
    trouble.image_came("cam0", new=True)
    trouble.look(60.0)  # one step took a minute
    assert not trouble.silent


def test_a_slow_camera_is_silent_after_five_of_its_intervals() -> None:
    trouble = InputTrouble("imu0", {"cam0": 0.5})
    for now_s in range(12):
        trouble.look(float(now_s))
        trouble.imu_came(new=True)
    assert list(trouble.silent) == ["camera/cam0"]
    trouble.image_came("cam0", new=True)
    for now_s in range(12, 21):
        trouble.look(float(now_s))
        trouble.imu_came(new=True)
    assert not trouble.silent


def test_where_data_come_only_now_and_then_drivers_are_asked_and_other_devices_only_heard() -> None:
    """In `mode: verify`: nobody listens between two checks."""
    trouble = InputTrouble("imu0", {"cam0": 10.0, "cam1": 10.0}, always=False)

    def say(name: str, age_s: str) -> None:
        status = DiagnosticStatus(Level.OK, name, "", values={"data_age_s": age_s})
        trouble.take(decode_diagnostics(encode_diagnostics(0, "camera", [status])))

    for now_s in range(9):
        say("camera/cam0", "inf")  # nothing yet
        say("camera/cam1", "0.05")
        trouble.look(float(now_s))
    assert trouble.words() == "nothing from cam0 yet, after 8 s"  # no driver speaks of imu0: not known
    for now_s in range(9, 16):
        trouble.look(float(now_s), ["imu/imu0"])
    assert set(trouble.silent) == {"imu/imu0", "camera/cam0", "camera/cam1"}  # the drivers are gone as well
    trouble.imu_came(new=True)
    say("camera/cam0", "0.05")
    assert list(trouble.silent) == ["camera/cam1"]
