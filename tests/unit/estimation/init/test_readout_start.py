"""readout_start.py: how long rows take, from how they bend a board in motion; nothing else bends it so."""

from dataclasses import replace

import numpy as np
import pytest
from vical_mocks.points import board_points, crooked_board, simulate
from vical_mocks.rig import reference_rig

from vical_daemon.estimation.init.camera_start import starting_camera
from vical_daemon.estimation.init.readout_start import lens_fit, likely_axis, looks_rolling, readout
from vical_daemon.estimation.measurements import CameraPrior, PointsFrame

BOARD = board_points()


def seen(seed, readout_s, seconds=4.0, axis="rows", **options):
    rig = replace(reference_rig(seed, timeshift_cam_imu_s=0.01), readout_s=readout_s, readout_axis=axis)
    run = simulate(seed, seconds, rig=rig, **options)
    frames = [(f.t_s, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames]
    return frames, starting_camera(CameraPrior((640, 480), (530.0, 530.0, 322.0, 236.0)))


def rolls(frames, lens):
    fit = lens_fit(frames, lens, BOARD)
    return fit is not None and looks_rolling(frames, lens, BOARD, fit)


@pytest.mark.parametrize("readout_s", [-0.03, 0.008, 0.033])
@pytest.mark.parametrize(("seed", "axis"), [(1, "rows"), (2, "rows"), (2, "columns")])
def test_a_rolling_shutter_is_seen_either_way_up(seed, axis, readout_s):
    frames, lens = seen(seed, readout_s, axis=axis)
    assert rolls(frames, lens) == axis
    assert likely_axis(frames, lens, BOARD) == axis
    lens.readout_axis = axis
    assert readout(frames, lens, BOARD, 0.0) == pytest.approx(readout_s, abs=1e-3 + 0.1 * abs(readout_s))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"points_m": crooked_board(3)},
        {"corner_sigma_px": 0.1, "stamp_jitter_s": 1e-3},
        {"frame_sigma_px": 0.3},
        {"outlier_fraction": 0.05},
        {"outlier_fraction": 0.02, "camera_rate_hz": 5.0, "corner_sigma_px": 0.15},
    ],
)
@pytest.mark.parametrize("seed", [1, 3])
def test_nothing_else_looks_like_it(seed, options):
    frames, lens = seen(seed, 0.0, **options)
    assert not rolls(frames, lens)


def test_a_rig_that_stands_still_shows_nothing():
    still = reference_rig(1, mean_rate_dps=0.05)
    run = simulate(1, 4.0, rig=replace(still, readout_s=0.02))
    frames = [(f.t_s, PointsFrame("cam0", f.t_cam_ns, f.ids, f.uv_px)) for f in run.frames]
    lens = starting_camera(CameraPrior((640, 480), (530.0, 530.0, 322.0, 236.0)))
    assert not rolls(frames, lens)
    assert readout(frames, lens, BOARD, 0.011) == 0.011


def test_a_readout_of_four_milliseconds_is_found_to_half_of_one():
    frames, lens = seen(1, 0.004)
    assert readout(frames, lens, BOARD, 0.0) == pytest.approx(0.004, abs=5e-4)


def test_images_too_far_apart_show_nothing():
    frames, lens = seen(1, 0.02)
    slow = [(3.0 * t_s, frame) for t_s, frame in frames[::2]]
    assert not rolls(slow, lens)
    assert readout(slow, lens, BOARD, 0.0) == 0.0


def test_views_that_show_no_pose_are_left_out():
    frames, lens = seen(1, 0.02)
    nowhere = np.full_like(frames[20][1].uv_px, 7.0)
    for k in (20, 30, 40):  # chosen for sure: nothing else lies there
        f = frames[k][1]
        frames[k] = (frames[k][0], PointsFrame(f.camera, f.t_cam_ns, f.ids, nowhere[: len(f.ids)]))
    assert rolls(frames, lens)


def test_too_few_images_show_nothing():
    frames, lens = seen(1, 0.02)
    assert not rolls(frames[:6], lens)
    assert not rolls([], lens)
