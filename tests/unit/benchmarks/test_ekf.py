"""The comparator has to be a fair one: started close to the truth a plain EKF reaches the bound."""

import numpy as np
import pytest
from vical_mocks.cramer_rao.bound import bounds
from vical_mocks.cramer_rao.information import BoundOptions
from vical_mocks.harness.feed import StartErrors, camera_prior, feed, imu_noise
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig
from vical_mocks.rotations import exp_so3, log_so3

from benchmarks.ekf import (
    BA,
    BG,
    LEVER,
    MOUNT,
    SHIFT,
    SIZE,
    THETA,
    EkfSubject,
    G,
    Nominal,
    P,
    PlainEkf,
    V,
)
from vical_daemon.estimation.measurements import CalibrationOptions


def started_at_the_truth(run, t_s, rng):
    rig, path = run.rig, run.rig.trajectory
    s = np.zeros(SIZE)
    s[THETA], s[P], s[V], s[BG], s[BA], s[G] = 0.02, 0.01, 0.05, 2e-3, 0.02, 0.05
    s[LEVER], s[MOUNT], s[SHIFT] = 0.01, 0.01, 1e-3
    e = s * rng.standard_normal(SIZE)
    start = Nominal(
        t_s,
        path.R_world_imu(t_s) @ exp_so3(e[THETA]),
        path.p_world_imu(t_s) + e[P],
        path.v_world_imu(t_s) + e[V],
        rig.gyro_bias.value(t_s) + e[BG],
        rig.accel_bias.value(t_s) + e[BA],
        rig.gravity_world_mps2 + e[G],
        rig.R_imu_cam @ exp_so3(e[MOUNT]),
        rig.p_imu_cam + e[LEVER],
        rig.timeshift_cam_imu_s + float(e[SHIFT][0]),
        rig.lens,
    )
    return PlainEkf(start, s, imu_noise(run), 0.5, estimate_lens=False)


def test_a_plain_ekf_reaches_the_bound_from_close_by():
    run = simulate(5, 5.0, rig=reference_rig(5, timeshift_cam_imu_s=0.01), camera_rate_hz=10.0)
    t_imu_s = (run.t_imu_ns - run.options.epoch_ns) * 1e-9
    rows = np.column_stack([t_imu_s, run.gyro_rps, run.specific_force_mps2])
    first, *rest = [f for f in run.frames if f.t_s <= run.duration_s]
    ekf = started_at_the_truth(run, first.t_s, np.random.default_rng(1))
    for frame in rest:
        t_s = (frame.t_cam_ns - run.options.epoch_ns) * 1e-9 + ekf.x.timeshift_s
        inner = rows[(rows[:, 0] > ekf.x.t_s) & (rows[:, 0] < t_s)]
        ends = np.array([[np.interp(t, t_imu_s, column) for column in rows.T] for t in (ekf.x.t_s, t_s)])
        ekf.propagate(np.vstack([ends[:1], inner, ends[1:]]))
        ekf.update(frame.uv_px, run.points_m[frame.ids])
    sigma = np.sqrt(np.diag(ekf.covariance))
    error = np.concatenate(
        [
            ekf.x.p_imu_cam - run.rig.p_imu_cam,
            log_so3(run.rig.R_imu_cam.T @ ekf.x.R_imu_cam),
            [ekf.x.timeshift_s - run.rig.timeshift_cam_imu_s],
        ]
    )
    claimed = np.concatenate([sigma[LEVER], sigma[MOUNT], sigma[SHIFT]])
    assert np.all(np.abs(error) < 4 * claimed)
    limit = bounds(run, BoundOptions(intrinsics=False, distortion=False, gravity="free"))[0]
    least = np.concatenate([limit.sigma(name) for name in ("p_imu_cam", "r_imu_cam", "timeshift")])
    # Its prior helps a little in so short a time, hence slightly below 1 is right.
    assert np.all(claimed / least > 0.7)
    assert np.all(claimed / least < 1.15)


@pytest.mark.parametrize("known", [True, False])
def test_the_comparator_begins_where_the_product_does(known):
    run = simulate(6, 8.0, rig=reference_rig(6, timeshift_cam_imu_s=-0.02))
    fix = frozenset({"intrinsics"}) if known else frozenset()
    options = CalibrationOptions(fix=fix, imu_noise=imu_noise(run))
    prior = camera_prior(run, 6, StartErrors(), exact_lens=known)
    record = feed(run, EkfSubject(options, prior, run.points_m))
    assert record.started_s() < 7.0
    last = record.snapshots[-1]
    sigma = np.sqrt(np.diag(last.covariance))[:7]
    assert np.all(np.abs(last.error[:7]) < 5 * sigma)
    assert sigma[:3].max() < 2e-3
