"""`mode: verify`: checks of a stored calibration on a live stream, against a true and a wrong one."""

from __future__ import annotations

import re
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.harness import bus_rig
from vical_mocks.harness.feed import events_in_order
from vical_mocks.points import SimulatedFrame, simulate

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import (
    CheckState,
    DiagnosticStatus,
    Level,
    decode_calibration,
    decode_diagnostics,
    decode_verification,
    encode_diagnostics,
    encode_imu,
    encode_points,
    encode_string,
)
from vical_daemon.calibrate import role
from vical_daemon.calibrate.in_use import InUse
from vical_daemon.calibrate.motion import Motion
from vical_daemon.calibrate.verification import Verification
from vical_daemon.config.model import StoreConfig, VerifyConfig
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import known_cameras
from vical_daemon.results.store import CalibrationStore
from vical_daemon.results.verifier import Answer
from vical_daemon.service.wall_clock import private_clock
from vical_daemon.web.state import WebState

T0_NS = 1_800_000_000 * 10**9
SIGMA = np.array([2e-4] * 3 + [2e-4] * 3 + [5e-5] + [0.2] * 4 + [1e-3] * 4)
RNG_SEED = 5


@pytest.fixture(scope="module")
def run():
    return simulate(RNG_SEED, 50.0, camera_rate_hz=10.0)


def estimate(run, turned_deg=0.0):
    """A stored calibration of the simulated rig, true but for a rotation about the camera's y axis."""
    rig = run.rig
    off = Rotation.from_rotvec([0.0, np.deg2rad(turned_deg), 0.0])
    R = Rotation.from_matrix(rig.R_imu_cam) * off
    covariance = np.diag(SIGMA**2)
    camera = CameraEstimate(
        PoseEstimate(
            rig.p_imu_cam.tolist(),
            np.roll(R.as_quat(canonical=True), 1).tolist(),
            covariance[:6, :6].tolist(),
        ),
        rig.timeshift_cam_imu_s,
        float(SIGMA[6]),
        list(rig.lens.intrinsics),
        SIGMA[7:11].tolist(),
        "radtan",
        list(rig.lens.distortion),
        SIGMA[11:].tolist(),
        0.3,
        resolution=list(rig.lens.resolution),
        calibration_covariance=covariance.tolist(),
    )
    return CalibrationEstimate(
        T0_NS, Status.CONVERGED, "", 1.0, "", 30.0, 600, 3000, {"cam0": camera}, None, [0, 0, -9.8], 1.0, 0.0
    )


def checks(run, folder, turned_deg=0.0):
    stored = estimate(run, turned_deg)
    known = known_cameras(rig_from_estimate(stored), "store")
    config = replace(bus_rig.load_config(folder), mode="verify")
    return Verification(config, InUse("store", known, {}, stored))


def stream(run, begin_ns=T0_NS, late_s=0.0):
    """What IMU and detector send: stamp, key, payload; images are stamped `late_s` late on average."""
    shift_ns, rng = begin_ns - run.options.epoch_ns, np.random.default_rng(begin_ns // 10**9)
    for _, event in events_in_order(run):
        if isinstance(event, SimulatedFrame):
            t_ns = event.t_cam_ns + shift_ns + round(min(rng.exponential(late_s), 0.03) * 1e9)
            payload = encode_points(t_ns, "cam0", event.ids, event.uv_px, None, run.rig.lens.resolution)
            yield t_ns, topics.POINTS.key("rig0", "cam0"), payload
        else:
            t_ns = int(run.t_imu_ns[event]) + shift_ns
            force = tuple(run.specific_force_mps2[event])
            yield (
                t_ns,
                topics.IMU.key("rig0", "imu0"),
                encode_imu(t_ns, "imu0", tuple(run.gyro_rps[event]), force),
            )


def play(verification, run, seconds, *, begin_ns=T0_NS, late_s=0.0):
    """Feed messages until a check ends; True if one did."""
    for stamp_ns, key, payload in stream(run, begin_ns, late_s):
        if stamp_ns > begin_ns + seconds * 1e9:
            break
        verification.take(Sample(key, payload, 0))
        if verification.step():
            return True
    return False


def test_a_true_calibration_holds_and_each_check_has_data_of_its_own(run, tmp_path):
    verification = checks(run, tmp_path)
    first = verification.role.estimator
    assert verification.verdict is Answer.CANNOT_TELL and verification.probability("cam0") is None
    assert play(verification, run, 20.0)
    assert verification.verdict is Answer.HOLDS and verification.checks == 1
    assert T0_NS + 3e9 < verification.answered_ns < T0_NS + 20e9
    (event,) = verification.events()
    assert event.kind is EventKind.STORED_HOLDS and event.value == verification.answers["cam0"].seconds
    # the next check knows nothing of these data
    assert verification.role.estimator is not first and verification.used_s == 0.0
    assert verification.role.estimator.estimate().frames == 0
    assert play(verification, run, 20.0, begin_ns=T0_NS + 3600 * 10**9)
    assert verification.checks == 2 and not verification.events()  # what is known is not announced again


def test_a_wrong_calibration_needs_two_checks_and_is_named_with_its_size(run, tmp_path):
    verification = checks(run, tmp_path, turned_deg=0.5)
    assert play(verification, run, 20.0)
    assert verification.suspected and verification.verdict is Answer.CANNOT_TELL
    assert not verification.events() and verification.checks == 0
    assert play(verification, run, 20.0, begin_ns=T0_NS + 60 * 10**9)
    assert verification.verdict is Answer.CHANGED and not verification.suspected
    (change,) = verification.answers["cam0"].changes
    assert change.block == "rotation"
    assert change.value == pytest.approx(np.deg2rad(0.5), abs=max(4.0 * change.sigma, 1e-4))
    assert abs(change.axis[1]) > 0.95
    (event,) = verification.events()
    assert event.kind is EventKind.CAMERA_TURNED and event.camera == "cam0" and event.changed
    assert play(verification, run, 20.0, begin_ns=T0_NS + 120 * 10**9)
    assert verification.verdict is Answer.CHANGED and not verification.events()  # announced once


def test_images_stamped_on_arrival_are_no_change_of_the_time_shift(run, tmp_path):
    """Stored by a recording, whose stamps were corrected: 4 ms of delay are not in its time shift."""
    verification, events = checks(run, tmp_path), []
    for k in range(8):
        play(verification, run, 20.0, begin_ns=T0_NS + 60 * k * 10**9, late_s=4e-3)
        verification.end_stretch()
        events += verification.events()
        if verification.checks:
            break
    assert verification.verdict is Answer.HOLDS
    assert [e.kind for e in events] == [EventKind.STAMPED_ON_ARRIVAL, EventKind.STORED_HOLDS]


def test_a_check_goes_on_after_a_pause(run, tmp_path):
    """Stretches that are too short for an answer add up; the pause in between is no gap in the data."""
    verification = checks(run, tmp_path)
    assert not play(verification, run, 4.0) and verification.role.estimator.can_go_on
    verification.end_stretch()
    estimator, used_s = verification.role.estimator, verification.used_s
    assert not play(verification, run, 0.5, begin_ns=T0_NS + 600 * 10**9)
    assert verification.role.estimator is estimator and verification.used_s >= used_s
    assert play(verification, run, 20.0, begin_ns=T0_NS + 1200 * 10**9)
    assert verification.verdict is Answer.HOLDS


def test_a_stretch_too_short_for_a_start_is_forgotten(run, tmp_path):
    verification = checks(run, tmp_path)
    verification.end_stretch()  # before any data
    assert not play(verification, run, 2.0)
    verification.end_stretch()
    assert verification.used_s == 0.0 and verification.role.estimator.estimate().frames == 0


def test_still_is_known_from_moving(rng):
    motion = Motion(100.0)
    noise = 0.005 * rng.standard_normal((300, 3))

    def feed(rates, now_s):
        for k, rate in enumerate(rates):
            payload = encode_imu(T0_NS + k * 10**7, "imu0", tuple(rate), (0.0, 0.0, 9.8))
            motion.take(Sample("imu", payload, k), now_s)

    feed(noise + np.array([0.0, 0.0, 0.5]), 1.0)  # at a constant rate nothing shows a delay either
    assert motion.looked and motion.moved_s == -np.inf
    feed(noise + 0.2 * np.sin(np.linspace(0.0, 20.0, 300))[:, None], 2.0)
    assert motion.moved_s == 2.0


class Live:
    """A running role with `mode: verify` on a bus of this process; the test is the IMU and the detector."""

    def __init__(self, config, run=None, turned_deg=0.0, **verify) -> None:
        config = replace(config, mode="verify", verify=VerifyConfig(cpu_percent=100.0, **verify))
        folder = config.path.parent / "store"
        self.config = replace(config, store=StoreConfig(str(folder)))
        if run is not None:
            CalibrationStore(folder).save("I1", "C1", "cam0", estimate(run, turned_deg), T0_NS)
        self.bus, self.stop = LocalBus(), threading.Event()
        self.results, self.events, self.statuses, self.wanted = [], [], {}, []
        self.heard_s: list[float] = []
        self.bus.subscribe(topics.VERIFY.key("rig0", "cam0"), self._verified)
        self.bus.subscribe(topics.CALIBRATION.key("rig0", "cam0"), self._calibrated)
        self.bus.subscribe(topics.STATUS.key("rig0", "estimate"), self._status)
        for name, component, serial in (("imu", "imu/imu0", "I1"), ("camera", "camera/cam0", "C1")):
            payload = encode_diagnostics(1, name, [DiagnosticStatus(Level.OK, component, "", serial)])
            self.bus.publish(topics.STATUS.key("rig0", name), payload)
        options = {"clock": private_clock()}
        self.thread = threading.Thread(
            target=role.run, args=(self.config, self.bus, self.stop), kwargs=options
        )
        self.thread.start()

    def _verified(self, sample):
        self.results.append(decode_verification(sample.payload))

    def _calibrated(self, sample):
        self.last = decode_calibration(sample.payload)
        self.events += self.last.estimate.events

    def _status(self, sample):
        self.statuses = {s.name: s for s in decode_diagnostics(sample.payload).statuses}
        self.heard_s.append(time.monotonic())

    def play(self, messages, until, speed=3.0):
        """Send messages at a multiple of their pace until something is true; points only if wanted."""
        begin_s, end_s = time.monotonic(), time.monotonic() + 180.0
        first_ns = None
        for stamp_ns, key, payload in messages:
            first_ns = stamp_ns if first_ns is None else first_ns
            if until():
                return
            while time.monotonic() - begin_s < (stamp_ns - first_ns) * 1e-9 / speed:
                time.sleep(1e-3)
            assert time.monotonic() < end_s
            wanted = bool(self.results) and self.results[-1].image_rate_hz > 0
            self.wanted.append(wanted)
            if "/imu/" in key or ("/points" in key and wanted):
                self.bus.publish(key, payload)
        while not until():  # a busy machine is behind
            assert time.monotonic() < end_s, self.results[-1:]
            time.sleep(0.02)

    def close(self):
        self.stop.set()
        self.thread.join(60)


@pytest.fixture
def live(tmp_path):
    started = []

    def start(*args, **more):
        started.append(Live(bus_rig.load_config(tmp_path), *args, **more))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture(scope="module")
def messages(run):
    """What IMU and detector send, made once."""
    return list(stream(run))


def test_the_role_publishes_answer_status_event_and_the_calibration_in_use(run, live, messages):
    role_run = live(run)
    role_run.play(messages, lambda: role_run.results and role_run.results[-1].verdict == "holds")
    result = role_run.results[-1]
    assert result.against == "store" and result.checks == 1 and "store holds" in result.text
    assert {r.state for r in role_run.results} == {CheckState.CHECKING, CheckState.RESTING}
    assert result.state is CheckState.RESTING and result.image_rate_hz == 0.0
    assert max(r.image_rate_hz for r in role_run.results) == 10.0  # not the 30 of calibrating
    role_run.play(messages, lambda: "holds" in getattr(role_run.statuses.get("verify/cam0"), "message", ""))
    assert role_run.statuses["verify/cam0"].level is Level.OK
    role_run.play(messages, lambda: role_run.events)  # sent after the answer
    assert [e.kind for e in role_run.events] == [EventKind.STORED_HOLDS]
    in_use = role_run.last.camera_estimate
    np.testing.assert_allclose(in_use.T_imu_cam.p_m, run.rig.p_imu_cam, atol=1e-12)


def test_a_check_that_takes_long_at_one_step_is_not_taken_for_dead(run, live, messages, monkeypatch):
    """A start on a small or busy computer: "estimate has been silent for 6 s" in the journal, not fed."""
    steps: list[float] = []

    def slow(_self) -> bool:
        steps.append(time.monotonic())
        time.sleep(3.5)
        return False

    monkeypatch.setattr(Verification, "step", slow)
    role_run = live(run)
    role_run.play(messages, lambda: len(steps) > 1)
    assert sum(steps[0] < heard_s < steps[0] + 3.5 for heard_s in role_run.heard_s) >= 2


def test_without_a_stored_calibration_it_says_what_to_do_and_calibrates_on_command(live, messages):
    role_run = live()
    role_run.play(messages, lambda: "verify/cam0" in role_run.statuses)
    status = role_run.statuses["verify/cam0"]
    assert status.level is Level.WARN and "vical command calibrate" in status.message
    assert not any(role_run.wanted)
    role_run.bus.publish(topics.COMMAND.key("rig0", "estimate"), encode_string("calibrate"))
    role_run.play(messages, lambda: role_run.results[-1].state is CheckState.CALIBRATING)


def test_a_rig_at_rest_asks_for_no_images(run, live, rng):
    role_run = live(run)
    rates = 0.005 * rng.standard_normal((600, 3))
    still = [
        (
            T0_NS + k * 10**7,
            topics.IMU.key("rig0", "imu0"),
            encode_imu(T0_NS + k * 10**7, "imu0", r, (0, 0, 9.8)),
        )
        for k, r in enumerate(map(tuple, rates.tolist()))
    ]
    role_run.play(still, lambda: len(role_run.wanted) > 590 and role_run.results)
    assert not any(role_run.wanted) and role_run.results[-1].state is CheckState.RESTING


def test_a_silent_device_is_named_wherever_people_look_and_the_answer_stays(run, live):
    """It said that the store holds, or that the motion is not enough, with the camera unplugged."""
    role_run = live(run)

    def say(level, message, age_s):
        values = {"data_age_s": str(age_s)}
        payload = encode_diagnostics(
            1, "camera", [DiagnosticStatus(level, "camera/cam0", message, "C1", values)]
        )
        role_run.bus.publish(topics.STATUS.key("rig0", "camera"), payload)

    role_run.play([], lambda: role_run.results)  # it listens by now
    say(Level.ERROR, "/dev/video0 does not exist", 12.0)
    why, page, imu = "/dev/video0 does not exist", WebState("rig0"), topics.IMU.key("rig0", "imu0")
    for topic, name in ((topics.STATUS, "estimate"), (topics.CALIBRATION, "cam0"), (topics.VERIFY, "cam0")):
        role_run.bus.subscribe(topic.key("rig0", name), page.take)
    readings = [x for x in stream(run) if x[1] == imu][:1500]  # the rig moves; no image comes
    role_run.play(
        readings, lambda: role_run.statuses and why in role_run.statuses["verify/cam0"].message, speed=1.0
    )
    result, told = role_run.results[-1], role_run.last.estimate
    assert re.fullmatch(rf"nothing from cam0 for 1\d s: {why}; cannot tell yet .*", result.text)
    assert not result.missing_motion
    assert {role_run.statuses[name].level for name in ("estimate", "verify/cam0")} == {Level.WARN}
    assert role_run.statuses["estimate"].values["silent"] == "camera/cam0"
    assert told.status is Status.CONVERGED and why in told.reason
    page.tick()
    shown = page.full()["cameras"]["cam0"]
    assert "cam0" in shown["fault"]["headline"] and why in shown["fault"]["message"]
    say(Level.OK, "30.0 Hz, 0 lost", 0.01)
    role_run.play(readings, lambda: role_run.statuses["estimate"].level is Level.OK, speed=1.0)
    assert "nothing from" not in role_run.results[-1].text


def test_a_file_that_cannot_be_used_is_named(live, messages):
    role_run = live(against="nowhere.yaml")
    role_run.play(messages, lambda: "verify/cam0" in role_run.statuses)
    assert "verify.against" in role_run.statuses["verify/cam0"].message
    assert "no such file" in role_run.statuses["verify/cam0"].message
