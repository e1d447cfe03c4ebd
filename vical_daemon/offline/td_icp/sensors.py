"""Any number of sensors: what each name means, and all of them registered together."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from vical_daemon.estimation.temporal.rotation_curves import GyroCurve
from vical_daemon.estimation.temporal.td_icp import joint_of_orientations, joint_with_gyro
from vical_daemon.estimation.temporal.td_icp_input import OrientationStream, clean_gyro
from vical_daemon.estimation.temporal.td_icp_result import JointResult
from vical_daemon.logs import Recording, RecordingError
from vical_daemon.offline.errors import InputError, OptionError
from vical_daemon.offline.td_icp.own_clock import placed
from vical_daemon.offline.td_icp.recorded_orientations import pose_topic, trajectory_file
from vical_daemon.offline.td_icp.request import TdIcpRequest, choose_gyro, is_trajectory, prior_of
from vical_daemon.offline.td_icp.sources import LensUsed, camera_stream, seconds

_INTEGRATED_HZ = 30.0  # of a gyro's attitude: what lies between adds nothing to a hand's motion
_INTEGRATED_SIGMA_RAD = 3e-3  # only a start: the fit measures it


def register_sensors(request: TdIcpRequest, names: list[str]) -> tuple[JointResult, dict[str, LensUsed]]:
    """Collect the sensors' orientations and register them; also the lens of each camera.

    Args:
        request: What to register.
        names: Of the sensors. Next to a single one, the imu of the recording is meant.

    Raises:
        InputError: A name means nothing, or its data cannot be used.
    """
    path, options = request.path, request.options
    names = _each_once(request, names)
    if is_trajectory(path):
        first, base = trajectory_file(path, None, request.warn)
        others = [trajectory_file(Path(name), base, request.warn)[0] for name in names if _file(name)]
        return joint_of_orientations([first, *others], options), {}
    recording = _recording(request, names)
    imus = {} if recording is None else recording.imus
    if len(names) == 1 and recording is not None and imus and names[0] not in imus:
        names = [choose_gyro(recording, request.imu)[0], *names]
    gyros = [name for name in names if name in imus]
    base_ns = None if recording is None else recording.begin_ns
    streams, lenses = [], {}
    for name in names:
        if recording is not None and name in gyros[1:] and base_ns is not None:
            streams.append(_integrated(recording, name, base_ns))
        elif recording is not None and name in recording.cameras and base_ns is not None:
            camera, prior = recording.cameras[name], prior_of(request.initial, name)
            if gyros and request.target:
                camera = placed(recording, gyros[0], camera, prior, request.target, request.warn)
            stream, lenses[name] = camera_stream(
                recording, camera, prior, request.target, base_ns, request.warn
            )
            streams.append(stream)
        elif name not in gyros:
            stream, base_ns = _other_stream(request, recording, name, base_ns)
            streams.append(stream)
    if gyros and recording is not None and base_ns is not None:
        imu, t_ns, gyro = choose_gyro(recording, gyros[0])
        return joint_with_gyro(imu, seconds(t_ns, base_ns), gyro, streams, options), lenses
    return joint_of_orientations(streams, options), lenses


def _each_once(request: TdIcpRequest, names: list[str]) -> list[str]:
    """The names without those that were given before; INPUT is the first sensor where it is a trajectory."""
    known = {os.path.realpath(request.path)} if is_trajectory(request.path) else set()
    kept = []
    for name in names:
        place = os.path.realpath(name)
        if place in known:
            request.warn(f"--sensors: {name} is given twice, and taken once")
        else:
            kept.append(name)
            known.add(place)
    if names and not kept:
        raise OptionError(f"--sensors: {names[0]} is INPUT itself; name another sensor to register it with")
    return kept


def _integrated(recording: Recording, name: str, base_ns: int) -> OrientationStream:
    """A further imu as a stream of orientations: its integrated gyro; its bias joins the reference's."""
    _, t_ns, gyro = choose_gyro(recording, name)
    cleaned = clean_gyro(seconds(t_ns, base_ns), gyro)
    if isinstance(cleaned, str):
        raise InputError(f"{name}: {cleaned}")
    curve = GyroCurve.integrate(*cleaned, np.zeros(3))
    step = max(1, round(1.0 / (_INTEGRATED_HZ * float(np.median(np.diff(curve.t_s))))))
    R = curve.R_ref_imu[::step]
    return OrientationStream(name, curve.t_s[::step], R, _INTEGRATED_SIGMA_RAD)


def _recording(request: TdIcpRequest, names: list[str]) -> Recording | None:
    """Open the recording; None where it holds neither imu nor camera and none of the names is one."""
    try:
        return request.open()
    except RecordingError:
        if names and all(_is_topic(name) or Path(name).is_file() for name in names):
            return None
        raise


def _other_stream(
    request: TdIcpRequest, recording: Recording | None, name: str, base_ns: int | None
) -> tuple[OrientationStream, int]:
    """A sensor that is no camera: its orientations, and what was subtracted from its stamps."""
    if _is_topic(name):
        return pose_topic(request.path, name, base_ns)
    if Path(name).is_file():
        return trajectory_file(Path(name), base_ns, request.warn)
    if Path(name).exists():
        raise OptionError(f"{name}: one recording is taken, {request.path}; what follows it are its sensors")
    known = "" if recording is None else ", ".join([*recording.imus, *recording.cameras])
    raise OptionError(f"--sensors: {name!r} is no sensor of the recording ({known}), no /topic and no file")


def _is_topic(name: str) -> bool:
    return name.startswith("/") and not Path(name).exists()


def _file(name: str) -> bool:
    if not Path(name).is_file():
        raise InputError(
            f"--sensors: {name} does not exist; with a trajectory as INPUT all sensors are files"
        )
    return True
