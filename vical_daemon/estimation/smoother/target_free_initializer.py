"""Attempts to start a target-free calibration from the tracks and inertial data of the last seconds."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.inertial.white_noise import at_least_measured
from vical_daemon.estimation.init.attempts import LONG_S, MOVED_PX, Attempts, rest_in_words
from vical_daemon.estimation.init.camera_start import camera_by_rotations, not_sure_yet, starting_camera
from vical_daemon.estimation.init.closed_form import PARTIAL_S
from vical_daemon.estimation.measurements import (
    IMAGE_GAP_S,
    CalibrationOptions,
    CameraPrior,
    FloatArray,
    Frames,
)
from vical_daemon.estimation.model import imu_scale
from vical_daemon.estimation.model.priors import (
    LONG_SHIFT_SIGMA_S,
    ROTATION_SIGMA_RAD,
    SHIFT_SIGMA_S,
    WINDOW_START,
)
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.smoother.marginal_prior import MarginalPrior
from vical_daemon.estimation.smoother.track_start import (
    ArmPrior,
    NoStartError,
    TrackStart,
    mounting_about,
    still_axis,
)
from vical_daemon.estimation.smoother.window import Window
from vical_daemon.estimation.temporal.epipolar_fit import EpipolarFit, epipolar_fit
from vical_daemon.estimation.temporal.epipolar_pairs import LAGS_S
from vical_daemon.estimation.temporal.mounting_search import likely_mountings
from vical_daemon.estimation.temporal.td_icp import td_icp
from vical_daemon.estimation.temporal.track_orientations import MIN_FEATURES, track_orientations


class _Found(NamedTuple):
    """What rotations say, or what was known before."""

    camera: CameraState
    imu: FloatArray  # biases, and numbers of `imu_scale`, see `PreintegratedLinks`
    arm_sigma_m: float
    about: FloatArray | None = None  # axis of the imu about which the mounting is not known, unit


_REACH_S = 2.0  # time shifts that are looked for, to both sides of what is given
_NEAR_S = np.linspace(-0.2, 0.2, 5)  # time shifts about what is given, where strung-together turns show none
_LEAST_S, _LEAST_KNOWN_S = 3.5, 2.0  # of images in an attempt at least; with a calibration to begin with
_ROTATION_SIGMA_RAD = 2.0 * ROTATION_SIGMA_RAD  # of the mounting by rotations: a window converges from there
_LEAST_IMAGES, _MOST_IMAGES = 20, 120  # of a start: its cost grows with the cube
_MOST_FEATURES = 20_000  # in pairs of images: more of the same images add little


class TargetFreeInitializer:
    """Decides when to try, and tries.

    Args:
        options: Switches and noise.
        prior: What is known about the camera.

    Attributes:
        attempts: When they are made.
        motion_missing: What the last attempt lacked was motion, not time.
        held: Axis of the imu along which the lever arm is not known and stays as it is, unit, shape (3,): the
            last start was a partial one. None: all of it shows.
    """

    def __init__(self, options: CalibrationOptions, prior: CameraPrior) -> None:
        self.options, self.prior = options, prior
        self.motion_missing = False
        self.held: FloatArray | None = None
        self.attempts = Attempts(first_s=1.0)

    def stretch(
        self, buffer: ImuBuffer, frames: Frames, end_s: float, known: MarginalPrior | None, *, last: bool
    ) -> Frames | str | None:
        """Choose the images of an attempt when it is time for one.

        Args:
            buffer: Inertial readings.
            frames: Images that wait, in order.
            end_s: Inertial data cover images up to about here, s.
            known: Calibration and biases of before, where there are any.
            last: End of the data: try now.

        Returns:
            The images; why there are none; or None when it is not time to try.
        """
        if not (last or self.attempts.due(end_s)):
            return None
        shift = known.camera.timeshift_s if known else self.prior.timeshift_cam_imu_s or 0.0
        usable = _last_stretch(frames, end_s - max(shift, 0.0), buffer.oldest_s + 0.05 - min(shift, 0.0))
        if not usable or usable[-1][0] - usable[0][0] < (_LEAST_KNOWN_S if known else _LEAST_S) - 0.1:
            self.motion_missing = False
            return (
                _too_few_features(frames, end_s)
                or "collecting the first seconds: move the rig, keep textured things in view"
            )
        self.attempts.tried(end_s)
        self.motion_missing = True
        if _still(usable):
            return rest_in_words(buffer, "move it to and fro while turning it")
        return usable

    def window(self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior | None) -> Window | str:
        """Make a window of a stretch, with the calibration of before where there is one.

        Args:
            buffer: Inertial readings.
            frames: See `stretch`.
            known: Calibration and biases of before, or None.

        Returns:
            A window to adjust, or why there is none.
        """
        if known is None:
            self.held = None
        found = self._rotations(buffer, frames, self.prior) if known is None else _known(known)
        return found if isinstance(found, str) else self._structure(buffer, frames, found)

    def window_anew(self, buffer: ImuBuffer, frames: Frames, known: MarginalPrior) -> Window | str:
        """Make a window of a stretch with mounting and time shift found again, and all else as known.

        Args:
            buffer: Inertial readings.
            frames: See `stretch`.
            known: Calibration and biases of before.

        Returns:
            A window to adjust, or why there is none.
        """
        if self.held is not None:
            return "turns about one axis do not show what has changed"
        c = known.camera
        fx, fy, cx, cy = c.intrinsics.tolist()
        prior = replace(
            self.prior,
            intrinsics=(fx, fy, cx, cy),
            distortion=tuple(c.distortion.tolist()),
            T_imu_cam=(c.R_imu_cam, c.p_imu_cam),
            timeshift_cam_imu_s=c.timeshift_s,
            readout_s=c.readout_s,
            readout_axis=c.readout_axis,
        )
        found = self._rotations(buffer, frames, prior, known)
        if isinstance(found, str):
            return found
        if found.about is not None:
            return "turns about one axis do not show what has changed"
        camera = replace(
            _known(known).camera, R_imu_cam=found.camera.R_imu_cam, timeshift_s=found.camera.timeshift_s
        )
        imu = np.concatenate([found.imu[:6], known.imu[1:]])
        return self._structure(buffer, frames, _Found(camera, imu, found.arm_sigma_m))

    def _structure(self, buffer: ImuBuffer, frames: Frames, found: _Found) -> Window | str:
        """Speed, scale, lever arm and points; after turns about one axis the mounting about it, too."""
        camera = found.camera
        frames = [x for x in frames if buffer.oldest_s < x[0] + camera.timeshift_s < buffer.newest_s - 5e-3]
        if len(frames) < _LEAST_IMAGES:
            return "inertial data do not cover the images: are both stamped by the same clock?"
        noise, gravity = at_least_measured(self.options.imu_noise, buffer.rows), self.options.gravity_mps2
        held = self.held if found.about is None else found.about
        arm = ArmPrior(camera.p_imu_cam, found.arm_sigma_m, held)
        try:
            start = TrackStart(buffer, frames, camera, found.imu, noise, gravity)
            if found.about is not None:
                camera.R_imu_cam = mounting_about(start, found.about, camera.R_imu_cam, arm)
            window = start.window(arm)
        except NoStartError as error:
            return str(error)
        self.held = held
        return window

    def _rotations(
        self, buffer: ImuBuffer, frames: Frames, prior: CameraPrior, known: MarginalPrior | None = None
    ) -> _Found | str:
        """Mounting, delay, lens (unless `known`) and gyro bias from the epipolar constraint; or why not."""
        camera = starting_camera(prior)
        rows = buffer.rows
        shift_s = prior.timeshift_cam_imu_s or 0.0
        begin_s, end_s = frames[0][0] + shift_s - _REACH_S, frames[-1][0] + shift_s + _REACH_S
        reach = (rows[:, 0] > begin_s) & (rows[:, 0] < end_s)
        t, gyro = rows[reach, 0], rows[reach, 1:4]
        given = prior.T_imu_cam if "extrinsics" in self.options.fix else None
        inside = (t > frames[0][0] + shift_s) & (t < frames[-1][0] + shift_s)
        one_axis = still_axis(t[inside], gyro[inside], np.zeros(3)) is not None
        if one_axis and given is None and frames[-1][0] - frames[0][0] < PARTIAL_S:
            return "the rig turns about one axis only so far: turn it about a second one"
        gyro_bias = np.zeros(3) if known is None else known.bias[:3]
        seeds, reason = self._seeds(t, gyro - gyro_bias, frames, camera, prior, look_around=not one_axis)
        lens = (camera.intrinsics, camera.distortion, camera.distortion_model)
        free_lens = known is None and "intrinsics" not in self.options.fix
        best = _best_fit(t, gyro, frames, lens, seeds, free_lens=free_lens)
        if best is None:
            return (
                reason or "too few features are followed from image to image: more texture or light is needed"
            )
        about = None
        worst = float(np.sqrt(np.max(np.diag(best.rotation_covariance))))
        most = _ROTATION_SIGMA_RAD if given is None else np.inf
        long = frames[-1][0] - frames[0][0] > PARTIAL_S
        limit_s = LONG_SHIFT_SIGMA_S if long else SHIFT_SIGMA_S
        why = not_sure_yet(best.timeshift_sigma_s, worst, limit_s, most)
        if why and long:
            inside = (t > frames[0][0] + best.timeshift_s) & (t < frames[-1][0] + best.timeshift_s)
            about = _only_unsure_about(best, still_axis(t[inside], gyro[inside], best.gyro_bias))
        if why and about is None:
            return reason or why
        camera.intrinsics, camera.distortion = best.intrinsics, best.distortion
        camera = camera_by_rotations(camera, prior, self.options.fix, best.R_imu_cam, best.timeshift_s)
        sigma = WINDOW_START.lever_arm_m if given is None else 1e-4
        imu = np.concatenate([best.gyro_bias, np.zeros(3 + imu_scale.NUMBERS)])
        return _Found(camera, imu, sigma, about)

    def _seeds(
        self,
        t: FloatArray,
        gyro: FloatArray,
        frames: Frames,
        camera: CameraState,
        prior: CameraPrior,
        *,
        look_around: bool,
    ) -> tuple[list[tuple[FloatArray, float]], str]:
        """Places from which to start the fit, and what TD-ICP has to say against its own."""
        seeds: list[tuple[FloatArray, float]] = []
        if prior.T_imu_cam is not None:
            seeds.append((prior.T_imu_cam[0].copy(), prior.timeshift_cam_imu_s or 0.0))
        chains = track_orientations(
            (f for _, f in frames), camera.intrinsics, camera.distortion, camera.distortion_model
        )
        if not chains:
            return seeds, ""
        chain = max(chains, key=lambda c: len(c.t_cam_ns))
        chained = set(chain.t_cam_ns.tolist())
        t_cam = np.array([s for s, f in frames if f.t_cam_ns in chained])
        result = td_icp(t, gyro, t_cam, chain.R_world_cam, chain.covariance)
        shift, shifts = result.timeshift_cam_imu_s, _NEAR_S + (prior.timeshift_cam_imu_s or 0.0)
        known = result.R_imu_cam if result.status != "refused" else None
        if known is not None and shift is not None:
            seeds.append((known, shift))
            shifts = np.array([shift])
            if prior.T_imu_cam is not None:
                seeds.append((prior.T_imu_cam[0].copy(), shift))
        if result.status != "ok" and look_around and not result.still:
            lens = (camera.intrinsics, camera.distortion, camera.distortion_model)
            seeds += likely_mountings(t, gyro, frames, lens, shifts, known)
        return seeds, result.reason if known is None else ""


def _known(known: MarginalPrior) -> _Found:
    return _Found(deepcopy(known.camera), np.concatenate([known.bias[:3], np.zeros(3), known.imu[1:]]), 5e-3)


def _misfit(fit: EpipolarFit) -> float:
    return fit.error / max(fit.inliers, 0.1)


def _best_fit(
    t: FloatArray,
    gyro: FloatArray,
    frames: Frames,
    lens: tuple[FloatArray, FloatArray, str],
    seeds: list[tuple[FloatArray, float]],
    *,
    free_lens: bool,
) -> EpipolarFit | None:
    """The best of the fits from some mountings and delays; None: there is none."""
    features = len(LAGS_S) * sum(len(f.ids) for _, f in frames)
    every = max(1, math.ceil(features / _MOST_FEATURES))

    def fit(R: FloatArray, shift_s: float, **how: bool) -> EpipolarFit | None:
        return epipolar_fit(t, gyro, frames, lens, R, shift_s, every=every, **how)

    if len(seeds) != 1:  # look around with the lens as given: three times quicker
        fits = [f for f in (fit(*seed, roughly=True) for seed in seeds) if f is not None]
        best = min(fits, key=_misfit, default=None)
        if best is None:
            return None
        seeds = [(best.R_imu_cam, best.timeshift_s)]
    # turns about one axis may not show the lens; the window estimates it later
    return (fit(*seeds[0], fit_lens=True) if free_lens else None) or fit(*seeds[0])


def _only_unsure_about(fit: EpipolarFit, axis: FloatArray | None) -> FloatArray | None:
    """The axis of the imu that kept its direction, where the mounting is known but for a turn about it."""
    if axis is None or fit.timeshift_sigma_s > SHIFT_SIGMA_S:
        return None
    along = fit.R_imu_cam.T @ axis
    across = np.eye(3) - np.outer(along, along)
    worst = np.sqrt(np.linalg.eigvalsh(across @ fit.rotation_covariance @ across)[-1])
    return axis if worst < _ROTATION_SIGMA_RAD else None


def _last_stretch(frames: Frames, end_s: float, begin_s: float) -> Frames:
    """The last images without a hole between them; of very many every second or third.

    So many as a start needs may take a slow camera longer than a start usually looks back.
    """
    out: Frames = []
    for t, frame in reversed(frames):
        if t > end_s or len(frame.ids) < MIN_FEATURES:
            continue
        if t < begin_s or (out and out[-1][0] - t > IMAGE_GAP_S):
            break
        if len(out) > _LEAST_IMAGES and out[0][0] - t > LONG_S:
            break
        out.append((t, frame))
    every = max(1, math.ceil(len(out) / _MOST_IMAGES))
    return out[::every][::-1]


def _too_few_features(frames: Frames, end_s: float) -> str:
    """What to do if most images of the last seconds show too few features to be used; empty: they do not."""
    counts = [len(frame.ids) for t, frame in frames if end_s - LONG_S < t <= end_s]
    if not counts or end_s - frames[0][0] < _LEAST_S or np.median(counts) >= MIN_FEATURES:
        return ""
    return (
        f"most images show only {np.median(counts):.0f} features, fewer than {MIN_FEATURES}: "
        "more texture or light is needed"
    )


def _still(frames: Frames) -> bool:
    """Whether features hardly move over half a second, all along."""
    t = np.array([s for s, _ in frames])
    ahead = np.searchsorted(t, t + 0.5)
    travels = []
    for i in range(0, len(t), 3):
        if ahead[i] >= len(t):
            break
        a, b = frames[i][1], frames[int(ahead[i])][1]
        _, ka, kb = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
        if len(ka):
            travels.append(float(np.median(np.linalg.norm(a.uv_px[ka] - b.uv_px[kb], axis=1))))
    return bool(travels) and float(np.median(travels)) < MOVED_PX
