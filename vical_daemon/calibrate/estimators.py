"""Creates the estimator of a config. Target-based and target-free estimators have one interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

from vical_daemon.bus import topics
from vical_daemon.config.model import Config, ConfigError
from vical_daemon.config.priors import calibration_options, camera_prior
from vical_daemon.estimation.measurements import CalibrationOptions, CameraPrior, PointsFrame
from vical_daemon.estimation.result import CalibrationEstimate, HeldOutCheck


class Estimator(Protocol):
    """What a role needs of an estimator; see `Calibrator`."""

    def add_imu(self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]) -> None:
        """Take one inertial sample."""
        ...

    def stamps_known_to(self, sigma_s: float) -> None:
        """Take the stamp uncertainty that the IMU's driver reports now, one sigma, s."""
        ...

    def add_points(self, frame: PointsFrame) -> None:
        """Take the points of one image."""
        ...

    def do_without(self, cameras: frozenset[str]) -> None:
        """Wait for none of these cameras: nothing comes from them now."""
        ...

    @property
    def waiting(self) -> int:
        """Images that have been neither used nor rejected yet."""
        ...

    @property
    def left_out(self) -> dict[str, int]:
        """Readings and images that were not used, by cause."""
        ...

    def process(self) -> Sequence[Any]:
        """Process the data that have arrived."""
        ...

    def finish(self) -> Sequence[Any]:
        """End of the data."""
        ...

    @property
    def can_go_on(self) -> bool:
        """Whether there is a calibration that another recording of the same rig can go on with."""
        ...

    def next_recording(self, *, common_clock: bool = True) -> None:
        """What comes now is another recording of the same rig; see `Calibrator.next_recording`."""
        ...

    def estimate(self) -> CalibrationEstimate:
        """Return the current estimate, with the events since the last call."""
        ...

    def held_out(self) -> list[HeldOutCheck]:
        """Return how well the IMU alone predicted images before they were used."""
        ...


def make_estimator(config: Config, priors: dict[str, CameraPrior] | None = None) -> Estimator:
    """Make the estimator of a rig.

    Args:
        config: The rig.
        priors: Priors of the cameras; None: those of the config.

    Raises:
        ConfigError: The target file is missing or wrong.
    """
    options = calibration_options(config)
    if priors is None:
        priors = {name: camera_prior(config, name) for name in config.calibration_cameras}
    if options.target_free:
        return _target_free(options, priors)
    from vical_daemon.estimation.calibrator import Calibrator
    from vical_daemon.vision.target import load_target

    assert config.target_path is not None  # checked by `config.load`
    target = load_target(config.target_path)
    options = replace(options, target_alike=target.alike_upside_down)
    return Calibrator(options, priors, target.points_m)


def input_keys(config: Config) -> list[str]:
    """Return the keys that the estimator reads: one IMU, points or tracks of each camera, and statuses."""
    key_of = topics.TRACKS.key if config.calibration.mode == "target_free" else topics.POINTS.key
    imu = topics.IMU.key(config.rig, config.calibration_imu)
    points = [key_of(config.rig, camera) for camera in config.calibration_cameras]
    return [imu, *status_keys(config.rig), *points]


def status_keys(rig: str) -> list[str]:
    """Return the keys on which the roles that data come from say how they and their devices are."""
    return [topics.STATUS.key(rig, role) for role in ("imu", "camera", "detect")]


def _target_free(options: CalibrationOptions, priors: dict[str, CameraPrior]) -> Estimator:
    from vical_daemon.estimation.target_free import TargetFreeCalibrator
    from vical_daemon.estimation.target_free_rig import TargetFreeRig

    try:
        return TargetFreeCalibrator(options, priors) if len(priors) == 1 else TargetFreeRig(options, priors)
    except ValueError as error:
        raise ConfigError(str(error)) from error
