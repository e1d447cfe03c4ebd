"""Every format read back by the reader that its tool uses (OpenCV's FileStorage, PyYAML, XML, JSON).

The sign and direction of each is stated here once more, from the tools' own documentation:
Kalibr T_cam_imu and t_imu = t_cam + shift; OpenVINS T_imu_cam (R_CtoI) and t_imu = t_cam + dt;
VINS body_T_cam and image clock + td = imu clock; ORB-SLAM3 T_b_c1 camera to body; Basalt T_imu_cam and
frame.t_ns += cam_time_offset_ns.
"""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from vical_daemon.results.export import FORMATS, ExportError, Rig, export, rig_from_json
from vical_daemon.results.export.kalibr import read_camchain
from vical_daemon.results.export.text import number
from vical_daemon.results.files import read_known_file, read_rig

POINT_CAM = np.array([0.3, -0.2, 1.7])


def point_in_imu(camera):
    return camera.R_imu_cam @ POINT_CAM + camera.p_imu_cam


def apply(T, point):
    return (np.asarray(T) @ np.append(point, 1.0))[:3]


def storage(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    opened = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert opened.isOpened()
    return opened


def sequence(node):
    """Read a (nested) sequence as OpenVINS does, node by node."""
    return [sequence(node.at(i)) if node.at(i).isSeq() else node.at(i).real() for i in range(node.size())]


def files(rig, name):
    return {f.name: f.text for f in export(rig, name)}


def single(rig):
    return replace(rig, cameras={"cam0": rig.cameras["cam0"]})


def test_kalibr_direction_shift_and_chain(rig):
    made = files(rig, "kalibr")
    chain = yaml.safe_load(made["camchain-imucam.yaml"])
    first, second = rig.cameras.values()
    for entry, camera in ((chain["cam0"], first), (chain["cam1"], second)):
        assert apply(entry["T_cam_imu"], point_in_imu(camera)) == pytest.approx(POINT_CAM, abs=1e-10)
        assert entry["timeshift_cam_imu"] == pytest.approx(camera.timeshift_cam_imu_s)
        assert entry["intrinsics"] == pytest.approx(camera.intrinsics)
        assert all(isinstance(v, float) for v in entry["distortion_coeffs"])
    in_first = apply(first.T_cam_imu, point_in_imu(second))
    assert apply(chain["cam1"]["T_cn_cnm1"], in_first) == pytest.approx(POINT_CAM, abs=1e-10)
    imu = yaml.safe_load(made["imu.yaml"])
    assert imu["gyroscope_noise_density"] == pytest.approx(1.7e-4)
    assert imu["accelerometer_random_walk"] == pytest.approx(3.0e-3)
    assert imu["update_rate"] == 200.0


def test_kalibr_comes_back(rig, tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(files(rig, "kalibr")["camchain-imucam.yaml"])
    back = read_camchain(path)
    for camera, read in zip(rig.cameras.values(), back.cameras.values(), strict=True):
        assert read.R_imu_cam == pytest.approx(camera.R_imu_cam, abs=1e-11)
        assert read.p_imu_cam == pytest.approx(camera.p_imu_cam, abs=1e-11)
        assert read.timeshift_cam_imu_s == pytest.approx(camera.timeshift_cam_imu_s)
        assert (read.distortion_model, read.size) == (camera.distortion_model, camera.size)


def test_kalibr_chain_without_second_extrinsics_is_followed(rig, tmp_path):
    document = yaml.safe_load(files(rig, "kalibr")["camchain-imucam.yaml"])
    del document["cam1"]["T_cam_imu"]
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(document))
    second = list(rig.cameras.values())[1]
    assert read_camchain(path).cameras["cam1"].p_imu_cam == pytest.approx(second.p_imu_cam, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"T_cam_imu": [[1, 2], [3, 4]]}, "expected 4 values, found 2"),
        ({"T_cam_imu": np.diag([2.0, 2.0, 2.0, 1.0]).tolist()}, "not a rotation"),
        ({"T_cam_imu": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "not a rotation"),
        ({"T_cam_imu": [[1, 0, 0, 70], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "the unit is m"),
        ({"T_cam_imu": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.1, 0, 0, 1]]}, "last row"),
        ({"T_imu_cam0": np.eye(4).tolist()}, "did you mean T_imu_cam"),
        ({"timeshift_cam_imu": -8121.0}, "below -5; seconds"),
        ({"timeshift_cam_imu": float("nan")}, "must be a finite number"),
        ({"intrinsics": [1, 2]}, "expected 4 values, found 2"),
        ({"intrinsics": [float("nan"), 460.0, 360.0, 240.0]}, "must be a finite number"),
        ({"intrinsics": [-461.0, 460.0, 360.0, 240.0]}, "must be above 0"),
        ({"intrinsics": None}, "cam0 has no intrinsics"),
        ({"distortion_coeffs": None}, "cam0 has no distortion_coeffs"),
        ({"camera_model": "omni"}, "omni"),
        ({"distortion_model": "fov"}, "fov"),
    ],
)
def test_kalibr_mistakes_are_named(rig, tmp_path, change, says):
    document = yaml.safe_load(files(rig, "kalibr")["camchain-imucam.yaml"])
    document["cam0"] |= change
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ExportError, match=says):
        read_camchain(path)


def test_kalibr_lens_without_distortion_and_line_delay(rig, tmp_path):
    document = yaml.safe_load(files(single(rig), "kalibr")["camchain-imucam.yaml"])
    document["cam0"] |= {"distortion_model": "none", "distortion_coeffs": [], "line_delay": 2e-5}
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(document))
    camera = read_camchain(path).cameras["cam0"]
    assert (camera.distortion_model, camera.distortion) == ("radtan", (0.0,) * 4)
    assert camera.readout_s == pytest.approx(2e-5 * camera.size[1])


@pytest.mark.parametrize(
    "value", [{"intrinsics": [float("nan"), 460.0, 360.0, 240.0]}, {"timeshift_cam_imu_s": float("inf")}]
)
def test_a_result_with_numbers_that_are_not_finite_is_refused(rig, value):
    document = json.loads(files(single(rig), "json")["calibration.json"])
    document["cameras"]["cam0"] |= value
    with pytest.raises(ExportError, match=r"cam0: a number of its .* is not finite"):
        rig_from_json(document)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("calib.json", '{"value0": {"T_imu_cam": [{"px": 0}], "cam_time_offset_ns": 0}}', "Basalt's"),
        ("euroc.yaml", '%YAML:1.0\nCamera.type: "PinHole"\nTbc: !!opencv-matrix\n  rows: 4\n', "ORB-SLAM3"),
        ("vins.yaml", "%YAML:1.0\nimu: 1\nbody_T_cam0: !!opencv-matrix\n   rows: 4\n", "VINS-Fusion"),
        ("cam0.yaml", "%YAML:1.0\nmodel_type: PINHOLE\ncamera_name: camera\n", "VINS-Fusion's lens"),
        ("sensor.yaml", "sensor_type: camera\nT_BS:\n  cols: 4\n", "inverse of T_BS"),
        ("cameras.txt", "# Camera list\n1 OPENCV 752 480 461 460 362 246 0 0 0 0\n", "COLMAP's"),
        ("cameras.txt", "1 SIMPLE_RADIAL 752 480 461 362 246 0\n", "COLMAP's"),
        ("rig.urdf", '<?xml version="1.0"?>\n<robot name="rig"/>\n', "URDF"),
        ("results-imucam.txt", "Calibration results\n===================\n", "give the camchain-imucam.yaml"),
        ("calib.xml", '<?xml version="1.0"?>\n<opencv_storage>\n', "OpenCV's FileStorage"),
        ("notes.txt", "fx is 461\n", "not a calibration that vical reads: give a result"),
    ],
)
def test_files_of_other_tools_are_named_with_what_to_try(tmp_path, name, text, says):
    path = tmp_path / name
    path.write_text(text)
    for read in (read_rig, read_known_file):
        with pytest.raises(ExportError, match=says) as refused:
            read(path)
        assert "\n" not in str(refused.value) and str(refused.value).startswith(f"{path}: ")


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("kalibr", "openvins", "json")])
def test_our_own_files_for_other_tools_are_named_when_they_come_back(rig, tmp_path, name):
    for made in export(single(rig), name):
        path = tmp_path / made.name
        path.write_text(made.text)
        with pytest.raises(ExportError, match=r"this is|no transforms in it"):
            read_rig(path)


def test_openvins_reads_camera_to_imu(rig, tmp_path):
    opened = storage(tmp_path, files(rig, "openvins")["kalibr_imucam_chain.yaml"])
    for index, camera in enumerate(rig.cameras.values()):
        node = opened.getNode(f"cam{index}")
        T = sequence(node.getNode("T_imu_cam"))
        assert apply(T, POINT_CAM) == pytest.approx(point_in_imu(camera), abs=1e-10)
        assert node.getNode("timeshift_cam_imu").real() == pytest.approx(camera.timeshift_cam_imu_s)
        assert sequence(node.getNode("intrinsics")) == pytest.approx(camera.intrinsics)
        assert node.getNode("distortion_model").string() == camera.distortion_model
        assert [int(v) for v in sequence(node.getNode("resolution"))] == list(camera.size)


def test_openvins_imu_model_corrects_as_ours(rig, tmp_path):
    opened = storage(tmp_path, files(rig, "openvins")["kalibr_imu_chain.yaml"])  # owns its nodes: keep it
    node = opened.getNode("imu0")
    Tw, Ta = (np.array(sequence(node.getNode(k))) for k in ("Tw", "Ta"))
    R_imu_to_gyro = np.array(sequence(node.getNode("R_IMUtoGYRO")))
    measured = np.array([0.3, -0.7, 1.1])
    # OpenVINS: w = R_GYROtoIMU Dw w_m, a = R_ACCtoIMU Da a_m with D = T^-1, lower triangular.
    assert R_imu_to_gyro.T @ np.linalg.inv(Tw) @ measured == pytest.approx(
        rig.gyro_matrix @ measured, abs=1e-9
    )
    assert np.linalg.inv(Ta) @ measured == pytest.approx(rig.accel_matrix @ measured, abs=1e-9)
    for T in (Tw, Ta):
        assert np.triu(T, 1) == pytest.approx(np.zeros((3, 3)), abs=1e-11)
    assert np.linalg.det(R_imu_to_gyro) == pytest.approx(1.0)
    assert R_imu_to_gyro @ R_imu_to_gyro.T == pytest.approx(np.eye(3), abs=1e-10)
    assert np.diag(Tw) == pytest.approx(np.ones(3), abs=0.01)


def test_vins_body_T_cam_td_and_noise(rig, tmp_path):
    made = files(rig, "vins")
    opened = storage(tmp_path, made["vins.yaml"])
    for index, camera in enumerate(rig.cameras.values()):
        T = opened.getNode(f"body_T_cam{index}").mat()
        assert apply(T, POINT_CAM) == pytest.approx(point_in_imu(camera), abs=1e-10)
    # image clock + td = imu clock
    assert opened.getNode("td").real() == pytest.approx(rig.cameras["cam0"].timeshift_cam_imu_s)
    assert opened.getNode("num_of_cam").real() == 2
    assert opened.getNode("gyr_n").real() == pytest.approx(1.7e-4 * np.sqrt(200))
    pinhole = storage(tmp_path, made["cam0.yaml"])
    assert pinhole.getNode("model_type").string() == "PINHOLE"
    assert pinhole.getNode("projection_parameters").getNode("fx").real() == 458.0
    assert pinhole.getNode("distortion_parameters").getNode("p2").real() == pytest.approx(1.76187114e-05)
    fisheye = storage(tmp_path, made["cam1.yaml"])
    assert fisheye.getNode("model_type").string() == "KANNALA_BRANDT"
    assert fisheye.getNode("projection_parameters").getNode("k2").real() == pytest.approx(0.0035)
    assert fisheye.getNode("projection_parameters").getNode("mu").real() == pytest.approx(190.97)


def test_orbslam3_reads_reals_where_it_insists_on_them(rig, tmp_path):
    opened = storage(tmp_path, files(single(rig), "orbslam3")["settings.yaml"])
    T = opened.getNode("IMU.T_b_c1").mat()
    assert T.dtype == np.float32
    assert apply(T, POINT_CAM) == pytest.approx(point_in_imu(rig.cameras["cam0"]), abs=1e-6)
    assert opened.getNode("Camera.type").string() == "PinHole"
    for key in ("Camera1.fx", "Camera1.p2", "IMU.NoiseGyro", "IMU.Frequency", "ORBextractor.scaleFactor"):
        assert opened.getNode(key).isReal(), key  # readParameter<float> exits on an integer
    for key in ("Camera.width", "Camera.fps", "Camera.RGB", "ORBextractor.nFeatures"):
        assert opened.getNode(key).isInt(), key
    assert opened.getNode("IMU.NoiseAcc").real() == pytest.approx(2.0e-3)


def test_orbslam3_fisheye(rig, tmp_path):
    alone = replace(rig, cameras={"left": rig.cameras["left"]})
    opened = storage(tmp_path, files(alone, "orbslam3")["settings.yaml"])
    assert opened.getNode("Camera.type").string() == "KannalaBrandt8"
    assert opened.getNode("Camera1.k4").real() == pytest.approx(0.0002)


def test_opencv_file_projects_like_the_camera(rig, tmp_path):
    camera = rig.cameras["cam0"]
    opened = storage(tmp_path, files(single(rig), "opencv")["camera.yaml"])
    K, D = opened.getNode("camera_matrix").mat(), opened.getNode("distortion_coefficients").mat()
    uv = cv2.projectPoints(POINT_CAM[None, None], np.zeros(3), np.zeros(3), K, D)[0].ravel()
    x, y = POINT_CAM[:2] / POINT_CAM[2]
    r2, (k1, k2, p1, p2) = x * x + y * y, camera.distortion
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    fx, fy, cx, cy = camera.intrinsics
    assert uv == pytest.approx([fx * xd + cx, fy * yd + cy], abs=1e-6)
    assert apply(opened.getNode("T_imu_cam").mat(), POINT_CAM) == pytest.approx(
        point_in_imu(camera), abs=1e-10
    )


FIVE = (-0.32, 0.15, 1e-4, 5e-5, -0.04)


def test_a_fifth_coefficient_goes_where_there_is_a_place_for_it(rig, tmp_path):
    camera = replace(rig.cameras["cam0"], distortion_model="plumb_bob", distortion=FIVE)
    rig = replace(rig, cameras={"cam0": camera})
    info = yaml.safe_load(files(rig, "ros")["cam0.yaml"])
    assert info["distortion_model"] == "plumb_bob"
    assert info["distortion_coefficients"]["data"] == pytest.approx(FIVE)
    opened = storage(tmp_path, files(rig, "opencv")["camera.yaml"])
    assert opened.getNode("distortion_coefficients").mat().ravel() == pytest.approx(FIVE)
    opened = storage(tmp_path, files(rig, "orbslam3")["settings.yaml"])
    assert opened.getNode("Camera1.k3").real() == pytest.approx(-0.04)
    basalt = json.loads(files(rig, "basalt")["calibration.json"])["value0"]["intrinsics"][0]
    assert basalt["camera_type"] == "pinhole-radtan8"
    assert [basalt["intrinsics"][k] for k in ("k1", "p2", "k3", "k4")] == pytest.approx(
        [-0.32, 5e-5, -0.04, 0]
    )
    again = rig_from_json(json.loads(files(rig, "json")["calibration.json"]))
    assert again.cameras["cam0"].distortion == pytest.approx(FIVE)
    for name in ("kalibr", "openvins", "vins"):
        with pytest.raises(
            ExportError, match=f"cam0: {name} has no place for plumb_bob's k3; calibrate with"
        ):
            files(rig, name)


def test_ros_camera_info_has_what_the_parser_asks_for(rig):
    made = files(rig, "ros")
    info = yaml.safe_load(made["cam0.yaml"])
    assert (info["image_width"], info["image_height"], info["camera_name"]) == (752, 480, "cam0")
    assert info["distortion_model"] == "plumb_bob"
    for key, shape in (
        ("camera_matrix", (3, 3)),
        ("distortion_coefficients", (1, 5)),
        ("rectification_matrix", (3, 3)),
        ("projection_matrix", (3, 4)),
    ):
        assert (info[key]["rows"], info[key]["cols"]) == shape
        assert len(info[key]["data"]) == shape[0] * shape[1]
    assert info["camera_matrix"]["data"][2] == pytest.approx(367.215)
    fisheye = yaml.safe_load(made["left.yaml"])
    assert fisheye["distortion_model"] == "equidistant"
    assert len(fisheye["distortion_coefficients"]["data"]) == 4
    words = next(
        line for line in made["cam0.yaml"].splitlines() if "static_transform_publisher" in line
    ).split()
    quaternion = [float(words[words.index(f"--{k}") + 1]) for k in ("qx", "qy", "qz", "qw")]
    R = Rotation.from_quat(quaternion).as_matrix()
    assert np.allclose(R, rig.cameras["cam0"].R_imu_cam, atol=1e-9)
    assert words[words.index("--frame-id") + 1] == "imu"


def test_urdf_joint_places_the_camera(rig):
    root = ET.fromstring(files(rig, "urdf")["rig.urdf"])
    joints = root.findall("joint")
    assert len(joints) == 2
    for joint, camera in zip(joints, rig.cameras.values(), strict=True):
        origin = joint.find("origin")
        roll, pitch, yaw = (float(v) for v in origin.get("rpy").split())
        R = (
            Rotation.from_rotvec([0, 0, yaw])
            * Rotation.from_rotvec([0, pitch, 0])
            * Rotation.from_rotvec([roll, 0, 0])
        ).as_matrix()
        xyz = np.array([float(v) for v in origin.get("xyz").split()])
        assert R @ POINT_CAM + xyz == pytest.approx(point_in_imu(camera), abs=1e-9)
        assert joint.find("parent").get("link") == "imu"


def test_ros_and_urdf_name_the_frames_as_the_bus_does(rig):
    named = replace(rig, imu_frame="imu0")
    joints = ET.fromstring(files(named, "urdf")["rig.urdf"]).findall("joint")
    urdf = {(j.find("parent").get("link"), j.find("child").get("link")) for j in joints}
    ros = set()
    for text in files(named, "ros").values():
        words = next(line for line in text.splitlines() if "static_transform_publisher" in line).split()
        ros.add((words[words.index("--frame-id") + 1], words[words.index("--child-frame-id") + 1]))
    assert urdf == ros == {("imu0", "cam0"), ("imu0", "left")}


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_every_file_says_how_good_it_is(rig, name):
    rig = rig if name not in ("opencv", "orbslam3") else single(rig)
    for file in export(rig, name):
        text = file.text.replace("\\", "")
        for needed in ("converging", "2014-05-13 16:53:20 UTC", "6223-00042", "0.02 ms"):
            if name == "json":
                continue
            assert needed in text, (file.name, needed)
    back = rig_from_json(json.loads(export(rig, "json")[0].text))
    assert (back.status, back.reason, back.t_ns, back.devices) == (
        rig.status, rig.reason, rig.t_ns, rig.devices,
    )  # fmt: skip
    assert back.header == rig.header


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_what_the_motion_did_not_determine_needs_force(rig, name):
    camera = replace(rig.cameras["cam0"], unobservable=("lever arm along the optical axis",))
    rig = replace(rig, cameras={"cam0": camera})
    if name == "json":  # names its format itself
        assert json.loads(export(rig, name)[0].text)["cameras"]["cam0"]["unobservable"]
        return
    with pytest.raises(ExportError, match=r"cam0: lever arm along the optical axis.*--force"):
        export(rig, name)
    for file in export(rig, name, force=True):
        assert "NOT DETERMINED by the motion: lever arm along the optical axis" in file.text


def test_basalt_direction_offset_and_bias_form(rig):
    value = json.loads(files(rig, "basalt")["calibration.json"])["value0"]
    for pose, camera in zip(value["T_imu_cam"], rig.cameras.values(), strict=True):
        R = Rotation.from_quat([pose[k] for k in ("qx", "qy", "qz", "qw")]).as_matrix()
        p = np.array([pose[k] for k in ("px", "py", "pz")])
        assert R @ POINT_CAM + p == pytest.approx(point_in_imu(camera), abs=1e-9)
    assert value["cam_time_offset_ns"] == -5_120_000  # frame.t_ns += offset
    assert [i["camera_type"] for i in value["intrinsics"]] == ["pinhole-radtan8", "kb4"]
    assert value["resolution"] == [[752, 480], [512, 512]]
    measured = np.array([0.3, -9.7, 1.1])
    full = value["calib_accel_bias"]
    scale = np.array([[full[3], 0, 0], [full[4], full[6], 0], [full[5], full[7], full[8]]])
    corrected = (np.eye(3) + scale) @ measured - full[:3]
    assert corrected == pytest.approx(rig.accel_matrix @ (measured - rig.accel_bias_mps2), abs=1e-12)
    full = np.array(value["calib_gyro_bias"])
    corrected = (np.eye(3) + full[3:].reshape(3, 3).T) @ measured - full[:3]
    assert corrected == pytest.approx(rig.gyro_matrix @ (measured - rig.gyro_bias_rps), abs=1e-12)
    # The keys of Basalt's own data/euroc_ds_calib.json, without its motion-capture ones.
    assert set(value) == {
        "T_imu_cam", "intrinsics", "resolution", "calib_accel_bias", "calib_gyro_bias", "imu_update_rate",
        "accel_noise_std", "gyro_noise_std", "accel_bias_std", "gyro_bias_std", "cam_time_offset_ns",
        "vignette",
    }  # fmt: skip


def test_json_comes_back(rig):
    back = rig_from_json(json.loads(files(rig, "json")["calibration.json"]))
    for name, camera in rig.cameras.items():
        assert back.cameras[name].T_imu_cam == pytest.approx(camera.T_imu_cam, abs=1e-12)
        assert back.cameras[name].size == camera.size
    assert back.noise == rig.noise
    assert back.gyro_matrix == pytest.approx(rig.gyro_matrix)


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_every_format_says_what_is_missing(rig, name):
    bare = replace(rig.cameras["cam0"], resolution=None)
    if name in ("json", "urdf"):
        assert export(Rig({"cam0": bare}), name)
    else:
        with pytest.raises(ExportError, match="--resolution"):
            export(Rig({"cam0": bare}), name)
    with pytest.raises(ExportError, match="no solution yet"):
        export(Rig({}), name)


def test_single_camera_formats_ask_which(rig):
    for name in ("orbslam3", "opencv"):
        with pytest.raises(ExportError, match="--camera"):
            export(rig, name)
    with pytest.raises(ExportError, match="none of"):
        export(rig, "matlab")


def test_result_mistakes_are_named():
    with pytest.raises(ExportError, match="cameras"):
        rig_from_json({"status": "waiting"})
    with pytest.raises(ExportError, match="intrinsics"):
        rig_from_json({"cameras": {"c": {"T_imu_cam": {"p_m": [0, 0, 0], "q_wxyz": [1, 0, 0, 0]}}}})


@pytest.mark.parametrize("value", [1e-5, 458, 0.0, -3.2e-17, 1e20, 123456.789])
def test_numbers_are_numbers_to_pyyaml(value):
    read = yaml.safe_load(number(value))
    assert isinstance(read, float)
    assert read == pytest.approx(value, rel=1e-11)
