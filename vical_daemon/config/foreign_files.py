"""Recognises calibration files of other programs that vical does not read, so that the message can name them.

Asked only after a file has been refused: the marks need to tell these formats apart, not to validate them.
"""

from __future__ import annotations

import re
from pathlib import Path

from vical_drivers.user_files import read_text

_COPY = (
    "vical does not read it: copy its values into a file of Kalibr's form "
    "(cam0: intrinsics, distortion_coeffs, resolution, T_cam_imu, timeshift_cam_imu)"
)
_FORMATS = (  # mark at the start of a line (or JSON key), what it is, what to do; the first that fits
    (r"\s*\{?\s*\"value0\"\s*:", "Basalt's calibration", _COPY),
    (r".*(!!opencv-matrix|<opencv_storage)", "OpenCV's FileStorage, as in ORB-SLAM3 and VINS-Fusion", _COPY),
    (r"(model_type|projection_parameters)\s*:", "VINS-Fusion's lens file", _COPY),
    (r"(Camera\d?\.(type|fx)|File\.version)\s*:", "ORB-SLAM3's settings", _COPY),
    (r"(sensor_type|T_BS)\s*:", "EuRoC's sensor.yaml", f"{_COPY}; T_cam_imu is the inverse of T_BS"),
    (r"\d+ [A-Z_]*(PINHOLE|RADIAL|OPENCV|FISHEYE|FOV)[A-Z_]* \d+ \d+ ", "COLMAP's cameras.txt", _COPY),
    (r"cameras\s*:\s*\n\s*-", "a camera file of OKVIS or maplab", _COPY),
    (r".*<robot\b", "a URDF", _COPY),
    (r"Calibration results\s*$", "Kalibr's report", "give the camchain-imucam.yaml that was written with it"),
)
_FOR_PRIORS = (  # read elsewhere, but not as prior values
    (r"target_type\s*:", "a target file", "give it with --target"),
    (
        r"relative_config_imucam\s*:",
        "OpenVINS's estimator_config.yaml",
        "give the kalibr_imucam_chain.yaml that it names",
    ),
    (
        r"(imus|cameras)\s*:",
        "a config of vical",
        "prior values have sections like `cam0: {{intrinsics: [...]}}`",
    ),
    (
        r"\s*\{?\s*\"(t_ns|cameras|estimate|note)\"\s*:",
        "a result of vical",
        "`vical export {path} --format kalibr -o FOLDER` makes prior values of it",
    ),
    (r"(camera_matrix|image_width|distortion_model|k|K|transforms)\s*:", "a file of ROS", _COPY),
)


def foreign_file(path: Path, limit: int, *, as_prior: bool = False) -> str:
    """Say what a refused file is, and what to do; "" if it is none of the known formats.

    Args:
        path: The file.
        limit: How many bytes it may have.
        as_prior: It was given as prior values (`--initial`): results of vical and files of ROS are no priors.
    """
    try:
        text = read_text(path, limit)
    except (OSError, UnicodeDecodeError):
        return ""
    for mark, what, advice in (*_FORMATS, *(_FOR_PRIORS if as_prior else ())):
        if re.search(f"^{mark}", text, re.MULTILINE):
            return f"{path}: this is {what}; {advice.format(path=path)}"
    return ""
