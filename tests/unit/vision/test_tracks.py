import cv2
import numpy as np
import pytest
from vical_mocks.rig import reference_rig
from vical_mocks.room import RoomCamera

from vical_daemon.vision.flow_prediction import FlowCamera, FlowPredictor
from vical_daemon.vision.tracks import FeatureTracker, TrackOptions

STEP_S = 0.05
START_NS = 10**12


@pytest.fixture(scope="module")
def rig():
    return reference_rig(1)


@pytest.fixture(scope="module")
def room(rig):
    cv2.setNumThreads(1)
    return RoomCamera(rig.lens, rig.camera_pose_target)


@pytest.fixture(scope="module")
def pictures(room):
    return [room.render(k * STEP_S) for k in range(11)]


def with_gyro(rig, shift_s=0.0):
    camera = FlowCamera(
        rig.lens.intrinsics, rig.lens.distortion, rig.lens.model, rig.R_imu_cam, timeshift_cam_imu_s=shift_s
    )
    predictor = FlowPredictor(camera)
    t = np.arange(-0.1, 0.8, 0.01)
    for instant, rate in zip(t, rig.trajectory.omega_imu_rps(t), strict=True):
        predictor.add_imu(START_NS + round((instant + shift_s) * 1e9), tuple(rate))
    return predictor


def stamp(k):
    return START_NS + round(k * STEP_S * 1e9)


def test_tracks_stay_on_their_points(room, pictures):
    tracker = FeatureTracker()
    first, begun, errors, ages = {}, {}, [], []
    for k, picture in enumerate(pictures):
        found = tracker.detect(picture, stamp(k))
        assert found is not None
        assert len(found.ids) <= tracker.options.max_features
        assert np.all(np.diff(found.ids) > 0)
        fresh = np.array([i not in first for i in found.ids])
        where = room.surface_points(found.uv_px[fresh], k * STEP_S)
        first.update(zip(found.ids[fresh], where, strict=True))
        begun.update(dict.fromkeys(found.ids[fresh], k))
        ages.append([k - begun[i] for i in found.ids[~fresh]])
        points = np.array([first[i] for i in found.ids[~fresh]]).reshape(-1, 3)
        errors.append(np.linalg.norm(found.uv_px[~fresh] - room.project(points, k * STEP_S), axis=1))
    error, age = np.concatenate(errors), np.concatenate(ages)
    error, age = error[np.isfinite(error)], age[np.isfinite(error)]
    assert len(error) > 400
    assert np.median(error) < 0.08
    assert np.mean(error > 2.0) < 0.03
    assert np.median(error[age >= 8]) < 0.08  # errors do not add up: 0.22 where windows only move


def test_features_spread_over_the_picture(pictures):
    tracker = FeatureTracker(TrackOptions(max_features=60))
    found = tracker.detect(pictures[0], 0)
    assert 40 <= len(found.ids) <= 60
    quadrant = (found.uv_px[:, 0] > 320) * 2 + (found.uv_px[:, 1] > 240)
    assert np.bincount(quadrant, minlength=4).min() >= 8
    cells = np.unique(np.floor(found.uv_px / [64, 60]).astype(int), axis=0)
    assert len(cells) == len(found.ids)


def squares(edge_px, offset_px):
    """A blurred checkerboard, and the places of its corners, shape (n, 2)."""
    x, y = (np.arange(n) - n / 2 - offset_px for n in (640, 480))
    a, b = (np.tanh(0.35 * edge_px * np.sin(np.pi * v / edge_px)) for v in (x, y))
    k = np.arange(-12, 13) * edge_px + offset_px
    where = np.stack(np.meshgrid(k + 320, k + 240), axis=-1).reshape(-1, 2)
    return (128 + 90 * b[:, None] * a[None, :]).astype(np.uint8), where


def test_corners_are_followed_where_they_are_while_the_camera_comes_nearer():
    tracker, off = FeatureTracker(), {}
    for k in range(12):
        picture, where = squares(45.3 * 1.02**k, 0.4)
        found = tracker.detect(picture, stamp(k))
        near = np.linalg.norm(found.uv_px[:, None] - where, axis=2).min(axis=1)
        off.update(zip(found.ids.tolist(), near.tolist(), strict=True))
    assert len(off) > 40
    assert np.median(list(off.values())) < 0.1
    assert np.mean(np.array(list(off.values())) > 0.3) < 0.1


def test_gyro_rotation_is_the_cameras(rig):
    R, _ = rig.camera_pose_target(np.array([0.2, 0.25]))
    for shift_s in (0.0, 0.03):
        turned = with_gyro(rig, shift_s).rotation(stamp(4), stamp(5))
        angle = np.linalg.norm(cv2.Rodrigues(turned @ (R[1].T @ R[0]).T)[0])
        assert angle < 2e-3


def test_gyro_foretells_the_flow_of_a_pure_rotation(rig):
    predictor = with_gyro(rig)
    uv = np.array([[100.0, 100.0], [320.0, 240.0], [500.0, 400.0]])
    R, _ = rig.camera_pose_target(np.array([0.2, 0.25]))
    rays = rig.lens.unproject(uv) @ R[0].T @ R[1]
    expected, _ = rig.lens.project(rays)
    np.testing.assert_allclose(predictor.predict(uv, stamp(4), stamp(5)), expected, atol=1.0)
    assert predictor.rotation(stamp(4), stamp(400)) is None


def test_dropped_frames_are_bridged_by_the_gyro(rig, pictures):
    kept = {}
    for name, predictor in (("gyro", with_gyro(rig)), ("none", FlowPredictor())):
        tracker = FeatureTracker(TrackOptions(levels=1), predictor)
        first = tracker.detect(pictures[0], stamp(0))
        later = tracker.detect(pictures[4], stamp(4))
        kept[name] = np.isin(later.ids, first.ids).sum()
    assert kept["gyro"] > kept["none"]
    assert kept["gyro"] > 20


def test_something_that_moves_by_itself_is_dropped(pictures):
    tracker = FeatureTracker()
    patch = np.random.default_rng(0).integers(0, 255, (16, 16)).astype(np.uint8)
    patch = cv2.resize(patch, (192, 192), interpolation=cv2.INTER_CUBIC)
    for k in range(11):
        picture = pictures[k].copy()
        left = 200 + 6 * k
        picture[140 : 140 + 192, left : left + 192] = patch
        found = tracker.detect(picture, stamp(k))
    on_patch = (np.abs(found.uv_px - [left + 96, 236]) < 96).all(axis=1)
    assert on_patch.sum() <= 5


def test_light_that_changes_from_picture_to_picture_loses_nothing(pictures):
    steady, flickering = FeatureTracker(), FeatureTracker()
    for k, picture in enumerate(pictures[:6]):
        wanted = steady.detect(picture, stamp(k))
        found = flickering.detect(cv2.convertScaleAbs(picture, alpha=(0.6, 1.0)[k % 2]), stamp(k))
    old = steady.options.max_features  # ids of the first picture are below
    assert np.sum(found.ids < old) > 0.8 * np.sum(wanted.ids < old) > 20


def test_darkness_and_another_size_start_anew(pictures):
    tracker = FeatureTracker()
    before = tracker.detect(pictures[0], stamp(0))
    assert tracker.detect(np.zeros((480, 640), np.uint8), stamp(1)) is None
    after = tracker.detect(pictures[2], stamp(2))
    assert not np.isin(after.ids, before.ids).any()
    smaller = tracker.detect(np.ascontiguousarray(pictures[3][::2, ::2]), stamp(3))
    assert smaller.ids.min() > after.ids.max()


def test_a_gyro_that_misleads_is_left_out_of_it(rig):
    """A mounting that is 120 degrees off foretells flow the wrong way: after a few frames it is not asked."""
    right, wrong = with_gyro(rig), with_gyro(rig)
    turned = cv2.Rodrigues(np.array([0.0, 0.0, 2.1]))[0]
    wrong.camera = FlowCamera(
        rig.lens.intrinsics, rig.lens.distortion, rig.lens.model, rig.R_imu_cam @ turned
    )
    u, v = np.meshgrid(np.linspace(60, 580, 6), np.linspace(60, 420, 5))
    grid = np.column_stack([u.ravel(), v.ravel()])
    rays = rig.lens.unproject(grid)
    errors = {"right": [], "wrong": []}
    for k in range(12):
        R, _ = rig.camera_pose_target(np.array([k, k + 1]) * STEP_S)
        truth, _ = rig.lens.project(rays @ R[0].T @ R[1])
        for name, predictor in (("right", right), ("wrong", wrong)):
            foretold = predictor.predict(grid, stamp(k), stamp(k + 1))
            errors[name].append(np.median(np.linalg.norm(foretold - truth, axis=1)))
            predictor.learn(grid, truth, stamp(k), stamp(k + 1))
    assert max(errors["right"]) < 1.0
    assert errors["wrong"][0] > 5.0
    assert np.median(errors["wrong"][6:]) < 0.5 * np.median(errors["wrong"][:3])
