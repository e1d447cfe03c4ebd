"""`vical td-icp` and `vical observability` on small recordings: figures, refusals, sensors, trajectories."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig
from vical_mocks.tracks import simulate_tracks
from vical_mocks.trajectory import one_axis

from vical_daemon.cli import main

TARGET = """target_type: checkerboard
targetCols: 8
targetRows: 6
rowSpacingMeters: 0.05
colSpacingMeters: 0.05
"""


def _write(folder, run, *, gyro_factor=1.0, late_s=0.0, stretch=1.0, kind="corners"):
    """The recording as an ASL folder; the gyro's unit and the camera's stamps may be spoiled."""
    (folder / "mav0/imu0").mkdir(parents=True)
    (folder / "mav0/cam0").mkdir(parents=True)
    rows = ["#timestamp [ns],wx,wy,wz,ax,ay,az"]
    for t, w, f in zip(run.t_imu_ns, run.gyro_rps * gyro_factor, run.specific_force_mps2, strict=True):
        rows.append(",".join(map(str, [t, *w, *f])))
    (folder / "mav0/imu0/data.csv").write_text("\n".join(rows))
    rows = ["#timestamp [ns],point_id,u [px],v [px]"]
    for frame in run.frames:
        first = run.frames[0].t_cam_ns
        stamp = first + round(stretch * (frame.t_cam_ns - first) + late_s * 1e9)
        rows += [f"{stamp},{i},{u},{v}" for i, (u, v) in zip(frame.ids, frame.uv_px, strict=True)]
    (folder / f"mav0/cam0/{kind}.csv").write_text("\n".join(rows))
    (folder / "mav0/cam0/sensor.yaml").write_text("resolution: [640, 480]\n")
    (folder / "target.yaml").write_text(TARGET)
    lens = run.rig.lens
    (folder / "initial.yaml").write_text(
        f"cam0:\n  resolution: [640, 480]\n  intrinsics: {list(map(float, lens.intrinsics))}\n"
        f"  distortion_model: {lens.model}\n  distortion_coeffs: {list(map(float, lens.distortion))}\n"
    )
    return folder


@pytest.fixture(scope="module")
def run():
    return simulate(3, 8.0, timeshift_cam_imu_s=0.012, camera_rate_hz=10.0, corner_sigma_px=0.3)


def _vical(capsys, command, folder, *more):
    code = main([command, str(folder), "--target", str(folder / "target.yaml"), "--json", *more])
    captured = capsys.readouterr()
    return code, json.loads(captured.out) if captured.out.strip() else {}, captured.err


@pytest.mark.parametrize("late_s", [0.75, -0.75])
def test_the_delay_is_found_with_a_camera_three_quarters_of_a_second_off(tmp_path, capsys, run, late_s):
    folder = _write(tmp_path, run, late_s=late_s)
    code, result, _ = _vical(capsys, "td-icp", folder, "--initial", str(folder / "initial.yaml"))
    assert code == 0 and result["status"] == "ok"
    assert abs(result["timeshift_cam_imu_s"] - (0.012 - late_s)) < 4 * result["timeshift_sigma_s"]
    assert result["timeshift_sigma_s"] < 0.4e-3
    assert len(result["R_imu_cam_q_wxyz"]) == 4 and len(result["gyro_bias_rps"]) == 3
    assert result["pairs"] > 55 and result["iterations"] > 0


def test_a_gyro_in_degrees_is_refused_with_the_reason(tmp_path, capsys, run):
    folder = _write(tmp_path, run, gyro_factor=180 / np.pi)
    code, result, err = _vical(capsys, "td-icp", folder, "--initial", str(folder / "initial.yaml"))
    assert code == 1 and result["status"] == "refused"
    assert "degrees per second" in err and len(err.strip().splitlines()) == 1


def test_stretched_stamps_are_refused_and_the_stamps_are_blamed(tmp_path, capsys, run):
    folder = _write(tmp_path, run, stretch=1.05)
    code, result, err = _vical(capsys, "td-icp", folder, "--initial", str(folder / "initial.yaml"))
    assert code == 1 and result["status"] == "refused"
    assert "the stamps of camera and IMU advance at different rates" in err
    assert "direction" not in err and len(err.strip().splitlines()) == 1


def test_a_trajectory_file_joins_as_a_sensor(tmp_path, capsys, run):
    folder = _write(tmp_path, run)
    t_s = np.arange(0.2, 7.8, 0.05)
    q = Rotation.from_matrix(run.rig.trajectory.R_world_imu(t_s)).as_quat()
    noise = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 1e-3, (len(t_s), 3)))
    q = (Rotation.from_quat(q) * noise).as_quat()
    base = run.t_imu_ns[0] * 1e-9
    lines = [f"{base + t - 0.3:.9f} 0 0 0 {' '.join(map(str, row))}" for t, row in zip(t_s, q, strict=True)]
    tum = folder / "mocap.txt"
    tum.write_text("# TUM\n" + "\n".join(lines))
    code, result, _ = _vical(
        capsys, "td-icp", folder, "--initial", str(folder / "initial.yaml"), "--sensors", f"imu0,cam0,{tum}"
    )
    assert code == 0 and result["reference"] == "imu0"
    assert set(result["sensors"]) == {"cam0", "mocap.txt"}
    found = result["sensors"]["mocap.txt"]
    assert abs(found["timeshift_s"] - 0.3) < 5 * found["timeshift_sigma_s"] + 1e-6
    assert len(result["pairs"]) == 3


def test_a_sensor_that_is_given_twice_is_taken_once(tmp_path, capsys):
    t_s = np.arange(0.0, 12.0, 0.05)
    turns = 0.4 * np.stack([np.sin(1.3 * t_s), np.sin(2.1 * t_s), np.sin(0.7 * t_s)], axis=1)
    rng = np.random.default_rng(1)
    for name, late_s in (("a.txt", 0.0), ("b.txt", 0.2)):
        noise = Rotation.from_rotvec(rng.normal(0.0, 1e-3, turns.shape))
        q = (Rotation.from_rotvec(turns) * noise).as_quat()
        rows = (
            f"{t + late_s + 0.001:.6f} 0 0 0 {' '.join(map(str, v))}" for t, v in zip(t_s, q, strict=True)
        )
        (tmp_path / name).write_text("\n".join(rows))
    a, b = (str(tmp_path / name) for name in ("a.txt", "b.txt"))
    assert main(["td-icp", a, "--sensors", f"{a},{b}", "--json"]) == 0
    captured = capsys.readouterr()
    assert list(json.loads(captured.out)["sensors"]) == ["b.txt"]
    assert f"{a} is given twice, and taken once" in captured.err
    assert main(["td-icp", a, "--sensors", a]) == 2
    assert "is INPUT itself" in capsys.readouterr().err


def test_what_cannot_work_is_said_in_one_line(tmp_path, capsys, run):
    folder = _write(tmp_path, run)
    assert main(["td-icp", str(folder)]) == 2
    assert "--target" in capsys.readouterr().err
    assert main(["td-icp", str(folder / "nothing")]) == 1
    assert main(["td-icp", str(folder), "--search", "-1"]) == 2
    assert main(["td-icp", str(folder), "--sensors", "imu0,radar"]) == 2
    assert "radar" in capsys.readouterr().err
    assert main(["observability", str(folder), "--estimate", "colour"]) == 2


def test_watching_follows_the_delay(tmp_path, capsys, run):
    folder = _write(tmp_path, run)
    initial = str(folder / "initial.yaml")
    code, result, _ = _vical(
        capsys, "td-icp", folder, "--initial", initial, "--watch", "4", "--search", "0.5"
    )
    assert code == 0 and len(result["watch"]) >= 2
    assert all(abs(w["timeshift_s"] - 0.012) < 5 * w["timeshift_sigma_s"] for w in result["watch"])
    assert not any(w["jumped"] for w in result["watch"])


def test_observability_without_a_board(tmp_path, capsys):
    run = simulate_tracks(4, 10.0, timeshift_cam_imu_s=0.012, camera_rate_hz=10.0)
    folder = _write(tmp_path, run, kind="tracks")
    assert main(["observability", str(folder), "--initial", str(folder / "initial.yaml"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (
        result["rank"] == result["unknowns"] == result["model"]["rank"] == result["model"]["unknowns"] == 18
    )
    assert result["observable"] and not result["missing"]
    arm = np.array(result["sigma"]["lever_arm"])
    assert (arm > 1e-5).all() and (arm < 2e-3).all()  # the Cramer-Rao bound of such rigs: 0.3 mm after 10 s
    assert main(["observability", str(folder), "--target", str(folder / "target.yaml")]) == 1
    assert "leave out --target" in capsys.readouterr().err


def test_observability_names_what_one_axis_does_not_show(tmp_path, capsys):
    rig = reference_rig(4)
    turning = one_axis(4, [0, 0, 1], T_imu_cam=(rig.R_imu_cam, rig.p_imu_cam))
    single = simulate(4, 6.0, rig=replace(rig, trajectory=turning), camera_rate_hz=8.0, corner_sigma_px=0.3)
    folder = _write(tmp_path / "single", single)
    code, result, err = _vical(capsys, "observability", folder, "--initial", str(folder / "initial.yaml"))
    assert code == 0 and not result["observable"]
    assert result["model"] == {"rank": 25, "unknowns": 25}
    advice = {m["block"]: m for m in result["missing"]}
    assert advice["lever_arm"]["direction"] == "the optical axis"
    assert "rotate about another axis" in advice["lever_arm"]["advice"]
    assert "optical axis" in err


@pytest.mark.parametrize("given", [True, False])
def test_the_lens_that_was_used_is_told(tmp_path, capsys, run, given):
    folder = _write(tmp_path, run)
    initial = ["--initial", str(folder / "initial.yaml")] if given else []
    code, answer, _ = _vical(capsys, "td-icp", folder, *initial)
    assert code == 0
    lens = answer["lens"]
    assert lens["distortion_model"] == run.rig.lens.model and len(lens["distortion"]) == 4
    assert lens["intrinsics"][0] == pytest.approx(run.rig.lens.intrinsics[0], rel=0.02)
    start = "--initial" if given else "a guess from the image size"
    assert lens["origin"].endswith(f"views of the board, starting from {start}")
    assert main(["td-icp", str(folder), "--target", str(folder / "target.yaml"), *initial]) == 0
    said = capsys.readouterr().out
    assert f"lens         fx {lens['intrinsics'][0]:.2f} fy" in said and lens["origin"] in said
    sensors = ["--sensors", "imu0,cam0"]
    code, answer, _ = _vical(capsys, "td-icp", folder, *sensors, *initial)
    assert code == 0 and answer["lenses"]["cam0"] == lens
