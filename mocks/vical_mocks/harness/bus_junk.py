"""Junk and extreme messages for every key of a rig, and whether the logs of such a run still open.

A message made here is malformed (random bytes, cut, mutated or with a tail), or it is well formed and says at
least one thing that cannot be: a value beyond every device, a stamp far from the stream's. What a careful
liar would send is not junk: who may publish at all is the bus' affair.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status

RIG = "rig0"
NUMBERS = np.array([0, -0.0, 1e-300, 1, -1, 1e3, -1e6, 1e9, 1e30, -1e300, 1.7e308, np.nan, np.inf, -np.inf])
BEYOND = (1e4, -1e6, 1e9, 1e30, 1e300, -1e300, np.nan, np.inf, -np.inf)
NAMES = ("imu0", "cam0", "cam1", "imu", "camera", "estimate", "detect", "record")
_S = 10**9
_STAMPS = (0, 1, -_S, 2**31 * _S - 1, -(2**31) * _S)
_AWAY_S = (-1e9, -1e6, -3600.0, -600.0, 600.0, 3600.0, 3601.0, 1e6, 1e8)  # further than a run is long
_WORDS = ("", "stopp", "RESET", "\x00", "start; stop", "x" * 5000, "é\n\t")
FloatArray = npt.NDArray[np.float64]


class Junk:
    """An endless source of it.

    Args:
        seed: Of the random numbers.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._extreme: dict[str, Callable[[int, str], bytes]] = {
            "imu": self._imu, "image": self._image, "compressed": self._compressed,
            "camera_info": self._camera_info, "points": self._points, "tracks": self._points,
            "predicted": self._points, "calibration": self._calibration, "stored": self._calibration,
            "verify": self._verification,
            "pose": self._pose,
            "tf_static": self._transforms, "status": self._status, "command": self._command,
        }  # fmt: skip

    def message(self, number: int, now_ns: int) -> tuple[str, bytes]:
        """One message.

        Args:
            number: How many came before: the keys take turns.
            now_ns: What the good messages of this moment are stamped with, UNIX ns.

        Returns:
            Key and payload.
        """
        rng = self._rng
        topic = topics.TOPICS[number % len(topics.TOPICS)]
        name = str(rng.choice(NAMES)) if rng.random() < 0.9 else f"junk{rng.integers(50)}"
        if topic is topics.IMU and rng.random() < 0.8:
            name = "imu0"
        if topic.kind in ("image", "compressed", "points", "tracks") and rng.random() < 0.8:
            name = "cam0" if rng.random() < 0.5 else "cam1"
        key = topic.key(RIG, name)
        if rng.random() < 0.3:
            return key, rng.integers(0, 256, int(rng.integers(0, 400)), dtype=np.uint8).tobytes()
        payload = self._extreme[topic.kind](now_ns, name)
        return key, self._damaged(payload) if rng.random() < 0.4 else payload

    def _damaged(self, payload: bytes) -> bytes:
        """Cut, lengthened, or with lengths and values overwritten."""
        rng, raw = self._rng, bytearray(payload)
        way = rng.integers(0, 3)
        if way == 0:
            return bytes(raw[: rng.integers(0, len(raw))])
        if way == 1:
            return bytes(raw) + rng.integers(0, 256, int(rng.integers(4, 50)), dtype=np.uint8).tobytes()
        at = int(rng.integers(4, max(len(raw) - 4, 5)))
        raw[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80"])
        return bytes(raw)

    def _wild(self, count: int) -> FloatArray:
        """Numbers of which at least one is beyond every device."""
        values = self._rng.choice(NUMBERS, count)
        if count:
            values[self._rng.integers(0, count)] = self._rng.choice(BEYOND)
        return np.asarray(values, np.float64)

    def _stamp(self, now_ns: int) -> int:
        """A stamp of nonsense, or one far from those of the good messages."""
        if self._rng.random() < 0.5:
            return int(self._rng.choice(_STAMPS))
        stamp_ns = now_ns + round(float(self._rng.choice(_AWAY_S)) * _S)
        return min(max(stamp_ns, -(2**31) * _S), 2**31 * _S - 1)

    def _imu(self, now_ns: int, name: str) -> bytes:
        if self._rng.random() < 0.3:
            six = self._rng.uniform(-5, 5, 6)
            return m.encode_imu(self._stamp(now_ns), name, tuple(six[:3]), tuple(six[3:]))
        six = self._wild(6)
        stamp_ns = now_ns if self._rng.random() < 0.5 else self._stamp(now_ns)
        return m.encode_imu(stamp_ns, name, tuple(six[:3]), tuple(six[3:]))

    def _points(self, now_ns: int, name: str) -> bytes:
        rng = self._rng
        n = int(rng.integers(1, 60))
        ids, uv, size = (
            rng.choice(48, min(n, 48), replace=False),
            rng.uniform(0, 480, (min(n, 48), 2)),
            (640, 480),
        )
        sigma: FloatArray | None = None
        stamp_ns, wrong = now_ns, rng.integers(0, 5)
        if wrong == 0:
            stamp_ns = self._stamp(now_ns)
        elif wrong == 1:
            uv = self._wild(2 * len(ids)).reshape(-1, 2)
        elif wrong == 2:
            ids = rng.choice([-1, -(2**63), 2**63 - 1, 7], len(ids) + 1)
            uv = rng.uniform(0, 480, (len(ids), 2))
            ids[0] = -1
        elif wrong == 3:
            size = (int(rng.choice([0, 2**32 - 1])), 2**31)
        else:
            sigma = rng.choice([0.0, 1e-300, 1e300, np.nan, -1.0], len(ids))
        return m.encode_points(stamp_ns, name, ids.astype(np.int64), uv, sigma, size)

    def _image(self, now_ns: int, name: str) -> bytes:
        rows, columns = self._rng.choice([1, 2, 3, 7, 300], 2)
        pixels = self._rng.integers(0, 256, (rows, columns), dtype=np.uint8)
        return m.encode_image(self._stamp(now_ns), name, pixels, "mono8")

    def _compressed(self, now_ns: int, name: str) -> bytes:
        kind = str(self._rng.choice(["png", "jpeg", ""]))
        return m.encode_compressed_image(self._stamp(now_ns), name, kind, b"\x89PNG\r\n\x1a\n" + bytes(40))

    def _camera_info(self, now_ns: int, name: str) -> bytes:
        size = (int(self._rng.choice([0, 2**32 - 1])), 3)
        model = str(self._rng.choice(["radtan", "", "x" * 300]))
        lens = [float(x) for x in self._wild(4)]
        return m.encode_camera_info(self._stamp(now_ns), name, size, lens, model, self._wild(5).tolist())

    def _estimate(self, now_ns: int) -> CalibrationEstimate:
        wild = self._wild
        pose = PoseEstimate(wild(3).tolist(), wild(4).tolist(), wild(36).reshape(6, 6).tolist())
        shift_s, shift_sigma_s = wild(2).tolist()
        lens = (wild(4).tolist(), wild(4).tolist(), "radtan", wild(4).tolist(), wild(4).tolist())
        camera = CameraEstimate(pose, shift_s, shift_sigma_s, *lens, float(wild(1)[0]))
        status = self._rng.choice([Status.CONVERGED, Status.CONVERGING])
        return CalibrationEstimate(
            self._stamp(now_ns), Status(status), "", float(wild(1)[0]), "", float(wild(1)[0]), 2**63, 0,
            {"cam0": camera}, None, wild(3).tolist(), *wild(2).tolist(),
        )  # fmt: skip

    def _calibration(self, now_ns: int, name: str) -> bytes:
        return m.encode_calibration(self._estimate(now_ns), "cam0" if name != "cam1" else name)

    def _verification(self, now_ns: int, name: str) -> bytes:
        value, sigma, probability, used_s, rate_hz = self._wild(5).tolist()
        change = m.Change(
            str(self._rng.choice(["position", "", "x" * 300])), value, sigma, tuple(self._wild(3))
        )
        result = m.VerifyResult(
            self._stamp(now_ns), name, m.CheckState.CHECKING, "changed", self._stamp(now_ns), "\n" * 50, "",
            probability, used_s, 2**63, (change,) * int(self._rng.integers(0, 9)), ("",), rate_hz,
        )  # fmt: skip
        return m.encode_verification(result)

    def _pose(self, now_ns: int, name: str) -> bytes:
        with np.errstate(all="ignore"):
            return m.encode_pose(self._stamp(now_ns), name, self._estimate(now_ns).cameras["cam0"].T_imu_cam)

    def _transforms(self, now_ns: int, name: str) -> bytes:
        p, q = self._wild(3), self._wild(4)
        one = m.Transform(self._stamp(now_ns), name, "", (p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]))
        return m.encode_transforms([one] * int(self._rng.integers(0, 20)))

    def _status(self, now_ns: int, name: str) -> bytes:
        worth = str(self._rng.choice(["nan", "-1", "1e300", "inf", "", "many"]))
        component = str(self._rng.choice(["imu/imu0", f"junk/{self._rng.integers(10**6)}"]))
        values = {"stamp_sigma_us": worth, "x" * 200: "y" * 200}
        status = m.DiagnosticStatus(m.Level.WARN, component, "\n" * 50, "", values)
        return m.encode_diagnostics(
            self._stamp(now_ns), f"junk {name}", [status] * int(self._rng.integers(0, 9))
        )

    def _command(self, _now_ns: int, _name: str) -> bytes:
        return m.encode_string(str(self._rng.choice(_WORDS)))


def unopened(log: Path, scratch: Path) -> list[str]:
    """Read a log with mcap-ros2, rosbags and rosbags-convert; what failed, [] if nothing did."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from rosbags.highlevel import AnyReader

    def with_mcap_ros2() -> int:
        with log.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            return sum(1 for _ in reader.iter_decoded_messages())

    def with_rosbags() -> int:
        with AnyReader([log]) as reader:
            messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
        return len(messages)

    def with_rosbags_convert() -> int:
        tool = Path(sys.executable).with_name("rosbags-convert")
        bag = scratch / f"{log.stem}.bag"
        command: list[Any] = [tool, "--src", log, "--dst", bag]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode or not bag.is_file():
            raise RuntimeError((done.stderr or done.stdout)[-200:])
        with AnyReader([bag]) as reader:
            return int(reader.message_count)

    problems, counts = [], {}
    for read in (with_mcap_ros2, with_rosbags, with_rosbags_convert):
        try:
            counts[read.__name__] = read()
        except Exception as error:
            problems.append(f"{log.name} {read.__name__}: {type(error).__name__}: {str(error)[:200]}")
    if len(set(counts.values())) > 1:
        problems.append(f"{log.name}: the readers found {counts}")
    return problems
