"""A ROS rig: a chain of frames made with scipy, read as `ros2 topic echo` prints it, and from logs."""

import numpy as np
import pytest
import yaml
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from vical_daemon.bus.messages import Transform, encode_camera_info, encode_transforms
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.offline.sources import read_known
from vical_daemon.results.export import ExportError, export

K = [458.0, 0.0, 367.2, 0.0, 457.3, 248.4, 0.0, 0.0, 1.0]
D = [-0.28, 0.074, 2e-4, 1.8e-5, 0.0]
BASE_IMU = Rotation.from_rotvec([0.1, -0.2, 0.3]), np.array([0.1, 0.0, 0.2])
BASE_MAST = Rotation.from_rotvec([0.0, 0.0, 1.5]), np.array([0.0, -0.3, 0.9])
MAST_CAM = Rotation.from_rotvec([-1.6, 0.1, 0.0]), np.array([0.02, 0.03, 0.04])
CHAIN = [
    ("base_link", "imu_link", BASE_IMU),
    ("base_link", "mast", BASE_MAST),
    ("mast", "cam_optical", MAST_CAM),
]
POINT_CAM = np.array([0.3, -0.2, 1.7])


def point_in_imu():
    """By the definition of tf2: p_parent = R p_child + t, from frame to frame."""
    point = POINT_CAM
    for R, p in (MAST_CAM, BASE_MAST):
        point = R.apply(point) + p
    return BASE_IMU[0].inv().apply(point - BASE_IMU[1])


def tf_document(chain=CHAIN):
    entries = []
    for parent, child, (R, p) in chain:
        q, t = (
            dict(zip(axes, map(float, v), strict=True)) for axes, v in (("xyzw", R.as_quat()), ("xyz", p))
        )
        entries.append(
            {
                "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": parent},
                "child_frame_id": child,
                "transform": {"translation": t, "rotation": q},
            }
        )
    return {"transforms": entries}


def info_document(**changes):
    header = {"stamp": {"sec": 17, "nanosec": 5}, "frame_id": "cam_optical"}
    info = {"header": header, "height": 480, "width": 752, "distortion_model": "plumb_bob", "d": D, "k": K}
    return info | changes


def write(tmp_path, *documents):
    path = tmp_path / "ros.yaml"
    path.write_text("---\n".join(yaml.safe_dump(d) for d in documents) + "---\n")
    return str(path)


def seen(camera):
    """A point of the camera in the imu's frame, lens, model and image size."""
    point = camera.R_imu_cam @ POINT_CAM + camera.p_imu_cam
    return [*point, *camera.lens], (camera.model, camera.resolution)


def expected():
    return pytest.approx([*point_in_imu(), 458.0, 457.3, 367.2, 248.4, *D[:4]]), ("radtan", (752, 480))


def test_echoed_messages_in_one_file(tmp_path):
    known, rig = read_known(write(tmp_path, tf_document(), info_document()))
    assert seen(known["cam_optical"]) == expected()
    assert "no sigma given" in known["cam_optical"].notes[0]
    assert rig.imu_frame == "imu_link"


def test_a_file_of_camera_info_manager_with_a_transform_and_a_time_shift(tmp_path, rig):
    text = next(f.text for f in export(rig, "ros") if f.name == "cam0.yaml")
    camera = rig.cameras["cam0"]
    pose = Rotation.from_matrix(camera.R_imu_cam), camera.p_imu_cam
    loose = {"imu_frame": "body", "timeshift_cam_imu": 0.0125}
    path = write(tmp_path, yaml.safe_load(text), tf_document([("body", "eye", pose)]), loose)
    (found,) = read_known(path)[0].values()
    assert found.R_imu_cam == pytest.approx(camera.R_imu_cam, abs=1e-9)
    assert found.p_imu_cam == pytest.approx(camera.p_imu_cam, abs=1e-9)
    assert found.lens == pytest.approx([*camera.intrinsics, *camera.distortion])
    assert found.timeshift_s == 0.0125


def test_an_mcap_with_camera_info_and_static_transforms(tmp_path):
    transforms = [Transform(0, a, b, tuple(p), tuple(np.roll(R.as_quat(), 1))) for a, b, (R, p) in CHAIN]
    with LogWriter(tmp_path / "a.mcap") as writer:
        writer.write("vical/rig0/tf_static", encode_transforms(transforms), 10**18)
        lens = (458.0, 457.3, 367.2, 248.4)
        info = encode_camera_info(10**18, "cam_optical", (752, 480), lens, "radtan", D[:4])
        writer.write("vical/rig0/camera/cam0/camera_info", info, 10**18)
    assert seen(read_known(str(tmp_path / "a.mcap"))[0]["cam0"]) == expected()


def test_a_bag_of_ros_1(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    tf = "tf2_msgs/msg/TFMessage"
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf))
    make = store.types
    stamp = make["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    entries = [
        make["geometry_msgs/msg/TransformStamped"](
            make["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id=parent),
            child,
            make["geometry_msgs/msg/Transform"](
                make["geometry_msgs/msg/Vector3"](*p), make["geometry_msgs/msg/Quaternion"](*R.as_quat())
            ),
        )
        for parent, child, (R, p) in CHAIN
    ]
    region = make["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    header = make["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="/cam_optical")
    info = make["sensor_msgs/msg/CameraInfo"](
        header, 480, 752, "plumb_bob", np.array(D), np.array(K), np.zeros(9), np.zeros(12), 0, 0, region
    )
    messages = (("/tf_static", make[tf](entries)), ("/front/camera_info", info))
    with Bag1Writer(tmp_path / "a.bag") as bag:
        for topic, message in messages:
            connection = bag.add_connection(topic, message.__msgtype__, typestore=store)
            bag.write(connection, 10**18, store.serialize_ros1(message, message.__msgtype__))
    assert seen(read_known(str(tmp_path / "a.bag"))[0]["front"]) == expected()


def test_binning_and_region_of_interest_are_applied(tmp_path):
    roi = {"x_offset": 100, "y_offset": 40, "height": 400, "width": 600, "do_rectify": False}
    info = info_document(binning_x=2, binning_y=2, roi=roi)
    camera = read_known(write(tmp_path, tf_document(), info))[0]["cam_optical"]
    assert camera.resolution == (300, 200)
    assert camera.lens[:4].tolist() == pytest.approx([458.0 / 2, 457.3 / 2, 267.2 / 2, 208.4 / 2])


@pytest.mark.parametrize("stated", ["plumb_bob", "radtan", "rational_polynomial"])
@pytest.mark.parametrize(("k3", "model", "count"), [(0.0, "radtan", 4), (0.02, "plumb_bob", 5)])
def test_five_coefficients_are_those_of_the_model_that_has_them(tmp_path, stated, k3, model, count):
    info = info_document(distortion_model=stated, d=[*D[:4], k3])
    camera = read_known(write(tmp_path, tf_document(), info))[0]["cam_optical"]
    assert (camera.model, camera.lens[4:].tolist()) == (model, [*D[:4], k3][:count])


@pytest.mark.parametrize(
    ("documents", "line"),
    [
        ([tf_document()], "no CameraInfo in it"),
        ([info_document()], "no transforms in it"),
        (
            [tf_document(CHAIN[1:]), info_document()],
            r"which frame is the IMU's\? \(there are base_link, mast",
        ),
        ([tf_document(CHAIN[:2]), info_document()], "no transform of the camera's frame 'cam_optical'"),
        ([tf_document([CHAIN[0], CHAIN[2]]), info_document()], "no chain of static transforms from imu_link"),
        ([tf_document(), info_document(k=[0.0] * 9)], "is not calibrated"),
        ([tf_document(), info_document(k=[1.0])], "camera matrix has 1 numbers"),
        ([tf_document(), info_document(distortion_model="cubic")], "distortion model 'cubic'"),
        (
            [tf_document(), info_document(distortion_model="equidistant", d=[0.1] * 5)],
            "5 distortion coefficients of cam_optical, equidistant has 4",
        ),
        (
            [tf_document(), info_document(d=[0.1] * 3)],
            "3 distortion coefficients of cam_optical, radtan has 4",
        ),
        ([tf_document(), {"k": K, "d": D}], "'width' is missing"),
        ([tf_document(), info_document(), {"imu_frame": "nose"}], "no transform of the IMU's frame 'nose'"),
    ],
)
def test_what_is_missing_is_one_line(tmp_path, documents, line):
    with pytest.raises(ExportError, match=line) as error:
        read_known(write(tmp_path, *documents))
    assert "\n" not in str(error.value)
