"""The calibration in use that `mode: verify` checks: from the store, or from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.calibrate.persistence import CalibrationPersistence
from vical_daemon.config.model import Config
from vical_daemon.config.priors import camera_prior
from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, PoseEstimate, Status
from vical_daemon.results.export import ExportError, Rig, rig_from_estimate
from vical_daemon.results.files import read_known_file
from vical_daemon.results.known import KnownCamera, known_cameras


class NothingInUseError(Exception):
    """There is no calibration to be checked; the message says why, and what to do."""


class DevicesUnknownError(NothingInUseError):
    """There may be one, but the serial numbers of the devices are not known yet."""


@dataclass(frozen=True, slots=True)
class InUse:
    """A calibration that is checked.

    Attributes:
        source: Where it comes from, for messages.
        known: What it claims about each camera.
        readouts_s: Readout of each camera with a rolling shutter, s.
        estimate: The same as an estimate, for all who use it.
    """

    source: str
    known: dict[str, KnownCamera]
    readouts_s: dict[str, float]
    estimate: CalibrationEstimate

    def prior(self, config: Config, name: str) -> CameraPrior:
        """Return what a check starts from: the lens, and nothing about mounting and time shift."""
        prior = replace(camera_prior(config, name), T_imu_cam=None, timeshift_cam_imu_s=None)
        known = self.known[name]
        if known.lens is None:
            return prior
        fx, fy, cx, cy, *distortion = (float(x) for x in known.lens)
        return replace(
            prior,
            intrinsics=(fx, fy, cx, cy),
            distortion_model=known.model,
            distortion=tuple(distortion),
            readout_s=self.readouts_s.get(name, prior.readout_s),
        )


def calibration_in_use(config: Config, persistence: CalibrationPersistence, now_ns: int) -> InUse:
    """Read the calibration that the config wants checked.

    Args:
        config: The rig.
        persistence: The store; its `priors` were asked for.
        now_ns: UNIX time, stamp of the estimate.

    Raises:
        NothingInUseError: There is none.
        DevicesUnknownError: That is not known before the devices are there.
    """
    path = config.verify_path
    if path is None:
        return _from_store(config, persistence, now_ns)
    try:
        known, rig = read_known_file(path)
    except ExportError as error:
        raise NothingInUseError(f"verify.against: {error}") from None
    names = config.calibration_cameras
    if len(known) == len(names) == 1:
        known = {names[0]: replace(next(iter(known.values())), name=names[0])}
    for name in names:
        if name not in known:
            raise NothingInUseError(
                f"verify.against: {path} has no camera {name} (it has {', '.join(known)})"
            )
        if known[name].lens is None and config.cameras[name].lens.intrinsics is None:
            raise NothingInUseError(
                f"verify.against: {path} has no lens; give cameras.{name}.lens.intrinsics"
            )
        made_for, size = known[name].resolution, config.cameras[name].size
        if known[name].lens is not None and made_for is not None and made_for != size:
            before, now = ("{} x {}".format(*one) for one in (made_for, size))
            raise NothingInUseError(
                f"verify.against: {path} is for images of {before} px, not {now}: `vical command calibrate`"
            )
    known = {name: known[name] for name in names}
    return InUse(path.name, known, _readouts_s(rig, names), _estimate(config, known, now_ns))


def _from_store(config: Config, persistence: CalibrationPersistence, now_ns: int) -> InUse:
    stored = persistence.before
    lacking = [name for name in config.calibration_cameras if name not in stored]
    if lacking and not persistence.devices:
        raise DevicesUnknownError("waiting for the serial numbers of IMU and cameras")
    if lacking:
        raise NothingInUseError(
            f"no calibration of {', '.join(lacking)} is stored for these devices: `vical command calibrate`"
        )
    known, readouts_s = {}, {}
    for name in config.calibration_cameras:
        entry = stored[name]
        if entry.resized(camera_prior(config, name)):
            before, now = (
                "{} x {}".format(*size) for size in (entry.known.resolution, config.cameras[name].size)
            )
            raise NothingInUseError(
                f"{name}: what is stored is of images of {before} px, not {now}: `vical command calibrate`"
            )
        estimate = replace(entry.estimate, cameras={name: entry.known})
        rig = rig_from_estimate(estimate, {name: config.cameras[name].size})
        known[name] = known_cameras(rig, "store")[name]
        readouts_s[name] = entry.known.readout_s
    first = next(iter(stored.values())).estimate
    cameras = {name: stored[name].known for name in known}
    return InUse("store", known, readouts_s, replace(first, cameras=cameras, events=[], t_ns=now_ns))


def _readouts_s(rig: Rig | None, names: tuple[str, ...]) -> dict[str, float]:
    return {} if rig is None else {name: rig.cameras[name].readout_s for name in names if name in rig.cameras}


def _estimate(config: Config, known: dict[str, KnownCamera], now_ns: int) -> CalibrationEstimate:
    """What a file claims, in the form of an estimate."""
    cameras = {name: _camera(config, camera) for name, camera in known.items()}
    return CalibrationEstimate(now_ns, Status.CONVERGED, "", 1.0, "", 0.0, 0, 0, cameras, None, [], 1.0, 0.0)


def _camera(config: Config, known: KnownCamera) -> CameraEstimate:
    given = camera_prior(config, known.name)
    sigma = known.sigma
    lens = np.array([*given.start_intrinsics(), *given.coefficients()]) if known.lens is None else known.lens
    lens_sigma = np.zeros(len(lens)) if known.lens is None else sigma[7:]
    quaternion = so3.quat_from_matrix(known.R_imu_cam)
    return CameraEstimate(
        PoseEstimate(known.p_imu_cam.tolist(), quaternion.tolist(), known.covariance[:6, :6].tolist()),
        known.timeshift_s,
        float(sigma[6]),
        lens[:4].tolist(),
        lens_sigma[:4].tolist(),
        known.model,
        lens[4:].tolist(),
        lens_sigma[4:].tolist(),
        0.0,
        resolution=list(config.cameras[known.name].size),
    )
