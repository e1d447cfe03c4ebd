"""`vical td-icp INPUT --sensors`: every kind of recorded orientation, in every kind of log, and the truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from vical_mocks.rotations import exp_so3, log_so3
from vical_mocks.trajectory import hand_motion

from vical_daemon.cli import main
from vical_daemon.estimation.geometry.so3 import matrix_from_quat

DEG = np.pi / 180
EPOCH_NS = 1_700_000_000_000_000_000
IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
# topic -> type, rate in Hz, noise in deg, t_imu = t_sensor + shift in s
TOPICS = {
    "/odom": (ODOMETRY, 15.0, 0.3, 0.25),
    "/vicon/pose": (POSE, 20.0, 0.1, -0.75),
    "/ahrs/data": (IMU, 25.0, 0.2, 0.012),
    "/slam": (POSE_COVARIANCE, 10.0, 0.2, 0.1),
}


class World:
    """A motion of 7 s, and what sensors on it say."""

    def __init__(self, seed: int = 4) -> None:
        self.rng, self.motion = np.random.default_rng(seed), hand_motion(seed, 55.0)
        self.mounting = {name: exp_so3(self.rng.normal(0, 1, 3)) for name in TOPICS}

    def gyro(self) -> tuple[np.ndarray, np.ndarray]:
        t = np.arange(3.0, 12.0, 0.01)
        return t, self.motion.omega_imu_rps(t) + 0.01 + self.rng.normal(0, 5.2e-3, (len(t), 3))

    def orientations(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Stamps in the sensor's clock, s, and quaternions x y z w."""
        _, hz, noise, shift = TOPICS[name]
        t = np.arange(4.0, 11.0, 1 / hz)
        R = exp_so3(self.rng.normal(0, 1, 3)) @ self.motion.R_world_imu(t) @ self.mounting[name]
        R = R @ exp_so3(self.rng.normal(0, noise * DEG, (len(t), 3)))
        return t - shift, Rotation.from_matrix(R).as_quat()


def _header(store: Any, t_s: float, ros1: bool) -> Any:
    ns = EPOCH_NS + round(t_s * 1e9)
    stamp = store.types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
    kind = store.types["std_msgs/msg/Header"]
    return kind(0, stamp, "x") if ros1 else kind(stamp, "x")


def _message(store: Any, kind: str, header: Any, q: np.ndarray, rate: np.ndarray) -> Any:
    types = store.types
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    quaternion = types["geometry_msgs/msg/Quaternion"](*q.tolist())
    pose = types["geometry_msgs/msg/Pose"](point(0.0, 0.0, 0.0), quaternion)
    six = np.diag([1e-4] * 3 + [1e-5] * 3).ravel()
    if kind == POSE:
        return types[kind](header, pose)
    if kind == POSE_COVARIANCE:
        return types[kind](header, types["geometry_msgs/msg/PoseWithCovariance"](pose, six))
    if kind == ODOMETRY:
        twist = types["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        speed = types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36))
        return types[kind](header, "base", types["geometry_msgs/msg/PoseWithCovariance"](pose, six), speed)
    nine = np.zeros(9)
    unknown = nine - np.eye(3).ravel() * np.array([1, 0, 0] * 3)  # -1 in front: no orientation
    given = unknown if not q.any() else nine
    return types[kind](header, quaternion, given, vector(*rate.tolist()), nine, vector(0.0, 0.0, 9.8), nine)


@contextmanager
def _writer(kind: str, path: Path) -> Iterator[tuple[Any, Callable[[str, str, int, Any], None], bool]]:
    """A log of one kind, and a function (topic, type, stamp, message) that writes to it."""
    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        log: Any = Bag1Writer(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        log = Bag2Writer(path, version=9, storage_plugin=plugin)
    serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
    connections: dict[str, Any] = {}

    def write(topic: str, type_name: str, t_ns: int, message: Any) -> None:
        if topic not in connections:
            connections[topic] = log.add_connection(topic, type_name, typestore=store)
        log.write(connections[topic], t_ns, serialise(message, type_name))

    with log:
        yield store, write, ros1


def _record(kind: str, path: Path, world: World, *, gyro: bool = True, topics: tuple[str, ...]) -> Path:
    rows = []
    if gyro:
        t, rates = world.gyro()
        rows += [(a, "/imu0/data_raw", IMU, np.zeros(4), w) for a, w in zip(t, rates, strict=True)]
    for topic in topics:
        t, q = world.orientations(topic)
        rows += [(a, topic, TOPICS[topic][0], b, np.zeros(3)) for a, b in zip(t, q, strict=True)]
    with _writer(kind, path) as (store, write, ros1):
        for t_s, topic, type_name, q, rate in sorted(rows, key=lambda row: row[0]):
            message = _message(store, type_name, _header(store, t_s, ros1), q, rate)
            write(topic, type_name, EPOCH_NS + round(t_s * 1e9), message)
    return path


def _td_icp(capsys: Any, path: Path, sensors: str) -> SimpleNamespace:
    code = main(["td-icp", str(path), "--sensors", sensors, "--json"])
    captured = capsys.readouterr()
    out = json.loads(captured.out) if captured.out.strip() else {}
    return SimpleNamespace(code=code, out=out, err=captured.err)


def _check(result: dict[str, Any], world: World, topics: tuple[str, ...], reference: str) -> None:
    """Delays of all pairs and mountings lie within their sigmas of the truth, and these are no excuse."""
    shift = {name: TOPICS[name][3] for name in topics} | {reference: TOPICS.get(reference, (0.0,))[-1]}
    assert set(result["sensors"]) == set(topics) - {reference}
    assert len(result["pairs"]) == len(shift) * (len(shift) - 1) // 2
    for pair in result["pairs"]:
        error = pair["timeshift_s"] - (shift[pair["a"]] - shift[pair["b"]])
        assert abs(error) < 4.5 * pair["timeshift_sigma_s"] < 4.5e-3, pair
    R_imu_ref = world.mounting.get(reference, np.eye(3))
    for name, sensor in result["sensors"].items():
        R = matrix_from_quat(np.array(sensor["R_ref_sensor_q_wxyz"]))
        error = log_so3(world.mounting[name].T @ R_imu_ref @ R)
        assert np.all(np.abs(error) < 4.5 * np.array(sensor["rotation_sigma_rad"]))
        assert max(sensor["rotation_sigma_rad"]) < 0.01
        assert sensor["noise_rad"] == pytest.approx(TOPICS[name][2] * DEG, rel=0.35)
    names, covariance = result["order"], np.array(result["covariance"])
    assert covariance.shape == (4 * len(names), 4 * len(names))
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


@pytest.mark.parametrize(
    ("kind", "topics"),
    [
        ("mcap", ("/odom", "/vicon/pose", "/ahrs/data")),
        ("sqlite", ("/odom", "/slam")),
        ("ros1", ("/vicon/pose", "/ahrs/data")),
    ],
)
def test_sensors_of_a_log_and_its_gyro_agree_with_the_truth(
    kind: str, topics: tuple[str, ...], tmp_path: Path, capsys: Any
) -> None:
    world = World()
    path = _record(kind, tmp_path / ("log.bag" if kind == "ros1" else "log"), world, topics=topics)
    found = _td_icp(capsys, path, ",".join(("imu0", *topics)))
    assert found.code == 0 and found.out["status"] == "ok", found.err
    assert found.out["reference"] == "imu0"
    _check(found.out, world, topics, "imu0")
    np.testing.assert_allclose(found.out["gyro_bias_rps"], 0.01, atol=3e-3)


def test_without_any_gyro_the_fastest_stream_is_the_reference(tmp_path: Path, capsys: Any) -> None:
    world, topics = World(6), ("/slam", "/vicon/pose", "/odom")
    path = _record("mcap", tmp_path / "log", world, gyro=False, topics=topics)
    found = _td_icp(capsys, path, ",".join(topics))
    assert found.code == 0, found.err
    assert found.out["reference"] == "/vicon/pose"
    shift = {name: TOPICS[name][3] for name in topics}
    for pair in found.out["pairs"]:
        error = pair["timeshift_s"] - (shift[pair["a"]] - shift[pair["b"]])
        assert abs(error) < 5 * pair["timeshift_sigma_s"] < 1e-2


def test_trajectory_files_of_both_kinds_join_a_log(tmp_path: Path, capsys: Any) -> None:
    world = World(7)
    path = _record("mcap", tmp_path / "log", world, topics=("/odom",))
    t, q = world.orientations("/vicon/pose")
    tum, euroc = tmp_path / "vicon.txt", tmp_path / "truth.csv"
    ns = [EPOCH_NS + round(x * 1e9) for x in t]
    tum.write_text(
        "# timestamp tx ty tz qx qy qz qw\n"
        + "\n".join(
            f"{n // 10**9}.{n % 10**9:09d} 0 0 0 {' '.join(map(repr, b.tolist()))}"
            for n, b in zip(ns, q, strict=True)
        )
    )
    t, q = world.orientations("/slam")
    euroc.write_text(
        "#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z\n"
        + "\n".join(
            ",".join(
                map(
                    repr, [EPOCH_NS + round(x * 1e9), 0.0, 0.0, 0.0, *b[[3, 0, 1, 2]].tolist(), 0.0, 0.0, 0.0]
                )
            )
            for x, b in zip(t, q, strict=True)
        )
    )
    found = _td_icp(capsys, path, f"imu0,/odom,{tum},{euroc}")
    assert found.code == 0, found.err
    truth = {"imu0": 0.0, "/odom": 0.25, "vicon.txt": -0.75, "truth.csv": 0.1}
    assert {p["a"] for p in found.out["pairs"]} | {p["b"] for p in found.out["pairs"]} == set(truth)
    for pair in found.out["pairs"]:
        error = pair["timeshift_s"] - (truth[pair["a"]] - truth[pair["b"]])
        assert abs(error) < 4.5 * pair["timeshift_sigma_s"] < 6e-3
    assert main(["td-icp", str(path), str(tum), "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert (pair["a"], pair["b"]) == ("imu0", "vicon.txt")
    assert abs(pair["timeshift_s"] - 0.75) < 4.5 * pair["timeshift_sigma_s"] < 6e-3


def test_what_is_no_orientation_is_said(tmp_path: Path, capsys: Any) -> None:
    path = _record("mcap", tmp_path / "log", World(), topics=("/odom",))
    missing = _td_icp(capsys, path, "imu0,/nothing")
    assert missing.code == 1 and "/odom (nav_msgs/msg/Odometry)" in missing.err
    empty = _td_icp(capsys, path, "imu0,/imu0/data_raw")
    assert empty.code == 1 and "no orientation" in empty.err
    assert len(empty.err.strip().splitlines()) == 1
    stranger = _td_icp(capsys, path, "imu0,radar")
    assert stranger.code == 2 and "radar" in stranger.err


def test_a_second_recording_is_no_sensor(asl_folder, capsys):
    """A folder's path begins with a slash, as topics do."""
    assert main(["td-icp", str(asl_folder), str(asl_folder.parent)]) == 2
    line = capsys.readouterr().err
    assert f"one recording is taken, {asl_folder}; what follows it are its sensors" in line


def test_a_target_file_in_place_of_the_recording_is_named(asl_folder, tmp_path, capsys):
    (tmp_path / "target.yaml").write_text("target_type: checkerboard\n")
    for words in (
        ["td-icp", str(tmp_path / "target.yaml"), str(asl_folder)],
        ["calibrate", str(tmp_path / "target.yaml")],
    ):
        assert main(words) == 1
        assert "target.yaml is no recording: give a target with --target" in capsys.readouterr().err
