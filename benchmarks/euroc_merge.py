"""EuRoC's two halves merged, against the whole: what does the cut cost?

Three calibrations of the same corners, lens estimated: the whole; the halves as two recordings of one rig
(motion, biases and gravity anew); and the whole with its motion alone forgotten at the cut. What information
the cut loses, the filter's own sigmas show: an efficient estimate of less data differs from one of more by
sqrt(P_less - P_more). Gravity in the frame of the board, which does not move, is compared between the halves.
At last the halves as two files, by `vical merge`: they continue one another, so they are one recording.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import json
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from vical_mocks.harness.recordings import Items, read

from benchmarks.euroc_halves import FOLDER, NOISE, PRIOR, SPLIT_S
from vical_daemon import cli
from vical_daemon.estimation.calibrator import Calibrator
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CalibrationOptions, FloatArray, PointsFrame
from vical_daemon.estimation.model.state import GRAVITY
from vical_daemon.vision.target import load_target

NAMES = ("px", "py", "pz", "rx", "ry", "rz", "shift")
_APART_NS = 10_000_000_000  # between two recordings, as `vical merge` puts them


@dataclass(frozen=True)
class Gravity:
    """Gravity in the frame of the board.

    Attributes:
        vector: m/s^2, shape (3,).
        covariance: By the filter, shape (3, 3).
        factor: By how much the stated variances are larger, because errors last.
    """

    vector: FloatArray
    covariance: FloatArray
    factor: float

    @classmethod
    def of(cls, f: CalibrationFilter) -> Gravity:
        """As a filter has it."""
        covariance = f.covariance([*range(GRAVITY.start, GRAVITY.stop)])
        return cls(f.state.gravity.copy(), covariance, f.consistency["cam0"].factor)

    def print_difference(self, other: Gravity) -> None:
        """Turns about two axes across gravity and the change of its size, and in sigmas."""
        size = float(np.linalg.norm(self.vector))
        axes = np.linalg.svd(self.vector[None] / size)[2]
        d = axes @ (other.vector - self.vector)
        own = np.sqrt(np.diag(axes @ (self.covariance + other.covariance) @ axes.T))
        reported = self.factor * self.covariance + other.factor * other.covariance
        stated = np.sqrt(np.diag(axes @ reported @ axes.T))
        cells = [np.round(x, 1).tolist() for x in (1e3 * d, d / own, d / stated)]
        print("\ngravity, second half from first: {} mm/s^2, {} of its sigmas, {} as stated".format(*cells))


@dataclass(frozen=True)
class Answer:
    """A calibration.

    Attributes:
        position_m, R_imu_cam, shift_s: Of the camera.
        stated: Sigmas as stated, shape (7,).
        own: Sigmas of the filter, if its model were exact, shape (7,).
        gravity: At the cut and at the end.
    """

    position_m: FloatArray
    R_imu_cam: FloatArray
    shift_s: float
    stated: FloatArray
    own: FloatArray
    gravity: list[Gravity]

    def off(self, whole: Answer) -> FloatArray:
        """Difference from the whole, in the order of `NAMES`."""
        turn = so3.log(whole.R_imu_cam.T @ self.R_imu_cam)
        return np.array([*(self.position_m - whole.position_m), *turn, self.shift_s - whole.shift_s])


def calibrate(items: Items, points: FloatArray, at_the_cut: str) -> Answer:
    """Calibrate the recording; `at_the_cut`: "", "next recording" or "lose motion"."""
    c = Calibrator(CalibrationOptions(imu_noise=NOISE), {"cam0": PRIOR}, points)
    later_ns, begin_ns = 0, items[0][0]
    gravity: list[Gravity] = []
    for t_ns, item in items:
        if at_the_cut and (t_ns - begin_ns) * 1e-9 > SPLIT_S:
            if at_the_cut == "next recording":
                c.finish()
                gravity += [Gravity.of(c.filter)] if c.filter else []
                c.next_recording()
                later_ns = _APART_NS
            else:
                c._lose_motion()
            at_the_cut = ""
        if isinstance(item, PointsFrame):
            c.add_points(replace(item, camera="cam0", t_cam_ns=item.t_cam_ns + later_ns))
            c.process()
        else:
            c.add_imu(item.stamp_ns + later_ns, item.gyro_rps, item.specific_force_mps2)
    c.finish()
    camera, f = c.estimate().cameras["cam0"], c.filter
    assert f is not None
    assert camera.calibration_covariance is not None
    where = f.layout.cameras["cam0"]
    rows = [
        *range(where.position.start, where.position.stop),
        *range(where.rotation.start, where.rotation.stop),
    ]
    own = f.covariance([*rows, where.timeshift])
    return Answer(
        np.array(camera.T_imu_cam.p_m),
        so3.matrix_from_quat(np.array(camera.T_imu_cam.q_wxyz)),
        camera.timeshift_cam_imu_s,
        np.sqrt(np.diag(np.array(camera.calibration_covariance))[:7]),
        np.sqrt(np.diag(own)),
        [*gravity, Gravity.of(f)],
    )


def write_half(folder: Path, begin_s: float, end_s: float) -> Path:
    """Write the lines of the recording that are within two times, counted from its begin."""
    begin_ns = 0
    for name, opened in (("imu0/data.csv", open), ("cam0/corners.csv.gz", gzip.open)):
        with opened(FOLDER / "mav0" / name, "rt") as file:
            head, *lines = file.readlines()
        stamps_ns = np.array([int(line.split(",", 1)[0]) for line in lines])
        begin_ns = begin_ns or int(stamps_ns[0])
        t_s = (stamps_ns - begin_ns) * 1e-9
        kept = [line for line, t in zip(lines, t_s, strict=True) if begin_s <= t < end_s]
        path = folder / "mav0" / name.removesuffix(".gz")
        path.parent.mkdir(parents=True)
        path.write_text("".join([head, *kept]))
    return folder


def largest_difference(files: list[Path]) -> float:
    """Of the lever arm by `vical merge` of the files and by `vical calibrate` of the whole, mm."""
    common = ["--target", f"{FOLDER}/target.yaml", "--initial", f"{FOLDER}/initial.yaml", "--json"]
    answers = []
    for words in (["calibrate", str(FOLDER)], ["merge", *map(str, files)]):
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
            cli.main([*words, *common])
        answers.append(json.loads(out.getvalue())["cameras"]["cam0"]["T_imu_cam"]["p_m"])
    return 1e3 * float(np.abs(np.subtract(*answers)).max())


def main(argv: list[str]) -> int:
    """Print the table."""
    argparse.ArgumentParser(prog="python -m benchmarks euroc_merge", description=__doc__).parse_args(argv)
    items, points = read(FOLDER), load_target(FOLDER / "target.yaml").points_m
    whole = calibrate(items, points, "")
    recordings: list[Gravity] = []
    print("| at the cut | | " + " | ".join(NAMES) + " |")
    print("|---|---|" + "---|" * len(NAMES))
    for what in ("next recording", "lose motion"):
        part = calibrate(items, points, what)
        lost = np.sqrt(np.maximum((part.own / whole.own) ** 2 - 1.0, 0.0))
        for name, row in (
            ("difference from the whole, in its stated sigmas", part.off(whole) / whole.stated),
            ("expected from what the cut loses (rms)", lost),
            ("stated sigma over that of the whole", part.stated / whole.stated),
        ):
            print(f"| {what} | {name} | " + " | ".join(f"{x:.2f}" for x in row) + " |", flush=True)
        if what == "next recording":
            recordings = part.gravity
    recordings[0].print_difference(recordings[1])
    with tempfile.TemporaryDirectory() as folder:
        first = write_half(Path(folder) / "first", -1.0, SPLIT_S)
        second = write_half(Path(folder) / "second", SPLIT_S, math.inf)
        print(f"\ntwo files by vical merge: {largest_difference([first, second]):.2g} mm from the whole")
    return 0
