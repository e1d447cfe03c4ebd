"""What goes into the estimator: settings, priors and observations. Plain data, no behaviour."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry.camera_model import (
    COEFFICIENTS,
    PLUMB_BOB,
    RADTAN,
    check_model,
    coefficients_error,
)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ROWS, COLUMNS = "rows", "columns"
"""What a rolling shutter reads one after the other; columns: a phone's sensor, of images turned upright."""

IMAGE_GAP_S = 0.6
"""Between images further apart, s, is a gap: it is reported, and nothing is followed across it. A track may
belong to another point, and the motion may be better known from the next image. A camera of 2 Hz has none,
even if its stamps jitter."""
LEAST_POINTS = 4
"""An image with fewer points of the target is not used: a homography needs four."""


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Continuous-time noise densities of an IMU (Kalibr's four numbers).

    Defaults: 3DM-GX3-25 (0.03 deg/s/sqrt(Hz), 80 ug/sqrt(Hz) and the bias walks of its class).
    """

    gyro_density: float = 5.2e-4  # rad/s/sqrt(Hz)
    gyro_walk: float = 2.0e-5  # rad/s^2/sqrt(Hz)
    accel_density: float = 8.0e-4  # m/s^2/sqrt(Hz)
    accel_walk: float = 2.0e-4  # m/s^3/sqrt(Hz)
    rate_hz: float = 100.0


class MeasuredNoise(ImuNoise):
    """White noise of both sensors is what the readings show, whatever was stated."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """What is known about a camera before the first frame.

    Attributes:
        resolution: width, height, px.
        intrinsics: fx fy cx cy, px; None: guessed from the resolution.
        distortion_model: radtan, plumb_bob or equidistant.
        distortion: The model's coefficients; None or none: zeros.
        T_imu_cam: (R_imu_cam (3,3), p_imu_cam (3,)) or None: nothing known, found from the data.
        timeshift_cam_imu_s: t_imu = t_cam + shift, s; None: nothing known, found from the data.
        readout_s: Rolling-shutter readout, first to last row (or column), s; 0: global shutter.
        readout_axis: What is read one after the other, `ROWS` or `COLUMNS`; empty: rows where a readout is
            given, found from the data where it is estimated.
        intrinsics_sigma: How well fx fy cx cy are known where they are held, px; None: exactly.
        distortion_sigma: Likewise the coefficients.
        term: The last coefficient is one more than the lens has that is reported, see `with_next_term`.

    Raises:
        ValueError: Unknown distortion model, or not as many coefficients or sigmas as it has.
    """

    resolution: tuple[int, int]
    intrinsics: tuple[float, float, float, float] | None = None
    distortion_model: str = "radtan"
    distortion: tuple[float, ...] | None = None
    T_imu_cam: tuple[FloatArray, FloatArray] | None = None
    timeshift_cam_imu_s: float | None = None
    readout_s: float = 0.0
    readout_axis: str = ""
    intrinsics_sigma: tuple[float, float, float, float] | None = None
    distortion_sigma: tuple[float, ...] | None = None
    term: bool = False

    def __post_init__(self) -> None:
        check_model(self.distortion_model)
        for what in ("distortion", "distortion_sigma"):
            values: tuple[float, ...] | None = getattr(self, what)
            if values and (error := coefficients_error(self.distortion_model, values)):
                raise ValueError(f"{what}: {error}")

    def start_intrinsics(self) -> FloatArray:
        """Focal lengths and centre, px: as given, or of a lens of 60 degrees across; fx fy cx cy, (4,)."""
        width, height = self.resolution
        guess = (0.87 * width, 0.87 * width, 0.5 * (width - 1), 0.5 * (height - 1))
        return np.array(guess if self.intrinsics is None else self.intrinsics, dtype=np.float64)

    def coefficients(self) -> FloatArray:
        """The distortion as given, zeros where it is not, shape (d,)."""
        given = self.distortion or (0.0,) * len(COEFFICIENTS[self.distortion_model])
        return np.array(given, dtype=np.float64)

    def with_next_term(self) -> CameraPrior:
        """A radtan lens with the term of the radius that it would have next, k3; other lenses as they are.

        No real lens is exactly radtan. With this term as an alternative model, sigmas include
        what it would do.
        """
        if self.distortion_model != RADTAN:
            return self
        sigma = self.distortion_sigma
        return replace(
            self,
            distortion_model=PLUMB_BOB,
            distortion=(*self.coefficients().tolist(), 0.0),
            distortion_sigma=None if sigma is None else (*sigma, 0.0),
            term=True,
        )


@dataclass(frozen=True, slots=True)
class PointsFrame:
    """Points seen in one image: target corners (known places) or feature tracks (unknown places).

    Attributes:
        camera: Name of the camera.
        t_cam_ns: Stamp of the image in the camera's clock (UNIX or monotonic, one base per recording), ns.
        ids: Point or feature ids, shape (n,), int64.
        uv_px: Raw distorted pixel coordinates (u right, v down, pixel centres at integers), shape (n, 2).
        sigma_px: One-sigma per axis as the detector states it, shape (n,); None: measured by the filter.
    """

    camera: str
    t_cam_ns: int
    ids: IntArray
    uv_px: FloatArray
    sigma_px: FloatArray | None = None

    def only(self, chosen: BoolArray) -> PointsFrame:
        """The same image with some of its points: a mask of shape (n,)."""
        sigma_px = None if self.sigma_px is None else self.sigma_px[chosen]
        return PointsFrame(self.camera, self.t_cam_ns, self.ids[chosen], self.uv_px[chosen], sigma_px)


Frames = list[tuple[float, PointsFrame]]
"""Stamps in the camera's clock, s, and points; in order of time."""


@dataclass(frozen=True, slots=True)
class ConvergenceTargets:
    """A calibration counts as converged when every sigma lies below these (m, rad, s)."""

    position_m: float = 0.005
    rotation_rad: float = float(np.deg2rad(0.1))
    timeshift_s: float = 5e-4


STANDARD_GRAVITY_MPS2, _ASSUMED_SIGMA_MPS2 = 9.80665, 0.015
"""Gravity where nobody says: at sea level it is 9.780 (equator) to 9.832 (poles) [WGS 84]."""
_STATED_SIGMA_MPS2 = 3e-3  # of gravity that somebody states: the value of the place, rounded to two decimals


def gravity_sigma_mps2(stated_mps2: float) -> float:
    """How well the magnitude of gravity is known, one sigma, m/s^2, where this value is stated."""
    return _ASSUMED_SIGMA_MPS2 if stated_mps2 == STANDARD_GRAVITY_MPS2 else _STATED_SIGMA_MPS2


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Switches of the estimator; names as on the command line.

    Attributes:
        fix: Of {"intrinsics", "timeshift", "extrinsics"}: held at their priors.
        estimate: Of {"imu_intrinsics", "size_effect", "readout", "target_scale", "target_shape",
            "accel_lag"}: optional blocks that are switched on.
        target_free: Landmarks are estimated, no target is known.
        target_alike: A half turn maps the target onto itself, and its ids do not tell which end is up.
        gravity_mps2: Magnitude of gravity, m/s^2.
        gravity_sigma_mps2: How well it is known, m/s^2, one sigma.
        corner_sigma_px: First guess of the corner noise; measured from the data afterwards.
        imu_noise: Densities of the IMU.
        targets: What counts as converged.
    """

    fix: frozenset[str] = frozenset()
    estimate: frozenset[str] = frozenset()
    target_free: bool = False
    target_alike: bool = False
    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    gravity_sigma_mps2: float = _ASSUMED_SIGMA_MPS2
    corner_sigma_px: float = 0.5
    imu_noise: ImuNoise = field(default_factory=ImuNoise)
    targets: ConvergenceTargets = field(default_factory=ConvergenceTargets)
