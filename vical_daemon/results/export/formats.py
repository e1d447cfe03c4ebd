"""The table of formats, and the one function that turns a rig into files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from vical_daemon.results.export import kalibr, robots, slam
from vical_daemon.results.export.rig import ExportError, Rig


@dataclass(frozen=True, slots=True)
class ExportFile:
    """One file of an export: its usual name and its text."""

    name: str
    text: str


def _kalibr(rig: Rig) -> list[ExportFile]:
    imu = kalibr.write_imu(rig.noise, rig.imu_topic, rig.header)
    return [ExportFile("camchain-imucam.yaml", kalibr.write_camchain(rig)), ExportFile("imu.yaml", imu)]


def _openvins(rig: Rig) -> list[ExportFile]:
    return [
        ExportFile("kalibr_imucam_chain.yaml", slam.write_openvins_cameras(rig)),
        ExportFile("kalibr_imu_chain.yaml", slam.write_openvins_imu(rig)),
    ]


def _vins(rig: Rig) -> list[ExportFile]:
    cameras = [
        ExportFile(f"cam{i}.yaml", slam.write_vins_camera(c, rig)) for i, c in enumerate(rig.cameras.values())
    ]
    return [ExportFile("vins.yaml", slam.write_vins(rig)), *cameras]


def _ros(rig: Rig) -> list[ExportFile]:
    return [ExportFile(f"{c.name}.yaml", robots.write_camera_info(c, rig)) for c in rig.cameras.values()]


FORMATS: dict[str, Callable[[Rig], list[ExportFile]]] = {
    "kalibr": _kalibr,
    "ros": _ros,
    "opencv": lambda rig: [ExportFile("camera.yaml", slam.write_opencv(rig))],
    "openvins": _openvins,
    "vins": _vins,
    "orbslam3": lambda rig: [ExportFile("settings.yaml", slam.write_orbslam3(rig))],
    "basalt": lambda rig: [ExportFile("calibration.json", robots.write_basalt(rig))],
    "urdf": lambda rig: [ExportFile("rig.urdf", robots.write_urdf(rig))],
    "json": lambda rig: [ExportFile("calibration.json", robots.write_json(rig))],
}


_FOUR_COEFFICIENTS = ("kalibr", "openvins", "vins")  # have no fifth for radtan


def export(rig: Rig, format_name: str, *, force: bool = False) -> list[ExportFile]:
    """Turn a rig into the files of a format; the first one is the main file.

    Args:
        rig: What to write.
        format_name: One of `FORMATS`.
        force: Write also directions that the motion did not determine. Our own JSON names them and needs
            no force; the reader of any other format would take their numbers for known.

    Raises:
        ExportError: No camera, an unknown format, something that the format needs is not known, or a
            direction that the motion did not determine.
    """
    if format_name not in FORMATS:
        raise ExportError(f"format {format_name!r} is none of {', '.join(FORMATS)}")
    if not rig.cameras:
        raise ExportError("there is no camera in the source: the calibration had no solution yet")
    withheld = [f"{c.name}: {what}" for c in rig.cameras.values() for what in c.unobservable]
    if withheld and format_name != "json" and not force:
        raise ExportError(
            f"the motion did not determine everything ({'; '.join(withheld)}): record such a motion, or "
            "write it all the same with --force"
        )
    longer = [c.name for c in rig.cameras.values() if len(c.distortion) > 4]
    if longer and format_name in _FOUR_COEFFICIENTS:
        raise ExportError(
            f"{', '.join(longer)}: {format_name} has no place for plumb_bob's k3; calibrate with "
            "distortion_model: radtan, or export to ros, opencv, orbslam3 or basalt"
        )
    return FORMATS[format_name](rig)
