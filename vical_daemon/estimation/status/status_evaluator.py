"""Says how far to trust the filter: status, reasons in words, progress, withheld directions."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from vical_daemon.estimation.events import Cause, Event, EventKind
from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.snapshot import camera_estimate, imu_estimate
from vical_daemon.estimation.geometry.camera_model import EQUIDISTANT
from vical_daemon.estimation.guidance import Edge, Guidance, Lack, Verb, WeakDirection, of_camera
from vical_daemon.estimation.measurements import BoolArray, CalibrationOptions, FloatArray
from vical_daemon.estimation.model.camera_rays import PATCHES
from vical_daemon.estimation.model.frame_report import FrameReport
from vical_daemon.estimation.model.priors import OFF, SURE
from vical_daemon.estimation.model.snapshot import in_gyro_frame
from vical_daemon.estimation.result import CalibrationEstimate, CameraEstimate, HeldOutCheck, Status
from vical_daemon.estimation.selection import clock_drift, model_mixture, model_selection
from vical_daemon.estimation.significance import EVERY_S
from vical_daemon.estimation.status.evaluator import (
    CONFIRMING,
    Evaluator,
    Verdict,
    lacking_verdict,
    lens_known,
    lens_verdict,
)
from vical_daemon.estimation.status.excitation import ALL_WAYS
from vical_daemon.estimation.status.holdout_check import HELD_BACK_EVERY_S, imu_noise_error
from vical_daemon.estimation.status.mounting_changes import (
    IRRELEVANT_M,
    IRRELEVANT_PX,
    differences,
    lens_difference,
    visible_move_m,
)
from vical_daemon.estimation.wording import not_in_view

IMAGES_WANDER = "whole images move against the motion of the IMU: image stabilisation, or something is loose"
SHIFT_VARIES = "the time shift varies within seconds: fix the exposure time, or stamp the middle of exposures"
_ENOUGH_S = 10.0  # until then a drift of the clocks of 100 ppm could hide
_RECENT = 60  # images by which the fit of late is known; before, no status is one
_KEPT_CHECKS = round(3600.0 / HELD_BACK_EVERY_S)  # of an hour
_ACROSS, _DOWN = (2 * n for n in PATCHES)  # parts of the picture
_LEAST = 5  # corners of a part that has been seen
_SHARE = 0.5  # of the parts along an edge
_PARTLY = 0.75  # of the most corners in one image; fewer: targets are seen that are partly in the picture


class StatusEvaluator(Evaluator):
    """Watches what goes in and out of the filter.

    Args:
        options: Switches and targets.
    """

    def __init__(self, options: CalibrationOptions) -> None:
        super().__init__(options, "the target has not been seen yet: show the whole board to the camera", 300)
        self._asked = options.estimate
        self.frames = 0
        self.in_doubt = ""
        self.clocks_doubtful = False  # a time shift may be drifting
        self.silent: frozenset[str] = frozenset()  # cameras from which nothing comes now
        self.not_joined = ""  # why a camera that is seen now could not join the others yet
        self._partial = ""
        self._reopened_s = -np.inf
        self._points = [0, 0]
        self._recent_used: deque[bool] = deque(maxlen=_RECENT)
        self._held_back: deque[float] = deque(maxlen=40)
        self.held_out: deque[HeldOutCheck] = deque(maxlen=_KEPT_CHECKS)
        self._residuals: dict[str, deque[tuple[float, int]]] = {}
        self._cover = Cover()
        self._before: dict[str, CameraEstimate] = {}  # from before a change, until it is known what changed
        self._named = True  # that a mounting changed has been announced
        self._stepped: set[str] = set()  # cameras of which a step of the time shift was, since that change

    # ------------------------------------------------------------------ what happens
    def started(self, t_s: float, partial: str = "") -> None:
        """The filter runs from `t_s` on; `partial`: what the motion did not show, and was guessed."""
        self.reason, self._started_s, self._partial = "", t_s, partial
        self.not_joined = ""
        self._recent_used.clear()
        self._squares.clear()
        self._held_back.clear()
        self._after_change()

    def reopened(self, t_s: float) -> None:
        """Something that was known has to be found again: patience begins again at `t_s`."""
        self._reopened_s = t_s
        self._steady.reset(min(self.status, Status.CONVERGING, key=list(Status).index))

    def jumped(self, t_s: float) -> None:
        """Something has changed at `t_s`, and the filter allows for it."""
        self._recent_used.clear()
        self._squares.clear()
        self._held_back.clear()
        self.reopened(t_s)

    def may_have_moved(self, before: CalibrationFilter, why: Cause, *, sure: bool) -> None:
        """A mounting may have changed, and the filter allows for it.

        Args:
            before: The filter before the change.
            why: What speaks for it.
            sure: Nothing else explains the images.
        """
        known = self.weighed(before)
        self._before = self._before or {name: self._camera(name, known) for name in _seen(known)}
        self._named = sure
        self._stepped.clear()
        if self._named:
            self.announce_change(why)

    def changed(self, why: Cause) -> None:
        """The rig has changed: the calibration is found again."""
        self._named = True
        self._change(why, Status.INCONSISTENT)

    def held_back(self, ratio: float, f: CalibrationFilter, camera: str) -> None:
        """Take in how well the imu alone predicted an image.

        Args:
            ratio: Squared error over its predicted variance.
            f: The filter.
            camera: Its name.
        """
        self._held_back.append(ratio)
        self.held_out.append(HeldOutCheck(self.elapsed_s, ratio))
        error = imu_noise_error(self._held_back, f, camera)
        if error is not None:
            self.announce(Event(EventKind.IMU_NOISE, value=error), once="imu noise")

    def confirms(self, t_s: float) -> bool:
        """Whether enough has been seen since the start, up to `t_s`, to confirm what the sigmas say."""
        return self.frames >= _RECENT and t_s - (self._started_s or 0.0) >= _ENOUGH_S

    def saw_frame(self, report: FrameReport, f: CalibrationFilter) -> None:
        """Take the verdict of one frame."""
        accepted = int(np.count_nonzero(report.accepted))
        self._points[0] += len(report.accepted) - accepted
        self._points[1] += len(report.accepted)
        self._recent_used.append(report.used)
        if not report.used:
            return
        self.frames += 1
        self._squares.append((report.nis, report.dof))
        square = self._residuals.setdefault(report.camera, deque(maxlen=400))
        good = report.residual_px[report.accepted].ravel()
        square.append((float(good @ good), len(good)))
        self._cover.saw(report, f)
        if f.unobservable is not None:  # with guesses nothing can be said of what else may be off
            return
        shared = f.shared[report.camera]
        self._announce_jitter(report.camera, shared.jitter_found_s)
        if shared.wander_px:
            event = Event(EventKind.IMAGES_WANDER, report.camera, shared.wander_px)
            self.announce(event, once=f"wander {report.camera}")
        if shared.wander_s and shared.correlation_known:
            event = Event(EventKind.TIMESHIFT_VARIES, report.camera, shared.wander_s)
            self.announce(event, once=f"varies {report.camera}")

    # ------------------------------------------------------------------ output
    def estimate(
        self, f: CalibrationFilter | None, stale: CalibrationFilter | None = None
    ) -> CalibrationEstimate:
        """Put everything together; `stale`: what was known before a change, shown while restarting."""
        shares = None if f is None else model_selection.weights(f)
        self.in_doubt = "" if f is None else self._doubt(f, shares)
        self.believed &= not self.in_doubt
        axes_m = _axes_m(f or stale)
        f = None if f is None else self.weighed(f, shares)
        stale = None if stale is None else self.weighed(stale)
        shown = f or stale
        cameras = {} if shown is None else {name: self._camera(name, shown) for name in _seen(shown)}
        missing = {} if f is None else {name: self._missing(e, name, f) for name, e in cameras.items()}
        verdict = self._decide(f, missing)
        if f is None:
            reported = self._published(verdict)
        else:
            first = _seen(f)[0]
            named = first if len(f.layout.cameras) > 1 else ""
            reported = self._followed(verdict, f.state.cameras[first].R_imu_cam, f.state.gyro_bias, named)
            if not reported.guidance and self.status != Status.INCONSISTENT:
                reported = reported._replace(guidance=self._cover.advice())
        if f is None and stale is not None and self._ever_converged:
            self._before = self._before or cameras
        elif f is not None and self._before and cameras.keys() >= self._before.keys():  # none is absent
            self._report_change(cameras, f.state.t_s, doubt=_lens_may_have_jumped(f, shares))
        return self._put_together(
            reported,
            cameras,
            missing,
            partial=f is not None and f.unobservable is not None,
            frames=self.frames,
            imu=None if shown is None else imu_estimate(shown, self._asked, axes_m),
            gravity=[] if shown is None else self._of_stated_size(shown.state.gravity),
            refused=self._points[0] / max(self._points[1], 1),
        )

    def _of_stated_size(self, gravity: FloatArray) -> list[float]:
        """Gravity with its direction alone estimated: scale of the accelerometer and its size look alike."""
        return [self.options.gravity_mps2 / float(np.linalg.norm(gravity)) * float(x) for x in gravity]

    def _report_change(self, now: dict[str, CameraEstimate], t_s: float, *, doubt: bool) -> None:
        """Name what has changed as soon as that is known; once it is known well, report by how much.

        Args:
            now: The cameras.
            t_s: Time, s.
            doubt: A fixed lens may have changed instead: the mounting for its values is then another, too.
        """
        moved, lens = {}, {}
        for name, before in self._before.items():
            moved[name] = differences(name, before, now[name], self.elapsed_s, Cause.BUMPED)
            lens[name] = lens_difference(name, before, now[name], self.elapsed_s)
        since_s = t_s - max(self._started_s or 0.0, self._reopened_s)
        # the first images after a change may not show yet that a lens explains them as well
        if not self._named and since_s >= EVERY_S:
            kinds = {event.kind for events in moved.values() for event in events}
            if kinds <= {EventKind.TIMESHIFT_CHANGED}:
                self._clocks_stepped(moved)
            elif not doubt:
                self._named = True
                self.announce_change(Cause.IMAGES_DISAGREE)
        visible_m = {name: visible_move_m(before, now[name]) for name, before in self._before.items()}
        well = since_s >= _ENOUGH_S or max(visible_m.values()) <= IRRELEVANT_M
        known = well and self.status == Status.CONVERGED
        for event in (event for events in lens.values() for event in events):
            if known or event.sigma is None or event.sigma < IRRELEVANT_PX:
                self.announce(event, once=f"lens {event.camera} {self._reopened_s}")
        if not known:
            return
        if not any(moved.values()) and not any(lens.values()):
            self.announce_all(Event(EventKind.NOT_BUMPED, name, visible_m[name]) for name in moved)
        for name, events in moved.items():
            told = name in self._stepped
            self.announce_all(e for e in events if not (told and e.kind is EventKind.TIMESHIFT_CHANGED))
        self._before = {}

    def _clocks_stepped(self, changed: dict[str, list[Event]]) -> None:
        """Announce time shifts that differ where nothing else does; each once after a change."""
        for name, events in changed.items():
            if events and name not in self._stepped:
                self._stepped.add(name)
                self.announce(Event(EventKind.TIMESHIFT_STEPPED, name, events[0].value))

    def _doubt(self, f: CalibrationFilter, shares: model_mixture.Weights | None) -> str:
        """What keeps small sigmas from being believed, in words; empty: nothing."""
        drifts = (clock_drift.in_doubt(f, name, believed=self.believed) for name in _seen(f))
        if self.clocks_doubtful or self._clock_wanders or any(drifts):
            return clock_drift.CLOCKS_IN_DOUBT
        if any(x.wander_px for x in f.shared.values()):
            return IMAGES_WANDER
        varying = [x for x in f.shared.values() if x.wander_s]
        if varying:
            return SHIFT_VARIES if any(x.correlation_known for x in varying) else CONFIRMING
        return model_selection.IN_DOUBT.get(model_selection.in_doubt(f, shares, believed=self.believed), "")

    def weighed(self, f: CalibrationFilter, shares: model_mixture.Weights | None = None) -> CalibrationFilter:
        """The filter to be reported: mean and covariance over all models of imu, target and clocks.

        Args:
            f: The filter.
            shares: `model_selection.weights` of it, if they are known.
        """
        f = model_selection.averaged(f, shares, self._asked).allowing_for_arm_bias()
        if model_selection.IMU not in self._asked:
            cameras, S = in_gyro_frame(f.layout, f.state.gyro_matrix, f.state.cameras, f.S)
            f = replace(f, state=replace(f.state, cameras=cameras), S=S)
        return clock_drift.averaged(f)

    def _camera(self, name: str, f: CalibrationFilter) -> CameraEstimate:
        square, count = map(sum, zip(*self._residuals.get(name) or [(0.0, 0)], strict=True))
        rms = float(np.sqrt(square / count)) if count else 0.0
        return camera_estimate(f, name, rms)

    def _missing(self, e: CameraEstimate, name: str, f: CalibrationFilter) -> list[WeakDirection]:
        where = f.layout.cameras[name]
        if where.position is None and where.timeshift is None:
            return []
        if name in f.shared:  # no motion would show better what varies
            square = e.timeshift_sigma_s**2 - f.shared[name].wander_s ** 2
            e = replace(e, timeshift_sigma_s=math.sqrt(max(square, 0.0)))
        weak = self._weak(e, f.state.cameras[name].R_imu_cam, f.state.gyro_bias)
        return weak if len(f.layout.cameras) == 1 else [of_camera(direction, name) for direction in weak]

    def _decide(self, f: CalibrationFilter | None, missing: dict[str, list[WeakDirection]]) -> Verdict:
        """Status, reason and guidance by the data up to now."""
        if f is None:
            return self._before_start()
        trouble = self._trouble()
        if trouble:
            return Verdict(Status.INCONSISTENT, trouble)
        weak = sorted((g for gs in missing.values() for g in gs), key=lambda g: -g.excess)
        lacking = self._steady.counted(weak)
        if not lacking:
            if self._partial:
                return Verdict(Status.DEGENERATE, self._partial, ALL_WAYS)
            waited_for = f.absent - self.silent
            if waited_for:
                return Verdict(Status.CONVERGING, self.not_joined or not_in_view(waited_for))
            return self._once_known(enough=self.confirms(f.state.t_s), doubt=self.in_doubt)
        lens = self._lens_to_blame(f, missing)
        if lens:
            return lens_verdict(lacking[0], lens, off=model_mixture.lens_block(lens) in f.off)
        since_s = max(self._started_s or 0.0, self._reopened_s)
        return lacking_verdict(lacking, shown_s=f.state.t_s - since_s)

    def _lens_to_blame(self, f: CalibrationFilter, missing: dict[str, list[WeakDirection]]) -> str:
        """The camera whose fixed lens is why something is missing; empty: there is none.

        It is if images contradict it, whatever the motion shows, or if nothing is missing but for its errors.
        """
        off = [name for name in missing if missing[name] and model_mixture.lens_block(name) in f.off]
        if off:
            return max(off, key=lambda n: max(m.excess for m in missing[n]))
        cameras = {name: lens_known(self._camera(name, f)) for name in _seen(f) if name in f.layout.held}
        if not cameras or any(self._missing(e, name, f) for name, e in cameras.items()):
            return ""
        return max(missing, key=lambda n: max((m.excess for m in missing[n]), default=0.0))

    def _trouble(self) -> str:
        """Why the filter cannot be believed at present; empty when it can."""
        refused = self._recent_used.count(False)
        if len(self._recent_used) >= 20 and refused > len(self._recent_used) // 3:
            return f"{refused} of the last {len(self._recent_used)} images do not fit the motion"
        return ""


def _axes_m(f: CalibrationFilter | None) -> FloatArray | None:
    """Positions of the accelerometer's axes, if they are known to be apart or asked for; m, shape (3, 3)."""
    return f.state.accel_positions if f is not None and model_selection.SIZE_EFFECT in f.off else None


def _lens_may_have_jumped(f: CalibrationFilter, shares: model_mixture.Weights | None) -> bool:
    """Whether it is open which of a mounting and a fixed lens has changed."""
    held = [name for name, lens in f.layout.held.items() if lens.off > OFF]
    blocks = [model_mixture.lens_block(name) for name in held]
    return shares is not None and any(model_mixture.not_zero(shares, x) > 1.0 - SURE for x in blocks)


def _seen(f: CalibrationFilter) -> list[str]:
    """Cameras that have seen the target."""
    return [name for name in f.layout.cameras if name not in f.absent]


class Cover:
    """The pictures of all cameras whose lenses are estimated."""

    def __init__(self) -> None:
        self._pictures: dict[str, ImageCoverage] = {}

    def saw(self, report: FrameReport, f: CalibrationFilter) -> None:
        """Take the corners that the filter used; pictures of a fisheye may be round, and are left out."""
        camera = f.state.cameras[report.camera]
        if not f.layout.lens_free(report.camera) or camera.distortion_model == EQUIDISTANT:
            return
        if report.camera not in self._pictures:
            self._pictures[report.camera] = ImageCoverage(camera.resolution)
        self._pictures[report.camera].add(report.uv_px[report.accepted])

    def advice(self) -> Guidance:
        """What to show the cameras, the first that lacks something; nothing where none does."""
        for name, picture in self._pictures.items():
            edges = picture.unseen_edges()
            if edges:
                return Guidance(Verb.SHOW, lack=Lack.EDGES, camera=name, edges=edges)
        return Guidance()


class ImageCoverage:
    """Counts corners by part of the picture: beyond them a lens that is estimated is extrapolated.

    On a real recording a half without corners near two edges gave a lens that was 3.5 px off there. Asked for
    is only what can be shown: a detector that needs the whole target sees no corners at the edges.

    Args:
        resolution: Width and height, px.
    """

    def __init__(self, resolution: tuple[int, int]) -> None:
        self._part_px = np.array(resolution, dtype=np.float64) / (_ACROSS, _DOWN)
        self._counts = np.zeros((_DOWN, _ACROSS), dtype=np.int64)
        self._most, self._least = 0, np.iinfo(np.int64).max  # corners in one image

    def add(self, uv_px: FloatArray) -> None:
        """Take the corners of one image, shape (n, 2)."""
        column, row = (uv_px / self._part_px).astype(np.intp).T
        places = np.ravel_multi_index((row, column), self._counts.shape, mode="clip")
        self._counts += np.bincount(places, minlength=self._counts.size).reshape(self._counts.shape)
        self._most, self._least = max(self._most, len(uv_px)), min(self._least, len(uv_px))

    def unseen_edges(self) -> tuple[Edge, ...]:
        """Edges along most of which no corners have been, though they could."""
        if self._least >= _PARTLY * self._most:
            return ()
        seen = self._counts >= _LEAST
        edges: dict[Edge, BoolArray]
        edges = {"left": seen[:, 0], "right": seen[:, -1], "top": seen[0], "bottom": seen[-1]}
        return tuple(name for name, parts in edges.items() if parts.mean() < _SHARE)
