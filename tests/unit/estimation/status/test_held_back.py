"""The held-back check: predictions by the imu alone, and what they say about its noise."""

import pytest
from vical_mocks.points import simulate

from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.events import EventKind
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, ImuNoise, PointsFrame
from vical_daemon.estimation.wording import event_text


def events_with(density_factor):
    """Calibrate 40 s with densities that are wrong by a factor; the events and the last answer."""
    run = simulate(2, 40.0, timeshift_cam_imu_s=0.01)
    lens, true, k = run.rig.lens, run.rig.densities, density_factor
    noise = ImuNoise(k * true.gyro, true.gyro_walk, k * true.accel, true.accel_walk)
    prior = CameraPrior(lens.resolution, tuple(lens.intrinsics), lens.model, tuple(lens.distortion))
    options = CalibrationOptions(fix=frozenset({"intrinsics"}), imu_noise=noise)
    c = Calibrator(options, {"cam0": prior}, run.points_m)
    events, frames = [], iter(run.frames)
    frame = next(frames)
    for t, w, f in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True):
        while frame is not None and frame.t_cam_ns <= t:
            c.add_points(PointsFrame("cam0", frame.t_cam_ns, frame.ids, frame.uv_px))
            c.process()
            frame = next(frames, None)
        c.add_imu(int(t), w, f)
    c.finish()
    estimate = c.estimate()
    return [*events, *estimate.events], estimate


@pytest.mark.parametrize(("factor", "said"), [(0.2, "worse"), (1.0, ""), (6.0, "better")])
def test_wrong_noise_densities_are_told_once(monkeypatch, factor, said):
    """Where the readings do not show their white noise, as behind a filter or in a vibration."""
    monkeypatch.setattr("vical_daemon.estimation.init.initializer.measured_noise", lambda stated, _: stated)
    events, estimate = events_with(factor)
    assert estimate.nis_per_dof > 0.5
    announced = [event_text(e) for e in events if e.kind is EventKind.IMU_NOISE]
    assert len(announced) == (1 if said else 0)
    assert all(said in e and "vical allan" in e for e in announced)


@pytest.mark.parametrize("factor", [0.2, 6.0])
def test_densities_that_the_readings_show_need_not_be_told(factor):
    events, estimate = events_with(factor)
    assert not [e for e in events if e.kind in (EventKind.IMU_NOISE, EventKind.IMU_INTRINSICS)]
    assert estimate.nis_per_dof > 0.5
