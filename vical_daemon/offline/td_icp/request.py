"""What to register, and the streams of a recording that are meant."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vical_daemon.config.priors import Initial
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.estimation.temporal.td_icp_input import TdIcpOptions
from vical_daemon.logs import Recording, meant, open_recording
from vical_daemon.offline.camera_names import priors_meant
from vical_daemon.offline.errors import InputError, OptionError, Warn, ignore


@dataclass(frozen=True, slots=True)
class TdIcpRequest:
    """What to register.

    Attributes:
        path: Recording, or trajectory file.
        initial: What is known of lenses and the imu's noise.
        target: Target file, where a camera needs one.
        camera: Which, where there are several.
        imu: Which, where there are several.
        search_s: Delays are looked for up to so much either way, s.
        warn: Takes what is unusual about the input.
    """

    path: Path
    initial: Initial = field(default_factory=Initial)
    target: str | None = None
    camera: str | None = None
    imu: str | None = None
    search_s: float = 5.0
    warn: Warn = ignore

    @property
    def options(self) -> TdIcpOptions:
        """Settings that follow from this and what is known of the imu."""
        noise = self.initial.imu_noise
        if noise is None:
            # an unknown imu: the default class, loosely
            return TdIcpOptions(search_s=self.search_s, gyro_log_sigma=0.7)
        return TdIcpOptions(
            search_s=self.search_s, gyro_density=noise.gyro_density, gyro_walk=noise.gyro_walk
        )

    def open(self) -> Recording:
        """Open the recording without judging it, of a folder only one camera."""
        cameras = () if self.camera is None else (self.camera,)
        recording = open_recording(
            str(self.path), cameras=cameras, check=False
        )  # wrong units are found here, with the reason
        for warning in recording.warnings:
            self.warn(warning)
        return recording


def is_trajectory(path: Path) -> bool:
    """Whether this is a trajectory as text rather than a recording."""
    return path.is_file() and path.suffix in (".txt", ".csv", ".tum")


def choose_gyro(
    recording: Recording, name: str | None
) -> tuple[str, npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return name, stamps (ns) and rates (rad/s) of the imu that is meant.

    Raises:
        InputError: None, or several and no name.
    """
    imus = recording.imus
    if not imus:
        raise InputError(f"{recording.path} holds no IMU data")
    if name is None and len(imus) > 1:
        raise OptionError(f"{recording.path} has several IMUs: {', '.join(imus)}; choose one with --imu")
    chosen = meant(imus, name) if name else next(iter(imus))
    if chosen not in imus:
        raise OptionError(f"{recording.path} holds no imu {chosen!r}, only {', '.join(imus)}")
    arrays = recording.imu_arrays(chosen)
    return chosen, arrays.t_ns, arrays.gyro_rps


def prior_of(initial: Initial, camera: str) -> CameraPrior | None:
    """Return what a file says about a camera; a single camera of another name is meant for it.

    Raises:
        OptionError: The file is of other cameras.
    """
    return priors_meant(initial, [camera]).get(camera)
