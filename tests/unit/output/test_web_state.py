"""What the page keeps, says and draws, without a server."""

import base64
import json

import numpy as np
import pytest

from vical_daemon import topics
from vical_daemon.bus import LocalBus, Sample
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.liveness import FRESH_S
from vical_daemon.messages import decode_calibration, encode_calibration, encode_diagnostics
from vical_daemon.vision.image_codec import decode_image
from vical_daemon.web import words
from vical_daemon.web.images import CameraView, colour, draw, drawn_jpeg, picture_event, thinned
from vical_daemon.web.metrics import metrics
from vical_daemon.web.state import COLUMNS, HISTORY, SOURCES, WebState, history_row


@pytest.fixture
def bus():
    return LocalBus()


@pytest.fixture
def state(bus, web_feed):
    state = WebState(web_feed.RIG)
    bus.subscribe("vical/**", state.take)
    return state


def test_row_has_the_columns_and_units(web_feed):
    rng = np.random.default_rng(1)
    value = web_feed.estimate(10.0, rng)
    row = dict(zip(COLUMNS, history_row(decode_calibration(encode_calibration(value, "cam0"))), strict=True))
    camera = value.cameras["cam0"]
    assert row["px_mm"] == pytest.approx(1e3 * camera.T_imu_cam.p_m[0], rel=1e-6)
    assert row["spz_mm"] == pytest.approx(1e3 * np.sqrt(camera.T_imu_cam.covariance[2][2]), rel=1e-6)
    assert row["srx_deg"] == pytest.approx(np.degrees(np.sqrt(camera.T_imu_cam.covariance[3][3])), rel=1e-6)
    assert row["shift_ms"] == pytest.approx(1e3 * camera.timeshift_cam_imu_s, rel=1e-6)
    assert row["ay_mm"] == pytest.approx(-20.0)
    assert row["qw"] == pytest.approx(camera.T_imu_cam.q_wxyz[0], rel=1e-6)


def test_updates_add_up_to_the_full_state(bus, state, web_feed):
    rng, rows = np.random.default_rng(2), []
    for k in range(1, 40):
        web_feed.publish_estimate(bus, web_feed.estimate(0.2 * k, rng))
        if k % 3 == 0:
            rows += state.tick()["cameras"]["cam0"]["fresh"]
    rows += state.tick()["cameras"]["cam0"]["fresh"]
    full = state.full()
    assert full["cameras"]["cam0"]["rows"] == rows
    assert len(rows) == 39
    assert tuple(full["columns"]) == COLUMNS
    json.dumps(full, allow_nan=False)


def test_history_is_thinned_towards_the_past(bus, state, web_feed):
    rng = np.random.default_rng(3)
    for k in range(HISTORY + 300):
        web_feed.publish_estimate(bus, web_feed.estimate(0.2 * (k + 1), rng))
        if k % 500 == 0:
            state.tick()
    state.tick()
    times = [row[0] for row in state.full()["cameras"]["cam0"]["rows"]]
    assert len(times) <= HISTORY
    assert times == sorted(times)
    assert times[0] < 1.0
    assert times[-1] - times[-2] == pytest.approx(0.2, abs=1e-6)


def test_a_restarted_estimator_begins_a_new_history(bus, state, web_feed):
    rng = np.random.default_rng(4)
    for t in (1.0, 2.0, 3.0, 0.5):
        web_feed.publish_estimate(bus, web_feed.estimate(t, rng))
    update = state.tick()
    assert [row[0] for row in update["cameras"]["cam0"]["rows"]] == [0.5]


def test_nothing_known_yet_is_fine(bus, state, web_feed):
    empty = CalibrationEstimate(
        1,
        Status.INITIALISING,
        "no board seen yet",
        0.0,
        "show the board",
        1.0,
        0,
        100,
        {},
        None,
        [],
        0.0,
        0.0,
    )
    web_feed.publish_estimate(bus, empty)
    entry = state.tick()["cameras"]["cam0"]
    assert entry["lens"] is None
    assert entry["fresh"] == []
    assert "no board seen yet" in entry["sentence"]
    assert "vical_timeshift_seconds" not in metrics(state)


def test_malformed_messages_are_counted_not_raised(state, web_feed):
    key = topics.CALIBRATION.key(web_feed.RIG, "cam0")
    for payload in (b"", b"\x00\x01\x00\x00", b"x" * 200):
        state.take(Sample(key, payload, 0))
    state.take(Sample("other/key", b"", 0))
    state.tick()
    assert state.malformed == 3


def test_a_source_that_falls_silent_is_stale_with_its_age(bus, web_feed):
    now_s = [100.0]
    state = WebState(web_feed.RIG, lambda: now_s[0])
    bus.subscribe("vical/**", state.take)
    rng = np.random.default_rng(6)
    web_feed.publish_estimate(bus, web_feed.estimate(30.0, rng))
    web_feed.publish_status(bus)
    entry = state.tick()["cameras"]["cam0"]
    assert (entry["status"], entry["stale"], entry["age_s"]) == ("converged", False, 0.0)
    now_s[0] += FRESH_S + 7.0
    for document in (state.tick(), state.full()):
        entry = document["cameras"]["cam0"]
        assert (entry["status"], entry["stale"], entry["age_s"]) == ("stale", True, FRESH_S + 7.0)
        assert entry["last_status"] == "converged"
        assert "12 s" in entry["sentence"]
        assert "Converged:" not in entry["sentence"]
        for device in document["devices"]:
            assert device["level"] == 3
            assert device["message"].startswith("silent for 12 s")
    text = metrics(state)
    assert 'status="converged"} 0.0' in text
    assert 'vical_calibration_age_seconds{rig="rig0",camera="cam0"} 12.0' in text
    assert 'vical_component_level{rig="rig0",role="imu",component="imu/imu0"} 3.0' in text
    web_feed.publish_estimate(bus, web_feed.estimate(31.0, rng))
    web_feed.publish_status(bus)
    document = state.tick()
    assert document["cameras"]["cam0"]["status"] == "converged"
    assert {device["level"] for device in document["devices"]} == {0}


def test_invented_names_do_not_fill_the_memory(bus, state, web_feed):
    value = web_feed.estimate(30.0, np.random.default_rng(7))
    for k in range(10 * SOURCES):
        key = topics.CALIBRATION.key(web_feed.RIG, "cam0")
        bus.publish(key, encode_calibration(value, f"other{k}"))  # says that it is another camera's
        bus.publish(topics.CALIBRATION.key(web_feed.RIG, f"c{k}"), encode_calibration(value, f"c{k}"))
        bus.publish(topics.STATUS.key(web_feed.RIG, f"r{k}"), encode_diagnostics(1, "r", []))
        state.tick(wanted=False)
    assert len(state.calibrations) == SOURCES
    assert len(state.statuses) == SOURCES
    assert state.malformed == 10 * SOURCES + 2 * 9 * SOURCES


def test_devices_and_metrics(bus, state, web_feed):
    rng = np.random.default_rng(5)
    web_feed.publish_estimate(bus, web_feed.estimate(30.0, rng))
    web_feed.publish_status(bus)
    devices = {d["name"]: d for d in state.tick()["devices"]}
    assert devices["imu/imu0"]["values"]["rate_hz"] == "500.02"
    assert "clock" not in devices
    text = metrics(state)
    assert 'vical_component_rate_hz{rig="rig0",role="imu",component="imu/imu0"} 500.02' in text
    assert 'vical_calibration_status{rig="rig0",camera="cam0",status="converged"} 1.0' in text
    for line in text.splitlines():
        assert line.startswith("# ") or float(line.rsplit(" ", 1)[1]) is not None
    names = [line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("texts", "rotate", "translate"),
    [
        (["rotate about the optical axis"], ["z"], []),
        (["turn about cam x and y"], ["x", "y"], []),
        (["tilt the rig"], ["x", "y", "z"], []),
        (["move along z; rotate about x"], ["x"], ["z"]),
        (["move closer and further"], [], ["x", "y", "z"]),
        ([""], [], []),
        (["clean the lens"], [], []),
        (["rotation about the optical axis (roll): +-0.2 deg"], [], []),
        (["collecting the first seconds: move the rig, keep the target in view"], [], ["x", "y", "z"]),
        (["turn the rig back and forth faster, changing direction"], ["x", "y", "z"], []),
        (["rotate about the image's x axis (nod) and about the image's y axis (shake)"], ["x", "y"], []),
    ],
)
def test_motion_is_read_from_the_words(texts, rotate, translate):
    assert words.motion(texts) == {"rotate": rotate, "translate": translate}


def test_every_status_has_a_sentence(web_feed):
    for status in Status:
        assert words.sentence(web_feed.estimate(1.0, np.random.default_rng(0), status)).endswith(".")


def fill(view, web_feed, **options):
    bus = LocalBus()
    bus.subscribe("vical/**", view.take)
    return lambda number: web_feed.publish_image(bus, number, **options)


def test_picture_has_marks_where_the_points_are(web_feed):
    view = CameraView("cam0")
    fill(view, web_feed)(1)
    sight = view.next()
    picture = decode_image(np.frombuffer(drawn_jpeg(sight), dtype=np.uint8), colour=True)
    assert picture.shape == (480, 640, 3)
    shift = 30 * np.sin(0.2)
    around = picture[130:140, int(170 + shift) : int(181 + shift)].astype(int)
    assert np.abs(around[..., 0] - around[..., 2]).max() > 60  # a coloured mark on a grey picture
    assert view.next() is None  # shown once


def test_picture_event_gives_points_in_pixels_of_the_full_image(web_feed):
    view = CameraView("cam0")
    fill(view, web_feed, width=1920)(1)
    kind, data = picture_event(view.next()).decode().split("\n")[:2]
    assert kind == "event: picture"
    document = json.loads(data.removeprefix("data: "))
    assert document["size"] == [1920, 1440]
    jpeg = np.frombuffer(base64.b64decode(document["jpeg"]), dtype=np.uint8)
    assert decode_image(jpeg).shape == (480, 640)  # thinned: the page is for looking
    number, u, v = document["detected"][0]
    assert (number, u, v) == (0, pytest.approx(174.5 + 30 * np.sin(0.2), abs=0.01), 134.5)
    expected = np.array([row[1:] for row in document["predicted"]])
    found = np.array([row[1:] for row in document["detected"]])
    assert 0.2 < np.median(np.linalg.norm(expected - found, axis=1)) < 2.0


def test_picture_waits_for_its_points_but_not_for_ever(web_feed):
    view = CameraView("cam0")
    fill(view, web_feed)(1)
    assert view.next()
    bare = fill(view, web_feed, with_points=False)
    bare(2)
    assert view.next() is None
    bare(30)
    assert view.next() is not None


def test_picture_waits_for_a_prediction_while_there_are_any(web_feed):
    view = CameraView("cam0")
    fill(view, web_feed)(1)
    fill(view, web_feed, with_prediction=False)(2)
    assert view.next().predicted is not None  # the older image, which has everything
    assert view.next() is None
    fill(view, web_feed, with_prediction=False)(40)  # two seconds later nothing is predicted any more
    sight = view.next()
    assert sight.points is not None
    assert sight.predicted is None


def test_a_clock_that_goes_back_does_not_stop_the_picture(web_feed):
    view = CameraView("cam0")
    feed = fill(view, web_feed)
    feed(500)
    assert view.next()
    feed(1)
    assert view.next()


def test_marks_at_the_border_and_other_depths():
    small, factor = thinned(np.full((20, 30), 40000, dtype=np.uint16))
    picture = colour(small)
    assert factor == 1
    assert picture[0, 0].tolist() == [156] * 3
    shape = np.array([[0, 0], [1, 1]])
    draw(picture, np.array([[0.0, 0.0], [29.4, 19.6], [-50.0, 4.0], [1e300, 4.0]]), shape, (1, 2, 3))
    assert picture[0, 0].tolist() == [1, 2, 3]
    assert (picture != 156).any(axis=2).sum() == 2  # the others lie outside
    draw(picture, np.empty((0, 2)), shape, (1, 2, 3))
    assert colour(np.zeros((4, 5, 3), dtype=np.uint8)).shape == (4, 5, 3)


def test_broken_images_are_passed_over(web_feed):
    view = CameraView("cam0")
    view.take(Sample(topics.IMAGE.key(web_feed.RIG, "cam0"), b"\x00\x01\x00\x00abc", 0))
    view.take(Sample(topics.IMAGE.key(web_feed.RIG, "other"), b"", 0))
    sight = view.next()
    assert sight is None or (picture_event(sight) is None and drawn_jpeg(sight) is None)
