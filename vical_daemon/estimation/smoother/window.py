"""A stretch of images without a target: motion at each image, landmarks, and who saw what.

A landmark is kept as a bearing and an inverse distance from a point of the world, so that far points
are no special case: X = c + m / rho. [Civera et al., "Inverse depth parametrization for monocular SLAM",
2008, with an anchor that is no unknown: a step takes it along with the camera that saw the point first]
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vical_daemon.estimation.geometry import so3
from vical_daemon.estimation.inertial.imu_buffer import ImuBuffer
from vical_daemon.estimation.measurements import BoolArray, FloatArray, Frames, ImuNoise, PointsFrame
from vical_daemon.estimation.model.camera_rays import read_share, unproject
from vical_daemon.estimation.model.imu_scale import matrices
from vical_daemon.estimation.model.inertial_links import RELINK_S, PreintegratedLinks, make_links
from vical_daemon.estimation.model.priors import WINDOW_START
from vical_daemon.estimation.model.state import CameraState
from vical_daemon.estimation.plausible import usable_points

KNOT_S = 1.0  # biases are constant over this long and walk from one to the next
MAX_LANDMARKS = 220  # the longest tracks: three times what a camera of 75 features shows at once
_MIN_SEEN = 4  # images of a landmark: eight numbers for three unknowns, so that an outlier shows
NEAREST_M, FARTHEST_M = 0.1, 200.0  # of a landmark at the start: rooms and streets

IntArray = npt.NDArray[np.intp]
STEP_S = 1.5  # the window is adjusted again after so much new data; images further apart are not tied to it
SLACK_S = 1e-3  # stamps are not quite even


class Seen(NamedTuple):
    """Observations of a window, sorted by landmark; N of them.

    Attributes:
        frame: Index of the image, shape (N,).
        landmark: Index of the landmark, shape (N,).
        uv: Pixels, shape (N, 2).
        row: Its row from the middle one, over their number: by as much of the readout it is late, shape (N,).
        begin: First observation of each landmark, shape (L,).
        by_frame: Order that sorts the observations by image.
        frame_begin: First of each image in that order; only images with observations.
        frames_with: Those images.
    """

    frame: IntArray
    landmark: IntArray
    uv: FloatArray
    row: FloatArray
    begin: IntArray
    by_frame: IntArray
    frame_begin: IntArray
    frames_with: IntArray


@dataclass(slots=True)
class Landmarks:
    """Points by row; `ids` names their tracks.

    Attributes:
        ids: Track ids, shape (L,).
        anchor: c, m, shape (L, 3).
        bearing: m, unit, shape (L, 3).
        inverse: rho, 1/m, shape (L,).
    """

    ids: npt.NDArray[np.int64]
    anchor: FloatArray
    bearing: FloatArray
    inverse: FloatArray

    @classmethod
    def none(cls) -> Landmarks:
        """No points."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    def moved(self, step: FloatArray, along: FloatArray) -> Landmarks:
        """After a step of an adjustment, to first order; anchors go with the cameras that saw them first.

        Were anchors to stay, all landmarks would move against them when the lever arm moves all cameras: by
        centimetres in slow motion, and a bearing over an inverse distance is not linear then.

        Args:
            step: Of two tangents of the bearing and the inverse distance if anchors stay, shape (L, 3).
            along: How the anchors move, m, shape (L, 3).
        """
        m, inverse = self.bearing, self.inverse
        ahead = np.vecdot(m, along)
        bearing = m + np.matmul(so3.tangents(m), step[:, :2, None])[..., 0]
        bearing -= inverse[:, None] * (along - ahead[:, None] * m)
        bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
        return Landmarks(self.ids, self.anchor + along, bearing, inverse + step[:, 2] + inverse**2 * ahead)


@dataclass(slots=True)
class Window:
    """Images of a stretch and what is believed about them.

    Attributes:
        camera: Calibration in force.
        noise: Inertial densities.
        frames: (stamp in the camera's clock in s, tracks), in order.
        R, p, v: Attitude, position (m) and velocity (m/s) of the imu in the world at each image.
        bias: [gyro, accel] by knot, shape (K, 6).
        links: Inertial constraints between neighbours.
        shift_s: Time shift for which instants and links hold; the camera's own differs from it by little.
        landmarks: What has been placed so far.
        bad: (frame stamp in ns, track id) of observations refused.
        imu: Magnitude of gravity, m/s^2, and the numbers of `imu_scale` where they are estimated, shape (1,),
            (17,) or (23,).
        own_lens: What fx fy cx cy and the distortion differ by in this window, see `LensMisfit`, shape (n,).
        jumps: See `MarginalPrior`.
        measured: Rate, rad/s, and specific force, m/s^2, around each image (with biases), and their
            derivatives, shape (2, F, 6).
        moves: See `inertial.moves`; held during an adjustment, as its derivatives do not count.
    """

    camera: CameraState
    noise: ImuNoise
    frames: Frames
    R: FloatArray
    p: FloatArray
    v: FloatArray
    bias: FloatArray
    links: PreintegratedLinks
    shift_s: float
    landmarks: Landmarks
    imu: FloatArray
    bad: set[tuple[int, int]] = field(default_factory=set)
    own_lens: FloatArray = field(default_factory=lambda: np.zeros(0))
    jumps: FloatArray = field(default_factory=lambda: np.zeros(0))
    measured: FloatArray = field(default_factory=lambda: np.zeros((2, 0, 6)))
    moves: FloatArray = field(default_factory=lambda: np.zeros((0, 9, 3)))

    def __post_init__(self) -> None:
        if not len(self.own_lens):
            self.own_lens = np.zeros(4 + len(self.camera.distortion))

    @property
    def lens(self) -> tuple[FloatArray, FloatArray, str]:
        """Fx fy cx cy, distortion and model in this window."""
        camera, own = self.camera, self.own_lens
        return camera.intrinsics + own[:4], camera.distortion + own[4:], camera.distortion_model

    @property
    def gravity(self) -> FloatArray:
        """Acceleration of free fall in the world, m/s^2, shape (3,)."""
        return np.array([0.0, 0.0, -self.imu[0]])

    @property
    def gyro_matrix(self) -> FloatArray:
        """M_g, shape (3, 3)."""
        return matrices(self.imu[1:])[0]

    @property
    def span_s(self) -> float:
        """From the first image to the last."""
        return self.frames[-1][0] - self.frames[0][0]

    def knots(self) -> IntArray:
        """Knot in force on each link, shape (F - 1,)."""
        t = np.array([s for s, _ in self.frames])
        last = max(round(float(t[-1] - t[0]) / KNOT_S), 1) - 1
        return np.asarray(np.minimum(((t[:-1] - t[0]) / KNOT_S).astype(np.intp), last), np.intp)

    def fit_knots(self) -> None:
        """Give every second of the window a knot; new ones start where the last one is."""
        wanted = int(self.knots()[-1]) + 1 if len(self.frames) > 1 else 1
        if len(self.bias) < wanted:
            more = np.repeat(self.bias[-1:], wanted - len(self.bias), axis=0)
            self.bias = np.concatenate([self.bias, more])

    def rates(self) -> FloatArray:
        """Angular rate at each image, bias removed, rad/s, shape (F, 3)."""
        return np.asarray((self.measured[0] - self._biases())[:, :3] @ self.gyro_matrix.T)

    def _biases(self) -> FloatArray:
        """Of gyro and accelerometer at each image, shape (F, 6)."""
        knots = self.knots()
        return np.asarray(self.bias[np.concatenate([knots[:1], knots])])

    def imu_by_link(self) -> FloatArray:
        """Bias in force on each link, and numbers of the imu, shape (F - 1, 6 or 22 or 28)."""
        bias = self.bias[self.knots()]
        return np.concatenate([bias, np.broadcast_to(self.imu[1:], (len(bias), len(self.imu) - 1))], axis=1)

    def accelerations(self) -> tuple[FloatArray, FloatArray]:
        """Angular (imu frame) and linear (world) acceleration at each image, shapes (F, 3)."""
        force = (self.measured[0] - self._biases())[:, 3:] @ matrices(self.imu[1:])[1].T
        return self.measured[1, :, :3] @ self.gyro_matrix.T, np.matvec(self.R, force) + self.gravity

    def extend(self, buffer: ImuBuffer, frames: Frames) -> int:
        """Add images, carrying the motion on by inertial data; return how many could be added."""
        imu = np.concatenate([self.bias[-1], self.imu[1:]])[None]
        t_s = np.array([self.frames[-1][0], *(t for t, _ in frames)]) + self.shift_s
        count, links = len(frames), None
        while count:  # all but those that readings do not reach
            links = make_links(buffer, t_s[: count + 1], np.repeat(imu, count, axis=0), self.noise)
            if links is not None:
                break
            count -= 1
        if links is None:
            return 0
        R, p, v = [self.R], [self.p], [self.v]
        at = (self.R[-1], self.p[-1], self.v[-1])
        for k in range(count):
            at = carried(links, k, *at, self.gravity)
            for store, value in zip((R, p, v), at, strict=True):
                store.append(value[None])
        self.links = self.links.plus(links)
        self.frames += frames[:count]
        self.R, self.p, self.v = np.concatenate(R), np.concatenate(p), np.concatenate(v)
        self.fit_knots()
        self.measure(buffer)
        return count

    def measure(self, buffer: ImuBuffer) -> None:
        """Take from the readings how the imu moves at each image, at the time shift of the links."""
        instants = np.array([t for t, _ in self.frames]) + self.shift_s
        # they hold for half a readout of 30 ms before and after an image
        self.measured = np.array(buffer.around(instants, WINDOW_START.readout_s))

    def relink(self, buffer: ImuBuffer) -> bool:
        """Integrate again at the present time shift and biases; False where inertial data do not reach."""
        shift_s = self.camera.timeshift_s
        d = shift_s - self.shift_s
        instants = np.array([t for t, _ in self.frames]) + shift_s
        links = make_links(buffer, instants, self.imu_by_link(), self.noise)
        if links is None:
            return False
        rates, (_, acceleration) = self.rates(), self.accelerations()
        self.p = self.p + d * self.v
        self.R = self.R @ so3.exp(d * rates)
        self.v = self.v + d * acceleration
        self.links, self.shift_s = links, self.camera.timeshift_s
        self.measure(buffer)
        return True

    def last_at(self, shift_s: float) -> tuple[FloatArray, FloatArray]:
        """Attitude and velocity at the last image for a time shift a little off that of the links."""
        d = shift_s - self.shift_s
        turned = self.R[-1] @ so3.exp(d * self.rates()[-1])
        return turned, self.v[-1] + d * self.accelerations()[1][-1]

    def stale(self) -> bool:
        """Whether the links hold for another time shift or other biases than are believed now."""
        off = np.abs(self.imu_by_link() - self.links.imu)
        return (
            abs(self.camera.timeshift_s - self.shift_s) > RELINK_S
            or float(off[:, :3].max()) > 5e-3
            or float(off[:, 3:6].max()) > 0.5
            or float(off[:, 6:].max(initial=0.0)) > 5e-3
        )

    # ------------------------------------------------------------------ landmarks
    def observe(self) -> Seen:
        """Choose the landmarks, place new ones, and list the observations."""
        ids = np.concatenate([f.ids for _, f in self.frames])
        frame = np.repeat(np.arange(len(self.frames)), [len(f.ids) for _, f in self.frames])
        uv = np.concatenate([f.uv_px for _, f in self.frames])
        if self.bad:
            stamps = np.array([f.t_cam_ns for _, f in self.frames])[frame]
            good = np.array(
                [key not in self.bad for key in zip(stamps.tolist(), ids.tolist(), strict=True)], dtype=bool
            )
            ids, frame, uv = ids[good], frame[good], uv[good]
        names, inverse, counts = np.unique(ids, return_inverse=True, return_counts=True)
        chosen = np.flatnonzero(counts >= _MIN_SEEN)
        if len(chosen) > MAX_LANDMARKS:
            chosen = np.sort(chosen[np.argsort(-counts[chosen], kind="stable")[:MAX_LANDMARKS]])
        row = np.full(len(names), -1)
        row[chosen] = np.arange(len(chosen))
        landmark = row[inverse]
        keep = np.flatnonzero(landmark >= 0)
        order = keep[np.lexsort((frame[keep], landmark[keep]))]
        seen = _listed(frame[order], landmark[order], uv[order], self.camera)
        self._place(names[chosen], seen)
        return seen

    def _place(self, ids: npt.NDArray[np.int64], seen: Seen) -> None:
        """Keep known landmarks, and place the new ones where their rays meet."""
        old = self.landmarks
        known = {int(name): row for row, name in enumerate(old.ids)}
        row = np.array([known.get(name, -1) for name in ids.tolist()], np.intp)
        new = row < 0
        anchor, bearing, inverse = np.empty((len(ids), 3)), np.empty((len(ids), 3)), np.empty(len(ids))
        for values, before in ((anchor, old.anchor), (bearing, old.bearing), (inverse, old.inverse)):
            values[~new] = before[row[~new]]
        own = new[seen.landmark]
        fresh = _listed(seen.frame[own], (np.cumsum(new) - 1)[seen.landmark[own]], seen.uv[own], self.camera)
        count = int(np.count_nonzero(new))
        anchor[new], bearing[new], inverse[new] = place(
            fresh, self.R, self.p, self.camera, count, inverse[~new]
        )
        self.landmarks = Landmarks(ids, anchor, bearing, inverse)


def _listed(frame: IntArray, landmark: IntArray, uv: FloatArray, camera: CameraState) -> Seen:
    begin = np.flatnonzero(np.diff(landmark, prepend=-1))
    by_frame = np.argsort(frame, kind="stable")
    sorted_frames = frame[by_frame]
    frame_begin = np.flatnonzero(np.diff(sorted_frames, prepend=-1))
    row = read_share(uv, camera.resolution, camera.readout_axis)
    return Seen(frame, landmark, uv, row, begin, by_frame, frame_begin, sorted_frames[frame_begin])


def carried(
    links: PreintegratedLinks, k: int, R: FloatArray, p: FloatArray, v: FloatArray, gravity: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motion at the end of link k."""
    T, dR, dv, dp = links.dt[k], links.dR[k], links.dv[k], links.dp[k]
    return R @ dR, p + T * v + 0.5 * T * T * gravity + R @ dp, v + T * gravity + R @ dv


def rays_of(uv: FloatArray, camera: CameraState) -> tuple[FloatArray, BoolArray]:
    """Unit rays in the camera frame, shape (n, 3), and which are valid."""
    rays, ok = unproject(uv, camera.intrinsics, camera.distortion, camera.distortion_model)
    return np.where(ok[:, None], rays, [0.0, 0.0, 1.0]), ok


def place(
    seen: Seen, R: FloatArray, p: FloatArray, camera: CameraState, count: int, others: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Anchor, bearing, inverse distance where the rays of each landmark meet.

    Where they do not, the distance is the usual one, also of `others`, 1/m.
    """
    if not count:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    rays, ok = rays_of(seen.uv, camera)
    d = np.matvec(R[seen.frame] @ camera.R_imu_cam, rays)
    c = (p + R @ camera.p_imu_cam)[seen.frame]
    first = seen.begin
    anchor = c[first]
    P = (np.eye(3) - d[:, :, None] * d[:, None, :]) * ok[:, None, None]
    N = np.add.reduceat(P, first) + 1e-6 * np.eye(3)
    away = np.add.reduceat(np.matmul(P, (c - anchor[seen.landmark])[..., None]), first)
    X = np.linalg.solve(N, away)[..., 0]
    # the middle observation gives the bearing of those whose rays hardly cross
    distance = np.linalg.norm(X, axis=1)
    along = (X * d[first]).sum(axis=1) / np.maximum(distance, 1e-9)
    fine = (along > 0.9) & (distance > NEAREST_M) & (distance < FARTHEST_M)
    shown = np.concatenate([others, 1.0 / distance[fine]])
    usual = float(np.median(shown)) if len(shown) else 0.3
    bearing = np.where(fine[:, None], X / np.maximum(distance, 1e-9)[:, None], d[first])
    return anchor, bearing, np.where(fine, 1.0 / np.maximum(distance, 1e-9), usual)


class Ready(NamedTuple):
    """What can be taken into a window.

    Attributes:
        frames: (stamp in s, tracks), in order.
        gap_follows: They are the last before a hole.
        hole_s: Length of a hole that begins at once, s; 0: none.
    """

    frames: Frames
    gap_follows: bool = False
    hole_s: float = 0.0


def ready(waiting: Frames, begin_s: float, end_s: float) -> Ready:
    """Choose the images to go on with: a step's worth at most, up to the first hole.

    Args:
        waiting: All that came since, in order.
        begin_s: Stamp of the window's last image, s.
        end_s: Stamp up to which inertial data reach, s.
    """
    before, out = begin_s, list[tuple[float, PointsFrame]]()
    for t, frame in waiting:
        if t > end_s or before - begin_s > STEP_S - SLACK_S:
            break
        if t - before > STEP_S:
            return Ready(out, gap_follows=True, hole_s=0.0 if out else t - before)
        out.append((t, frame))
        before = t
    silent = not out and bool(waiting) and end_s - begin_s > 2.0 * STEP_S
    return Ready(out, hole_s=end_s - begin_s if silent else 0.0)


def cleaned(frame: PointsFrame) -> PointsFrame:
    """Return the tracks at possible pixels, each identity once."""
    ok = usable_points(frame)
    return frame.only(ok)
