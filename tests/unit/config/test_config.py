# ruff: noqa: E501  (a table of refusals reads best with one refusal a line)
"""The settings file: every refusal names path, bound, file and line; hostile YAML does no harm."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vical_daemon import config as module
from vical_daemon.config.model import Config, ConfigError, load, loads
from vical_daemon.config.priors import calibration_options, camera_prior, read_initial
from vical_daemon.config.strict_yaml import parse

EXAMPLE = Path(__file__).parents[3] / "examples" / "vical.yaml"
SHARED = Path(__file__).parents[4] / "shared" / "data" / "euroc_imu_april"

RIG = """\
rig: rover
imus:
  imu0:
    port: /dev/ttyUSB0
    rate_hz: 100
cameras:
  cam0:
    uri: v4l2:/dev/video0
    lens:
      intrinsics: [458.6, 457.3, 320.5, 240.0]
target: board.yaml
"""


def test_the_example_shows_every_key_and_only_defaults() -> None:
    config = load(EXAMPLE)
    assert config.imus["imu0"].rate_hz == 500 and config.cameras["cam0"].size == (640, 480)
    minimal = loads(
        "imus: {imu0: {port: /dev/vical/imu-SERIAL}}\ncameras: {cam0: {uri: 'v4l2:/dev/video0'}}\ntarget: target.yaml"
    )
    assert [getattr(config, f) for f in Config.__slots__ if f != "path"] == [
        getattr(minimal, f) for f in Config.__slots__ if f != "path"
    ]


def test_the_example_mentions_every_key_of_the_schema() -> None:
    text = EXAMPLE.read_text()
    for name in dir(module):
        kind = getattr(module, name)
        if name.endswith("Config") and dataclasses.is_dataclass(kind):
            for field in dataclasses.fields(kind):
                if not field.metadata.get("hidden"):
                    assert f"{field.name}:" in text, f"{name}.{field.name} is not in examples/vical.yaml"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rate_hz: 100", "rate_hz: 1500", "imus.imu0.rate_hz: 1500 is above 1000 (config line 5)"),
        ("rate_hz: 100", "rate_hz: 0", "imus.imu0.rate_hz: 0 is below 1 (config line 5)"),
        ("rate_hz: 100", "rate_hz: fast", "imus.imu0.rate_hz: expected a number, found the text 'fast' (config line 5)"),
        ("rate_hz: 100", "rate_hz: .nan", "imus.imu0.rate_hz: must be a finite number (config line 5)"),
        ("rate_hz: 100", "rate_hz: true", "imus.imu0.rate_hz: expected a number, found true (config line 5)"),
        ("rate_hz: 100", "rate_hz:", "imus.imu0.rate_hz: expected a number, found nothing (config line 5)"),
        ("rate_hz: 100", "rate_hz: 300", "imus.imu0.rate_hz: 300 is not 1000/n; the device can do 250 or 333.33 (config line 5)"),
        ("rate_hz: 100", "rate: 100", "imus.imu0.rate: unknown key; did you mean rate_hz? (config line 5)"),
        ("rate_hz: 100", "rate_hz: 12:30", "imus.imu0.rate_hz: 12:30 would be read as base 60; write a plain number or quote it (config line 5)"),
        ("rate_hz: 100", "rate_hz: 0100", "imus.imu0.rate_hz: 0100 would be read as octal; drop the leading zero or quote it (config line 5)"),
        ("rate_hz: 100", "port: /dev/ttyUSB1", "imus.imu0.port: given twice (config line 5)"),
        ("rate_hz: 100", "baud: 57600", "imus.imu0.baud: the number 57600 is none of 115200, 230400, 460800, 921600 (config line 5)"),
        ("rate_hz: 100", "link: rs232", "imus.imu0.link: the text 'rs232' is none of auto, usb, ftdi, uart (config line 5)"),
        ("    port: /dev/ttyUSB0\n", "", "imus.imu0.port: missing (config line 3)"),
        ("rig: rover", "rig: ../etc", "rig: '../etc' is not accepted; letters, digits and _, begin with a letter, at most 63 (config line 1)"),
        ("cam0:", "Cam/0:", "cameras.Cam/0: 'Cam/0' is not accepted; letters, digits and _, begin with a letter, at most 63 (config line 7)"),
        ("[458.6, 457.3, 320.5, 240.0]", "[458.6, 457.3, 320.5]", "cameras.cam0.lens.intrinsics: expected 4 values, found 3 (config line 10)"),
        ("[458.6, 457.3, 320.5, 240.0]", "[458.6, -1, 320.5, 2]", "cameras.cam0.lens.intrinsics.1: -1 must be above 0 (config line 10)"),
        ("[458.6, 457.3, 320.5, 240.0]", "[458.6, 457.3, 240.0, 620]", "cameras.cam0.lens.intrinsics: the principal point y = 620 lies outside 0..480 (config line 10)"),
        ("lens:\n", "lens:\n      distortion_model: fov\n", "cameras.cam0.lens.distortion_model: the text 'fov' is none of radtan, plumb_bob, equidistant (config line 10)"),
        ("lens:\n", "lens:\n      distortion_coeffs: [0, 0, 0]\n", "cameras.cam0.lens.distortion_coeffs: expected 4 values (k1 k2 p1 p2 of radtan), found 3 (config line 10)"),
        ("lens:\n", "lens:\n      distortion_model: plumb_bob\n      distortion_coeffs: [0, 0, 0, 0]\n", "cameras.cam0.lens.distortion_coeffs: expected 5 values (k1 k2 p1 p2 k3 of plumb_bob), found 4 (config line 11)"),
        ("lens:\n", "lens:\n      distortion_sigma: [0.1]\n", "cameras.cam0.lens.distortion_sigma: expected 4 values (k1 k2 p1 p2 of radtan), found 1 (config line 10)"),
        ("lens:\n", "lens:\n      intrinsics_sigma: [-1, 1, 1, 1]\n", "cameras.cam0.lens.intrinsics_sigma.0: -1 is below 0 (config line 10)"),
        ("lens:\n", "lens:\n      T_cam_imu: [[1,0,0,0],[0,1,0,0],[0,0,2,0],[0,0,0,1]]\n", "cameras.cam0.lens.T_cam_imu: the upper left 3x3 block is not a rotation (config line 10)"),
        ("target: board.yaml", "calibration: {}", "calibration.mode: target needs `target: FILE` (`vical target` makes one), or mode: target_free (config line 11)"),
        ("target: board.yaml", "target: b.yaml\ncalibration: {fix: [extrinsics]}", "cameras.cam0.lens: calibration.fix holds extrinsics, so T_cam_imu must be given here (config line 9)"),
        ("target: board.yaml", "target: b.yaml\ncalibration: {fix: [lens]}", "calibration.fix.0: the text 'lens' is none of intrinsics, timeshift, extrinsics (config line 12)"),
        ("target: board.yaml", "target: b.yaml\ncalibration: {imu: imu1}", "calibration.imu: there is no IMU imu1 (known: imu0) (config line 12)"),
        ("target: board.yaml", "target: b.yaml\nbus: {commanders: [anna]}", "bus.commanders: clients cannot prove such a name; set password_file, or tls_ca and tls_certificate (config line 12)"),
        ("target: board.yaml", "target: b.yaml\nbus: {publishers: [anna], tls_ca: ca.pem}", "bus.publishers: clients cannot prove such a name; set password_file, or tls_ca and tls_certificate (config line 12)"),
        ("target: board.yaml", "target: b.yaml\nbus: {readers: everybody}", "bus.readers: the text 'everybody' is none of group, loopback (config line 12)"),
        ("target: board.yaml", "target: b.yaml\nweb: {hosts: ['http://a/']}", "web.hosts.0: 'http://a/' is not accepted; a name without port (config line 12)"),
        ("target: board.yaml", "target: 5", "target: expected text, found the number 5; put it in quotes (config line 11)"),
        ("imus:\n", "imus: [1]\nx:\n", "imus: expected a section, found a list of 1 (config line 2)"),
    ],
)  # fmt: skip
def test_refusals_name_path_bound_and_line(old: str, new: str, message: str) -> None:
    assert loads(RIG).imus["imu0"].rate_hz == 100
    assert old in RIG
    with pytest.raises(ConfigError) as refused:
        loads(RIG.replace(old, new, 1))
    assert str(refused.value) == message
    assert refused.value.exit_code == 2


@pytest.mark.parametrize(
    ("text", "port"),
    [
        ("", 0),
        ("bus: {readers: group}", 0),
        ("bus: {readers: loopback}", 7447),
        ("bus: {readers: loopback, tcp_port: 7448}", 7448),
        ("bus: {tcp_port: 7448}", 7448),
        ("bus: {publishers: [feeder], password_file: users.txt}", 0),
    ],
)
def test_the_bus_is_on_loopback_only_where_the_config_asks_for_it(text: str, port: int) -> None:
    assert loads(f"rig: rover\n{text}").bus.loopback_port == port


def test_all_problems_are_found_at_once() -> None:
    with pytest.raises(ConfigError) as refused:
        loads("rgi: a\nweb: {port: 70000, host: 1}\nrecord: {rotate_s: 0}")
    assert [p.split(":")[0] for p in refused.value.problems] == [
        "rgi",
        "web.port",
        "web.host",
        "record.rotate_s",
    ]


def test_scientific_notation_is_the_number_it_means() -> None:
    text = RIG.replace("rate_hz: 100", "noise: {gyro_density: 1e-3, accel_density: 2E-3, gyro_walk: +1.5e-5}")
    noise = loads(text).imus["imu0"].noise
    assert (noise.gyro_density, noise.accel_density, noise.gyro_walk) == (1e-3, 2e-3, 1.5e-5)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("a: &x [1]\nb: *x", "aliases"),
        ('a: "x\\0y"', "a: a zero byte"),
        ("- 1\n- 2", "expected `key: value` lines"),
        ("a: [1", "not valid YAML"),
        ("a:\n\tb: 1", "not valid YAML: a tab; indent with spaces"),
        ("a: !!python/object/apply:os.system [true]", "expected"),
        ("a: !!python/name:os.system x", "tag"),
        ("[" * 5000, "nested too deeply"),
        ("a: \x00", "special characters"),
        ("? [1]\n: 2", "a key must be a plain word"),
        ("a: 1\n---\nb: 2", "not valid YAML"),
    ],
)
def test_hostile_yaml_is_one_line(text: str, part: str) -> None:
    with pytest.raises(ConfigError) as refused:
        loads(text)
    assert "\n" not in str(refused.value)
    assert part in str(refused.value) or "unknown key" in str(refused.value)


def test_an_alias_bomb_costs_nothing() -> None:
    bomb = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30))
    begin = time.perf_counter()
    with pytest.raises(ConfigError, match="aliases"):
        parse(bomb, "bomb")
    assert time.perf_counter() - begin < 1.0


@settings(max_examples=60, deadline=None)
@given(st.text(alphabet=st.sampled_from("ab:-[]{}&*!?|>'\"%@`#,\n 01.eE+~\t\\"), max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    outcome: Config | str
    try:
        outcome = loads(text)
    except ConfigError as error:
        outcome = str(error)
    assert isinstance(outcome, Config) or ("config" in outcome and len(outcome.splitlines()) == 1)


def test_missing_binary_and_huge_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"(?i)no such file"):
        load(tmp_path / "none.yaml")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ConfigError, match="not a text file"):
        load(tmp_path / "b.yaml")
    (tmp_path / "big.yaml").write_text("a: " + "x" * 250_001)
    with pytest.raises(ConfigError, match="larger than"):
        load(tmp_path / "big.yaml")


def test_target_is_relative_to_the_settings(tmp_path: Path) -> None:
    (tmp_path / "v.yaml").write_text(RIG)
    assert load(tmp_path / "v.yaml").target_path == tmp_path / "board.yaml"


def test_estimator_settings_from_the_config() -> None:
    pose = "[[0,0,1,0.5],[-1,0,0,0.25],[0,-1,0,0],[0,0,0,1]]"
    config = loads(
        RIG.replace("lens:\n", f"lens:\n      T_cam_imu: {pose}\n      timeshift_cam_imu: 1e-2\n")
        + "calibration: {fix: [intrinsics], estimate: [readout], corner_sigma_px: 0.3,\n"
        "  convergence: {position_sigma_m: 2e-3, rotation_sigma_deg: 0.05}}\n"
    )
    prior = camera_prior(config, "cam0")
    assert prior.T_imu_cam is not None
    R_imu_cam, p_imu_cam = prior.T_imu_cam
    T_cam_imu = np.eye(4)
    T_cam_imu[:3, :3], T_cam_imu[:3, 3] = R_imu_cam.T, -R_imu_cam.T @ p_imu_cam
    np.testing.assert_allclose(
        T_cam_imu, [[0, 0, 1, 0.5], [-1, 0, 0, 0.25], [0, -1, 0, 0], [0, 0, 0, 1]], atol=1e-12
    )
    assert prior.timeshift_cam_imu_s == 0.01 and prior.resolution == (640, 480)
    options = calibration_options(config)
    assert (
        options.fix == {"intrinsics"} and options.estimate == {"readout"} and options.corner_sigma_px == 0.3
    )
    assert (options.targets.position_m, options.targets.timeshift_s) == (0.002, 5e-4)
    assert options.targets.rotation_rad == pytest.approx(np.deg2rad(0.05))
    assert options.imu_noise.rate_hz == 100 and not options.target_free


class TestInitial:
    def read(self, tmp_path: Path, text: str):
        path = tmp_path / "initial.yaml"
        path.write_text(text)
        return read_initial(path)

    def test_kalibr_camchain_with_everything(self, tmp_path: Path) -> None:
        initial = self.read(
            tmp_path,
            "cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]\n"
            "  distortion_model: equidistant\n  intrinsics: [1, 2, 3, 4]\n  resolution: [640, 400]\n"
            "  rostopic: /cam0/image_raw\n  timeshift_cam_imu: -0.012\n  line_delay: 2.5e-5\n"
            "  intrinsics_sigma: [0.5, 0.6, 0.7, 0.8]\n  distortion_sigma: [0.01, 0.02, 0.0, 0.0]\n"
            "cam1: {T_cn_cnm1: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], distortion_model: none, distortion_coeffs: []}\n",
        )
        cam0 = initial.cameras["cam0"]
        assert cam0.distortion == (0.1, 0.2, 0.3, 0.4) and cam0.distortion_model == "equidistant"
        assert cam0.intrinsics_sigma == (0.5, 0.6, 0.7, 0.8)
        assert cam0.distortion_sigma == (0.01, 0.02, 0.0, 0.0)
        assert cam0.readout_s == pytest.approx(0.01) and cam0.timeshift_cam_imu_s == -0.012
        assert initial.cameras["cam1"].distortion is None and initial.imu_noise is None

    def test_openvins_files(self, tmp_path: Path) -> None:
        """OpenCV's first line, the inverse of Kalibr's pose, and matrices of the IMU."""
        rows = "[[0, 0, 1, 0.5], [-1, 0, 0, 0.25], [0, -1, 0, 0.125], [0, 0, 0, 1]]"
        camera = self.read(tmp_path, f"%YAML:1.0\n\ncam0:\n  T_imu_cam: {rows}\n  camera_model: pinhole\n")
        R_imu_cam, p_imu_cam = camera.cameras["cam0"].T_imu_cam or (None, None)
        assert p_imu_cam is not None and p_imu_cam.tolist() == [0.5, 0.25, 0.125]
        np.testing.assert_allclose(R_imu_cam, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)
        text = "%YAML:1.0\n\nimu0:\n  gyroscope_noise_density: 2e-4\n  Tw: [[1, 0], [0, 1]]\n  R_IMUtoGYRO: [[1]]\n"
        noise = self.read(tmp_path, text).imu_noise
        assert noise is not None and noise.gyro_density == 2e-4
        both = f"cam0: {{T_imu_cam: {rows}, T_cam_imu: {rows}}}\n"
        with pytest.raises(ConfigError, match=r"cam0\.T_imu_cam: T_cam_imu is given, too.* line 1"):
            self.read(tmp_path, both)

    def test_a_camera_without_a_pose_is_placed_by_the_one_before(self, tmp_path: Path) -> None:
        """T_cn_cnm1 maps points of the camera before into this one; PyYAML's files have cam10 before cam9."""
        text = (
            "cam10: {T_cn_cnm1: [[1,0,0,0],[0,1,0,0.5],[0,0,1,0],[0,0,0,1]]}\n"
            "cam8: {T_cam_imu: [[0,1,0,0.1],[-1,0,0,0.2],[0,0,1,0.3],[0,0,0,1]]}\n"
            "cam9: {T_cn_cnm1: [[0,0,1,0.25],[0,1,0,0],[-1,0,0,0],[0,0,0,1]]}\n"
        )
        cameras = self.read(tmp_path, text).cameras
        point = np.array([0.7, -0.3, 2.0])  # in the imu frame; by hand, from camera to camera:
        in_8 = np.array([point[1] + 0.1, -point[0] + 0.2, point[2] + 0.3])
        in_9 = np.array([in_8[2] + 0.25, in_8[1], -in_8[0]])
        in_10 = np.array([in_9[0], in_9[1] + 0.5, in_9[2]])
        for name, expected in (("cam8", in_8), ("cam9", in_9), ("cam10", in_10)):
            R_imu_cam, p_imu_cam = cameras[name].T_imu_cam or (None, None)
            assert R_imu_cam is not None and p_imu_cam is not None
            np.testing.assert_allclose(R_imu_cam @ expected + p_imu_cam, point, atol=1e-12)

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ('{"t_ns": 5, "cameras": {}}', "a result of vical; `vical export .*initial.yaml --format kalibr"),
            ("image_width: 752\ncamera_matrix:\n  rows: 3\n", "a file of ROS; .* Kalibr's form"),
            ("sensor_type: camera\nT_BS: {cols: 4}\n", "EuRoC's sensor.yaml"),
            ("target_type: aprilgrid\ntagCols: 6\n", "a target file; give it with --target"),
            (
                '%YAML:1.0\nuse_fej: true\nrelative_config_imucam: "a.yaml"\n',
                r"OpenVINS's .* give the kalibr_imu",
            ),
            ("%YAML:1.0\ncameras:\n     - {T_SC:\n        [1, 0]}\n", "a camera file of OKVIS or maplab"),
            ("label: rig\ncameras:\n- camera:\n    label: c\n", "a camera file of OKVIS or maplab"),
            ("rig: rover\ncameras: {cam0: {uri: x}}\n", "a config of vical; .*`cam0: {intrinsics"),
        ],
    )
    def test_files_of_other_tools_are_named(self, tmp_path: Path, text: str, says: str) -> None:
        with pytest.raises(ConfigError, match=says):
            self.read(tmp_path, text)

    def test_kalibr_imu_yaml_at_the_top_level(self, tmp_path: Path) -> None:
        initial = self.read(
            tmp_path,
            "accelerometer_noise_density: 2e-3\naccelerometer_random_walk: 3e-3\ngyroscope_noise_density: 1.7e-4\n"
            "gyroscope_random_walk: 1.9e-5\nrostopic: /imu0\nupdate_rate: 200.0\n",
        )
        assert initial.imu_noise is not None
        assert (initial.imu_noise.accel_density, initial.imu_rate_hz) == (2e-3, 200.0)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("cam0: {distorsion_coeffs: [1]}", "did you mean distortion_coeffs"),
            (
                "cam0: {distortion_coeffs: [1, 2, 3, 4, 5]}",
                r"expected 4 values \(k1 k2 p1 p2 of radtan\), found 5; the model with these is plumb_bob",
            ),
            ("cam0: {T_cam_imu: [1, 0, 0, 0]}", r"T_cam_imu.0: expected a list like"),
            (
                f"cam0: {{T_cam_imu: {[0] * 16}}}",
                r"T_cam_imu: expected 4 values, found 16: each must be a list like",
            ),
            ("cam0: {distortion_sigma: [1]}", r"distortion_sigma: expected 4 values"),
            ("cam0: {camera_model: fisheye}", "is not pinhole"),
            (
                "cam0: {camera_model: omni, intrinsics: [1.2, 500, 500, 320, 240]}",
                "calibrate as pinhole-equi",
            ),
            ("camera: {}\nlidar0: {}", "unknown section"),
            ("cam0: 5", "unknown key"),
            ("imu0: {gyroscope_noise_density: -1}", "must be above 0"),
        ],
    )
    def test_mistakes_are_one_line(self, tmp_path: Path, text: str, message: str) -> None:
        with pytest.raises(ConfigError, match=message) as refused:
            self.read(tmp_path, text)
        assert "\n" not in str(refused.value) and "initial.yaml" in str(refused.value)

    def test_the_shared_files(self) -> None:
        if not SHARED.is_dir():
            pytest.skip(f"shared data absent: {SHARED}")
        reference = read_initial(SHARED / "reference_kalibr.yaml").cameras["cam0"]
        assert reference.T_imu_cam is not None
        np.testing.assert_allclose(reference.T_imu_cam[1], [-0.01753, -0.06850, 0.00430], atol=1e-5)
        initial = read_initial(SHARED / "initial.yaml")
        assert initial.cameras["cam0"].resolution == (752, 480) and initial.imu_rate_hz == 200


def test_devices_that_are_files_lie_beside_the_settings_file(tmp_path: Path) -> None:
    (tmp_path / "vical.yaml").write_text(
        "imus: {imu0: {port: 'log:run.mcap#imu1', rate_hz: 208}}\n"
        "cameras: {cam0: {uri: 'folder:mav0/cam0'}, cam1: {uri: 'log:/data/run.mcap'}, cam2: {uri: emulated}}\n"
        "target: target.yaml\n"
    )
    config = load(tmp_path / "vical.yaml")
    assert config.imus["imu0"].port == f"log:{tmp_path}/run.mcap#imu1"
    uris = [camera.uri for camera in config.cameras.values()]
    assert uris == [f"folder:{tmp_path}/mav0/cam0", "log:/data/run.mcap", "emulated"]
