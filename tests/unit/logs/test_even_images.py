"""Images stamped on arrival get the stamps of their camera's even grid; other cameras keep theirs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vical_daemon.bus.messages import encode_image, encode_imu, encode_points
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.even_images import CameraStamps, PointReader, already_even, even_grid, mark_of
from vical_daemon.logs.mcap import LogWriter

RATE_HZ = 20.0
COUNT = 800
BEGIN_NS = 1_700_000_000_123_456_789
IDS = np.arange(12)
CORNERS_PX = np.random.default_rng(1).uniform(100.0, 600.0, (12, 2))


def truth_s(skew: float = 30e-6) -> np.ndarray:
    return np.arange(COUNT) / RATE_HZ * (1 + skew)


def points_px(t_s: float) -> np.ndarray:
    """Twelve points that a hand moves, with 0.1 px of noise."""
    move = [130.0 * np.sin(3.1 * t_s) + 60.0 * np.cos(5.0 * t_s), 110.0 * np.cos(4.3 * t_s)]
    noise = np.random.default_rng(round(t_s * 1e9)).normal(0.0, 0.1, (12, 2))
    return CORNERS_PX + move + noise


def payload(t_s: float, stamp_ns: int = BEGIN_NS) -> bytes:
    return encode_points(int(stamp_ns), "cam0", IDS, points_px(t_s), image_size=(752, 480))


def in_order(arrival_s: np.ndarray) -> np.ndarray:
    """One after the other, at least 0.1 ms apart."""
    out, last_s = [], -np.inf
    for t_s in arrival_s.tolist():
        last_s = max(t_s, last_s + 1e-4)
        out.append(last_s)
    return np.array(out)


def stamps_ns(t_s: np.ndarray) -> np.ndarray:
    return BEGIN_NS + np.round(t_s * 1e9).astype(np.int64)


def decided(taken_s: np.ndarray, stamped_s: np.ndarray):
    """What is decided about images taken at some times with stamps of other times."""
    payloads = [payload(t_s) for t_s in taken_s.tolist()]
    t_ns = stamps_ns(stamped_s)
    stamps = CameraStamps(t_ns, np.array([mark_of(p) for p in payloads]))
    reader = PointReader("points")
    for stamp_ns, content in zip(t_ns.tolist(), payloads, strict=True):
        if stamp_ns in stamps.wanted:
            stamps.take(stamp_ns, reader.read(content))
    return stamps.even()


def errors_ms(even, taken_s: np.ndarray) -> np.ndarray:
    assert even is not None
    return (even.t_ns - stamps_ns(taken_s)) * 1e-6


def delays_s(count: int, mean_s: float, late_share: float = 0.0, seed: int = 700) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.exponential(mean_s, count) + 0.06 * (rng.random(count) < late_share)


@pytest.mark.parametrize("seed", [700, 701, 702])
@pytest.mark.parametrize("mean_s", [1e-3, 4e-3])
def test_exponential_delays_are_taken_off(mean_s, seed) -> None:
    even = decided(truth_s(), in_order(truth_s() + delays_s(COUNT, mean_s, seed=seed)))
    errors = errors_ms(even, truth_s())
    assert errors.std() < 0.03 * mean_s * 1e3
    assert 0.0 < errors.mean() < 0.1 * mean_s * 1e3  # the earliest of twenty is late, too
    assert even.sigma_s == pytest.approx(mean_s / 20, rel=0.5)
    assert even.jitter_s == pytest.approx(mean_s, rel=0.15)
    assert "images were put on an even grid" in even.describe("cam0", "images")


@pytest.mark.parametrize("seed", [700, 701, 702])
def test_stamps_that_are_early_and_late_alike_follow_their_mean(seed) -> None:
    taken_s = truth_s()
    even = decided(taken_s, taken_s + 1e-3 * np.random.default_rng(seed).standard_normal(len(taken_s)))
    assert even is not None
    assert not even.delays
    assert "mean of the stamps" in even.describe("cam0", "images")
    assert np.abs(errors_ms(even, taken_s)).max() < 0.4


@pytest.mark.parametrize("length", [60, 100, 200])
def test_short_pieces_decide_together(length) -> None:
    """A robot at work sees its board for some seconds at a time."""
    taken_s = truth_s() + 30.0 * (np.arange(COUNT) // length)
    for seed in range(5):
        rng = np.random.default_rng([seed, length])
        for errors_s, delays in (
            (1e-3 * rng.standard_normal(COUNT), False),
            (rng.exponential(1e-3, COUNT), True),
        ):
            even = even_grid(stamps_ns(in_order(taken_s + errors_s)))
            assert even is not None and even.pieces == -(-COUNT // length)
            assert even.delays == delays and abs(even.log_odds) > np.log(1000.0)
            assert abs(errors_ms(even, taken_s).mean()) < 3.0 * even.sigma_s * 1e3
            assert even.sigma_s < 5e-4  # of 1 ms; a block of 20 images alone gives 0.22 (mean)


def test_a_few_images_leave_the_time_shift_open() -> None:
    """By 60 images: normal errors may be taken for delays, but the sigma includes that."""
    z = []
    for seed in range(30):
        taken_s = truth_s()[:60]
        even = even_grid(stamps_ns(taken_s + 1e-3 * np.random.default_rng([seed, 60]).standard_normal(60)))
        assert even is not None
        z.append(errors_ms(even, taken_s).mean() / even.sigma_s * 1e-3)
    assert np.abs(z).max() < 5.0 and np.sqrt(np.mean(np.square(z))) < 2.5


def test_a_first_image_that_is_late() -> None:
    late_s = delays_s(COUNT, 2e-3)
    late_s[0] = 18e-3
    assert np.abs(errors_ms(decided(truth_s(), in_order(truth_s() + late_s)), truth_s())).max() < 0.5


def test_images_later_than_the_next_one() -> None:
    even = decided(truth_s(), in_order(truth_s() + delays_s(COUNT, 4e-3, 0.01)))
    assert np.abs(errors_ms(even, truth_s())).max() < 1.0


def test_a_stalled_computer_delivers_six_images_at_once() -> None:
    late_s = delays_s(COUNT, 1e-3)
    for k in range(50, COUNT - 10, 130):
        late_s[k : k + 6] = truth_s()[k + 6] - truth_s()[k : k + 6]
    even = decided(truth_s(), in_order(truth_s() + late_s))
    assert np.abs(errors_ms(even, truth_s())).max() < 0.5


@pytest.mark.parametrize("share", [0.01, 0.1, 0.4])
def test_lost_images_and_a_gap_stay_lost(share) -> None:
    kept = np.random.default_rng(701).random(COUNT) > share
    kept[400:500] = False
    taken_s = truth_s()[kept]
    errors = errors_ms(decided(taken_s, in_order(taken_s + delays_s(len(taken_s), 4e-3))), taken_s)
    assert np.abs(errors).max() < 1.0


def test_images_that_are_delivered_twice() -> None:
    first = np.sort(np.random.default_rng(702).choice(COUNT - 1, 80, replace=False))
    taken_s = np.sort(np.concatenate([truth_s(), truth_s()[first]]))
    stamped_s = taken_s + delays_s(len(taken_s), 4e-3)
    again = np.append(False, np.diff(taken_s) == 0)
    stamped_s[again] += 25e-3
    even = decided(taken_s, in_order(stamped_s))
    errors = errors_ms(even, taken_s)
    assert np.abs(errors).max() < 1.0  # the second is put behind the first: it is left out later
    assert (np.diff(even.t_ns) > 0).all()


def test_even_stamps_stay_as_they_are() -> None:
    assert already_even(stamps_ns(truth_s()))
    assert decided(truth_s(), truth_s()) is None
    kept = np.random.default_rng(703).random(COUNT) > 0.1
    assert already_even(stamps_ns(truth_s()[kept]))
    assert decided(truth_s()[kept], truth_s()[kept]) is None


def test_images_that_are_really_taken_unevenly() -> None:
    """A trigger in software: late, and stamped when it was."""
    taken_s = in_order(truth_s() + delays_s(COUNT, 4e-3))
    assert decided(taken_s, taken_s) is None


def test_a_trigger_whose_delays_add_up() -> None:
    taken_s = np.cumsum(1.0 / RATE_HZ + np.random.default_rng(704).exponential(5e-3, COUNT))
    assert decided(taken_s, taken_s) is None


@pytest.mark.parametrize("stamps_follow", [True, False])
def test_an_exposure_that_changes(stamps_follow) -> None:
    """The middle of the exposure wanders by 3 ms within seconds, and with it the stamp, or it does not."""
    wander_s = 1.5e-3 * np.sin(truth_s() / 3.0)
    taken_s = truth_s() + wander_s if stamps_follow else truth_s()
    assert decided(taken_s, truth_s() + wander_s) is None


def test_a_rate_that_follows_the_light() -> None:
    """Between 12 and 20 images a second."""
    taken_s = np.cumsum(0.065 + 0.015 * np.sin(np.arange(COUNT) / 50.0))
    assert decided(taken_s, taken_s) is None
    assert decided(taken_s, in_order(taken_s + delays_s(COUNT, 4e-3))) is None


def test_a_rig_at_rest_decides_nothing() -> None:
    still = np.random.default_rng(705)
    t_ns = stamps_ns(in_order(truth_s() + delays_s(COUNT, 4e-3)))
    stamps = CameraStamps(t_ns, np.arange(COUNT))
    for stamp_ns in t_ns.tolist():
        uv = CORNERS_PX + still.normal(0.0, 0.1, (12, 2))
        stamps.take(stamp_ns, PointReader("points").read(encode_points(stamp_ns, "cam0", IDS, uv)))
    assert stamps.even() is None


@pytest.mark.parametrize("unit_ns", [1_000_000, 10_000_000])
def test_rounded_stamps_stay_as_they_are(unit_ns) -> None:
    begin_s = BEGIN_NS % unit_ns * 1e-9
    taken_s = truth_s() + 3e-4
    rounded_s = np.floor((taken_s + begin_s) / (unit_ns * 1e-9)) * unit_ns * 1e-9 - begin_s
    assert decided(taken_s, rounded_s) is None


@pytest.mark.parametrize("count", [0, 1, 2, 5, 50])
def test_short_streams_stay_as_they_are(count) -> None:
    taken_s = truth_s()[:count]
    assert decided(taken_s, in_order(taken_s + delays_s(count, 4e-3))) is None


def test_messages_that_hold_no_points() -> None:
    assert PointReader("points").read(b"\x00\x01\x00\x00") is None
    assert PointReader("image").read(b"nonsense") is None
    assert PointReader("compressed").read(payload(0.0)) is None
    assert PointReader("points").read(encode_points(1, "cam0", [], np.zeros((0, 2)))) is None


def a_picture(scene: np.ndarray, t_s: float) -> np.ndarray:
    """What a small camera sees that a hand turns."""
    centre = (300 + 110 * np.sin(3.1 * t_s), 300 + 90 * np.cos(4.3 * t_s))
    return cv2.getRectSubPix(scene, (240, 180), centre)


@pytest.mark.parametrize("kind", ["points", "image"])
def test_recordings_give_even_stamps_with_a_warning(tmp_path, a_motion, kind) -> None:
    t_ns, gyro, force = a_motion(seconds=20.0)
    taken_s = truth_s()[:390]
    late_ns = t_ns[0] + np.round(in_order(taken_s + delays_s(390, 4e-3)) * 1e9).astype(np.int64)
    rng = np.random.default_rng(706)
    scene = cv2.resize(rng.integers(0, 255, (40, 40), np.uint8), (600, 600), interpolation=cv2.INTER_CUBIC)
    log = tmp_path / "a.mcap"
    with LogWriter(log) as writer:
        for t, w, f in zip(t_ns.tolist(), gyro.tolist(), force.tolist(), strict=True):
            writer.write("vical/rig0/imu/imu0", encode_imu(t, "imu0", w, f), t)
        for stamp_ns, t_s in zip(late_ns.tolist(), taken_s.tolist(), strict=True):
            if kind == "points":
                writer.write("vical/rig0/camera/cam0/points", payload(t_s, stamp_ns), stamp_ns)
            else:
                image = encode_image(stamp_ns, "cam0", a_picture(scene, t_s), "mono8")
                writer.write("vical/rig0/camera/cam0/image", image, stamp_ns)
    recording = open_recording(log)
    assert any("cam0: its stamps jitter by" in warning for warning in recording.warnings)
    assert 0.0 < recording.stamp_sigma_s["cam0"] < 1e-3
    stamps = [stamp_of(p) for key, p in recording.messages() if "/camera/" in key]
    assert len(stamps) == 390
    assert np.abs(np.array(stamps) - t_ns[0] - taken_s * 1e9).max() < 1e6
    kept = open_recording(log, as_recorded=True)
    assert [stamp_of(p) for key, p in kept.messages() if "/camera/" in key] == late_ns.tolist()


def test_a_folder_of_corners(tmp_path, a_motion, write_asl) -> None:
    folder = write_asl(tmp_path / "asl", imu=a_motion(seconds=20.0))
    taken_s = truth_s()[:390]
    begin_ns = int(a_motion(seconds=20.0)[0][0])
    late_ns = begin_ns + np.round(in_order(taken_s + delays_s(390, 4e-3)) * 1e9).astype(np.int64)
    rows = ["#timestamp [ns],point_id,u [px],v [px]"]
    for stamp_ns, t_s in zip(late_ns.tolist(), taken_s.tolist(), strict=True):
        rows += [f"{stamp_ns},{i},{u!r},{v!r}" for i, (u, v) in enumerate(points_px(t_s).tolist())]
    (folder / "mav0/cam0/corners.csv").write_text("\n".join(rows) + "\n")
    recording = open_recording(folder)
    assert any("images were put on an even grid" in warning for warning in recording.warnings)
    stamps = np.array([stamp_of(p) for key, p in recording.messages() if "/camera/" in key])
    assert np.abs(stamps - begin_ns - taken_s * 1e9).max() < 1e6
    assert recording.cameras["cam0"].begin_ns == stamps[0]
