"""Rendered boards: the truth that the detectors are judged by."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from vical_mocks.camera import CameraSettings, SimulatedCamera
from vical_mocks.lens import Lens

from vical_daemon.vision.target import AprilGrid, Checkerboard, Target

EUROC_LENS = Lens(
    (458.654, 457.296, 330.0, 248.375), (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05), (640, 480)
)
FISHEYE = Lens((280.0, 280.0, 320.0, 240.0), (-0.01, 0.005, -0.003, 0.0005), (640, 480), "equidistant")


def hand_held(target: Target, distance_m: float, seed: int = 3, roll_rad: float = 0.0):
    """A swaying camera that looks at the middle of the board from its printed side."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.3, 0.9, 6), rng.uniform(0, 2 * np.pi, 6)
    middle = target.points_m.mean(axis=0)
    front = 1.0 if target.kind == "aprilgrid" else -1.0
    down = np.array([0.0, -front, 0.0])

    def pose(t_s):
        t = np.atleast_1d(np.asarray(t_s, float))[:, None]
        sway = np.sin(2 * np.pi * rate * t + phase)
        p = middle + np.array([0, 0, front * distance_m]) + sway[:, 3:] * [0.2, 0.2, 0.15] * distance_m
        z = (middle - p) / np.linalg.norm(middle - p, axis=1, keepdims=True)
        x = np.cross(down, z)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        R = np.stack([x, np.cross(z, x), z], axis=-1)
        turn = sway[:, :3] * [0.1, 0.1, 0.3] + [0, 0, roll_rad]
        return R @ np.array([cv2.Rodrigues(v)[0] for v in turn]), p

    return pose


@pytest.fixture
def aprilgrid() -> AprilGrid:
    return AprilGrid(6, 6, 0.088, 0.3)


@pytest.fixture
def checkerboard() -> Checkerboard:
    return Checkerboard(8, 7, 0.05, 0.05)


@pytest.fixture
def film() -> Callable[..., SimulatedCamera]:
    """Make a camera: film(target, distance_m, lens=..., seed=..., roll_rad=..., **settings)."""

    def make(target, distance_m, lens=EUROC_LENS, seed=3, roll_rad=0.0, **settings):
        cv2.setNumThreads(1)
        pose = hand_held(target, distance_m, seed, roll_rad)
        return SimulatedCamera(target, lens, pose, CameraSettings(**settings), seed)

    return make


@pytest.fixture
def fisheye() -> Lens:
    return FISHEYE
