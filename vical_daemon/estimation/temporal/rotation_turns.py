"""Turns of a sensor between pairs of its orientations: which pairs say something about the motion.

A pair serves where its turn stands out of the orientations' noise, so the time between the two is chosen by
the ratio of both. Pairs at rest all agree with each other at any delay; where they are the majority they are
left out, or else medians over all pairs would describe the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.measurements import BoolArray, FloatArray
from vical_daemon.estimation.robust import MEDIAN_CHI2_3
from vical_daemon.estimation.significance import PERHAPS_SIGMAS

IntArray = npt.NDArray[np.intp]

MIN_RATE_RPS = np.deg2rad(3.0)  # slower than this is "not moving"
MIN_PAIRS = 8  # 24 equations for mounting, bias and delay; as many orientations for a world and a delay
# Turns are taken over the shortest of these times over which they are distinct, s: a short one is little
# touched by outliers, by the gyro's bias and by holes; each doubling doubles the turn over the same noise.
BASELINES_S = (0.2, 0.4, 0.8, 1.6)
_DISTINCT = 10.0  # ratio of a usual turn to its noise
_MAX_PAIRS = 300  # for the start, which needs no more; the polish takes all orientations
_LOW = 0.05  # quantile of third differences that shows their noise: outliers are above
_SLOWEST_S = 0.11  # at less than 9 Hz third differences of a hand's motion exceed any noise


@dataclass(frozen=True)
class Turns:
    """Relative rotations between pairs of camera orientations.

    Attributes:
        first: Index of the earlier orientation, shape (k,).
        second: Index of the later one, shape (k,).
        rotvec_cam: Turn in the camera frame, rad, shape (k, 3).
        angle: Its length, rad, shape (k,).
        moving_share: Share of all pairs in which the camera moved; below one half only these are here, but
            all where it never moved (0).
        baseline_s: Time between the orientations of a pair, s.
    """

    first: IntArray
    second: IntArray
    rotvec_cam: FloatArray
    angle: FloatArray
    moving_share: float = 1.0
    baseline_s: float = BASELINES_S[0]

    def at(self, index: IntArray | BoolArray) -> Turns:
        """Some of the pairs."""
        return replace(
            self,
            first=self.first[index],
            second=self.second[index],
            rotvec_cam=self.rotvec_cam[index],
            angle=self.angle[index],
        )


def turns_apart(t_cam_s: FloatArray, q_world_cam: FloatArray, baseline_s: float = BASELINES_S[0]) -> Turns:
    """Pair each orientation with the one a given time later (at most three times that: holes are left out).

    Args:
        t_cam_s: Stamps, increasing, s, shape (n,).
        q_world_cam: Orientations w x y z, shape (n, 4).
        baseline_s: Time between the two, s.
    """
    first = np.arange(len(t_cam_s))
    second = np.searchsorted(t_cam_s, t_cam_s + baseline_s * 0.999)
    inside = second < len(t_cam_s)
    first, second = first[inside], second[inside]
    dt = t_cam_s[second] - t_cam_s[first]
    keep = dt < max(3.0 * baseline_s, 1.5 * float(np.median(dt)) if len(dt) else 0.0)
    first, second = first[keep], second[keep]
    turn = so3.turn_between(q_world_cam[first], q_world_cam[second])
    return Turns(first, second, turn, np.linalg.norm(turn, axis=1), baseline_s=baseline_s)


def evenly(turns: Turns, most: int) -> Turns:
    """At most so many of the pairs, evenly."""
    if len(turns.first) <= most:
        return turns
    return turns.at(np.linspace(0, len(turns.first) - 1, most).round().astype(np.intp))


def camera_turns(t_cam_s: FloatArray, q_world_cam: FloatArray, most: int = _MAX_PAIRS) -> Turns:
    """Pair orientations over a time in which turns stand out of the noise, and leave rest out if it prevails.

    Args:
        t_cam_s: Stamps, increasing, s, shape (n,).
        q_world_cam: Orientations w x y z, shape (n, 4).
        most: So many pairs are kept, evenly.
    """
    noise = orientation_noise(t_cam_s, q_world_cam)
    best: tuple[float, Turns, BoolArray] | None = None
    for baseline in BASELINES_S:
        turns = turns_apart(t_cam_s, q_world_cam, baseline)
        moving = _moving(t_cam_s, turns, noise)
        if np.count_nonzero(moving) < MIN_PAIRS:
            continue
        ratio = float(np.median(turns.angle[moving])) / max(_turn_noise(noise), 1e-12)
        if best is None or ratio > best[0]:
            best = ratio, turns, moving
        if ratio > _DISTINCT:
            break
    if best is None:
        return evenly(replace(turns_apart(t_cam_s, q_world_cam), moving_share=0.0), most)
    _, turns, moving = best
    share = float(np.mean(moving))
    return evenly(replace(turns if share >= 0.5 else turns.at(moving), moving_share=share), most)


def orientation_noise(t_s: FloatArray, q: FloatArray) -> float:
    """White noise of one orientation per axis, rad, from third differences; zero where the rate is too low.

    A low quantile: with a third of outliers only a quarter of the differences is free of them. Noise that
    lasts from one orientation to the next is not seen; the motion of a hand adds 0.1 deg at 15 Hz.

    Args:
        t_s: Stamps, increasing, s, shape (n,).
        q: Orientations w x y z, shape (n, 4).
    """
    if len(t_s) < MIN_PAIRS:
        return 0.0
    dt = np.diff(t_s)
    usual = float(np.median(dt))
    if usual > _SLOWEST_S:
        return 0.0
    turn = so3.turn_between(q[:-1], q[1:]) * (usual / dt)[:, None]
    even = np.abs(dt - usual) < 0.5 * usual
    even = even[2:] & even[1:-1] & even[:-2]
    third = np.linalg.norm(turn[2:] - 2.0 * turn[1:-1] + turn[:-2], axis=1)[even]
    if len(third) < MIN_PAIRS:
        return 0.0
    # a third difference of white noise has 1 + 9 + 9 + 1 times its variance
    return float(np.quantile(third, _LOW) / np.sqrt(20.0 * chdtri(3, 1.0 - _LOW)))


def _turn_noise(noise_rad: float) -> float:
    """Usual length of the error of a turn between two orientations of some noise per axis, rad."""
    return float(np.sqrt(2.0 * MEDIAN_CHI2_3)) * noise_rad


def _moving(t_cam_s: FloatArray, turns: Turns, noise_rad: float) -> BoolArray:
    dt = t_cam_s[turns.second] - t_cam_s[turns.first]
    least = np.maximum(MIN_RATE_RPS * dt, PERHAPS_SIGMAS * _turn_noise(noise_rad))
    return np.asarray(turns.angle > least)


def without_long_rest(t_s: FloatArray, q: FloatArray) -> BoolArray:
    """Which orientations to register: all, or where rest prevails those that move and half as many at rest.

    Rest shows the gyro's bias and nothing else, and the residuals at rest, which know no error of the stamps
    or of the gyro's scale, would set the scale by which those in motion are judged.

    Args:
        t_s: Stamps, increasing, s, shape (n,).
        q: Orientations w x y z, shape (n, 4).
    """
    everything = np.ones(len(t_s), dtype=np.bool_)
    turns = camera_turns(t_s, q, most=len(t_s))
    if turns.moving_share >= 0.5 or turns.moving_share == 0.0:
        return everything
    # all orientations inside of a moving pair, for its first and last may be some apart
    edge = np.zeros(len(t_s) + 1, dtype=np.int64)
    np.add.at(edge, turns.first, 1)
    np.add.at(edge, turns.second + 1, -1)
    keep = np.cumsum(edge[:-1]) > 0
    resting = np.flatnonzero(~keep)
    wanted = np.count_nonzero(keep) // 2
    if len(resting) > wanted:
        resting = resting[np.linspace(0, len(resting) - 1, wanted).round().astype(np.intp)]
    keep[resting] = True
    return keep
