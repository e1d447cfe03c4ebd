"""The ros2msg definitions of all messages; a log embeds them so that other tools can read it.

Our own types are defined here; those of ROS come from rosbags' typestore (a text, no ROS needed).
"""

from __future__ import annotations

from functools import cache
from typing import Any

_POINTS_FIELDS = """\
std_msgs/Header header   # stamp: middle of the exposure; frame_id: camera
uint32 width             # px of the image, 0 unknown
uint32 height
int64[] ids              # {ids}
float64[] uv_px          # u0 v0 u1 v1 ...: raw distorted pixels, u right, v down, centres at integers
float64[] sigma_px       # one sigma per axis for each point; empty: unknown
"""

DEFINITIONS: dict[str, str] = {
    "vical_msgs/msg/TargetPoints": "# Points of a calibration target seen in one image\n"
    + _POINTS_FIELDS.format(ids="row of the point in the target"),
    "vical_msgs/msg/FeatureTracks": "# Unknown points followed from image to image\n"
    + _POINTS_FIELDS.format(ids="id of the feature, never used again"),
    "vical_msgs/msg/ImuCalibration": """\
# Inertial biases and matrices; empty arrays were not estimated
bool known
float64[] gyro_bias_rps
float64[] accel_bias_mps2
float64[] gyro_bias_sigma_rps
float64[] accel_bias_sigma_mps2
float64[] gyro_matrix            # 3x3 row by row
float64[] accel_matrix           # 3x3 row by row
""",
    "vical_msgs/msg/CameraCalibration": """\
# Mounting of a camera on the imu, its time shift and its lens; empty arrays were not estimated
bool known
geometry_msgs/Pose pose_imu_cam  # pose of the camera in the imu frame
float64[36] covariance           # [px py pz rx ry rz], m, rad; rotation local (right): about the cam axes
float64 timeshift_cam_imu_s      # t_imu = t_cam + timeshift_cam_imu_s
float64 timeshift_sigma_s
float64[] intrinsics             # fx fy cx cy, px
float64[] intrinsics_sigma
string distortion_model          # radtan (k1 k2 p1 p2), plumb_bob (with k3) or equidistant
float64[] distortion
float64[] distortion_sigma
float64 readout_s                # first to last row, 0 global shutter
float64 readout_sigma_s
float64 reprojection_rms_px
float64 corner_sigma_px
string[] unobservable            # withheld directions, each with the motion that would reveal it
""",
    "vical_msgs/msg/Event": """\
# One announcement as data; kinds, units and causes: docs/reference/events.md. Not a number: has none
string kind
string camera                    # empty: the rig, its imu or its target
float64 t_s                      # since the first inertial reading
float64 value                    # SI
float64 sigma
string cause
float64 cause_value
""",
    "vical_msgs/msg/Guidance": """\
# The next motion to make, as data; empty verb: no motion is needed
string verb                      # turn turn_faster turn_to_and_fro turn_and_move show
string axes                      # of the camera, e.g. xy; x right, y down, z along the optical axis
string lack                      # still slow one_axis steady_rate fast_changes edges
float64[] turned_about           # axis about which it turned so far, in the camera frame; empty: several
float64 rate_rps                 # how fast it turns
string camera                    # whose image, for show; of several cameras, whose axes
string[] edges                   # left right top bottom, for show
""",
    "vical_msgs/msg/WeakDirection": """\
# A direction that the motion did not reveal
string block                     # lever_arm rotation timeshift
float64[3] axis_cam              # in the camera frame, unit length; zeros for the time shift
float64 sigma                    # m, rad or s
float64 limit                    # above which sigma it counts as unknown
vical_msgs/Guidance guidance     # the motion that would reveal it
""",
    "vical_msgs/msg/Change": """\
# What has changed since a calibration was stored
string block                     # position rotation timeshift lens
float64 value                    # m, rad, s, or px RMS over the image
float64 sigma
float64[] axis                   # unit vector: position in the imu frame, rotation in the camera frame
""",
    "vical_msgs/msg/VerifyResult": """\
# Whether a stored calibration of one camera still holds
std_msgs/Header header           # stamp: newest data looked at; frame_id: camera
string state                     # resting checking calibrating unable
string verdict                   # holds changed cannot_tell: the last answer
builtin_interfaces/Time answered # when it was given; 0: no answer yet
string against                   # what is checked: store, or a file
string text                      # all of this in one line
float64 probability_changed      # from the check that is going on; not a number: none yet
float64 seconds_used             # data in it
uint64 checks                    # answers so far
vical_msgs/Change[] changes      # of the last answer, where it is `changed`
string[] missing_motion          # what would help the check that is going on
float64 image_rate_hz            # what the detector is asked for now; 0: nothing
""",
    "vical_msgs/msg/CalibrationEstimate": """\
# The complete estimate of one camera at one moment
std_msgs/Header header           # stamp: newest data used; frame_id: camera
string status                    # waiting initialising converging converged degenerate inconsistent
string reason
string guidance                  # what motion to make next
string[] events                  # as text; as data: event_data
float64 progress                 # 0 to 1
float64 duration_s
uint64 frames
uint64 imu_samples
float64 nis_per_dof              # 1 when consistent
float64 rejected_fraction
float64[] gravity_world_mps2     # acceleration of free fall in the world frame
vical_msgs/ImuCalibration imu
vical_msgs/CameraCalibration camera
# from here on absent in messages of version 0.1.0
vical_msgs/Event[] event_data    # events, in the same order
vical_msgs/Guidance next_motion  # guidance
vical_msgs/WeakDirection[] withheld  # camera.unobservable, in the same order
""",
}


@cache
def typestore() -> Any:
    """Return rosbags' typestore of ROS 2 with our own types registered (0.1 s the first time)."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, definition in DEFINITIONS.items():
        types.update(get_types_from_msg(definition, name))
    store.register(types)
    return store


@cache
def ros2_schema(type_name: str) -> str:
    """Return the full ros2msg text of a type with all that it contains, as MCAP wants it.

    Args:
        type_name: ROS 2 name, e.g. ``sensor_msgs/msg/Imu``.

    Raises:
        KeyError: No such type.
    """
    store = typestore()
    if type_name not in store.fielddefs:
        raise KeyError(type_name)
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return str(text)
