"""What a calibration claims about a camera: values and one joint covariance, wherever it comes from.

A file without covariances (Kalibr's camchain, OpenVINS) gets assumed ones; `notes` says which.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vical_daemon.estimation.geometry.camera_model import COEFFICIENTS
from vical_daemon.estimation.measurements import CameraPrior, FloatArray
from vical_daemon.results.export.rig import Rig, RigCamera

POSITION, ROTATION, SHIFT, LENS = slice(0, 3), slice(3, 6), slice(6, 7), slice(7, None)
BLOCKS = {"position": POSITION, "rotation": ROTATION, "time shift": SHIFT, "lens": LENS}
"""Blocks of a calibration's errors, in the order of `CameraEstimate.calibration_covariance`."""

# One sigma of a value without covariance. Kalibr's calibrations of the two halves of EuRoC's `imu_april`
# differ by 1.5 mm (length of three axes) and 0.073 deg, so one sigma of an axis is 1.5 / sqrt(6) = 0.6 mm and
# 0.03 deg of a half; two recordings are less alike than two halves of one: 1 mm and 0.05 deg.
ASSUMED_POSITION_M = 1e-3
ASSUMED_ROTATION_RAD = float(np.deg2rad(0.05))
ASSUMED_SHIFT_S = 1e-4  # docs/benchmarks.md: OpenVINS, 0.02 to 0.05 ms; Kalibr's halves 0.017 ms; times two
ANY_SHIFT_S = 1.0  # sigma of a time shift that is not known; those of videos were moved to within some ms
ASSUMED_LENS_SHARE = 1e-3  # of the focal length; EuRoC's free lens: 0.7 of 460 px
ASSUMED_DISTORTION = 5e-3  # times the square of the radius at the border, 0.7: the same 0.25 % of f there


@dataclass(frozen=True, slots=True)
class KnownCamera:
    """One camera as a calibration claims it.

    Attributes:
        name: Of the camera.
        source: Where it was read.
        R_imu_cam: Maps cam vectors into imu, shape (3, 3).
        p_imu_cam: Camera origin in the imu frame, m, shape (3,).
        timeshift_s: t_imu = t_cam + timeshift, s.
        lens: fx fy cx cy (px) and the distortion, shape (n,); None: not in the source.
        model: Distortion model.
        resolution: Width and height, px; None: not known.
        covariance: Of [position, rotation (local), time shift, lens], m, rad, s, px, shape (7 + n, 7 + n).
        inflation: By what `covariance` is too large on its diagonal, because correlations are not known.
        lens_held: The lens was held at given values, not estimated.
        lens_contradicted: It was held, and `covariance` includes by how much images contradict it.
        model_fits: See `CameraEstimate`.
        duration_s: Seconds of data used; 0: not known.
        reading_hashes: See `CalibrationEstimate`; (): not known.
        serials: Serial numbers of imu and camera; "": not known.
        notes: What was assumed, in words.
        topic: ROS topic of the images; "": not known.
    """

    name: str
    source: str
    R_imu_cam: FloatArray
    p_imu_cam: FloatArray
    timeshift_s: float
    lens: FloatArray | None
    model: str
    resolution: tuple[int, int] | None
    covariance: FloatArray
    inflation: float = 1.0
    lens_held: bool = False
    lens_contradicted: bool = False
    model_fits: bool | None = None
    duration_s: float = 0.0
    reading_hashes: tuple[int, ...] = ()
    serials: tuple[str, str] = ("", "")
    notes: tuple[str, ...] = ()
    topic: str = ""

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (7 + n,)."""
        return np.sqrt(np.diag(self.covariance) / self.inflation)

    def given_lens(self) -> KnownCamera:
        """The same if its lens is taken to be right: what else is known is known as well as that makes it."""
        return replace(self, lens=None, covariance=given(self.covariance, LENS), lens_held=True)

    def without_lens(self) -> KnownCamera:
        """Mounting and time shift alone, whatever the lens."""
        return replace(self, lens=None, covariance=self.covariance[:7, :7])

    def with_any_shift(self) -> KnownCamera:
        """The same without its time shift: a video has a clock of its own, which begins with it."""
        covariance = self.covariance.copy()
        covariance[SHIFT, :] = covariance[:, SHIFT] = 0.0
        covariance[SHIFT, SHIFT] = ANY_SHIFT_S**2
        notes = (*self.notes, "the time shift is not compared: a video has a clock of its own")
        return replace(self, covariance=covariance, notes=notes)


def known_cameras(rig: Rig, source: str) -> dict[str, KnownCamera]:
    """Return what a rig claims about each of its cameras."""
    return {name: _known(camera, rig, source) for name, camera in rig.cameras.items()}


def known_prior(name: str, prior: CameraPrior, source: str, topic: str = "") -> KnownCamera | None:
    """Return what a Kalibr file claims that may lack its lens; None without a pose."""
    if prior.T_imu_cam is None:
        return None
    lens = None if prior.intrinsics is None else np.array([*prior.intrinsics, *prior.coefficients()])
    n = 0 if lens is None else len(lens)
    bare = KnownCamera(
        name,
        source,
        prior.T_imu_cam[0],
        prior.T_imu_cam[1],
        prior.timeshift_cam_imu_s or 0.0,
        lens,
        prior.distortion_model,
        prior.resolution if prior.resolution != (0, 0) else None,
        np.zeros((7 + n, 7 + n)),
        topic=topic,
    )
    return _completed(bare)


def given(covariance: FloatArray, block: slice) -> FloatArray:
    """Covariance of the errors before a block, given that block: P_aa - P_ab P_bb^-1 P_ba."""
    a = slice(0, block.start)
    P_ab = covariance[a, block]
    return np.asarray(covariance[a, a] - P_ab @ pinv(covariance[block, block]) @ P_ab.T)


def pinv(covariance: FloatArray) -> FloatArray:
    """Inverse of a covariance in mixed units; directions of no variance at all are left out."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))


def keys(model: str, *, lens: bool) -> list[str]:
    """Names of a calibration's errors with their units, in order, as in JSON."""
    pose = [f"{block}_{axis}_{unit}" for block, unit in (("p", "m"), ("r", "rad")) for axis in "xyz"]
    more = [f"{k}_px" for k in ("fx", "fy", "cx", "cy")] + list(COEFFICIENTS[model]) if lens else []
    return [*pose, "timeshift_s", *more]


def _known(camera: RigCamera, rig: Rig, source: str) -> KnownCamera:
    lens = np.array([*camera.intrinsics, *camera.distortion])
    size = 7 + len(lens)
    covariance, inflation = np.zeros((size, size)), 1.0
    notes: tuple[str, ...] = ()
    if camera.calibration_covariance is not None:
        covariance = camera.calibration_covariance.copy()
        if camera.timeshift_sigma_s:
            covariance[6, 6] = max(covariance[6, 6], camera.timeshift_sigma_s**2)
    elif camera.covariance is not None:
        covariance, inflation = _of_blocks(camera, size)
        notes = (f"{source}: no correlations between pose, time shift and lens; vical bounds their effect",)
    return _completed(
        KnownCamera(
            camera.name,
            source,
            camera.R_imu_cam,
            camera.p_imu_cam,
            camera.timeshift_cam_imu_s,
            lens,
            camera.distortion_model,
            camera.resolution,
            covariance,
            inflation,
            "intrinsics" in rig.fixed or (bool(camera.lens_sigma) and not any(camera.lens_sigma)),
            "intrinsics" in rig.fixed and any(camera.lens_sigma),
            camera.model_fits,
            rig.duration_s,
            rig.reading_hashes,
            (rig.devices.get("imu", ""), rig.devices.get(f"camera/{camera.name}", "")),
            notes,
            camera.topic,
        )
    )


def _of_blocks(camera: RigCamera, size: int) -> tuple[FloatArray, float]:
    """Bound of a covariance of which only the blocks are known: with k of them, P <= k diag(P_11 ... P_kk).

    (For any x = sum x_i the square of a sum of k terms is at most k times the sum of their squares.)
    """
    covariance = np.zeros((size, size))
    covariance[:6, :6] = camera.covariance
    covariance[6, 6] = (camera.timeshift_sigma_s or 0.0) ** 2
    if camera.lens_sigma:
        covariance[range(7, size), range(7, size)] = np.square(camera.lens_sigma)
    blocks = int(np.count_nonzero(np.diag(covariance)[[0, *range(6, size)]]))
    return covariance * max(blocks, 1), float(max(blocks, 1))


def _completed(known: KnownCamera) -> KnownCamera:
    """Give values without a variance the assumed one, and say so."""
    n = len(known.covariance)
    focal = 1.0 if known.lens is None else float(known.lens[0])
    assumed = np.array(
        [ASSUMED_POSITION_M] * 3
        + [ASSUMED_ROTATION_RAD] * 3
        + [ASSUMED_SHIFT_S]
        + ([ASSUMED_LENS_SHARE * focal] * 4 + [ASSUMED_DISTORTION] * (n - 11) if n > 7 else [])
    )
    missing = np.diag(known.covariance) <= 0.0
    covariance = known.covariance + np.diag(np.where(missing, assumed**2 * known.inflation, 0.0))
    words = {
        "position": f"{1e3 * ASSUMED_POSITION_M:g} mm",
        "rotation": f"{np.rad2deg(ASSUMED_ROTATION_RAD):.2g} deg",
        "time shift": f"{1e3 * ASSUMED_SHIFT_S:g} ms",
        "lens": f"{100 * ASSUMED_LENS_SHARE:g} % of the focal length",
    }
    lacking = [f"{name} {words[name]}" for name, block in BLOCKS.items() if missing[block].any()]
    text = f"{known.source}: no sigma given, assumed: {', '.join(lacking)}"
    return replace(known, covariance=covariance, notes=(*known.notes, *([text] if lacking else [])))
