"""What the page keeps, says and draws, without a server."""

import base64
import io
import json
import os
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus, Sample
from vical_daemon.bus.messages import (
    CalibrationMessage,
    Change,
    CheckState,
    DiagnosticStatus,
    Level,
    VerifyResult,
    decode_calibration,
    encode_calibration,
    encode_diagnostics,
    encode_verification,
)
from vical_daemon.config.model import CameraConfig, Config, RecordConfig
from vical_daemon.estimation.events import Event, EventKind
from vical_daemon.estimation.guidance import AXES, Block, Guidance, Lack, Verb, WeakDirection
from vical_daemon.estimation.result import CalibrationEstimate, Status
from vical_daemon.estimation.wording import guidance_text
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.results.export import ExportError
from vical_daemon.service.liveness import FRESH_S
from vical_daemon.vision.image_codec import decode_image
from vical_daemon.vision.target import Checkerboard
from vical_daemon.web.camera_watch import CameraWatch
from vical_daemon.web.downloads import Downloads
from vical_daemon.web.images import CameraView, colour, draw, drawn_jpeg, picture_event, thinned
from vical_daemon.web.metrics import metrics
from vical_daemon.web.state import COLUMNS, EVENTS, HISTORY, SOURCES, WebState, history_row


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


def test_the_history_of_an_hour_has_no_hole(bus, state, web_feed):
    """Between the first row and the last 15 minutes there was none: charts showed a straight line."""
    message = web_feed.estimate(0.2, np.random.default_rng(3))
    for k in range(1, 5 * 3600):
        t_s = 0.2 * k
        state._calibration(CalibrationMessage("cam0", replace(message, duration_s=t_s)), t_s)
        state._cameras["cam0"].fresh.clear()
    times = np.array([row[0] for row in state.full()["cameras"]["cam0"]["rows"]])
    assert times[0] == 0.2 and times[-1] == t_s and len(times) <= HISTORY
    assert np.diff(times).max() < 15.0  # the older half has 750 rows
    assert np.diff(times[-750:]).max() < 0.21


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
    assert entry["reason"] == "no board seen yet"
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
        assert "12 s" in entry["headline"]
        assert "Converged" not in entry["headline"]
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
    ("asked", "rotate", "translate", "edges"),
    [
        (Guidance(), [], [], []),
        (Guidance(Verb.TURN, ("z",)), ["z"], [], []),
        (Guidance(Verb.TURN, ("x", "y"), Lack.ONE_AXIS, (0.0, 0.0, 1.0)), ["x", "y"], [], []),
        (Guidance(Verb.TURN_AND_MOVE, AXES), ["x", "y", "z"], ["x", "y", "z"], []),
        (Guidance(Verb.TURN, ("x",), camera="cam1"), [], [], []),  # of cam1's axes only the text speaks
        (Guidance(Verb.SHOW, lack=Lack.EDGES, camera="cam0", edges=("left",)), [], [], ["left"]),
        (Guidance(Verb.SHOW, lack=Lack.EDGES, camera="cam1", edges=("left",)), [], [], []),
    ],
)
def test_the_picture_shows_what_the_guidance_asks_for(bus, state, web_feed, asked, rotate, translate, edges):
    rng = np.random.default_rng(0)
    web_feed.publish_estimate(bus, web_feed.estimate(9.0, rng, Status.CONVERGING, motion=asked))
    entry = state.tick()["cameras"]["cam0"]
    assert entry["guidance"] == guidance_text(asked)
    motion = entry["motion"]
    assert (motion["rotate"], motion["translate"], motion["edges"]) == (rotate, translate, edges)
    named = {axis for axis in "xyz" if f" {axis}" in motion["caption"]} if rotate else set()
    assert named == set(rotate)


def test_every_status_has_a_short_headline_and_the_reason_below_it(bus, state, web_feed):
    reason = "the motion does not show: lever arm along the optical axis: ±300.0 mm"
    for status in Status:
        estimate = web_feed.estimate(1.0, np.random.default_rng(0), status, reason=reason)
        web_feed.publish_estimate(bus, estimate)
        entry = state.tick()["cameras"]["cam0"]
        assert entry["headline"].endswith(".") and len(entry["headline"]) < 60
        assert ":" not in entry["headline"] or status is Status.INCONSISTENT
        assert entry["reason"] == reason


def test_nothing_is_missing_is_said_only_where_nothing_is(bus, state, web_feed):
    """Converged, nothing missing and unseen edges never stand side by side."""
    rng = np.random.default_rng(0)
    show = Guidance(Verb.SHOW, lack=Lack.EDGES, camera="cam0", edges=("left", "right"))
    web_feed.publish_estimate(bus, web_feed.estimate(30.0, rng, Status.CONVERGED, motion=show))
    entry = state.tick()["cameras"]["cam0"]
    assert entry["headline"] == "Converged, except near the edges of the image."
    assert "nothing" not in entry["motion"]["caption"] and "no corners" in entry["guidance"]
    of_cam1 = Guidance(Verb.SHOW, lack=Lack.EDGES, camera="cam1", edges=("left",))
    web_feed.publish_estimate(bus, web_feed.estimate(30.1, rng, Status.CONVERGED, motion=of_cam1))
    entry = state.tick()["cameras"]["cam0"]
    assert entry["headline"] == "Converged." and "cam1" in entry["guidance"]
    assert "nothing" not in entry["motion"]["caption"]
    web_feed.publish_estimate(bus, web_feed.estimate(30.2, rng, Status.CONVERGED))
    entry = state.tick()["cameras"]["cam0"]
    assert (entry["headline"], entry["motion"]["caption"]) == ("Converged.", "no more motion needed")
    # a message of version 0.1.0 has guidance as text alone
    old = web_feed.estimate(30.4, rng, Status.CONVERGED, guidance="no corners yet near the left edge")
    web_feed.publish_estimate(bus, old)
    assert state.tick()["cameras"]["cam0"]["motion"]["caption"] == ""


def test_a_device_that_does_not_work_comes_before_advice(bus, state, web_feed):
    rng, asked = np.random.default_rng(0), Guidance(Verb.TURN, ("x",))
    web_feed.publish_estimate(bus, web_feed.estimate(9.0, rng, Status.CONVERGING, motion=asked))
    web_feed.publish_status(bus)
    document = state.tick()
    assert document["fault"] is None and document["cameras"]["cam0"]["guidance"]
    web_feed.publish_status(bus, Level.WARN, "480 Hz instead of 500 Hz")
    assert state.tick()["fault"] is None
    web_feed.publish_status(bus, Level.ERROR, "no data for 3.0 s")
    document = state.tick()
    assert document["fault"]["headline"] == "imu/imu0 does not work."
    assert document["fault"]["message"] == "no data for 3.0 s"
    entry = document["cameras"]["cam0"]
    assert entry["guidance"] == entry["motion"]["caption"] == "" and entry["motion"]["rotate"] == []


def test_a_fault_of_another_camera_takes_no_advice_away(bus, state, web_feed):
    rng, asked = np.random.default_rng(0), Guidance(Verb.TURN, ("x",))
    web_feed.publish_estimate(bus, web_feed.estimate(9.0, rng, Status.CONVERGING, motion=asked))
    values = {"data_age_s": "12.3"}
    gone = DiagnosticStatus(Level.ERROR, "camera/cam1", "no such device", values=values)
    bus.publish(topics.STATUS.key("rig0", "camera"), encode_diagnostics(0, "camera", [gone]))
    document = state.tick()
    assert document["fault"]["headline"] == "camera/cam1 does not work: no data for 12\N{NO-BREAK SPACE}s."
    entry = document["cameras"]["cam0"]
    assert entry["fault"] is None and entry["guidance"] and entry["motion"]["rotate"] == ["x"]


def test_a_device_that_repeats_itself_is_a_fault_though_it_reports_none(bus, state, web_feed):
    rng = np.random.default_rng(0)
    reason = "nothing new from cam0 for 8 s: it delivers the same again and again"
    web_feed.publish_estimate(bus, web_feed.estimate(30.0, rng, Status.CONVERGED, reason=reason))
    silent = DiagnosticStatus(Level.WARN, "estimate", "converged 100%", values={"silent": "camera/cam0"})
    bus.publish(topics.STATUS.key("rig0", "estimate"), encode_diagnostics(0, "estimate", [silent]))
    fault = state.tick()["cameras"]["cam0"]["fault"]
    assert fault["headline"] == "camera/cam0 sends no new data." and fault["message"] == reason
    assert state.tick()["cameras"]["cam0"]["headline"] == "converged, waiting for new data."
    spoken = replace(silent, values={"silent": ""})
    bus.publish(topics.STATUS.key("rig0", "estimate"), encode_diagnostics(0, "estimate", [spoken]))
    assert state.tick()["cameras"]["cam0"]["fault"] is None


def test_withheld_directions_are_named_without_a_second_advice(bus, state, web_feed):
    rng = np.random.default_rng(0)
    sent = web_feed.estimate(20.0, rng, Status.DEGENERATE, withheld=["time shift: turn the rig"])
    web_feed.publish_estimate(bus, sent)  # as of version 0.1.0
    assert state.tick()["cameras"]["cam0"]["withheld"] == ["time shift: turn the rig"]
    arm = WeakDirection(Block.LEVER_ARM, (0.0, 0.0, 1.0), 0.3, 5e-3, Guidance(Verb.TURN, ("x", "y")))
    sent.cameras["cam0"].withheld.append(arm)
    web_feed.publish_estimate(bus, sent)
    assert state.tick()["cameras"]["cam0"]["withheld"] == ["do not use: lever arm along the optical axis"]


def test_announcements_stay_on_the_page_for_a_while(bus, state, web_feed):
    rng = np.random.default_rng(0)
    for k in range(EVENTS + 3):
        event = Event(EventKind.POSE_LOST, "cam0", t_s=float(k))
        web_feed.publish_estimate(bus, web_feed.estimate(1.0 + k, rng, events=[event]))
        web_feed.publish_estimate(bus, web_feed.estimate(1.2 + k, rng))
    shown = state.tick()["cameras"]["cam0"]["events"]
    assert [event["t_s"] for event in shown] == [float(k) for k in range(3, EVENTS + 3)]
    assert shown[0]["kind"] == "pose_lost" and shown[0]["text"].startswith("cam0: the target was moved")
    web_feed.publish_estimate(bus, web_feed.estimate(0.5, rng))  # begun anew
    assert state.tick()["cameras"]["cam0"]["events"] == []


@pytest.mark.parametrize("size", [(640, 480), (0, 0)])
def test_where_only_points_arrive_they_are_shown(web_feed, size):
    view, bus = CameraView("cam0"), LocalBus()
    bus.subscribe("vical/**", view.take)
    web_feed.publish_points(bus, 1, size)
    assert view.next() is None  # the image may still come
    for number in range(2, 40):
        web_feed.publish_points(bus, number, size)
    sight = view.next()
    assert sight.image is None
    document = json.loads(picture_event(sight).split(b"data: ")[1])
    assert document["jpeg"] == "" and len(document["detected"]) == 48
    assert all(u < document["size"][0] and v < document["size"][1] for _, u, v in document["detected"])
    picture = decode_image(np.frombuffer(drawn_jpeg(sight), dtype=np.uint8), colour=True)
    assert picture.shape[:2] == tuple(document["size"][::-1]) and picture.max() > 60
    assert view.next() is None  # shown once
    web_feed.publish_image(bus, 60)
    assert view.next().image is not None  # images have come: they are shown


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
    ten_bit = np.repeat(np.array([40, 1023], dtype=np.uint16), 300).reshape(20, 30)
    small, factor = thinned(ten_bit)
    assert factor == 1
    assert small[0, 0] == 0 and small[-1, -1] == 255  # of 65535 it would be black
    picture = colour(np.full((20, 30), 156, dtype=np.uint8))
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


def test_a_verification_takes_the_place_of_the_estimators_words(bus, state, web_feed):
    def shown(**fields):
        result = VerifyResult(1, "cam0", CheckState.RESTING, **fields)
        bus.publish(topics.VERIFY.key(web_feed.RIG, "cam0"), encode_verification(result))
        web_feed.publish_estimate(bus, web_feed.estimate(10.0, np.random.default_rng(2)))
        return state.tick()["cameras"]["cam0"]

    changed = shown(verdict="changed", text="store no longer holds", changes=(Change("lens", 4.0, 1.0),))
    assert changed["status"] == "changed" and changed["headline"].endswith("no longer holds.")
    assert changed["reason"] == "store no longer holds" and changed["verify"]["changes"][0]["what"] == "lens"
    unsure = shown(missing_motion=("turn about x",))
    assert (unsure["status"], unsure["guidance"]) == ("verifying", "turn about x")
    before = state.malformed
    assert shown(seconds_used=float("nan"))["status"] == "verifying"  # the last good one
    assert state.malformed == before + 1


def test_the_stored_calibration_stands_beside_the_present_one(bus, state, web_feed):
    stored, now = (web_feed.estimate(t, np.random.default_rng(seed)) for t, seed in ((60.0, 1), (10.0, 2)))
    web_feed.publish_estimate(bus, now)
    assert state.tick()["cameras"]["cam0"]["stored"] is None
    bus.publish(topics.STORED.key(web_feed.RIG, "cam0"), encode_calibration(stored, "cam0"))
    shown = state.tick()["cameras"]["cam0"]
    assert len(shown["stored"]["rows"]) == 7 and shown["stored"]["t_ns"] == str(stored.t_ns)
    name, value, sigma, sigmas, unit = shown["stored"]["rows"][0]
    moved = now.cameras["cam0"].T_imu_cam.p_m[0] - stored.cameras["cam0"].T_imu_cam.p_m[0]
    assert (name, unit) == ("lever arm x", "mm")
    assert (value, sigmas) == (
        pytest.approx(1e3 * moved, rel=1e-5),
        pytest.approx(abs(value) / sigma, rel=1e-5),
    )
    assert {m["kind"] for m in shown["meters"]} == {"translation", "rotation", "time"}
    assert len(shown["rig"]["R"]) == 3


def test_the_images_of_a_camera_give_coverage_pose_and_a_wanted_place(bus, web_feed):
    board = Checkerboard(8, 6, 0.05, 0.05)
    state = WebState(web_feed.RIG, watches={"cam0": CameraWatch(board.points_m)})
    bus.subscribe("vical/**", state.take)
    rng = np.random.default_rng(0)
    web_feed.publish_estimate(bus, web_feed.estimate(10.0, rng))
    web_feed.publish_status(bus)
    for number in range(20):
        web_feed.publish_image(bus, number)
    sight = state.tick()["sights"]["cam0"]
    coverage = sight["coverage"]
    assert 0.1 < coverage["share"] < 0.6 and len(coverage["count"]) == coverage["rows"] * coverage["columns"]
    assert any(v is not None and 0.2 < v < 1.0 for v in coverage["rms_px"])
    assert sight["rate_hz"] == 20.0 and sight["board_share"] == 1.0
    assert sight["blur"]["px"] > 0 and sight["wanted"]["text"].startswith("bring the board")
    # 45 px squares of 50 mm at 520 px: the camera is 0.58 m in front of the board
    assert np.linalg.norm(np.array(sight["pose"]["p"])) == pytest.approx(0.61, abs=0.05)
    web_feed.publish_image(bus, 21)
    state.tick()
    assert len(state.full()["sights"]["cam0"]["path"]) == 2
    web_feed.publish_estimate(bus, web_feed.estimate(1.0, rng))  # begun anew: all is wanted again
    assert state.tick()["sights"]["cam0"]["coverage"] is None


def test_no_place_is_wanted_where_the_lens_is_held(bus, web_feed):
    state = WebState(web_feed.RIG, watches={"cam0": CameraWatch(Checkerboard(8, 6, 0.05, 0.05).points_m)})
    bus.subscribe("vical/**", state.take)
    held = web_feed.estimate(10.0, np.random.default_rng(0))
    held.cameras["cam0"].intrinsics_sigma[:] = [0.0] * 4
    web_feed.publish_estimate(bus, held)
    web_feed.publish_image(bus, 1)
    assert state.tick()["sights"]["cam0"]["wanted"] is None


def test_downloads_hold_the_present_result_and_the_newest_log(bus, state, web_feed, tmp_path):
    config = Config(
        rig=web_feed.RIG,
        cameras={"cam0": CameraConfig(uri="none", size=(640, 480))},
        record=RecordConfig(directory=str(tmp_path)),
    )
    downloads = Downloads(config, state)
    with pytest.raises(ExportError, match="no result yet"):
        downloads.export("kalibr")
    assert downloads.newest_log() is None
    web_feed.publish_estimate(bus, web_feed.estimate(10.0, np.random.default_rng(0)))
    state.tick()
    name, data = downloads.export("kalibr")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert (name, archive.namelist()) == ("kalibr.zip", ["camchain-imucam.yaml", "imu.yaml"])
        assert "resolution: [640, 480]" in archive.read("camchain-imucam.yaml").decode()
    name, data = downloads.export("json")
    assert name == "calibration.json" and json.loads(data)["cameras"]["cam0"]
    with pytest.raises(ExportError, match="none of"):
        downloads.export("nonsense")
    for age, part in ((100, "old.mcap"), (1, "new.mcap.part")):
        (tmp_path / part).write_bytes(b"x")
        os.utime(tmp_path / part, (1e9 - age, 1e9 - age))
    assert downloads.newest_log().name == "new.mcap.part"
    for age, segment in ((9, 1), (5, 0)):
        part = f"rig_19700101T000100Z_ffffff_000{segment}.mcap"
        (tmp_path / part).write_bytes(b"x")
        os.utime(tmp_path / part, (1e9 - age, 1e9 - age))
    assert downloads.newest_log().name == "rig_19700101T000100Z_ffffff_0001.mcap"  # whatever the files' dates
    with LogWriter(tmp_path / "rig_19700101T000030Z_000000_0000.mcap") as writer:
        os.utime(writer.part_path, (30, 30))
        assert downloads.newest_log() == writer.part_path
