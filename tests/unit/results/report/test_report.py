"""The report: self-contained, complete, honest about what is missing; its statistics against brute force."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vical_daemon.estimation.geometry.camera_model import project
from vical_daemon.results.report import ReportError, collect, worst, write_report
from vical_daemon.results.report.board_views import board_views
from vical_daemon.results.report.residuals import cells, gather, per_point_rms
from vical_daemon.results.report.values import value, warnings_of
from vical_daemon.results.report.verdict import limits, verdict
from vical_daemon.vision.target import Checkerboard

SIZE = (640, 480)


@dataclass(frozen=True)
class Frame:
    t_ns: int
    camera: str
    ids: np.ndarray
    uv_px: np.ndarray
    residual_px: np.ndarray
    accepted: np.ndarray
    nis: float
    dof: int


def make_frames(rng, count=120, sigma=0.25):
    frames = []
    for k in range(count):
        centre = rng.uniform((160, 120), (480, 360))
        grid = np.stack(np.meshgrid(np.arange(8), np.arange(6)), axis=-1).reshape(-1, 2) * 30.0
        uv = grid + centre - grid.mean(axis=0)
        residual = sigma * rng.standard_normal(uv.shape) + 0.0006 * (uv - 320.0)
        accepted = rng.uniform(size=len(uv)) > 0.02
        residual[~accepted] += 3.0
        dof = 2 * int(accepted.sum())
        frames.append(
            Frame(
                int(1e18) + k * 50_000_000,
                "cam0",
                np.arange(48),
                uv,
                residual,
                accepted,
                rng.chisquare(dof),
                dof,
            )
        )
    return frames


def make_trace(seconds=60):
    rng, trace = np.random.default_rng(0), []
    final = Rotation.from_euler("zyx", [89, 1, 0.2], degrees=True)
    for t in range(1, seconds):
        p_sigma, r_sigma, s_sigma = 0.02 / t, 0.01 / t, 5e-4 / t
        q = (final * Rotation.from_rotvec(r_sigma * rng.standard_normal(3))).as_quat(scalar_first=True)
        trace.append(
            {
                "t_s": float(t),
                "p_m": (np.array([0.08, 0.02, -0.03]) + p_sigma * rng.standard_normal(3)).tolist(),
                "p_sigma_m": [p_sigma] * 3,
                "q_wxyz": q.tolist(),
                "r_sigma_rad": [r_sigma] * 3,
                "timeshift_s": -0.0052 + s_sigma * rng.standard_normal(),
                "timeshift_sigma_s": s_sigma,
                "nis_per_dof": 1.0,
                "status": "converging",
            }
        )
    return trace


@pytest.fixture
def result():
    q = Rotation.from_euler("zyx", [89, 1, 0.2], degrees=True).as_quat(scalar_first=True)
    return {
        "status": "converged",
        "reason": "",
        "duration_s": 60.0,
        "cpu_s": 4.1,
        "frames": 1200,
        "imu_samples": 6000,
        "cameras": {
            "cam0": {
                "T_imu_cam": {
                    "p_m": [0.0801, 0.0199, -0.0302],
                    "q_wxyz": q.tolist(),
                    "covariance": np.diag([9e-8, 8e-8, 2e-7, 1e-8, 2e-8, 3e-9]).tolist(),
                },
                "timeshift_cam_imu_s": -0.00521,
                "timeshift_sigma_s": 1.8e-5,
                "intrinsics": [520.1, 519.8, 321.0, 239.4],
                "intrinsics_sigma": [0.3, 0.3, 0.2, 0.2],
                "distortion_model": "radtan",
                "distortion": [-0.28, 0.07, 0.0002, 0.0],
                "distortion_sigma": [1e-3, 2e-3, 1e-4, 1e-4],
                "reprojection_rms_px": 0.26,
                "corner_sigma_px": 0.25,
                "unobservable": [],
                "resolution": list(SIZE),
            }
        },
        "imu": {
            "gyro_bias_rps": [0.001, -0.002, 0.003],
            "accel_bias_mps2": [0.02, 0.01, -0.05],
            "gyro_bias_sigma_rps": [1e-5] * 3,
            "accel_bias_sigma_mps2": [2e-3] * 3,
        },
        "gravity_world_mps2": [0.1, 9.79, 0.3],
        "nis_per_dof": 1.02,
        "rejected_fraction": 0.02,
        "trace": make_trace(),
    }


def test_report_is_complete_and_self_contained(result, tmp_path):
    rng = np.random.default_rng(1)
    data = tmp_path / "input.bin"
    data.write_bytes(b"abc")
    path = tmp_path / "r.html"
    write_report(
        path,
        result,
        make_frames(rng, 40),
        provenance=collect("vical calibrate input.bin --target t.yaml", [data], {"seed": 1}),
    )
    text = path.read_text()
    names = re.sub(r"http://www\.w3\.org/(2000/svg|1999/xlink)", "", text)  # of the language, not fetched
    outside = re.findall(r"(?:src|href)=\"(?!data:|#)[^\"]*|url\((?!#)[^)]*|https?://[^\"'< ]*", names)
    assert outside == []
    for needed in (
        "converged",
        "80.10",
        "-5.210",
        "0.018",
        "gyro bias",
        "SHA-256",
        "--target t.yaml",
    ):
        assert needed in text, needed
    assert "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad" in text  # sha256("abc")
    for part in ("map", "scatter", "frames", "nis", "convergence", "sigmas", "correlation"):
        assert f'id="cam0{part}0' in text, part
    assert len(text) < 3_000_000


def test_report_without_frames_says_so(result, tmp_path):
    result["trace"] = result["trace"][:1]
    path = tmp_path / "r.html"
    write_report(path, result, png_folder=tmp_path / "png")
    names = {p.name for p in (tmp_path / "png").iterdir()}
    assert names == {"cam0-correlation.png", "cam0-nis-1.png", "cam0-nis-2.png"}
    assert "residuals of the frames were not kept" in path.read_text()


def test_names_from_outside_are_escaped(result, tmp_path):
    result |= {"reason": "<script>alert(1)</script>", "trace": []}
    result["cameras"]["<b>"] = result["cameras"].pop("cam0")
    path = tmp_path / "r.html"
    write_report(path, result)
    assert "<script>alert" not in path.read_text()
    assert "<b>" not in path.read_text()


def test_no_solution_and_no_folder_are_said(result, tmp_path):
    with pytest.raises(ReportError, match="no solution"):
        write_report(tmp_path / "r.html", {"cameras": {}, "reason": "no board seen"})
    result["trace"] = []
    with pytest.raises(ReportError, match="cannot write"):
        write_report(tmp_path / "none" / "r.html", result)


def test_warnings_name_what_must_not_be_used(result):
    assert warnings_of(result) == []
    result["status"] = "degenerate"
    result["cameras"]["cam0"]["unobservable"] = ["lever arm along cam z: rotate about x and y"]
    result |= {"nis_per_dof": 2.2, "rejected_fraction": 0.2, "guidance": "rotate about the optical axis"}
    text = " ".join(warnings_of(result))
    for needed in ("degenerate", "lever arm along cam z", "2.20", "20.0 %", "rotate about the optical axis"):
        assert needed in text
    assert "sigmas may be too small" in text
    text = " ".join(warnings_of(result | {"mode": "target_free"}))
    assert "differ by 2.20 times" in text and "The sigmas include that" in text and "board" not in text


def test_cells_equal_a_loop():
    rng = np.random.default_rng(2)
    points = gather(make_frames(rng, 20), "cam0")
    found = cells(points, SIZE, across=8)
    assert found.count.sum() == points.accepted.sum()
    for line in range(found.count.shape[0]):
        for column in range(8):
            inside = (
                points.accepted
                & (points.uv_px[:, 0] >= found.x_edges[column])
                & (points.uv_px[:, 0] < found.x_edges[column + 1])
                & (points.uv_px[:, 1] >= found.y_edges[line])
                & (points.uv_px[:, 1] < found.y_edges[line + 1])
            )
            assert found.count[line, column] == inside.sum()
            if inside.sum() >= 5:
                assert found.mean_px[line, column] == pytest.approx(points.residual_px[inside].mean(axis=0))
                assert found.rms_px[line, column] == pytest.approx(
                    np.sqrt((points.residual_px[inside] ** 2).mean())
                )


def test_point_rms_and_refused_share():
    frames = make_frames(np.random.default_rng(3), 30)
    points = gather(frames, "cam0")
    ids, rms, refused = per_point_rms(points)
    own = np.concatenate([f.residual_px[(f.ids == 7) & f.accepted] for f in frames])
    assert rms[list(ids).index(7)] == pytest.approx(np.sqrt((own**2).mean()))
    assert refused[7] == pytest.approx(np.mean([not f.accepted[7] for f in frames]))
    assert gather(frames, "other") is None


@pytest.mark.parametrize(
    ("number", "sigma", "shown"),
    [
        (1.23456, 0.012, ("1.235", "0.012")),
        (5, 120.0, ("5", "120")),
        (2, 0.0, ("2", "fixed")),
        (2, None, ("2", "")),
    ],
)
def test_values_have_the_digits_of_their_sigma(number, sigma, shown):
    assert value(number, sigma) == shown


def with_joint(result, lens_sigma_px):
    """Give the result a joint covariance in which the focal length and the lever arm along z go together."""
    camera = result["cameras"]["cam0"]
    order = ["px", "py", "pz", "rx", "ry", "rz", "timeshift", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]
    pose = np.array(camera["T_imu_cam"]["covariance"])
    sigma = np.concatenate([np.sqrt(np.diag(pose)), [1.8e-5], [lens_sigma_px] * 4, [1e-3] * 4])
    correlation = np.eye(len(order))
    correlation[2, 7] = correlation[7, 2] = 0.9 if lens_sigma_px > 1 else 0.1
    camera["calibration_covariance"] = (correlation * np.outer(sigma, sigma)).tolist()
    return camera


def test_the_verdict_says_how_well_and_what_helps(result):
    said = verdict(result)
    assert said.word == "Good."
    assert said.known == [
        "1 sigma in the worst direction: lever arm 0.45 mm, rotation 0.0081°, time shift 0.018 ms."
    ]
    assert "least certain along" in said.advice[0] and len(said.advice) == 1
    with_joint(result, 5.0)
    assert "55 % of the variance of the lever arm comes from the lens" in verdict(result).advice[0]
    result["events"] = [
        {"kind": "image_gap", "camera": "cam0", "t_s": 3.0, "text": "cam0: 5 s without images"},
        {"kind": "fixed_lens", "camera": "cam0", "t_s": 9.0, "text": "the fixed lens is off: free it"},
    ]
    said = verdict(result)
    assert (said.word, said.advice[0]) == ("Converged, with reservations.", "The fixed lens is off: free it")
    assert "comes from the lens: let vical estimate it" in said.advice[-1]
    assert not any("without images" in line for line in said.advice)
    for status, word in (
        ("degenerate", "Incomplete"),
        ("inconsistent", "Do not use"),
        ("waiting", "Do not use"),
    ):
        assert verdict(result | {"status": status}).word.startswith(word)


def test_limits_are_those_of_the_result_alone(result):
    camera = result["cameras"]["cam0"]
    causes = [cause for cause, *_ in limits(result, camera)]
    assert "lens" not in causes and "jitter of the image stamps" not in causes  # not recorded: left out
    camera["stamp_jitter_s"] = 4e-4
    rows = {cause: (size, why) for cause, size, why in limits(result, with_joint(result, 5.0))}
    assert rows["jitter of the image stamps"][0] == "400 µs"
    assert rows["lens"] == (
        "lever arm 0.45 mm, rotation 0.0081°", "with an exact lens: 0.30 mm, 0.0081°"
    )  # fmt: skip  # sqrt(9e-8) m is then the worst: pz is known to 0.45 mm * sqrt(1 - 0.9^2)


LENS = (np.array([520.1, 519.8, 321.0, 239.4]), np.array([-0.28, 0.07, 2e-4, 0.0]), "radtan")


def board_frames(rng, count=30):
    """Images of a board at known poses, with the true distance and tilt of each."""
    target = Checkerboard(8, 6, 0.05, 0.05).points_m
    frames, truth = [], []
    for k in range(count):
        tilt = rng.uniform(5, 40)
        R = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(k), np.sin(k), 0.0])).as_matrix()
        p = np.array([0.0, 0.0, rng.uniform(0.5, 1.2)]) - R @ target.mean(axis=0)
        points = target @ R.T + p
        uv = project(points, *LENS) + 0.1 * rng.standard_normal((len(target), 2))
        residual = np.full(uv.shape, 0.1 * (1 + k % 7))
        frame = Frame(k * 400_000_000, "cam0", np.arange(48), uv, residual, np.ones(48, bool), 96.0, 96)
        frames.append(frame)
        truth.append((np.linalg.norm(points.mean(axis=0)), tilt))
    return target, frames, truth


def test_views_of_the_board_are_where_it_was():
    target, frames, truth = board_frames(np.random.default_rng(4))
    views = board_views(frames, "cam0", target, *LENS)
    assert len(views) == len(frames)
    for view, (distance_m, tilt_deg) in zip(views, truth, strict=True):
        assert view.distance_m == pytest.approx(distance_m, rel=5e-3)
        assert np.degrees(view.tilt_rad) == pytest.approx(tilt_deg, abs=1.5)
        assert view.R_cam_target @ view.p_target_cam + view.p_cam_target == pytest.approx(
            np.zeros(3), abs=1e-12
        )
    assert board_views(frames, "cam1", target, *LENS) == []


def test_the_images_that_fit_worst_are_a_second_apart_and_drawn_with_their_image():
    _, frames, _ = board_frames(np.random.default_rng(5))
    chosen = worst.worst_frames(frames, "cam0")
    assert [worst.rms(f) for f in chosen] == pytest.approx([0.7, 0.7, 0.7, 0.7, 0.4])  # 0.6: next to 0.7
    assert min(abs(a.t_ns - b.t_ns) for a in chosen for b in chosen if a is not b) >= 1e9
    bare = worst.drawn(chosen[0], SIZE, 0, {})
    assert "<image" not in bare and bare.count("l14.0,14.0") == 48  # 0.7 px, 20 times as long
    assert "data:image/jpeg;base64,YWJj" in worst.drawn(chosen[0], SIZE, 0, {chosen[0].t_ns: b"abc"})


def test_a_full_result_fills_every_section(result, tmp_path):
    target, frames, _ = board_frames(np.random.default_rng(6))
    with_joint(result, 0.3)
    for point in result["trace"]:
        point |= {"gyro_bias_rps": [0.0] * 3, "gyro_bias_sigma_rps": [1e-4] * 3}
        point |= {"accel_bias_mps2": [0.0] * 3, "accel_bias_sigma_mps2": [1e-2] * 3}
    result["held_out"] = [{"t_s": float(t), "ratio": 1.21} for t in range(20)]
    result["events"] = [{"kind": "image_gap", "camera": "cam0", "t_s": 3.04, "text": "5 s without images"}]
    path = tmp_path / "r.html"
    write_report(path, result, frames, target_m=target, images=lambda name, stamps: {stamps[0]: b"abc"})
    text = path.read_text()
    for needed in (
        "what limits the accuracy", "projection uncertainty", "poses of the board", "largest residuals",
        "3.0\N{NO-BREAK SPACE}s",
        "are 1.10 times (RMS)", "T_imu_cam0 = [[", "T_cam0_imu = [[", "\"board\":", "biases0",
    ):  # fmt: skip
        assert needed in text, needed
    assert len(text) < 3_000_000
    numbers = [
        float(v) for v in re.findall(r"-?\d\.\d{8}", text.split("T_imu_cam0 = ")[1].split("</pre>")[0])
    ]
    T = np.array(numbers).reshape(4, 4)
    assert T[:3, 3] == pytest.approx(result["cameras"]["cam0"]["T_imu_cam"]["p_m"], abs=1e-8)
    assert T[:3, :3] == pytest.approx(
        Rotation.from_euler("zyx", [89, 1, 0.2], degrees=True).as_matrix(), abs=1e-8
    )
