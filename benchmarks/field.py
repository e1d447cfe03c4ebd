"""EuRoC's recording, changed one thing at a time by what real devices do: is the answer still the same?

    python -m benchmarks field                      all faults, lens free
    python -m benchmarks field --fault clip_gyro    one of them

Each fault is written as an ASL folder and calibrated by `vical calibrate`. A row gives the largest difference
from the answer of the unchanged recording, in joint sigmas over rotation, lever arm and time shift; CPU time
over that of the unchanged recording; and what was announced or said.
"""

from __future__ import annotations

import argparse
import gzip
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from benchmarks import runner

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "euroc_imu_april"
WIDTH_PX, IMU_HZ = 752, 200.0
BIAS_RPS = np.radians([-0.148, 1.369, 4.364])  # of this gyro, by `vical td-icp`
_USUAL = {"target_shape", "lens_term_missing", "image_gap"}  # announced for the unchanged recording, too


@dataclass(frozen=True)
class Data:
    """A recording: stamps of the imu, ns; rates and forces (n, 6); points (stamp ns, id, u px, v px)."""

    t_ns: np.ndarray
    six: np.ndarray
    points: np.ndarray


def load() -> Data:
    """Read EuRoC's recording; all numbers of the points fit into 64-bit floats but the stamps, kept apart."""
    imu = FOLDER / "mav0/imu0/data.csv"
    t_ns = np.loadtxt(imu, delimiter=",", comments="#", usecols=0, dtype=np.int64)
    six = np.loadtxt(imu, delimiter=",", comments="#", usecols=range(1, 7))
    row = np.dtype([("t", "<i8"), ("id", "<i8"), ("uv", "<f8", (2,))])
    with gzip.open(FOLDER / "mav0/cam0/corners.csv.gz") as file:
        points = np.loadtxt(file, dtype=row, delimiter=",", comments="#")
    return Data(t_ns, six, points)


def write(data: Data, folder: Path, kind: str = "corners") -> None:
    """Write an ASL folder; its points are `corners` of a board or `tracks` of unknown points."""
    for name in ("imu0", "cam0"):
        (folder / "mav0" / name).mkdir(parents=True)
    rows = (
        f"{t}," + ",".join(map(repr, v)) for t, v in zip(data.t_ns.tolist(), data.six.tolist(), strict=True)
    )
    (folder / "mav0/imu0/data.csv").write_text("#timestamp [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(rows) + "\n")
    t_ns, ids, uv = (data.points[key].tolist() for key in ("t", "id", "uv"))
    rows = (f"{t},{i},{u!r},{v!r}" for t, i, (u, v) in zip(t_ns, ids, uv, strict=True))
    name = "point_id" if kind == "corners" else "feature_id"
    (folder / f"mav0/cam0/{kind}.csv").write_text(f"#timestamp [ns],{name},u,v\n" + "\n".join(rows) + "\n")


def _delayed(data: Data, rng: np.random.Generator) -> Data:
    late = data.t_ns + rng.exponential(2e6, len(data.t_ns)).astype(np.int64)
    return replace(data, t_ns=np.maximum.accumulate(late) + np.arange(len(late)))


def _bursts(data: Data, rng: np.random.Generator) -> Data:  # noqa: ARG001
    last = np.minimum(np.arange(len(data.t_ns)) // 4 * 4 + 3, len(data.t_ns) - 1)
    return replace(data, t_ns=data.t_ns[last])


def clipped(data: Data, columns: slice, most: float) -> Data:
    """Readings that stop at the rails of some axes."""
    six = data.six.copy()
    six[:, columns] = np.clip(six[:, columns], -most, most)
    return replace(data, six=six)


def _spikes(data: Data, rng: np.random.Generator) -> Data:
    six = data.six.copy()
    at = rng.choice(len(six), 40, replace=False)
    six[at, rng.integers(0, 3, 40)] += rng.choice([-1.0, 1.0], 40) * rng.uniform(5.0, 20.0, 40)
    return replace(data, six=six)


def _twice(data: Data, rng: np.random.Generator) -> Data:
    stamps = np.unique(data.points["t"])
    at = np.sort(rng.choice(len(stamps) - 1, len(stamps) // 10, replace=False))
    copies = []
    for k in at.tolist():
        copy = data.points[data.points["t"] == stamps[k]].copy()
        copy["t"] = (stamps[k] + stamps[k + 1]) // 2
        copies.append(copy)
    points = np.concatenate([data.points, *copies])
    return replace(data, points=points[np.argsort(points["t"], kind="stable")])


def _rest(data: Data, rng: np.random.Generator) -> Data:
    count = 60 * 200
    noise = rng.normal(0.0, 1.0, (count, 6)) * [2e-3, 2e-3, 2e-3, 2e-2, 2e-2, 2e-2]
    t_ns = data.t_ns[0] - np.arange(count, 0, -1) * 5_000_000
    first = data.points[data.points["t"] == data.points["t"][0]]
    images = []
    for k in range(60 * 20, 0, -1):
        image = first.copy()
        image["t"] -= k * 50_000_000
        image["uv"] += rng.normal(0.0, 0.1, image["uv"].shape)
        images.append(image)
    still = np.concatenate([BIAS_RPS, data.six[:200, 3:].mean(axis=0)])  # the rig is almost at rest at first
    six = np.concatenate([still + noise, data.six])
    return Data(np.concatenate([t_ns, data.t_ns]), six, np.concatenate([*images, data.points]))


def _mirrored(data: Data) -> Data:
    points = data.points.copy()
    points["uv"][:, 0] = WIDTH_PX - 1 - points["uv"][:, 0]
    return replace(data, points=points)


def _held(data: Data) -> Data:
    """An accelerometer of 62.5 Hz in rows of 200 Hz: each of its readings is written three or four times."""
    since_s = (data.t_ns - data.t_ns[0]) * 1e-9
    six = data.six.copy()
    six[:, 3:] = six[np.searchsorted(since_s, np.floor(62.5 * since_s) / 62.5 - 1e-6), 3:]
    return replace(data, six=six)


def _paired(data: Data) -> Data:
    """For two seconds a driver pairs each image with the stamp of the next one."""
    stamps, image = np.unique(data.points["t"], return_inverse=True)
    since_s = (stamps - data.t_ns[0]) * 1e-9
    wrong = (since_s > 30.0) & (since_s < 32.0)
    moved = np.where(wrong, np.append(stamps[1:], stamps[-1]), stamps)
    points = data.points.copy()
    points["t"] = moved[image]
    lost = np.append(False, np.diff(moved) == 0)  # the image whose stamp is taken
    return replace(data, points=points[~lost[image]])


def _lowpass(data: Data) -> Data:
    """A filter of second order (Butterworth): 22 ms late."""
    six = data.six.copy()
    still = six[0, 3:]
    six[:, 3:] = still + lfilter(*butter(2, 10.0 / (0.5 * IMU_HZ)), six[:, 3:] - still, axis=0)
    return replace(data, six=six)


def late_images(data: Data, rng: np.random.Generator) -> Data:
    """Images stamped when a driver has them, one after the other: 4 ms late, 1 % of them 60 ms."""
    stamps, image = np.unique(data.points["t"], return_inverse=True)
    late = rng.exponential(4e6, len(stamps)) + 60e6 * (rng.random(len(stamps)) < 0.01)
    arrivals: list[int] = []
    for arrival in (stamps + late.astype(np.int64)).tolist():
        arrivals.append(max(arrival, arrivals[-1] + 100_000) if arrivals else arrival)
    points = data.points.copy()
    points["t"] = np.array(arrivals)[image]
    return replace(data, points=points)


FAULTS: dict[str, tuple[str, Callable[[Data, np.random.Generator], Data]]] = {
    "none": ("unchanged", lambda d, _: d),
    "delayed": ("IMU stamped on arrival, delays of 2 ms (exponential)", _delayed),
    "bursts": ("IMU stamped on arrival, four readings at once", _bursts),
    "clip_gyro": (
        "gyro clipped at 1 rad/s (30 % of the readings)",
        lambda d, _: clipped(d, slice(0, 3), 1.0),
    ),
    "clip_gyro_2": ("gyro clipped at 2 rad/s", lambda d, _: clipped(d, slice(0, 3), 2.0)),
    "clip_accel": ("accelerometer clipped at 10 m/s^2 (10 %)", lambda d, _: clipped(d, slice(3, 6), 10.0)),
    "spikes": ("40 gyro spikes of one reading each", _spikes),
    "twice": ("10 % of the images delivered twice", _twice),
    "rest": ("60 s at rest before", _rest),
    "negated": ("accelerometer negated", lambda d, _: replace(d, six=d.six * [1, 1, 1, -1, -1, -1])),
    "axes": ("accelerometer's axes permuted", lambda d, _: replace(d, six=d.six[:, [0, 1, 2, 4, 5, 3]])),
    "mirrored": ("images mirrored", lambda d, _: _mirrored(d)),
    "held": ("accelerometer of 62.5 Hz in rows of 200 Hz", lambda d, _: _held(d)),
    "paired": ("images of 2 s stamped as the next ones", lambda d, _: _paired(d)),
    "loud": ("white noise stated three times too large", lambda d, _: d),
    "quiet": ("white noise stated three times too small", lambda d, _: d),
    "late_images": ("images stamped on arrival, 4 ms late, 1 % of them 60 ms", late_images),
    "lowpass": ("accelerometer behind a low-pass filter of 10 Hz", lambda d, _: _lowpass(d)),
}
STATED = {"loud": 3.0, "quiet": 1.0 / 3.0}
"""By how much the densities in the file with the prior are too large."""


def _initial(stated: float) -> str:
    """The prior, with other densities of white noise."""

    def other(found: re.Match[str]) -> str:
        return f"{found[1]}{stated * float(found[2]):.4e}"

    return re.sub(r"(_noise_density: )(\S+)", other, (FOLDER / "initial.yaml").read_text())


def calibrate(data: Data, stated: float = 1.0) -> dict[str, Any]:
    """Run `vical calibrate` on the data; its JSON, with what it printed last where it found nothing.

    Args:
        data: The recording.
        stated: By how much the stated white noise is too large.
    """
    with tempfile.TemporaryDirectory() as name:
        folder, initial = Path(name) / "recording", Path(name) / "initial.yaml"
        write(data, folder)
        initial.write_text(_initial(stated))
        command = [sys.executable, "-m", "vical_daemon", "calibrate", str(folder), "--json", "--quiet"]
        command += ["--target", str(FOLDER / "target.yaml"), "--initial", str(initial)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    result: dict[str, Any] = json.loads(done.stdout) if done.stdout else {"cameras": {}, "status": "none"}
    result["said"] = (done.stderr.strip().splitlines() or [""])[-1].replace(
        "vical: error: no calibration: ", ""
    )
    return result


def difference(a: dict[str, Any], b: dict[str, Any]) -> float:
    """Largest difference of two results in joint sigmas, taken as independent."""
    a, b = a["cameras"]["cam0"], b["cameras"]["cam0"]
    A, B = a["T_imu_cam"], b["T_imu_cam"]
    variance = np.diag(A["covariance"]) + np.diag(B["covariance"])
    turn = Rotation.from_quat(B["q_wxyz"], scalar_first=True).inv() * Rotation.from_quat(
        A["q_wxyz"], scalar_first=True
    )
    away = np.concatenate([np.subtract(A["p_m"], B["p_m"]), turn.as_rotvec()])
    shift = a["timeshift_cam_imu_s"] - b["timeshift_cam_imu_s"]
    sigma_s = np.hypot(a["timeshift_sigma_s"], b["timeshift_sigma_s"])
    return float(max(np.abs(away / np.sqrt(variance)).max(), abs(shift) / sigma_s))


def main(argv: list[str]) -> int:
    """Print a row for each fault."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks field", description=__doc__)
    parser.add_argument("--fault", action="append", choices=FAULTS, help="only this one; may be repeated")
    parser.add_argument("--rigs", action="store_true", help="simulated rigs instead: see `field_rigs`")
    parser.add_argument("--target-free", action="store_true", help="simulated rigs without a board")
    parser.add_argument("--zoo", action="store_true", help="random rigs instead of the reference rig")
    runner.add_arguments(parser, trials=20, seconds=25.0)
    args = parser.parse_args(argv)
    if args.rigs or args.target_free or args.zoo:
        from benchmarks.field_rigs import study

        return study(args)
    if not FOLDER.is_dir():
        print(f"no {FOLDER}: the recording is not part of the repository", file=sys.stderr)
        return 1
    original = load()
    whole = calibrate(original)
    print("| fault | status | largest difference, joint sigma | CPU | announced |")
    print("|---|---|---|---|---|")
    for number, (name, (text, change)) in enumerate(FAULTS.items()):
        if args.fault and name not in args.fault:
            continue
        changed = change(original, np.random.default_rng([number, 26]))
        result = calibrate(changed, STATED.get(name, 1.0))
        if "cam0" not in result["cameras"]:
            print(f"| {text} | {result['status']} | - | - | {result['said']} |")
            continue
        kinds = [e["kind"] for e in result["events"] if e["kind"] not in _USUAL]
        said = ", ".join(f"{kind} x{kinds.count(kind)}" for kind in dict.fromkeys(kinds)) or "-"
        print(
            f"| {text} | {result['status']} | {difference(result, whole):.1f} "
            f"| {result['cpu_s'] / whole['cpu_s']:.1f} | {said} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
