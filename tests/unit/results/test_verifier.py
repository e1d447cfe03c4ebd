"""The answer of a verification, from estimates as the estimator gives them; no recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
)
from vical_daemon.results.change_odds import Counts
from vical_daemon.results.export import rig_from_estimate
from vical_daemon.results.known import ANY_SHIFT_S, known_cameras
from vical_daemon.results.verifier import Answer, CameraCheck, Verifier

LENS = [458.0, 457.0, 367.0, 248.0]
SIGMA = np.array([2e-4] * 3 + [2e-4] * 3 + [5e-5] + [0.2] * 4 + [1e-3] * 4)


def estimate(e=None, *, times=1.0, seconds=4.0, status=Status.CONVERGING, covariance=None):
    """An estimate that is off by `e`, with sigmas `times` SIGMA."""
    e = np.zeros(15) if e is None else e
    P = np.diag((times * SIGMA) ** 2) if covariance is None else covariance
    R = Rotation.from_euler("zyx", [89.0, 1.5, 0.3], degrees=True) * Rotation.from_rotvec(e[3:6])
    q = np.roll(R.as_quat(canonical=True), 1)
    sigma = np.sqrt(np.diag(P))
    camera = CameraEstimate(
        PoseEstimate((np.array([-0.02, -0.06, 0.01]) + e[:3]).tolist(), q.tolist(), P[:6, :6].tolist()),
        -5e-3 + e[6],
        float(sigma[6]),
        (np.array(LENS) + e[7:11]).tolist(),
        sigma[7:11].tolist(),
        "radtan",
        (np.array([-0.28, 0.07, 0.0, 0.0]) + e[11:]).tolist(),
        sigma[11:].tolist(),
        0.3,
        resolution=[752, 480],
        unobservable=["the lever arm along x: turn about y"] if times > 5.0 else [],
        calibration_covariance=P.tolist(),
    )
    imu = ImuEstimate([0.0] * 3, [0.0] * 3)
    guidance = "turn faster about x" if times > 5.0 else ""
    return CalibrationEstimate(
        0, status, "", 0.5, guidance, seconds, 80, 400, {"cam0": camera}, imu, [0.0, 0.0, -9.8], 1.0, 0.0
    )


@pytest.fixture
def stored():
    return known_cameras(rig_from_estimate(estimate()), "stored.json")["cam0"]


def test_the_same_rig_holds(stored):
    verifier = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    assert verifier.look(estimate(0.5 * SIGMA))
    document = verifier.document()
    assert document["verdict"] == "holds"
    assert document["changes"] == []
    assert document["seconds_used"] == 4.0
    assert document["probability_changed"] < 0.01


def test_a_turned_camera_is_found_and_the_turn_is_told_in_its_axis(stored):
    e = np.zeros(15)
    e[3:6] = np.deg2rad(0.3) * np.array([0.0, 0.6, 0.8])
    verifier = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    assert verifier.look(estimate(e))
    document = verifier.document()
    assert document["verdict"] == "changed"
    (change,) = document["changes"]
    assert change["what"] == "rotation"
    assert change["unit"] == "rad"
    assert change["value"] == pytest.approx(np.deg2rad(0.3), rel=0.05)
    assert change["axis"] == pytest.approx([0.0, 0.6, 0.8], abs=0.05)
    assert 1e-4 < change["sigma"] < 1e-3


def test_a_changed_lens_is_told_in_pixels_over_the_image(stored):
    e = np.zeros(15)
    e[9] = 5.0  # cx: every point of the image moves by as much
    verifier = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    verifier.look(estimate(e))
    (change,) = verifier.document()["changes"]
    assert change["what"] == "lens"
    assert change["value"] == pytest.approx(5.0, rel=0.05)
    assert change["unit"] == "px"


@pytest.mark.parametrize(("k1", "verdict"), [(0.28, "changed"), (0.05, "changed"), (0.004, "holds")])
def test_a_lens_whose_distortion_alone_is_wrong_is_another_lens(stored, k1, verdict):
    """It was `holds` with a probability of a change of 1: a file whose distortion is `none`."""
    e = np.zeros(15)
    e[11] = k1  # 0.004: significant, and less than counts
    verifier = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    assert verifier.look(estimate(e))
    document = verifier.document()
    assert document["verdict"] == verdict
    assert [change["what"] for change in document["changes"]] == ["lens"] * (verdict == "changed")
    assert document["cameras"]["cam0"]["blocks"]["lens"]["holds"] == (verdict == "holds")


def test_a_certain_change_below_what_counts_is_none_while_another_block_is_undecided(stored):
    """Stamps that settle in the first seconds: the time shift of a demo was 0.28 ms apart, 6 sigma."""
    e, times = np.zeros(15), np.ones(15)
    e[6] = 4.5e-4
    times[:3] = 8.0  # what counts of the position is not yet visible
    check = CameraCheck(replace(stored, model_fits=True), lens_asked=True)
    assert not Verifier({"cam0": check}).look(estimate(e, covariance=np.diag((times * SIGMA) ** 2)))
    assert check.answer is Answer.CANNOT_TELL
    assert check.odds is not None
    assert check.odds.blocks == ("time shift",)
    assert check.odds.log_changed > np.log(1000.0)
    assert check.odds.undecided == ["position"]


def test_poor_motion_cannot_tell_and_names_what_is_missing(stored):
    verifier = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    assert not verifier.look(estimate(times=40.0))
    document = verifier.document()
    assert document["verdict"] == "cannot tell"
    assert document["missing_motion"] == ["turn faster about x", "the lever arm along x: turn about y"]
    blocks = document["cameras"]["cam0"]["blocks"]
    assert blocks["position"]["visible_from"] > blocks["position"]["counts_from"] == pytest.approx(2e-3)
    assert blocks["time shift"]["counts_from"] == pytest.approx(1e-3)


def test_whether_the_model_fits_is_taken_from_the_stored_calibration_where_a_short_recording_cannot_tell(
    stored,
):
    def visible_from(before, today):
        verifier = Verifier({"cam0": CameraCheck(replace(stored, model_fits=before), lens_asked=True)})
        now = estimate()
        camera = replace(now.cameras["cam0"], model_fits=today)
        verifier.look(replace(now, cameras={"cam0": camera}))
        return verifier.document()["cameras"]["cam0"]["blocks"]["rotation"]["visible_from"]

    fits = visible_from(None, True)
    assert visible_from(True, None) == fits
    assert visible_from(False, True) == fits  # the recording itself has shown it
    for before, today in ((None, None), (False, None), (True, False)):
        assert visible_from(before, today) > 1.5 * fits


def test_contradictory_data_are_not_weighed(stored):
    verifier = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    assert not verifier.look(replace(estimate(), status=Status.INCONSISTENT, reason="images do not fit"))
    camera = verifier.document()["cameras"]["cam0"]
    assert camera["verdict"] == "cannot tell"
    assert camera["reason"] == "images do not fit"


def test_a_lens_that_is_not_asked_about_leaves_doubts_to_changed_alone(stored):
    """A held lens of which the pose depends strongly: off by what another lens explains is no change."""
    P = np.diag(SIGMA**2)
    J = np.eye(15)
    J[4, 9] = 1e-3  # a turn about y for each px of cx
    lens = np.zeros(15)
    lens[9] = 4.0**2
    P = J @ (P + np.diag(lens)) @ J.T
    e = np.zeros(15)
    e[4] = np.deg2rad(0.25)
    check = CameraCheck(stored.given_lens(), lens_asked=False)
    assert not Verifier({"cam0": check}).look(estimate(e, covariance=P))
    assert check.answer is Answer.CANNOT_TELL
    check = CameraCheck(stored.given_lens(), lens_asked=False)
    assert Verifier({"cam0": check}).look(estimate(covariance=P))
    assert check.answer is Answer.HOLDS


def test_a_rig_holds_if_every_camera_does(stored):
    other = replace(stored, name="cam1")
    checks = {"cam0": CameraCheck(stored, lens_asked=True), "cam1": CameraCheck(other, lens_asked=True)}
    verifier = Verifier(checks)
    both = estimate()
    assert not verifier.look(both)  # cam1 has not been seen
    assert verifier.answer is Answer.CANNOT_TELL
    both = replace(both, cameras=both.cameras | {"cam1": both.cameras["cam0"]})
    assert verifier.look(both)
    assert verifier.answer is Answer.HOLDS


def test_the_time_shift_of_a_video_is_not_compared(stored):
    """Its clock begins with it: whatever its stamps were moved by first is not the rig's."""
    e = np.zeros(len(stored.sigma))
    e[6] = 1e-2
    unlike = Verifier({"cam0": CameraCheck(stored, lens_asked=True)})
    counts = Counts(timeshift_s=10.0 * ANY_SHIFT_S)
    alike = Verifier({"cam0": CameraCheck(stored.with_any_shift(), lens_asked=True)}, counts)
    for verifier, verdict in ((unlike, Answer.CHANGED), (alike, Answer.HOLDS)):
        verifier.look(estimate(e))
        assert verifier.answer is verdict
