"""Whatever travels on its keys, the estimate role goes on: it refuses, counts, and restarts its estimator."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import Level
from vical_daemon.calibrate import role as estimate
from vical_daemon.calibrate.worker import STUCK_S, EstimateRole
from vical_daemon.config.model import Config, loads
from vical_daemon.estimation.measurements import PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.service import notify
from vical_daemon.service.liveness import Liveness
from vical_daemon.service.wall_clock import private_clock

MS = 1_000_000
NOW = 1_800_000_000_000_000_000
IMU, POINTS = topics.IMU.key("rover", "imu0"), topics.POINTS.key("rover", "cam0")
EXTREMES = (1e5, -1e9, 1e300, -1e300, 1e307)


@pytest.fixture
def config() -> Config:
    return loads(
        "rig: rover\nimus: {imu0: {port: /dev/x}}\n"
        "cameras: {cam0: {uri: 'v4l2:/dev/video0', size: [64, 48]}}\ntarget: t.yaml\n"
    )


class Recorded:
    """An estimator that takes everything, and fails or waits on request."""

    def __init__(self) -> None:
        self.frames = self.imu_samples = 0
        self.sigma_s: float | None = None
        self.waiting = 0
        self.left_out = {"imu_clipped": 3, "imu_spikes": 1}
        self.hangs = self.fails = False

    def stamps_known_to(self, sigma_s: float) -> None:
        self.sigma_s = sigma_s

    def do_without(self, cameras: frozenset[str]) -> None:
        self.without = cameras

    def add_imu(self, t_imu_ns: int, gyro_rps: Any, specific_force_mps2: Any) -> None:
        if self.fails:
            raise np.linalg.LinAlgError("SVD did not converge")
        self.imu_samples += 1

    def add_points(self, frame: PointsFrame) -> None:
        self.frames += 1
        self.waiting += self.hangs

    def process(self) -> list[Any]:
        return []

    finish = process

    def estimate(self) -> CalibrationEstimate:
        return CalibrationEstimate(
            1, Status.WAITING, "", 0.0, "", 0.0, self.frames, self.imu_samples, {}, None, [], 0.0, 0.0
        )


def imu(t_ns: int, gyro: Any = (0.0, 0.0, 0.1), force: Any = (0.0, 0.0, 9.8)) -> Sample:
    return Sample(IMU, m.encode_imu(t_ns, "imu0", gyro, force), 0)


def points(t_ns: int, ids: Any = range(4), uv: Any = None, **more: Any) -> Sample:
    ids = np.array(list(ids), np.int64)
    uv = np.arange(2.0 * len(ids)).reshape(-1, 2) if uv is None else np.asarray(uv, np.float64)
    return Sample(POINTS, m.encode_points(t_ns, "cam0", ids, uv, **more), 0)


def implausible() -> list[Sample]:
    """Well-formed messages that no device sends."""
    corner = np.ones((4, 2))
    found = []
    for value in EXTREMES:
        found += [imu(NOW, (0.0, value, 0.0)), imu(NOW, force=(value, 0.0, 0.0))]
        found += [points(NOW, uv=corner * value), points(NOW, sigma_px=np.full(4, abs(value) * 10))]
    found += [points(NOW, sigma_px=np.full(4, 1e-300)), points(NOW, [-1, 0, 1, 2]), points(NOW, [1, 1, 2, 3])]
    found += [points(NOW, image_size=(4_000_000_000, 10)), points(NOW, image_size=(10, 0))]
    found += [points(NOW, uv=corner * 100, image_size=(20, 20))]
    status = m.DiagnosticStatus(Level.OK, "imu/imu0", values={"stamp_sigma_us": "1e300"})
    for text in ("nan", "-5", "1e300", "many"):
        status = m.DiagnosticStatus(Level.OK, "imu/imu0", values={"stamp_sigma_us": text})
        found.append(Sample(topics.STATUS.key("rover", "imu"), m.encode_diagnostics(0, "imu", [status]), 0))
    return found


class TestEstimate:
    def test_what_no_device_measures_is_refused_and_counted(self, config: Config) -> None:
        estimator = Recorded()
        role = EstimateRole(config, estimator)
        bad = implausible()
        for k in range(len(bad) + 200):
            role.take(imu(NOW + k * 5 * MS))
            role.take(points(NOW + k * 5 * MS))
            if k < len(bad):
                role.take(bad[k])
        role.finish()
        values = role.statuses()[0].values
        assert values["implausible"] == str(len(bad)) and values["malformed"] == "0"
        assert estimator.imu_samples == estimator.frames == len(bad) + 200 and estimator.sigma_s is None

    @pytest.mark.parametrize("stamp", [0, -(10**9), 2**31 * 10**9 - 1, NOW + 3700 * 10**9])
    def test_a_stamp_of_nonsense_does_not_stop_the_frame_count(self, config: Config, stamp: int) -> None:
        estimator = Recorded()
        role = EstimateRole(config, estimator)
        for k in range(100):
            if k % 25 == 0:
                role.take(imu(stamp))
                role.take(points(stamp))
            role.take(imu(NOW + k * 10 * MS))
            role.take(points(NOW + k * 10 * MS))
            role.step()
        role.finish()
        assert estimator.frames == estimator.imu_samples == 100
        values = role.statuses()[0].values
        assert values["stamps_refused"] == "8"
        assert (values["imu_clipped"], values["imu_spikes"]) == ("3", "1")

    def test_progress_counts_what_is_used_or_refused(self, config: Config) -> None:
        estimator = Recorded()
        role = EstimateRole(config, estimator)
        for k in range(100):
            role.take(imu(NOW + k * 10 * MS))
            role.take(points(NOW + k * 10 * MS))
            role.take(Sample(POINTS, b"junk", 0))
        role.step()
        lag_images = round(config.calibration.lag_s / 0.01)
        assert role.images == 200 and role.settled == 200 - lag_images
        estimator.waiting = 50
        assert role.settled == 150 - lag_images
        assert role.statuses(0, STUCK_S + 1)[0].level is Level.STALE
        assert role.statuses(0, STUCK_S - 1)[0].level is not Level.STALE


class Service:
    """The role estimate, running, with estimators that the test can spoil."""

    def __init__(self, config: Config, patch: pytest.MonkeyPatch) -> None:
        self.made: list[Recorded] = []
        self.events: list[tuple[str, str]] = []
        self.bus, self.stop, self.k = LocalBus(), threading.Event(), 0
        self.key = topics.STATUS.key("rover", "estimate")
        self.live = Liveness(["estimate"], 0.0)
        self.bus.subscribe(self.key, lambda sample: self.live.take(sample, 0.0))

        def make(*_: Any) -> Recorded:
            self.made.append(Recorded())
            return self.made[-1]

        patch.setattr(estimate, "make_estimator", make)
        patch.setattr(notify, "event", lambda name, text, **_: self.events.append((name, text)))
        self.thread = threading.Thread(
            target=estimate.run, args=(config, self.bus, self.stop), kwargs={"clock": private_clock()}
        )
        self.thread.start()

    def until(self, condition: Any) -> None:
        """Send good data until something is so."""
        end_s = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end_s and self.thread.is_alive(), self.status()
            for _ in range(4):
                self.k += 1
                self.bus.publish(IMU, imu(NOW + self.k * 5 * MS).payload)
            self.bus.publish(POINTS, points(NOW + self.k * 5 * MS).payload)
            time.sleep(0.01)

    def status(self) -> Any:
        last = self.bus.latest(self.key)
        return m.decode_diagnostics(last[0].payload).statuses[0] if last else None

    def close(self) -> None:
        self.stop.set()
        self.thread.join(30)
        assert not self.thread.is_alive()


@pytest.fixture
def service(config: Config, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Any:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    service = Service(config, monkeypatch)
    yield service
    service.close()


class TestSupervisor:
    def test_an_estimator_that_raises_is_started_again_and_the_journal_says_so(
        self, service: Service
    ) -> None:
        service.until(lambda: service.made and service.made[0].frames > 10)
        service.made[0].fails = True
        service.until(lambda: len(service.made) > 1 and service.made[1].frames > 10)
        service.until(lambda: service.status().values["estimator_restarts"] == "1")
        ((_, text),) = [event for event in service.events if event[0] == "estimator_restarted"]
        assert "LinAlgError: SVD did not converge" in text and len(text.splitlines()) == 1
        assert service.live.problem(0.0) == ""

    def test_one_that_fails_each_time_is_tried_later_and_later(self, service: Service) -> None:
        service.until(lambda: service.made and service.made[0].frames > 10)
        for k in range(4):
            service.made[k].fails = True
            service.until(lambda k=k: len(service.made) == k + 2)
        service.until(lambda: "failed 4 times, starts again in" in service.status().message)
        assert service.status().level is Level.ERROR and len(service.made) == 5

    def test_one_that_gets_nowhere_is_not_called_alive(
        self, service: Service, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from vical_daemon.calibrate import worker as estimate_role

        service.until(lambda: service.made and service.made[0].frames > 10)
        monkeypatch.setattr(estimate_role, "STUCK_S", 0.2)
        monkeypatch.setattr(estimate, "STUCK_S", 2.0)
        service.made[0].hangs = True
        service.until(lambda: (status := service.status()) and status.level is Level.STALE)
        assert "none used or refused" in service.live.problem(0.0)
        service.until(lambda: len(service.made) > 1 and service.made[1].frames > 10)
        service.until(lambda: service.live.problem(0.0) == "")
