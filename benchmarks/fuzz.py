"""Mutated MCAP, CDR and YAML: every input ends in a value or in the one error that is documented.

python -m benchmarks fuzz --count 100000
"""

from __future__ import annotations

import argparse
import random
import resource
import tempfile
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.config.model import ConfigError, loads
from vical_daemon.estimation.result import PoseEstimate
from vical_daemon.logs import RecordingError, open_recording
from vical_daemon.logs.mcap import LogError, LogReader, LogWriter

Case = tuple[str, bytes, Callable[[bytes], object], tuple[type[Exception], ...]]


def main(argv: list[str]) -> int:
    """Mutate, feed, count."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks fuzz")
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(argv)
    rng = random.Random(args.seed)
    rows, worst = [], 0
    with tempfile.TemporaryDirectory() as folder:
        families = cases(Path(folder))
        for name, share in (("CDR", 0.6), ("MCAP", 0.3), ("recording", 0.02), ("YAML", 0.08)):
            result = run(families[name], max(1, int(args.count * share)), rng)
            rows.append((name, *result))
            worst += result[3]
    print("| inputs | count | refused | taken | other exceptions | slowest, ms | memory / input, worst |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        print("| {} | {} | {} | {} | {} | {:.0f} | {:.1f} |".format(*row))
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\nLargest resident memory of the whole run: {peak_mb:.0f} MB")
    return int(worst > 0)


def cases(folder: Path) -> dict[str, list[Case]]:
    """Return sound inputs with their readers and the errors that these may raise."""
    status = m.DiagnosticStatus(m.Level.OK, "a", values={"k": "v"})
    transform = m.Transform(1, "a", "b", (0.0,) * 3, (1.0, 0.0, 0.0, 0.0))
    decoders: list[tuple[Callable[[bytes], object], bytes]] = [
        (m.decode_imu, m.encode_imu(1, "imu0", (1.0, 2.0, 3.0), (0.0, 0.0, 9.8))),
        (m.decode_points, m.encode_points(1, "cam0", np.arange(30), np.ones((30, 2)), np.ones(30))),
        (_pixels, m.encode_image(1, "cam0", np.zeros((12, 16), np.uint8), "mono8")),
        (m.decode_compressed_image, m.encode_compressed_image(1, "cam0", "png", bytes(64))),
        (m.decode_camera_info, m.encode_camera_info(1, "c", (8, 6), [1, 2, 3, 4], "radtan", [0, 0, 0, 0])),
        (m.decode_diagnostics, m.encode_diagnostics(1, "imu", [status])),
        (m.decode_transforms, m.encode_transforms([transform])),
        (m.decode_pose, m.encode_pose(1, "a", PoseEstimate([0.0] * 3, [1.0, 0, 0, 0], np.eye(6).tolist()))),
        (m.decode_string, m.encode_string("start")),
    ]
    path = folder / "a.mcap"
    with LogWriter(path, {"vical": {"version": "1"}}) as writer:
        for i in range(60):
            writer.write(topics.IMU.key("rig0", "imu0"), m.encode_imu(i, "imu0", (0, 0, 0), (0, 0, 9.8)), i)
            points = m.encode_points(i, "c", np.arange(9), np.ones((9, 2)))
            writer.write(topics.POINTS.key("rig0", "cam0"), points, i)
            if i % 20 == 0:
                writer.flush()
        writer.attach("config.yaml", "text/yaml", b"rig: rig0", 1)
    raw = path.read_bytes()
    mutant = folder / "m.mcap"
    text = (
        b"rig: rig0\nimus:\n  imu0: {port: /dev/ttyUSB0, rate_hz: 500}\ncameras:\n  cam0:\n"
        b"    uri: v4l2:/dev/video0\n"
        b"    size: [752, 480]\n    lens: {intrinsics: [458.0, 457.0, 367.0, 248.0]}\ntarget: t.yaml\n"
    )
    return {
        "CDR": [(f.__name__, data, f, (m.MessageError,)) for f, data in decoders],
        "MCAP": [("mcap", raw, lambda data: _read(mutant, data), (LogError,))],
        "recording": [("recording", raw, lambda data: _open(mutant, data), (RecordingError,))],
        "YAML": [("yaml", text, lambda data: loads(data.decode("utf-8", "replace")), (ConfigError,))],
    }


def _pixels(data: bytes) -> object:
    return m.decode_image(data).pixels()


def _read(path: Path, data: bytes) -> int:
    path.write_bytes(data)
    return sum(len(message.payload) for message in LogReader(path).messages())


def _open(path: Path, data: bytes) -> object:
    path.write_bytes(data)
    return sum(len(payload) for _, payload in open_recording(path, check=False).messages())


_EXTREMES = [n.to_bytes(4, "little") for n in (0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000)]
_LONG_EXTREMES = [n.to_bytes(8, "little") for n in (0, 2**31, 2**63 - 1, 2**64 - 1)]


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Flip, overwrite with extremes, cut, double or splice."""
    raw = bytearray(data)
    for _ in range(rng.randint(1, 5)):
        if len(raw) < 9:
            break
        at, kind = rng.randrange(len(raw) - 8), rng.randrange(6)
        if kind == 0:
            raw[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            raw[at] = rng.randrange(256)
        elif kind == 2:
            raw[at : at + 4] = rng.choice(_EXTREMES)
        elif kind == 3:
            raw[at : at + 8] = rng.choice(_LONG_EXTREMES)
        elif kind == 4:
            del raw[at : at + rng.randint(1, 64)]
        else:
            raw[at:at] = raw[at : at + rng.randint(1, 64)]
    return bytes(raw[: rng.randint(0, len(raw))]) if rng.random() < 0.2 else bytes(raw)


def run(family: list[Case], count: int, rng: random.Random) -> tuple[int, int, int, int, float, float]:
    """Return (count, refused, taken, other exceptions, slowest ms, worst memory over input)."""
    refused = taken = 0
    others: Counter[str] = Counter()
    slowest_s, worst_ratio = 0.0, 0.0
    for i in range(count):
        name, sound, reader, allowed = family[i % len(family)]
        data = mutate(sound, rng)
        measured = i % 50 == 0
        if measured:
            tracemalloc.start()
        begin_s = time.perf_counter()
        try:
            reader(data)
            taken += 1
        except allowed as error:
            refused += 1
            if "\n" in str(error):
                others[f"{name}: message of several lines"] += 1
        except Exception as error:
            others[f"{name}: {type(error).__name__}: {str(error)[:80]}"] += 1
        slowest_s = max(slowest_s, time.perf_counter() - begin_s)
        if measured:
            worst_ratio = max(worst_ratio, tracemalloc.get_traced_memory()[1] / max(len(data), 65536))
            tracemalloc.stop()
    for text, number in others.most_common(10):
        print(f"{number} x {text}")
    return count, refused, taken, sum(others.values()), slowest_s * 1e3, worst_ratio
