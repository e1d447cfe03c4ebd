import numpy as np
import pytest

from vical_daemon.vision.detection import as_gray
from vical_daemon.vision.detector import BoardDetector
from vical_daemon.vision.grid_model import fit_grid
from vical_daemon.vision.target import AprilGrid, Checkerboard

FRAME_NS = 50_000_000


def errors(camera, detection, target, t_s):
    uv, seen = camera.project(target.points_m, t_s)
    return detection.uv_px - uv[detection.ids], seen


def run(camera, detector, target, frames, edit=lambda image, k: image):
    """Per frame: detection, errors of its corners, which points the camera sees."""
    rows = []
    for k in range(frames):
        t_s = k * FRAME_NS * 1e-9
        found = detector.detect(edit(camera.render(t_s), k), k * FRAME_NS)
        if found is None:
            rows.append((None, np.zeros((0, 2)), camera.project(target.points_m, t_s)[1]))
        else:
            rows.append((found, *errors(camera, found, target, t_s)))
    return rows


@pytest.mark.parametrize("distance_m", [0.7, 1.8])
def test_aprilgrid_corners_and_ids_are_right(film, aprilgrid, distance_m):
    camera = film(aprilgrid, distance_m, exposure_s=0.004)
    rows = run(camera, BoardDetector(aprilgrid), aprilgrid, 4)
    for found, error, seen in rows:
        assert len(found.ids) >= 0.9 * seen.sum()
        assert np.all(np.diff(found.ids) > 0)
        assert np.abs(error).max() < 0.15
    everything = np.concatenate([error for _, error, _ in rows])
    assert np.sqrt(np.mean(everything**2)) < 0.02
    assert np.abs(everything.mean(axis=0)).max() < 0.004


@pytest.mark.parametrize("roll_rad", [1.6, 3.1, -1.4])
def test_aprilgrid_is_known_whichever_way_up(film, aprilgrid, roll_rad):
    camera = film(aprilgrid, 0.9, roll_rad=roll_rad)
    found, error, _ = run(camera, BoardDetector(aprilgrid), aprilgrid, 1)[0]
    assert len(found.ids) > 100
    assert np.abs(error).max() < 0.15


def test_an_aprilgrid_whose_ids_begin_elsewhere(film, aprilgrid):
    board = AprilGrid(6, 6, 0.088, 0.3, first_tag=36)
    camera = film(board, 0.9)
    for found, error, seen in run(camera, BoardDetector(board), board, 3):  # searched, then followed
        assert len(found.ids) >= 0.9 * seen.sum() and np.abs(error).max() < 0.15
    assert BoardDetector(aprilgrid).detect(camera.render(0.0), 0) is None  # none of its tags is there


@pytest.mark.parametrize("board", [AprilGrid(6, 6, 0.088, 0.3), Checkerboard(8, 7, 0.05, 0.05)])
def test_fisheye(film, fisheye, board):
    camera = film(board, 0.35 if board.kind == "checkerboard" else 0.5, lens=fisheye)
    rows = run(camera, BoardDetector(board), board, 2)
    for found, error, seen in rows:
        assert len(found.ids) >= 0.75 * seen.sum()
        assert np.abs(error).max() < 0.2


def test_checkerboard_corners_and_order(film, checkerboard):
    camera = film(checkerboard, 0.6, exposure_s=0.004)
    for found, error, seen in run(camera, BoardDetector(checkerboard), checkerboard, 4):
        assert len(found.ids) >= 0.9 * seen.sum()
        assert np.abs(error).max() < 0.1


@pytest.mark.parametrize("roll_rad", [1.57, 3.14])
def test_a_board_with_unlike_ends_is_never_turned(film, checkerboard, roll_rad):
    assert (checkerboard.cols + checkerboard.rows) % 2
    camera = film(checkerboard, 0.8, roll_rad=roll_rad)
    _, error, _ = run(camera, BoardDetector(checkerboard), checkerboard, 1)[0]
    assert np.abs(error).max() < 0.1


def test_a_symmetric_board_keeps_its_order_while_it_is_turned_over(film):
    board = Checkerboard(8, 6, 0.05, 0.05)
    detector = BoardDetector(board, guided=False)
    still = [film(board, 0.8, roll_rad=roll, seed=5) for roll in np.linspace(0, np.pi, 6)]
    for k, camera in enumerate(still):
        found = detector.detect(camera.render(0.0), k * FRAME_NS)
        assert np.abs(errors(camera, found, board, 0.0)[0]).max() < 0.1


def test_stated_sigma_is_the_error(film, aprilgrid):
    """Noisy, dim, blurred: errors grow, and the sigmas say so."""
    for noise, exposure in ((2.0, 0.0), (8.0, 0.0), (5.0, 0.015)):
        camera = film(aprilgrid, 1.2, noise_dn=noise, exposure_s=exposure, gain=150.0)
        rows = run(camera, BoardDetector(aprilgrid), aprilgrid, 3)
        ratio = np.concatenate([e / f.sigma_px[:, None] for f, e, _ in rows])
        assert 0.4 < np.mean(ratio**2) < 2.0


def test_guided_search_rides_through_fast_motion_and_keeps_partial_boards(film, aprilgrid):
    detector = BoardDetector(aprilgrid)

    def hide(image, k):
        image[:, : min(17 * k, 260)] = 90
        return image

    rows = run(film(aprilgrid, 0.8, exposure_s=0.008), detector, aprilgrid, 14, hide)
    assert all(found is not None for found, _, _ in rows)
    assert detector.stats.guided >= 12
    assert max(np.abs(error).max() for _, error, _ in rows) < 0.5
    everything = np.concatenate([error for _, error, _ in rows])
    assert np.sqrt(np.mean(everything**2)) < 0.03


@pytest.mark.parametrize("side", ["left", "top"])
def test_a_partly_hidden_checkerboard_gives_no_wrong_corner(film, checkerboard, side):
    detector = BoardDetector(checkerboard)

    def hide(image, k):
        width = 20 * max(k - 2, 0)
        if side == "left":
            image[:, 140 : 140 + width] = 128
        else:
            image[100 : 100 + width] = 128
        return image

    rows = run(film(checkerboard, 0.6), detector, checkerboard, 10, hide)
    for found, error, _ in rows:
        assert found is None or np.abs(error).max() < 0.5
    assert rows[6][0] is not None


def led_to(detector, uv):
    """Let the optical flow lead there, shape (points, 2), nan where unseen."""
    valid = np.isfinite(uv).all(axis=1)
    model = fit_grid(detector._layout.xy_m[valid], uv[valid], (480, 640), -0.1)
    around = model.predict((detector._layout.rim or detector._layout).xy_m)
    detector._flow = lambda gray, t_ns: (model, uv, around)
    return detector


def test_a_start_a_few_pixels_off_needs_no_search(film, aprilgrid):
    camera = film(aprilgrid, 1.0)
    uv, seen = camera.project(aprilgrid.points_m, 0.5)
    rng = np.random.default_rng(0)
    start = np.where(seen[:, None], uv + rng.normal(0, 1.0, uv.shape) + [1.5, -1.0], np.nan)
    detector = led_to(BoardDetector(aprilgrid), start)
    found = detector.detect(camera.render(0.5), 0)
    assert detector.stats.searches == 0
    assert len(found.ids) > 0.9 * seen.sum()
    assert np.abs(found.uv_px - uv[found.ids]).max() < 0.1


@pytest.mark.parametrize("columns", [1, -1])
def test_a_start_off_by_one_tag_is_noticed(film, aprilgrid, columns):
    camera = film(aprilgrid, 1.0)
    shifted = aprilgrid.points_m + np.array([columns * aprilgrid.pitch_m, 0, 0])
    uv, seen = camera.project(shifted, 0.0)
    detector = led_to(BoardDetector(aprilgrid), np.where(seen[:, None], uv, np.nan))
    found = detector.detect(camera.render(0.0), 0)
    assert (detector.stats.guided, detector.stats.searches) == (0, 1)
    assert np.abs(errors(camera, found, aprilgrid, 0.0)[0]).max() < 0.1


@pytest.mark.parametrize("shift", [(1, 1), (-1, 1), (2, 0), (0, -2), (1, 0)])
def test_a_checkerboard_shifted_by_squares_is_noticed(film, checkerboard, shift):
    camera = film(checkerboard, 1.0)
    shifted = checkerboard.points_m + np.array([*shift, 0]) * 0.05
    uv, seen = camera.project(shifted, 0.0)
    detector = led_to(BoardDetector(checkerboard), np.where(seen[:, None], uv, np.nan))
    found = detector.detect(camera.render(0.0), 0)
    assert detector.stats.guided == 0
    assert np.abs(errors(camera, found, checkerboard, 0.0)[0]).max() < 0.1


def test_nothing_there():
    noise = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    for board in (AprilGrid(6, 6, 0.088, 0.3), Checkerboard(8, 6, 0.05, 0.05)):
        detector = BoardDetector(board)
        for image in (np.zeros((480, 640), np.uint8), np.full((480, 640), 255, np.uint8), noise):
            assert detector.detect(image) is None


def test_another_board_is_not_taken_for_ours(film, aprilgrid):
    image = film(aprilgrid, 1.0).render(0.0)
    assert BoardDetector(Checkerboard(8, 6, 0.05, 0.05)).detect(image) is None


def test_colour_and_sixteen_bit_pictures(film, aprilgrid):
    image = film(aprilgrid, 1.2).render(0.0)
    colour, alpha = (np.repeat(image[:, :, None], n, axis=2) for n in (3, 4))
    deep = image.astype(np.uint16) * 16
    lamp, thermal = deep // 4, deep // 8 + 29000  # a lamp 64 times as bright as the board; 0.01 K a level
    lamp[:12, :12] = 65535
    for picture in (colour, alpha, deep, lamp, thermal):
        assert len(BoardDetector(aprilgrid).detect(picture).ids) > 130
    with pytest.raises(ValueError, match="expected"):
        as_gray(image.astype(np.float32))
    with pytest.raises(ValueError, match="expected"):
        as_gray(np.zeros((4, 4, 2), np.uint8))
