"""A camera that sees the target for the first time when others are calibrated already joins them.

Its mounting, time shift and lens are found from its own images, as at a start. Then a window is adjusted
that has what the filter knew before the first of them for its prior, so that no image counts twice.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.init import closed_form
from vical_daemon.estimation.init.attempts import LONG_S, Attempts
from vical_daemon.estimation.init.closed_form import StartData
from vical_daemon.estimation.init.initial_filter import with_camera
from vical_daemon.estimation.init.initializer import MIN_SPAN_S, Attempt, frames_from
from vical_daemon.estimation.init.numbering import late_numbered_differently
from vical_daemon.estimation.init.readout_start import at_middle_row
from vical_daemon.estimation.init.rig_model import RigModel
from vical_daemon.estimation.init.target_poses import TargetPose, usable_poses
from vical_daemon.estimation.init.window_start import Step, window_start
from vical_daemon.estimation.measurements import CalibrationOptions, Frames, PointsFrame


class LateCameras:
    """Keeps the images since the first one of a camera that is absent, until it can join.

    One camera at a time: while one is collected for, the images of other absent ones are left out.

    Args:
        options: Switches.
        rig: Its model.
        step: Propagates a filter to an image and corrects it.
    """

    def __init__(self, options: CalibrationOptions, rig: RigModel, step: Step) -> None:
        self._options, self._rig, self._step = options, rig, step
        self.anew()

    def anew(self) -> None:
        """Forget what was seen."""
        self._known: CalibrationFilter | None = None
        self._camera = ""
        self._frames: Frames = []
        self._attempts = Attempts(first_s=0.5)

    @property
    def oldest_s(self) -> float:
        """Instant from which readings are needed, s; infinite: none are."""
        return np.inf if self._known is None else self._known.state.t_s

    def take(self, f: CalibrationFilter, t_cam_s: float, frame: PointsFrame) -> bool:
        """Keep an image where it may be needed.

        Args:
            f: The filter, before this image.
            t_cam_s: Stamp of the image, s.
            frame: The image.

        Returns:
            Whether it is of an absent camera, so that the filter cannot use it.
        """
        absent = frame.camera in f.absent
        if not len(frame.ids):
            return absent
        first_s = next((t_s for t_s, kept in self._frames if kept.camera == frame.camera), t_cam_s)
        if t_cam_s - first_s > LONG_S:  # it did not see enough, or does not fit: from another image on
            self.anew()
        if self._known is None and absent and f.unobservable is None:
            self._known, self._camera = deepcopy(f), frame.camera
        if self._known is not None and (not absent or frame.camera == self._camera):
            self._frames.append((t_cam_s, frame))
        return absent

    def attempt(self, buffer: ImuBuffer, *, at_end: bool = False) -> Attempt | None:
        """Try to let the camera join; None: it is not time for an attempt."""
        own = [x for x in self._frames if x[1].camera == self._camera]
        if self._known is None or len(own) < 2 or own[-1][0] - own[0][0] < MIN_SPAN_S:
            return None
        if not (at_end or self._attempts.due(own[-1][0])):
            return None
        self._attempts.tried(own[-1][0])
        found = self._join(self._known, buffer)
        if found.half_turned:
            self._frames = self._rig.turns.from_the_other_end(self._camera, self._frames)
            found = self._join(self._known, buffer)
        return found

    def _join(self, known: CalibrationFilter, buffer: ImuBuffer) -> Attempt:
        """Try with the images as they are numbered now."""
        name, rig, frames = self._camera, self._rig, self._frames
        priors = {name: rig.priors[name]}
        own = {name: [x for x in frames if x[1].camera == name]}
        data = StartData(buffer, own, priors, self._options, rig.layout, rig.target, may_resize=False)
        result = closed_form.attempt(data, may_be_partial=False)
        if result.state is None:
            return Attempt(reason=result.reason, rolling=result.rolling)
        turned = late_numbered_differently(known, name, result.state, buffer)
        if turned is not None:
            return Attempt(reason=str(turned), half_turned=name if turned.half and rig.turns.alike else "")
        start = result.state
        state = replace(
            known.state,
            t_s=start.t_s,
            R_world_imu=start.R_world_imu,
            p_world_imu=start.p_world_imu,
            v_world_imu=start.v_world_imu,
            cameras={**known.state.cameras, name: start.cameras[name]},
        )
        images = frames_from(frames, state)
        poses = result.poses + self._poses(known, images)
        make = partial(with_camera, known, name)
        found = window_start(state, poses, images, make, self._step, buffer, rig.target)
        if found is None:
            return Attempt(reason=f"{name}: its images do not fit those of the other cameras yet")
        return Attempt(found.filter, images)

    def _poses(self, known: CalibrationFilter, images: Frames) -> list[TargetPose]:
        """Poses of the cameras that are known."""
        out: list[TargetPose] = []
        for name, camera in known.state.cameras.items():
            own = [x for x in images if x[1].camera == name and name not in known.absent]
            own = at_middle_row(own, camera.readout_s, camera.resolution, camera.readout_axis)
            out += usable_poses(own, camera, self._rig.target)
        return out
