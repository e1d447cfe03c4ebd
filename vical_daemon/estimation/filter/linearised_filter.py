"""The filter over its first seconds, linearised about a motion and a calibration that are known roughly.

A linearised Kalman filter: it estimates the errors of a reference, so that its own mean may be as far from
the truth as the prior is wide, and nothing is lost to curvature. [docs/math/filter.md, eq. (21)]
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.filter.calibration_filter import CalibrationFilter
from vical_daemon.estimation.filter.image_update import ImageFit, corner_gate
from vical_daemon.estimation.filter.linearise import Image, Linear, by_derivatives, by_small_steps, is_rolling
from vical_daemon.estimation.filter.passed import smoothed
from vical_daemon.estimation.filter.propagate import move_by_derivatives
from vical_daemon.estimation.filter.reset import displaced
from vical_daemon.estimation.inertial.imu_buffer import ImuSegment
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.model.rates import rates_after
from vical_daemon.estimation.model.retract import difference, orthonormal, retract
from vical_daemon.estimation.model.state import ATTITUDE, POSITION, VELOCITY, State, grp_from_rotation

_SAME_S = 1e-5  # instants less apart are the same


class Instant(NamedTuple):
    """Motion of the reference at one instant.

    Attributes:
        t_s: Instant in the imu's clock, s.
        R: R_world_imu, shape (3, 3).
        p: p_world_imu, m, shape (3,).
        v: v_world_imu, m/s, shape (3,).
    """

    t_s: float
    R: FloatArray
    p: FloatArray
    v: FloatArray


class Reference(NamedTuple):
    """Motion and calibration about which a filter is linearised.

    Attributes:
        calibration: A state; its motion does not count.
        instants: The motion, in order; from each on inertial data carry it to the next.
    """

    calibration: State
    instants: list[Instant]


class Seen(NamedTuple):
    """What a filter knew when an image corrected it.

    Attributes:
        camera: Whose image it was.
        reference: About which all is linearised, there.
        offset: The mean before the image, as errors of the reference, shape (n,).
    """

    camera: str
    reference: State
    offset: FloatArray


@dataclass(slots=True)
class LinearisedFilter(CalibrationFilter):
    """A filter whose `state` is the reference about which it is linearised; its mean is stored apart.

    Attributes:
        offset: The mean, as errors of `state`, shape (n,).
        instants: Motion of the reference from here on.
        seen: The images so far.
        at_reference: Pixels of the last image as the reference has them, shape (n, 2).
    """

    offset: FloatArray = field(default_factory=lambda: np.zeros(0))
    instants: list[Instant] = field(default_factory=list)
    seen: list[Seen] = field(default_factory=list)
    at_reference: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    @classmethod
    def about(cls, reference: Reference, known: CalibrationFilter) -> LinearisedFilter:
        """What `known` knows, linearised about a reference.

        Args:
            reference: The filter begins at the first of its instants.
            known: A filter with mean and covariance there; is used up.
        """
        calibration, (begin, *later) = reference
        cameras = {name: replace(camera) for name, camera in calibration.cameras.items()}
        state = replace(
            calibration,
            t_s=begin.t_s,
            R_world_imu=begin.R,
            p_world_imu=begin.p,
            v_world_imu=begin.v,
            cameras=cameras,
        )
        fields_of = {x.name: getattr(known, x.name) for x in fields(known)} | {"state": state}
        offset = difference(known.state, state, known.layout)
        return cls(**fields_of, offset=offset, instants=later)

    @property
    def mean(self) -> State:
        """The most likely state."""
        return retract(self.state, self.layout, self.offset)

    def plain(self) -> CalibrationFilter:
        """The filter that goes on from the mean."""
        known = {x.name: getattr(self, x.name) for x in fields(CalibrationFilter)}
        out = CalibrationFilter(**known)
        out.step(self.offset)
        return out

    def smoothed(self) -> Reference:
        """The motion and calibration that fit all images so far and all readings, to first order.

        Time shifts stay, so that images stay at their instants.
        """
        changes = smoothed(self.passed, self.layout.drifts)
        errors = [seen.offset + change for seen, change in zip(self.seen, changes, strict=True)]
        instants = []
        for seen, e in zip(self.seen, errors, strict=True):
            s = displaced(seen.reference, self.layout, e, seen.camera)
            instants.append(Instant(s.t_s, s.R_world_imu, s.p_world_imu, s.v_world_imu))
        calibration = errors[0].copy()
        for shift, rate in self.layout.drifts:
            calibration[[shift, rate]] = 0.0
        return Reference(retract(self.seen[0].reference, self.layout, calibration), instants)

    def predict(self, segment: ImuSegment) -> None:
        """Propagate to the end of a segment; the reference goes on from its own instant where it has one."""
        state, d = self.state, self.layout.dynamic
        if len(segment.t_s) < 2 or segment.t_s[-1] <= segment.t_s[0]:
            self.rates = rates_after(state, segment, self.rates)
            return
        moved = move_by_derivatives(state, self.layout, np.eye(d), segment)
        self.offset[:9] = moved.linear @ self.offset[:d]
        for shift, rate in self.layout.drifts:
            self.offset[shift] += moved.seconds * self.offset[rate]
        Q = moved.influence.noise(self.imu_noise)
        self._grow(moved._replace(linear=moved.linear @ self.S[:d]), Q)
        self._predict_score(moved, Q)
        state.t_s = float(segment.t_s[-1])
        state.R_world_imu, state.p_world_imu, state.v_world_imu = orthonormal(moved.R), moved.p, moved.v
        while self.instants and self.instants[0].t_s < state.t_s + _SAME_S:
            there = self.instants.pop(0)
            if there.t_s > state.t_s - _SAME_S:
                self._go_on_from(there)
        self.rates = rates_after(state, segment, self.rates)

    def _go_on_from(self, there: Instant) -> None:
        """Take another motion for reference; the mean stays where it is."""
        state = self.state
        self.offset[ATTITUDE] += grp_from_rotation(there.R.T @ state.R_world_imu)
        self.offset[POSITION] += state.p_world_imu - there.p
        self.offset[VELOCITY] += state.v_world_imu - there.v
        state.R_world_imu, state.p_world_imu, state.v_world_imu = there.R, there.p, there.v

    def _linearise(self, image: Image) -> Linear:
        """About the reference; the pixels are those of the mean."""
        rolling = is_rolling(self.state, self.layout, image.camera)
        derive = by_small_steps if rolling else by_derivatives
        lin = derive(self.state, self.layout, self.rates, image, self.S)
        self.at_reference = lin.z
        z = lin.z + (lin.ways @ (lin.by_error @ self.offset)).reshape(-1, 2)
        return self._with_shared(image, replace(lin, z=z))

    def _belonging(self, image: Image, innovation: FloatArray, lin: Linear) -> BoolArray:  # noqa: ARG002
        """By the reference: it has been adjusted to all images, while the mean may have lost its way."""
        return corner_gate(image, image.uv - self.at_reference, lin)

    def _misses_gate(self, fit: ImageFit) -> bool:  # noqa: ARG002
        """Corners have been compared with the reference; errors over a hole in the images are no news."""
        return False

    def _arm_score(self, image: Image, lin: Linear, fit: ImageFit) -> FloatArray:
        """See `CalibrationFilter._arm_score`; the size of the target keeps no uncertainty of a bias."""
        score = CalibrationFilter._arm_score(self, image, lin, fit)
        score[-1] = 0.0
        return score

    def _unbiased(self, dx: FloatArray, score: FloatArray, S: FloatArray) -> FloatArray:  # noqa: ARG002
        """The correction as it is: the reference fits images and readings alike (total least squares)."""
        return dx

    def _accept(self, S: FloatArray, dx: FloatArray, camera: str) -> tuple[FloatArray, FloatArray]:
        """Move the mean; the reference stays."""
        cameras = {name: replace(known) for name, known in self.state.cameras.items()}
        self.seen.append(Seen(camera, replace(self.state, cameras=cameras), self.offset))
        self.S, self.offset = S, self.offset + dx
        return S, S
