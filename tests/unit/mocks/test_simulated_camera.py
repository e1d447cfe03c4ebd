"""The rendered pictures against first principles: brute force, geometry, and the published tag codes."""

import cv2
import numpy as np
import pytest
from vical_mocks.board_art import draw_board, tag_modules
from vical_mocks.camera import CameraSettings, SimulatedCamera, pixel_rays
from vical_mocks.lens import Lens
from vical_mocks.rig import reference_rig
from vical_mocks.room import RoomCamera
from vical_mocks.texture import FULL_SCALE, BoardTexture

from vical_daemon.vision.target import AprilGrid, Checkerboard

SMALL = Lens((150.0, 152.0, 79.0, 61.0), (-0.2, 0.05, 1e-3, -5e-4), (160, 120))
BOARD = Checkerboard(5, 4, 0.05, 0.05)
QUIET = {"noise_dn": 0.0, "shot_noise": 0.0}


def looking(p_start, velocity=(0, 0, 0), tilt=(0.2, -0.3, 0.1), spin=(0, 0, 0), side=-1):
    R0 = np.eye(3) if side < 0 else np.diag([1.0, -1.0, -1.0])

    def pose(t_s):
        t = np.atleast_1d(np.asarray(t_s, float))
        turn = [cv2.Rodrigues(np.array(tilt) + s * np.array(spin))[0] for s in t]
        return R0 @ np.array(turn), np.array(p_start) + t[:, None] * np.array(velocity)

    return pose


def brute_force(art, lens, pose, t_s, samples=7):
    """Mean over rays of each pixel's square of what the board shows there (no filter, no texture)."""
    R, p = pose(t_s)
    R, p = R[0], p[0]
    width, height = lens.resolution
    part = (np.arange(samples) + 0.5) / samples - 0.5
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    total = np.zeros((height, width))
    for du in part:
        for dv in part:
            d = lens.unproject(np.stack([u + du, v + dv], -1)) @ R.T
            xy = p[:2] - d[..., :2] * (p[2] / d[..., 2])[..., None]
            x0, y0, x1, y1 = art.paper_m
            on = (xy[..., 0] > x0) & (xy[..., 0] < x1) & (xy[..., 1] > y0) & (xy[..., 1] < y1)
            shade = np.where(on, 0.85, 0.35)
            for a, b, c, e in art.black_m:
                black = (xy[..., 0] > a) & (xy[..., 0] < c) & (xy[..., 1] > b) & (xy[..., 1] < e)
                shade[black] = 0.08
            total += shade
    return 255 * total / samples**2


def test_pictures_equal_brute_force_up_to_the_lens_blur():
    pose = looking((0.1, 0.07, -0.35))
    camera = SimulatedCamera(BOARD, SMALL, pose, CameraSettings(**QUIET))
    rendered = camera.render_clean(0.0)
    exact = brute_force(draw_board(BOARD), SMALL, pose, 0.0)
    smooth = cv2.GaussianBlur(exact, (0, 0), 0.5), cv2.GaussianBlur(rendered.astype(float), (0, 0), 0.5)
    assert np.abs(rendered - exact).mean() < 3.0
    assert np.abs(smooth[1] - cv2.GaussianBlur(exact, (0, 0), 0.7)).mean() < 1.0
    # No shift: the best translation between the two is a few thousandths of a pixel.
    shift, _ = cv2.phaseCorrelate(*[np.ascontiguousarray(s) for s in smooth])
    gy, gx = np.gradient(smooth[0])
    design = np.column_stack([gx.ravel(), gy.ravel()])
    offset = np.linalg.lstsq(design, (smooth[1] - smooth[0]).ravel(), rcond=None)[0]
    assert np.abs(offset).max() < 0.005, shift


@pytest.mark.parametrize(
    ("tag_id", "word"), [(0, 0xD5D628584), (1, 0xD97F18B49), (2, 0xDD280910E), (9, 0x265AD0472)]
)
def test_tags_follow_the_published_code_words(tag_id, word):
    bits = np.array([(word >> (35 - k)) & 1 for k in range(36)]).reshape(6, 6)
    np.testing.assert_array_equal(tag_modules(tag_id)[2:8, 2:8], bits == 0)
    assert tag_modules(tag_id)[:2].all()
    assert tag_modules(tag_id)[:, -2:].all()


@pytest.mark.parametrize("board", [AprilGrid(3, 2, 0.08, 0.3), BOARD])
def test_black_rectangles_do_not_overlap_and_texture_keeps_their_area(board):
    art = draw_board(board)
    texture, to_texel = BoardTexture(art, white=1.0, black=0.0, surround=0.0).at_scale(0.002)
    x0, y0, x1, y1 = art.paper_m
    black = np.sum((art.black_m[:, 2] - art.black_m[:, 0]) * (art.black_m[:, 3] - art.black_m[:, 1]))
    white = (x1 - x0) * (y1 - y0) - black
    assert texture.sum() / FULL_SCALE / to_texel[0, 0] ** 2 == pytest.approx(white, rel=1e-4)


@pytest.mark.parametrize("model", ["radtan", "equidistant"])
def test_rays_and_projection_agree_with_opencv(model):
    lens = Lens((150.0, 152.0, 79.0, 61.0), (-0.1, 0.02, 1e-3, -5e-4), (160, 120), model)
    rays, blind = pixel_rays(lens)
    assert not blind.any()
    K = np.array([[150.0, 0, 79], [0, 152, 61], [0, 0, 1]])
    points = np.concatenate([rays.reshape(-1, 1, 2), np.ones((rays.shape[0] * rays.shape[1], 1, 1))], axis=2)
    project = cv2.projectPoints if model == "radtan" else cv2.fisheye.projectPoints
    uv, _ = project(points.astype(np.float64), np.zeros(3), np.zeros(3), K, np.array(lens.distortion))
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    np.testing.assert_allclose(uv.reshape(120, 160, 2), np.stack([u, v], -1), atol=1e-3)


def test_motion_blur_is_the_mean_over_the_exposure():
    pose = looking((0.1, 0.07, -0.35), velocity=(0.4, 0.1, 0.0), spin=(0, 0, 1.0))
    blurred = SimulatedCamera(BOARD, SMALL, pose, CameraSettings(exposure_s=0.02, blur_step_px=0.2, **QUIET))
    sharp = SimulatedCamera(BOARD, SMALL, pose, CameraSettings(exposure_s=0.0, **QUIET))
    instants = (np.arange(40) + 0.5) / 40 * 0.02 - 0.01
    mean = np.mean([sharp.render_clean(0.5 + t) for t in instants], axis=0)
    assert blurred.corner_blur_px(0.5) > 3
    assert np.abs(blurred.render_clean(0.5) - mean).mean() < 0.3


def test_rolling_shutter_shows_each_row_at_its_own_time():
    pose = looking((0.1, 0.07, -0.35), velocity=(0.5, 0.0, 0.0))
    rolling = SimulatedCamera(BOARD, SMALL, pose, CameraSettings(readout_s=0.02, exposure_s=0, **QUIET))
    snapshot = SimulatedCamera(BOARD, SMALL, pose, CameraSettings(exposure_s=0, **QUIET))
    picture = rolling.render_clean(0.1)
    for row in (10, 60, 110):
        t_row = 0.1 + (row / 119 - 0.5) * 0.02
        np.testing.assert_allclose(picture[row], snapshot.render_clean(t_row)[row], atol=0.5)


def test_seen_from_behind_or_looking_away_there_is_no_board():
    behind = SimulatedCamera(BOARD, SMALL, looking((0.1, 0.07, 0.35), side=1), CameraSettings(**QUIET))
    away, grazing = (
        SimulatedCamera(BOARD, SMALL, looking((0.1, 0.07, -0.35), tilt=tilt), CameraSettings(**QUIET))
        for tilt in ((0, 3.0, 0), (1.5, 0, 0))
    )
    for camera in (behind, away):
        assert np.ptp(camera.render_clean(0.0)) == 0
        assert not camera.project(BOARD.points_m, 0.0)[1].any()
    assert np.isfinite(grazing.render_clean(0.0)).all()


def test_noise_is_as_stated_and_seeded():
    settings = CameraSettings(noise_dn=3.0, shot_noise=0.05, exposure_s=0)
    pose = looking((0.1, 0.07, -0.35))
    camera = SimulatedCamera(BOARD, SMALL, pose, settings, seed=4)
    clean = camera.render_clean(0.0)
    pictures = np.array([camera.render(0.0) for _ in range(30)], float)
    expected = np.sqrt(9.0 + 0.05 * clean + 1 / 12)
    np.testing.assert_allclose(np.median(pictures.std(axis=0) / expected), 1.0, atol=0.03)
    again = SimulatedCamera(BOARD, SMALL, pose, settings, seed=4)
    np.testing.assert_array_equal(again.render(0.0), pictures[0])


def test_an_unknown_board_is_refused():
    with pytest.raises(ValueError, match="aprilgrid or checkerboard"):
        draw_board(object())


def test_room_pixels_and_surface_points_agree():
    rig = reference_rig(1, lens=SMALL)
    camera = RoomCamera(SMALL, rig.camera_pose_target, noise_dn=0.0)
    uv = np.array([[20.0, 30.0], [80.0, 60.0], [140.0, 100.0]])
    points = camera.surface_points(uv, 0.3)
    np.testing.assert_allclose(camera.project(points, 0.3), uv, atol=1e-6)
    _, p = rig.camera_pose_target(np.array([0.3]))
    assert np.all(np.linalg.norm(points - p[0], axis=1) < 6)
    picture = camera.render(0.3)
    assert picture.std() > 20
