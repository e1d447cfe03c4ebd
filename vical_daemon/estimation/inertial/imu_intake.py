"""Where inertial readings enter an estimator: in order, on one even axis, without repetitions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.inertial.clipped_readings import Bridged, ClippedReadings
from vical_daemon.estimation.inertial.faulty_readings import RangeLimits, Six, SpikeFilter
from vical_daemon.estimation.inertial.imu_buffer import BLOCK_S, EVEN, GAP_S, ImuBuffer
from vical_daemon.estimation.inertial.stamp_steps import LEARN, StampSteps
from vical_daemon.estimation.measurements import IMAGE_GAP_S
from vical_daemon.estimation.plausible import MOST_MPS2, MOST_RPS
from vical_daemon.estimation.significance import STRETCH_S

_MORE = 2.0  # times the share that was announced last is announced, too
_APART_S = 10.0  # between two recordings on the common time axis: longer than any gap that is bridged


class Reading(NamedTuple):
    """One inertial reading: stamp as it came, ns; rad/s; m/s^2; `Bridged.clipping_sigma`."""

    t_imu_ns: int
    gyro_rps: Sequence[float]
    specific_force_mps2: Sequence[float]
    clipping_sigma: Six | None = None


class ImuIntake:
    """Fills the buffer of inertial readings from one stream; those of fast devices with means (`BlockMeans`).

    A device or driver that hangs repeats its last reading bit by bit. Six noisy channels never do that by
    themselves, so such readings are left out: what remains is a gap like any other.

    A reading after a gap, or one older than the newest, is held until the next one. If that continues the
    readings before, the held one had a wrong stamp, or came out of order, and is dropped. If it continues the
    held one, time has jumped: forwards it is a gap; backwards the clock has been set back.

    Attributes:
        buffer: The readings, s since the first stamp; None before the first one.
        base_ns: First stamp, ns; stamps of images are counted from it, too.
        refused: Readings left out: out of order, no possible values, or with a wrong stamp.
        repeated: Readings left out because they repeat the one before, bit by bit.
        clipped: Readings of which a channel is at its range.
        between: Another recording was announced, and no reading of it has been added yet.
        gap_end_s: Where readings resumed after the latest gap, s; -inf: there was none.
        gap_s: How far stamps jumped forwards there, s; 0: backwards, or there was none.
    """

    def __init__(self) -> None:
        self.buffer: ImuBuffer | None = None
        self.base_ns = 0
        self.refused = 0
        self.repeated = 0
        self.clipped = 0
        self.gap_end_s, self.gap_s = -np.inf, 0.0
        self.between = False
        self._steps = StampSteps()
        self._set_back_s = 0.0  # by how much the clock has been set back in all
        self._newest_s = -np.inf  # stamp as it came, plus what the clock has been set back
        self._held: tuple[float, Reading] | None = None
        self._last: tuple[float, ...] = ()
        self._repeated_ns: int | None = None  # stamp of the newest reading that repeats the one before
        self._limits: RangeLimits[int] = RangeLimits()
        self._spikes: SpikeFilter[tuple[int, Six]] = SpikeFilter()
        self._bridges = ClippedReadings()
        self._blocks = BlockMeans()
        self._taken = 0
        self._clipping_s: float | None = None  # when the stretch began of which the share is counted
        self._at_range = 0  # readings of it
        self._share = 0.0  # of clipped readings, as announced
        self._news: list[Event] = []
        self._gap: Event | None = None  # forwards, until an image shows whether the clock was set

    @property
    def left_out(self) -> dict[str, int]:
        """Readings left out, by cause; spikes: neither neighbours nor the other sensor support them."""
        return {
            "imu_refused": self.refused,
            "imu_repeated": self.repeated,
            "imu_clipped": self.clipped,
            "imu_spikes": self._spikes.spikes,
        }

    @property
    def shift_s(self) -> float:
        """Time shift by the stamps as they come now, minus the time shift by the even axis, s."""
        return self._steps.total_s - self._set_back_s

    @property
    def stepped_s(self) -> float:
        """By how much all steps of even stamps have moved them, s."""
        return self._steps.total_s

    def take(
        self, t_imu_ns: int, gyro_rps: Sequence[float], specific_force_mps2: Sequence[float]
    ) -> list[Reading]:
        """Take one reading.

        Args:
            t_imu_ns: Stamp in the imu's clock, ns.
            gyro_rps: Measured rate, rad/s.
            specific_force_mps2: Measured specific force, m/s^2.

        Returns:
            The readings added: none, this one, or the one held before and this one.
        """
        x, y, z = map(float, gyro_rps)
        a, b, c = map(float, specific_force_mps2)
        six = (x, y, z, a, b, c)
        fast = -MOST_RPS <= x <= MOST_RPS and -MOST_RPS <= y <= MOST_RPS and -MOST_RPS <= z <= MOST_RPS
        hard = -MOST_MPS2 <= a <= MOST_MPS2 and -MOST_MPS2 <= b <= MOST_MPS2 and -MOST_MPS2 <= c <= MOST_MPS2
        if not (fast and hard):  # NaN is not within bounds, either
            self.refused += 1
            return []
        if six == self._last:
            self.repeated += 1
            self._repeated_ns = t_imu_ns
            return []
        self._last = six
        if self.buffer is None:
            self.base_ns = t_imu_ns
            self.buffer = ImuBuffer(t_imu_ns)
        added = []
        for good_ns, good in self._spikes.sift(six, (t_imu_ns, six)):
            for bridged in self._bridged_over(self.buffer, good_ns, good):
                added += self._place(self.buffer, bridged)
        for spike_ns, _ in self._spikes.late:
            self.buffer.remove((spike_ns - self.base_ns) * 1e-9 + self._set_back_s)
        self._spikes.late = []
        return added

    def _bridged_over(self, buffer: ImuBuffer, t_imu_ns: int, six: Six) -> list[Bridged]:
        """Give channels at the end of their range a value; also those before it was known to be the end."""
        found = self._limits.found
        decided = self._limits.sift(six, t_imu_ns)
        if self._limits.found > found:
            self._bridge_buffer(buffer)
        out = []
        for reading, t_ns, at_range in decided:
            t_s = (t_ns - self.base_ns) * 1e-9
            self._taken += 1
            if at_range:
                self.clipped += 1
                self._at_range += 1
            self._announce_clipping(t_s)
            out += self._bridges.take(t_ns, reading, at_range)
        return out

    def _bridge_buffer(self, buffer: ImuBuffer) -> None:
        bridges = ClippedReadings()
        rows = buffer.rows.tolist()
        settled = [
            x for t_s, *six in rows for x in bridges.take(round(t_s * 1e9), six, self._limits.at_range(six))
        ]
        for row, x in enumerate([*settled, *bridges.rest()]):
            if x.clipping_sigma is not None:
                self.clipped += 1
                buffer.replace(row, x.six, x.clipping_sigma)

    def _place(self, buffer: ImuBuffer, bridged: Bridged) -> list[Reading]:
        """Add a reading to the buffer, or hold it."""
        t_imu_ns, six, clipping_sigma = bridged
        t_s = (t_imu_ns - self.base_ns) * 1e-9 + self._set_back_s
        if self.between and t_s < self._newest_s + _APART_S:  # its stamps overlap, or seem to go on
            self.base_ns -= round((self._newest_s + _APART_S - t_s) * 1e9)
            t_s = self._newest_s + _APART_S
        return self._in_order(buffer, t_s, Reading(t_imu_ns, six[:3], six[3:], clipping_sigma))

    def _announce_clipping(self, t_s: float) -> None:
        if self._clipping_s is None and self._at_range:
            self._clipping_s, self._taken = t_s, 1
        if self._clipping_s is None or t_s <= self._clipping_s + STRETCH_S:
            return
        share = self._at_range / self._taken
        if share > _MORE * self._share:
            self._news.append(Event(EventKind.IMU_CLIPPED, value=share))
            self._share = share
        self._clipping_s, self._taken, self._at_range = t_s, 0, 0

    def _in_order(self, buffer: ImuBuffer, t_s: float, reading: Reading) -> list[Reading]:
        """Add a reading, hold it, or add it after the one held."""
        interval_s = t_s - self._newest_s
        if self._bridged(buffer, interval_s):
            self._held = None
            self._add(buffer, t_s, reading)
            return [reading]
        if self._held is not None:
            held_s, held = self._held
            jump_s = abs(held_s - self._newest_s)
            if 0.0 < t_s - held_s <= max(GAP_S, buffer.usual_gap_s, EVEN * jump_s):
                self.refused -= 1
                return self._jump(buffer, held_s, held, t_s, reading)
        self._held = t_s, reading
        self.refused += 1
        return []

    def _bridged(self, buffer: ImuBuffer, interval_s: float) -> bool:
        """Whether a reading follows the newest so closely that interpolation will do."""
        if self.between or interval_s <= 0.0:
            return False
        return interval_s <= GAP_S or len(buffer) < LEARN or interval_s <= buffer.usual_gap_s

    def _jump(
        self, buffer: ImuBuffer, held_s: float, held: Reading, t_s: float, reading: Reading
    ) -> list[Reading]:
        """Two readings agree that time has jumped."""
        self._held = None
        self.gap_s = max(held_s - self._newest_s, 0.0)
        if held_s <= self._newest_s:
            back_s = self._newest_s + (t_s - held_s) - held_s
            self._set_back_s += back_s
            self._news.append(Event(EventKind.IMU_CLOCK_SET_BACK, value=back_s))
            held_s, t_s = held_s + back_s, t_s + back_s
        elif not self.between:
            self._believe_gap()
            since_ns = self.base_ns + round((self._newest_s - self._set_back_s) * 1e9)
            repeats = self._repeated_ns is not None and since_ns < self._repeated_ns < held.t_imu_ns
            kind = EventKind.IMU_REPEATED if repeats else EventKind.IMU_GAP
            self._gap = Event(kind, value=held_s - self._newest_s)
        self.between = False
        self._append(buffer, self._blocks.rest())
        self.gap_end_s = self._add(buffer, held_s, held)
        self._add(buffer, t_s, reading)
        return [held, reading]

    def _add(self, buffer: ImuBuffer, t_s: float, reading: Reading) -> float:
        """Add a reading to its block; return its time on the even axis, s."""
        self._newest_s = t_s
        even_s = self._steps.even(t_s)
        six = (*reading.gyro_rps, *reading.specific_force_mps2)
        self._append(buffer, self._blocks.take(even_s, six, reading.clipping_sigma))
        return even_s

    @staticmethod
    def _append(buffer: ImuBuffer, mean: Mean | None) -> None:
        if mean is not None:
            buffer.spread_s2 = max(buffer.spread_s2, mean.spread_s2)
            buffer.append(mean.t_s, mean.six[:3], mean.six[3:], mean.clipping_sigma)

    def saw_image(self, ahead_s: float) -> None:
        """Learn from an image whether stamps that jumped forwards mean a gap, or a clock that was set.

        The clock: the jump is a step of the time shift, and reported as that.

        Args:
            ahead_s: By how much more its stamp is ahead of the newest reading than usual, s.
        """
        if self._gap is not None and ahead_s < -0.5 * (self._gap.value or 0.0):
            self._gap = None
        self._believe_gap()

    def _believe_gap(self) -> None:
        if self._gap is not None:
            self._news.append(self._gap)
            self._gap = None

    def next_recording(self) -> None:
        """Another recording follows: its stamps are regular again, and the gap before it is not reported."""
        self._believe_gap()
        self._steps, self._set_back_s = StampSteps(), 0.0
        self._spikes.restart()
        self._limits.restart()
        self._bridges = ClippedReadings()
        self._newest_s = -np.inf if self.buffer is None else self.buffer.newest_s
        self._held, self._repeated_ns, self.between = None, None, True

    def news(self, stated_s: float = 0.0) -> list[Event]:
        """What happened to the stream since the last call; a gap after an image, or half a second.

        Args:
            stated_s: How well the driver says that it knows the device's clock, one sigma, s.
        """
        if self._newest_s > self.gap_end_s + IMAGE_GAP_S:  # no image will show any more what it was
            self._believe_gap()
        news, self._news = self._news + self._steps.news(stated_s), []
        return news


class Mean(NamedTuple):
    """Mean of a block: instant, s; rates and forces, rad/s and m/s^2; `Bridged.clipping_sigma`.

    `spread_s2` is the variance of the instants of its readings, s^2.
    """

    t_s: float
    six: Sequence[float]
    clipping_sigma: Sequence[float] | None
    spread_s2: float = 0.0


class BlockMeans:
    """Joins readings that follow each other within 5 ms: noise of single readings would pass for motion.

    The time shift shows in how the rate changes between two images. From 1000 readings a second, one at
    either image, that change is mostly noise where the rig moves slowly, and noise squared counts as
    information. A mean over a block is what the gyro turned in that time. It is less than the rate in the
    middle of a swing, by 0.04 % of a motion at 3 Hz, (pi f T)^2 / 6. The buffer adds that again.
    """

    def __init__(self) -> None:
        self._block: list[Mean] = []
        self._before_s = -np.inf

    def take(self, t_s: float, six: Sequence[float], clipping_sigma: Six | None) -> Mean | None:
        """Take a reading; return the mean of the block that it completes, or None."""
        interval_s, self._before_s = t_s - self._before_s, t_s
        self._block.append(Mean(t_s, six, clipping_sigma))
        return self.rest() if t_s - self._block[0].t_s + 2.0 * interval_s > BLOCK_S else None

    def rest(self) -> Mean | None:
        """End the block, and return its mean; None where it is empty."""
        block, self._block = self._block, []
        if len(block) < 2:
            return block[0] if block else None
        clipped = [x.clipping_sigma for x in block if x.clipping_sigma is not None]
        sigma = np.sum(clipped, axis=0) / len(block) if clipped else None
        t_s = [x.t_s for x in block]
        return Mean(
            float(np.mean(t_s)),
            np.mean([x.six for x in block], axis=0).tolist(),
            None if sigma is None else sigma.tolist(),
            float(np.var(t_s)),
        )
