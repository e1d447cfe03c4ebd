"""The same recording, described another way: does the answer follow, and is nothing else announced?

    python -m benchmarks symmetries                                EuRoC's recording, lens free
    python -m benchmarks symmetries --target-free                  its corners as unknown points
    python -m benchmarks symmetries --every 2 --begin 12           each second image, from 12 s on

What the axes of the imu are called, how the picture is turned, the frame of the board, the order of corners
and the zero of the camera's clock are conventions. A mirrored world and time that runs backwards obey the
same laws: specific forces stay, and rates change their sign. So each row but the last must give the answer of
the first one, and the last must agree with it within its sigmas: it meets the same images in another order.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from vical_mocks.harness.recordings import Items, read

from benchmarks.euroc_halves import FOLDER, NOISE, PRIOR
from benchmarks.euroc_stretches import stretch
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, FloatArray, PointsFrame
from vical_daemon.estimation.target_free import TargetFreeCalibrator
from vical_daemon.vision.target import load_target

LOOK = 4  # images between two looks at what is announced
_SHIFT_S = 0.3


class Reading(NamedTuple):
    """Of the imu: stamp, ns, rate, rad/s, specific force, m/s^2."""

    t_ns: int
    gyro_rps: FloatArray
    force_mps2: FloatArray


@dataclass(frozen=True)
class View:
    """A way to describe a recording.

    Attributes:
        imu, camera, board: Turn vectors of the imu, the camera and the board into those of this view; a
            reflection where it is mirrored.
        picture: Turns pixels, shape (n, 2).
        prior: Of the camera in this view.
        later_s: By how much later the images are stamped.
        backwards: Time runs backwards.
        shuffled: Corners come in any order.
    """

    imu: FloatArray
    camera: FloatArray
    board: FloatArray
    picture: Callable[[FloatArray], FloatArray] = lambda uv_px: uv_px
    prior: CameraPrior = PRIOR
    later_s: float = 0.0
    backwards: bool = False
    shuffled: bool = False

    def seen(self, items: Items) -> list[Reading | PointsFrame]:
        """The recording in this view, in order."""
        rng, ends_ns = np.random.default_rng(0), items[0][0] + items[-1][0]
        rates = float(np.linalg.det(self.imu)) * (-1.0 if self.backwards else 1.0)  # they are axial vectors
        out: list[Reading | PointsFrame] = []
        for _, item in items:
            if isinstance(item, PointsFrame):
                order = rng.permutation(len(item.ids)) if self.shuffled else slice(None)
                sigma = item.sigma_px
                t_ns = item.t_cam_ns + round(self.later_s * 1e9)
                t_ns = ends_ns - t_ns if self.backwards else t_ns
                uv_px, sigma_px = self.picture(item.uv_px)[order], None if sigma is None else sigma[order]
                out.append(PointsFrame("cam0", t_ns, item.ids[order], uv_px, sigma_px))
            else:
                t_ns = ends_ns - item.stamp_ns if self.backwards else item.stamp_ns
                gyro = rates * self.imu @ np.asarray(item.gyro_rps)
                out.append(Reading(t_ns, gyro, self.imu @ np.asarray(item.specific_force_mps2)))
        return sorted(out, key=lambda x: (x.t_cam_ns, 1) if isinstance(x, PointsFrame) else (x.t_ns, 0))


class Answer(NamedTuple):
    """A calibration, brought back into the view of the recording; sigmas of arm, turn and time shift."""

    arm_m: FloatArray
    R: FloatArray
    shift_s: float
    sigmas: FloatArray
    status: str
    announced: frozenset[str]


def _turned(quarters: int) -> View:
    """The picture turned by quarters, against the clock: (u, v) becomes (v, width - 1 - u) each time."""
    C, prior, picture = np.eye(3), PRIOR, _as_is
    for _ in range(quarters):
        width, height = prior.resolution
        assert prior.intrinsics is not None and prior.distortion is not None
        fx, fy, cx, cy = prior.intrinsics
        k1, k2, p1, p2 = prior.distortion
        prior = replace(
            prior,
            resolution=(height, width),
            intrinsics=(fy, fx, cy, width - 1 - cx),
            distortion=(k1, k2, -p2, p1),
        )
        C = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ C
        picture = partial(_quarter, picture, width)
    return View(np.eye(3), C, np.eye(3), picture, prior)


def _as_is(uv_px: FloatArray) -> FloatArray:
    return uv_px


def _quarter(before: Callable[[FloatArray], FloatArray], width: int, uv_px: FloatArray) -> FloatArray:
    u, v = before(uv_px).T
    return np.stack([v, width - 1 - u], axis=1)


def _mirrored() -> View:
    """The world in a mirror: x of imu, camera and board change their sign."""
    assert PRIOR.intrinsics is not None and PRIOR.distortion is not None
    width, mirror = PRIOR.resolution[0], np.diag([-1.0, 1.0, 1.0])
    fx, fy, cx, cy = PRIOR.intrinsics
    k1, k2, p1, p2 = PRIOR.distortion
    prior = replace(PRIOR, intrinsics=(fx, fy, width - 1 - cx, cy), distortion=(k1, k2, p1, -p2))
    return View(mirror, mirror, mirror, lambda uv: np.array([width - 1, 0]) + uv * [-1, 1], prior)


def views() -> dict[str, View]:
    """All of them; the first one is the recording as it is."""
    same = np.eye(3)
    about_x = np.diag([1.0, -1.0, -1.0])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return {
        "as recorded": View(same, same, same),
        "imu: x, -y, -z": View(about_x, same, same),
        "imu: y, z, x": View(np.roll(same, -1, axis=0), same, same),
        "imu: -y, x, z": View(quarter, same, same),
        "picture turned by 90 deg": _turned(1),
        "picture turned by 180 deg": _turned(2),
        "mirrored world": _mirrored(),
        "frame of the board turned": View(same, same, quarter),
        "corners in any order": View(same, same, same, shuffled=True),
        "images stamped 0.3 s later": View(same, same, same, later_s=_SHIFT_S),
        "images stamped 0.3 s earlier": View(same, same, same, later_s=-_SHIFT_S),
        "backwards": View(same, same, same, backwards=True),
    }


def answer(items: Items, view: View, points_m: FloatArray, *, target_free: bool) -> Answer | None:
    """Calibrate in a view; None without an answer."""
    options = CalibrationOptions(imu_noise=NOISE, target_free=target_free)
    priors = {"cam0": view.prior}
    calibrator: Calibrator | TargetFreeCalibrator = (
        TargetFreeCalibrator(options, priors)
        if target_free
        else Calibrator(options, priors, points_m @ view.board.T)
    )
    announced: set[str] = set()
    images = 0
    for item in view.seen(items):
        if isinstance(item, Reading):
            calibrator.add_imu(*item)
            continue
        calibrator.add_points(item)
        calibrator.process()
        images += 1
        if images % LOOK == 0:
            announced |= {str(event.kind) for event in calibrator.estimate().events}
    calibrator.finish()
    estimate = calibrator.estimate()
    if "cam0" not in estimate.cameras:
        return None
    camera = estimate.cameras["cam0"]
    P = np.asarray(camera.T_imu_cam.covariance)
    arm, turn = view.imu.T @ P[:3, :3] @ view.imu, view.camera.T @ P[3:, 3:] @ view.camera
    q = Rotation.from_quat(camera.T_imu_cam.q_wxyz, scalar_first=True).as_matrix()
    shift_s = camera.timeshift_cam_imu_s + view.later_s
    return Answer(
        view.imu.T @ np.asarray(camera.T_imu_cam.p_m),
        view.imu.T @ q @ view.camera,
        -shift_s if view.backwards else shift_s,
        np.sqrt([*np.diag(arm), *np.diag(turn), camera.timeshift_sigma_s**2]),
        str(estimate.status),
        frozenset(announced | {str(event.kind) for event in estimate.events}),
    )


class Differences(NamedTuple):
    """From another answer: of lever arm, mounting and time shift, and the largest over its sigma there."""

    arm_m: float
    turn_rad: float
    shift_s: float
    largest_z: float


def differences(found: Answer, base: Answer) -> Differences:
    """How far an answer is from another one."""
    arm, turn = found.arm_m - base.arm_m, Rotation.from_matrix(base.R.T @ found.R).as_rotvec()
    shift_s = found.shift_s - base.shift_s
    z = np.array([*arm, *turn, shift_s]) / base.sigmas
    return Differences(
        float(np.linalg.norm(arm)), float(np.linalg.norm(turn)), shift_s, float(np.abs(z).max())
    )


def row(name: str, found: Answer | None, base: Answer) -> str:
    """A line of the table."""
    if found is None:
        return f"| {name} | no answer | | | | |"
    d, ratio = differences(found, base), found.sigmas / base.sigmas
    more = ", ".join(sorted(found.announced - base.announced)) or "-"
    return (
        f"| {name} | {found.status} | {1e3 * d.arm_m:.3f} mm, {np.degrees(d.turn_rad):.4f} deg, "
        f"{1e6 * d.shift_s:.1f} us | {d.largest_z:.2f} | {ratio.min():.2f} to {ratio.max():.2f} | {more} |"
    )


def main(argv: list[str]) -> int:
    """Print a row for each view."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks symmetries", description=__doc__)
    parser.add_argument("--target-free", action="store_true", help="corners as unknown points")
    parser.add_argument("--begin", type=float, default=0.0, metavar="S", help="from there on, s (default: 0)")
    parser.add_argument("--seconds", type=float, default=100.0, metavar="S", help="so long (default: all)")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="each K-th image (default: 1)")
    args = parser.parse_args(argv)
    items = stretch(read(FOLDER), args.begin, args.seconds, args.every)
    points_m = load_target(FOLDER / "target.yaml").points_m
    print(
        "| described as | status | answer differs by | largest z | sigmas over those of the first row "
        "| announced besides |\n|---|---|---|---|---|---|"
    )
    base = None
    for name, view in views().items():
        if args.target_free and name == "frame of the board turned":
            continue
        found = answer(items, view, points_m, target_free=args.target_free)
        base = base or found
        if base is None:
            print("no answer from the recording as it is")
            return 1
        print(row(name, found, base), flush=True)
    return 0
