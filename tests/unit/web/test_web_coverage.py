"""Coverage, the place where the board is wanted, and the meters: against brute force and known geometry."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry.camera_model import project
from vical_daemon.estimation.measurements import ConvergenceTargets
from vical_daemon.web.coverage import ACROSS, ENOUGH, Coverage, gain, tilt_name, wanted
from vical_daemon.web.meters import Motion, blur, known_of_needed, light

SIZE = (640, 480)
LENS = (np.array([520.0, 520.0, 320.0, 240.0]), np.array([-0.28, 0.07, 0.0, 0.0]), "radtan")
BOARD_M = (0.35, 0.25)


def test_cells_count_corners_and_their_misfit():
    coverage, rng = Coverage(SIZE), np.random.default_rng(0)
    uv = rng.uniform((0, 0), SIZE, (400, 2))
    error = np.where(uv[:, :1] < 320, 0.5, 2.0) * np.ones(2)
    coverage.add(uv)
    coverage.add_misfit(uv, error)
    assert set(coverage.document()["rms_px"]) == {None}  # one image says little
    for _ in range(9):
        coverage.add_misfit(uv, error)
    coverage.add(np.array([[np.nan, 3.0], [1e9, -5.0]]))  # whatever comes, nothing breaks
    document = coverage.document()
    count = np.array(document["count"]).reshape(document["rows"], document["columns"])
    for row, column in ((0, 1), (5, 3), (11, 14)):
        inside = (uv // 40 == (column, row)).all(axis=1)
        assert count[row, column] == min(inside.sum(), ENOUGH)
        rms = document["rms_px"][row * ACROSS + column]
        assert rms == (None if not inside.any() else pytest.approx(0.5 if column < 8 else 2.0))
    assert document["share"] == pytest.approx((coverage.count >= ENOUGH).mean(), abs=1e-3)


def test_the_misfit_of_the_first_seconds_is_forgotten():
    coverage, uv = Coverage(SIZE), np.array([[100.0, 100.0], [110.0, 105.0]])
    for k in range(80):
        coverage.add_misfit(uv, np.full((2, 2), 30.0 if k < 5 else 0.3))
    assert [v for v in coverage.document()["rms_px"] if v is not None] == [pytest.approx(0.3, abs=0.6)]


def fill(coverage, x0, y0, x1, y1):
    x, y = np.meshgrid(np.arange(x0, x1, 8.0), np.arange(y0, y1, 8.0))
    coverage.add(np.column_stack([x.ravel(), y.ravel()]))


def test_the_board_is_wanted_where_nothing_was_seen_and_nowhere_when_all_was():
    tilts = {"head-on", *(f"its {e} edge nearer" for e in ("left", "right", "upper", "lower"))}
    coverage = Coverage(SIZE)
    fill(coverage, 0, 0, 400, 480)  # the right part is missing
    place = wanted(coverage, tilts, BOARD_M, *LENS)
    assert place.outline_px[:, 0].mean() > 400
    assert ((place.outline_px > 0) & (place.outline_px < SIZE)).all()
    fill(coverage, 400, 0, 640, 480)
    assert wanted(coverage, tilts, BOARD_M, *LENS) is None
    missing = wanted(coverage, tilts - {"its left edge nearer"}, BOARD_M, *LENS)
    assert missing.tilt == "its left edge nearer" and "tilted, its left edge nearer" in missing.text
    assert gain(coverage, tilts, missing.outline_px, missing.tilt) == 0.0


@pytest.mark.parametrize("edge", ["left", "right", "upper", "lower"])
def test_an_outline_is_larger_where_its_edge_is_nearer(edge):
    tilts = {"head-on", *(f"its {e} edge nearer" for e in ("left", "right", "upper", "lower"))}
    coverage = Coverage(SIZE)
    fill(coverage, 0, 0, 640, 480)
    outline = wanted(coverage, tilts - {f"its {edge} edge nearer"}, BOARD_M, *LENS).outline_px
    top_left, top_right, bottom_right, bottom_left = outline[::6]
    lengths = {
        "left": np.linalg.norm(top_left - bottom_left),
        "right": np.linalg.norm(top_right - bottom_right),
        "upper": np.linalg.norm(top_left - top_right),
        "lower": np.linalg.norm(bottom_left - bottom_right),
    }
    opposite = {"left": "right", "right": "left", "upper": "lower", "lower": "upper"}[edge]
    assert lengths[edge] > 1.1 * lengths[opposite]


def test_a_tilt_is_named_by_the_edge_that_is_nearer():
    board = np.array([[-0.2, 0, 0], [0.2, 0, 0], [0, -0.2, 0], [0, 0.2, 0]])
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        R = Rotation.from_rotvec(np.radians(25) * sign * np.eye(3)[axis]).as_matrix()
        nearest = ("left", "right", "upper", "lower")[int(np.argmin((board @ R.T)[:, 2]))]
        assert tilt_name(-R[:, 2]) == f"its {nearest} edge nearer"
    assert tilt_name(np.array([0.0, 0.05, -1.0]) / np.hypot(0.05, 1.0)) == "head-on"
    assert np.isfinite(project(board + np.array([0, 0, 1]), *LENS)).all()


def test_meters_show_information_over_what_is_needed(web_feed):
    estimate = web_feed.estimate(16.0, np.random.default_rng(0))  # sigmas: 1, 1, 1.5 mm about the imu's axes
    camera = estimate.cameras["cam0"]
    meters = {
        (m["kind"], m["name"]): m for m in known_of_needed(camera, ConvergenceTargets(2e-4, 1e-3, 1e-4))
    }
    R = Rotation.from_quat(camera.T_imu_cam.q_wxyz, scalar_first=True).as_matrix()
    covariance = R.T @ np.diag([1e-3, 1e-3, 1.5e-3]) ** 2 @ R
    for i, axis in enumerate("xyz"):
        expected = 2e-4**2 / covariance[i, i]
        assert meters["translation", axis]["share"] == pytest.approx(expected, abs=1e-3)
    assert meters["rotation", "z"]["share"] == 1.0
    assert meters["time", "shift"]["share"] == 1.0 and meters["time", "shift"]["unit"] == "ms"
    assert all(m["share"] == 1.0 for m in known_of_needed(camera, ConvergenceTargets(1e-9), enough=True))
    camera.T_imu_cam.covariance[:] = np.zeros((6, 6)).tolist()
    assert [m["kind"] for m in known_of_needed(camera, ConvergenceTargets())] == ["time"]  # the rest is fixed


def test_blur_is_speed_times_exposure():
    motion, grid = Motion(), np.random.default_rng(0).uniform(0, 400, (40, 2))
    for k in range(20):
        motion.add(0.05 * k, np.arange(40), grid + np.array([10.0 * k, 0.0]))
    assert motion.speed_px_s == pytest.approx(200.0)
    assert motion.rate_hz == pytest.approx(20.0)
    found = blur(motion.speed_px_s, 0.0115)
    assert found == {
        "px": 2.3, "advice": "corners move 2.3 px in an exposure of 11.5 ms: shorten it to 5 ms"
    }  # fmt: skip
    assert blur(motion.speed_px_s, None) is None and blur(None, 0.01) is None
    motion.add(1.0, np.arange(10), grid[:10])
    assert motion.board_share(40) == 0.25 and motion.board_share(0) == 0.25  # of the most that was seen
    assert Motion().board_share(0) is None


def test_light_is_judged_by_the_bright_parts():
    rng = np.random.default_rng(0)
    good = rng.integers(30, 200, (240, 320)).astype(np.uint8)
    assert light(good)["advice"] == ""
    assert light(good // 8)["advice"].startswith("dark image")
    over = np.where(rng.uniform(size=good.shape) < 0.2, 255, good).astype(np.uint8)
    assert "% of the image is saturated" in light(over)["advice"]


def test_any_size_in_a_message_is_bounded():
    coverage = Coverage((1, 2**31))
    coverage.add(np.array([[0.5, 1e9], [np.nan, 3.0]]))
    assert coverage.count.size <= 4 * ACROSS**2 and coverage.count.sum() == 1
