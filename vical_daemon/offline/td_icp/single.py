"""One imu and one camera: the delay of a recording, and how it develops."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.temporal.delay_windows import DelayReport, delay_windows
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.td_icp_result import REFUSED, TdIcpResult
from vical_daemon.estimation.temporal.track_registration import track_registration
from vical_daemon.logs import Recording, meant
from vical_daemon.offline.errors import InputError, OptionError
from vical_daemon.offline.td_icp.gyro_unit import with_unit_named
from vical_daemon.offline.td_icp.own_clock import placed
from vical_daemon.offline.td_icp.request import TdIcpRequest, choose_gyro, prior_of
from vical_daemon.offline.td_icp.sources import LensUsed, camera_stream, seconds, track_frames

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SingleResult:
    """The answer.

    Attributes:
        imu: Name.
        camera: Name.
        result: Of the whole recording.
        lens: With which orientations were taken from images.
        watch: One report for each window, where they were asked for.
    """

    imu: str
    camera: str
    result: TdIcpResult
    lens: LensUsed
    watch: list[DelayReport] = field(default_factory=list)


def register_camera(request: TdIcpRequest, watch_s: float | None = None) -> SingleResult:
    """Register one camera with one imu.

    Args:
        request: What to register.
        watch_s: Also follow the delay in windows of so much, s; None: not.

    Raises:
        InputError: No such streams, or something needed is not there.
    """
    recording = request.open()
    camera = _choose_camera(recording, request.camera)
    imu, t_ns, gyro = choose_gyro(recording, request.imu)
    base, stream = int(t_ns[0]), recording.cameras[camera]
    t_imu, prior, options = seconds(t_ns, base), prior_of(request.initial, camera), request.options
    if request.target:
        stream = placed(recording, imu, stream, prior, request.target, request.warn)
    if stream.kind == "tracks":
        frames, used = track_frames(recording, stream, prior, base)
        lens = (used.lens.intrinsics, used.lens.distortion, used.lens.distortion_model)
        result = track_registration(t_imu, gyro, frames, lens, options)
        if watch_s is not None:
            raise OptionError("--watch needs a board: tracks of unknown points are fitted as a whole")
        if result.status == REFUSED:
            result = with_unit_named(result, recording.imu_arrays(imu))
        return SingleResult(imu, camera, result, used)
    found, used = camera_stream(recording, stream, prior, request.target, base, request.warn)
    poses = found.t_s, found.R_world_sensor, found.rotation_sigma
    result = td_icp(t_imu, gyro, *poses, options)
    if result.status == REFUSED:
        result = with_unit_named(result, recording.imu_arrays(imu), found.t_s, found.R_world_sensor)
    watch = []
    if watch_s is not None and result.status != REFUSED:
        watch = delay_windows(t_imu, gyro, *poses, options, watch_s)
    return SingleResult(imu, camera, result, used, watch)


def _choose_camera(recording: Recording, name: str | None) -> str:
    cameras = recording.cameras
    if not cameras:
        raise InputError(f"{recording.path} holds no camera: neither images nor points")
    if name is None and len(cameras) > 1:
        raise OptionError(
            f"{recording.path} holds the cameras {', '.join(cameras)}; choose one with --camera, "
            "or several with --sensors"
        )
    camera = meant(cameras, name) if name else next(iter(cameras))
    if camera not in cameras:
        raise OptionError(f"{recording.path} holds no camera {camera!r}, only {', '.join(cameras)}")
    return camera
