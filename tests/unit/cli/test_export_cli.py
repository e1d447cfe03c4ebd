"""`vical export`, `vical allan`, `vical imu-calibrate` as typed: files, JSON, one-line errors."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from vical_daemon.cli import main
from vical_daemon.estimation.result import (
    CalibrationEstimate,
    CameraEstimate,
    ImuEstimate,
    PoseEstimate,
    Status,
)
from vical_daemon.results.export import export


@pytest.fixture
def result_file(rig, tmp_path):
    path = tmp_path / "result.json"
    path.write_text(export(rig, "json")[0].text)
    return path


@pytest.fixture(scope="module")
def still_csv(tmp_path_factory):
    rng = np.random.default_rng(4)
    n, rate = 20_000, 50.0
    gyro = 5e-4 * np.sqrt(rate) * rng.standard_normal((n, 3))
    accel = 8e-4 * np.sqrt(rate) * rng.standard_normal((n, 3)) + [0, 0, 9.8]
    stamps = 1_700_000_000_000_000_000 + np.arange(n) * 20_000_000
    stamps = np.delete(stamps, [500, 501, 900])
    values = np.delete(np.hstack([gyro, accel]), [500, 501, 900], axis=0)
    path = tmp_path_factory.mktemp("still") / "data.csv"
    lines = [
        f"{t},{','.join(f'{v:.7g}' for v in row)}" for t, row in zip(stamps.tolist(), values, strict=True)
    ]
    path.write_text("#timestamp [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(lines) + "\n")
    return path


def test_folder_gets_every_file(result_file, tmp_path, capsys):
    assert main(["export", str(result_file), "--format", "vins", "-o", str(tmp_path / "vins")]) == 0
    assert capsys.readouterr().out.splitlines() == [
        str(tmp_path / "vins" / n) for n in ("vins.yaml", "cam0.yaml", "cam1.yaml")
    ]
    assert {p.name for p in (tmp_path / "vins").iterdir()} == {"vins.yaml", "cam0.yaml", "cam1.yaml"}


def test_main_file_goes_where_told_and_json_lists_files(result_file, tmp_path, capsys):
    target = tmp_path / "chain.yaml"
    assert main(["export", str(result_file), "--format", "kalibr", "-o", str(target), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["files"] == [str(target), str(tmp_path / "imu.yaml")]
    assert "cam1" in yaml.safe_load(target.read_text())


def test_kalibr_goes_in_and_basalt_comes_out(result_file, tmp_path, capsys):
    chain = tmp_path / "chain.yaml"
    main(["export", str(result_file), "--format", "kalibr", "-o", str(chain)])
    capsys.readouterr()
    assert main(["export", str(chain), "--format", "basalt"]) == 0
    value = json.loads(capsys.readouterr().out)["value0"]
    assert value["cam_time_offset_ns"] == -5_120_000


def test_a_withheld_direction_is_written_only_by_force(result_file, capsys):
    document = json.loads(result_file.read_text())
    document["cameras"]["cam0"]["unobservable"] = ["lever arm along the optical axis"]
    result_file.write_text(json.dumps(document))
    words = ["export", str(result_file), "--format", "kalibr"]
    assert main(words) == 1
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and "--force" in err
    assert main([*words, "--force"]) == 0
    out, err = capsys.readouterr()
    assert "# status: NOT CONVERGED: converging" in out and "lever arm along the optical axis" in out
    assert "vical: warning: not converged: converging" in err
    assert yaml.safe_load(out)["cam0"]["T_cam_imu"]


def test_options_fill_in_what_the_source_lacks(result_file, tmp_path, capsys):
    document = json.loads(result_file.read_text())
    for camera in document["cameras"].values():
        camera["resolution"] = None
    result_file.write_text(json.dumps(document))
    words = ["export", str(result_file), "--format", "orbslam3", "--camera", "left"]
    assert main(words) == 1
    assert "--resolution" in capsys.readouterr().err
    assert main([*words, "--resolution", "512x512"]) == 0
    assert "Camera.width: 512" in capsys.readouterr().out


def estimate(stamp, camera, shift):
    pose = PoseEstimate([0.1, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], np.eye(6).tolist())
    known = CameraEstimate(
        pose, shift, 1e-5, [500.0, 500.0, 320.0, 240.0], [0.0] * 4, "radtan", [0.0] * 4, [0.0] * 4, 0.2,
        resolution=[640, 480],
    )  # fmt: skip
    return CalibrationEstimate(
        stamp, Status.CONVERGED, "", 1.0, "", 60.0, 100, 1000, {camera: known},
        ImuEstimate([0.0] * 3, [0.0] * 3), [0.0, 0.0, -9.81], 1.0, 0.0,
    )  # fmt: skip


def test_log_gives_its_last_calibration(tmp_path, capsys):
    from vical_daemon.bus import topics
    from vical_daemon.bus.messages import encode_calibration, encode_camera_info
    from vical_daemon.logs.mcap import LogWriter

    path = tmp_path / "log.mcap"
    t0 = 1_700_000_000_000_000_000
    serials = {"camera/cam0": "SN7", "imu/imu0": "6223-1"}
    with LogWriter(path, {"devices": serials}) as log:
        info = encode_camera_info(t0, "cam0", (640, 480), [500.0, 500, 320, 240], "radtan", [0.0] * 4)
        log.write(topics.CAMERA_INFO.key("rig0", "cam0"), info, t0)
        for k, shift in enumerate((0.001, 0.002)):
            payload = encode_calibration(estimate(t0 + k, "cam0", shift), "cam0")
            log.write(topics.CALIBRATION.key("rig0", "cam0"), payload, t0 + k)
    assert main(["export", str(path), "--format", "kalibr"]) == 0
    text = capsys.readouterr().out
    assert "# devices: camera/cam0 SN7, imu/imu0 6223-1" in text and "# status: converged" in text
    chain = yaml.safe_load(text)
    assert chain["cam0"]["timeshift_cam_imu"] == pytest.approx(0.002)
    assert chain["cam0"]["resolution"] == [640, 480]


def test_store_gives_the_newest_calibration(tmp_path, capsys, monkeypatch):
    from vical_daemon.results.store import CalibrationStore

    monkeypatch.setenv("VICAL_STATE_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert main(["export", "store", "--format", "json"]) == 1
    assert "nothing has converged" in capsys.readouterr().err
    store = CalibrationStore(tmp_path / "calibration")
    for k, shift in enumerate((0.001, 0.003)):
        store.save("imu-1", f"cam-{k}", "cam0", estimate(10**18 + k, "cam0", shift), 10**18 + k)
    assert main(["export", "store", "--format", "json"]) == 0
    exported = json.loads(capsys.readouterr().out)
    assert exported["cameras"]["cam0"]["timeshift_cam_imu_s"] == pytest.approx(0.003)
    assert main(["export", "store", "--format", "kalibr"]) == 0  # the README's line: nothing else is needed
    assert yaml.safe_load(capsys.readouterr().out)["cam0"]["resolution"] == [640, 480]
    assert main(["export", str(tmp_path / "calibration"), "--format", "json"]) == 0  # its folder, by name
    assert json.loads(capsys.readouterr().out)["cameras"] == exported["cameras"]


@pytest.mark.parametrize(
    ("content", "says"),
    [("nonsense", "not JSON"), ("[1]", "not a calibration"), ("{}", "cameras"), ("", "not a calibration")],
)
def test_wrong_sources_are_one_line(tmp_path, capsys, content, says):
    path = tmp_path / "x.json"
    path.write_text(content)
    assert main(["export", str(path), "--format", "json"]) == 1
    error = capsys.readouterr().err
    assert says in error
    assert len(error.splitlines()) == 1


def test_a_file_is_named_once(tmp_path, capsys):
    log = tmp_path / "log.mcap"
    log.touch()
    assert main(["export", str(log), "--format", "kalibr"]) == 1
    assert capsys.readouterr().err == f"vical: error: {log} is empty; was it copied in full?\n"


def test_missing_source_and_bad_usage(capsys, result_file):
    assert main(["export", "no_such_file", "--format", "json"]) == 1
    assert main(["export", str(result_file), "--format", "ros", "--camera", "nobody"]) == 2
    assert main(["export", str(result_file), "--format", "ros", "--resolution", "wide"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 3


def test_allan_of_a_csv(still_csv, tmp_path, capsys):
    out, plots = tmp_path / "imu.yaml", tmp_path / "plots"
    assert main(["allan", str(still_csv), "-o", str(out), "--plots", str(plots), "--json", "--quiet"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["interpolated"] == 3
    assert found["rate_hz"] == pytest.approx(50.0, rel=1e-6)
    assert found["imu_noise"]["gyro_density"] == pytest.approx(5e-4, rel=0.05)
    assert found["axes"]["accel"]["z"]["density"]["value"] == pytest.approx(8e-4, rel=0.08)
    written = yaml.safe_load(out.read_text())
    assert written["accelerometer_noise_density"] == pytest.approx(
        found["imu_noise"]["accel_density"], rel=1e-9
    )
    assert sorted(p.name for p in plots.iterdir()) == ["accel.png", "gyro.png"]
    assert "3 lost samples" in captured.err


def test_allan_table_for_people(still_csv, capsys):
    assert main(["allan", str(still_csv), "--seconds", "100"]) == 0
    text = capsys.readouterr().out
    for needed in ("Gyroscope", "Accelerometer", "deg/sqrt(h)", "bias instability", "<"):
        assert needed in text


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--seconds", "0.5"], 1, "100 are needed"),
        (["--seconds", "-1"], 2, "--seconds"),
        (["--tau-min", "0"], 2, "--tau-min"),
    ],
)
def test_allan_mistakes(still_csv, capsys, words, code, says):
    assert main(["allan", str(still_csv), *words]) == code
    assert says in capsys.readouterr().err


def test_readings_that_never_change_have_no_noise(tmp_path, capsys):
    path = tmp_path / "still.csv"
    stamps = 1_700_000_000_000_000_000 + np.arange(2000) * 10_000_000
    path.write_text("".join(f"{t},0.01,0,0,0,0,9.81\n" for t in stamps.tolist()))
    assert main(["allan", str(path)]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"vical: error: {path}: not even noise changes gyro x (always 0.01)")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b\n1,2\n", "line 2 is not 7 numbers: '1,2'; expected timestamp [ns], 3 gyro and 3 accelerometer"),
        ("", "is empty"),
        ("1,2,3,4,5,6,7\n", "only 1 samples after --skip and --seconds, 100 are needed"),
    ],
)
def test_csv_mistakes(tmp_path, capsys, text, says):
    path = tmp_path / "x.csv"
    path.write_text(text)
    assert main(["allan", str(path)]) == 1
    error = capsys.readouterr().err
    assert says in error
    assert len(error.splitlines()) == 1


def test_a_csv_is_read_by_its_title(tmp_path, capsys):
    """At rest, nothing but the title tells deg/s from rad/s: all densities would be 57 times too large."""
    rows = np.tile([0.0, 0.0, 9.8, 0.0, 0.0, 0.0], (2000, 1))
    rows += np.repeat([1e-2, 1e-3], 3) * np.random.default_rng(0).standard_normal((2000, 6))
    path = tmp_path / "x.csv"

    def allan(title):
        text = (f"{k},{10**18 + k * 10**7}," + ",".join(map(str, row)) for k, row in enumerate(rows))
        path.write_text("\n".join([title, *text]))
        code = main(["allan", str(path), "--json", "--quiet"])
        return code, *capsys.readouterr()

    code, out, _ = allan("count,stamp,acc_x,acc_y,acc_z,gyro_x [rad/s],gyro_y,gyro_z")
    found = json.loads(out)["imu_noise"]
    assert code == 0 and found["gyro_density"] == pytest.approx(1e-4, rel=0.2)
    assert found["accel_density"] == pytest.approx(1e-3, rel=0.2)
    code, _, error = allan("count,stamp,acc_x,acc_y,acc_z,gyro_x [deg/s],gyro_y,gyro_z")
    assert code == 1 and "gives the gyro in degrees" in error and "multiply by pi/180" in error


def test_units_and_motion_are_noticed(tmp_path, capsys):
    rng = np.random.default_rng(0)
    path = tmp_path / "x.csv"

    def allan(gyro, force):
        rows = np.hstack([gyro, force]) + 1e-3 * rng.standard_normal((2000, 6))
        text = (f"{10**18 + k * 10**7}," + ",".join(map(str, row)) for k, row in enumerate(rows))
        path.write_text("\n".join(text))
        return main(["allan", str(path)]), capsys.readouterr().err

    still, down = np.zeros((2000, 3)), np.tile([0.0, 0.0, 9.8], (2000, 1))
    assert allan(still, down) == (0, "")
    code, error = allan(still, down / 9.8)
    assert code == 1
    assert "it looks like g: multiply by 9.80665" in error
    touched = still.copy()
    touched[1205:1290, 1] = 0.05
    code, error = allan(touched, down)
    assert code == 0
    assert "the IMU moved, first 12 s from the start; only its longest rest is used, 0 to 11 s" in error
    moving = 0.5 * np.sin(np.arange(2000) / 30.0)[:, None] * np.ones(3)
    code, error = allan(moving, down)
    assert code == 1
    assert "is never at rest for 10 s" in error
    moving[700:1900] = 0.0
    code, error = allan(moving, down)
    assert code == 0
    assert "8 to 18 s" in error


def test_many_lost_samples_are_refused(tmp_path, capsys):
    rng = np.random.default_rng(0)
    keep = np.sort(rng.choice(4000, 3000, replace=False))
    rows = [f"{10**18 + int(k) * 10**7},0,0,0,0,0,9.8" for k in keep]
    path = tmp_path / "x.csv"
    path.write_text("\n".join(rows))
    assert main(["allan", str(path)]) == 1
    assert "are missing" in capsys.readouterr().err


def test_imu_calibrate_writes_yaml_and_json(tmp_path, capsys, turns_csv):
    out = tmp_path / "imu_calibration.yaml"
    assert main(["imu-calibrate", str(turns_csv), "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["positions"] == 20
    assert found["gyro_matrix_found"]
    written = yaml.safe_load(out.read_text())
    assert np.allclose(written["accel"]["matrix"], found["accel"]["matrix"], atol=1e-9)
    assert main(["imu-calibrate", str(turns_csv)]) == 0
    assert "fixed" in capsys.readouterr().out
    assert main(["imu-calibrate", str(turns_csv), "--gravity", "1"]) == 2
    assert main(["imu-calibrate", str(turns_csv), "--seconds", "10"]) == 1
    assert "six faces" in capsys.readouterr().err


@pytest.fixture
def turns_csv(tmp_path, simulated_turns):
    gyro, force = simulated_turns
    rows = np.hstack([gyro, force])
    lines = [f"{10**18 + k * 10**7},{','.join(f'{v:.9g}' for v in row)}" for k, row in enumerate(rows)]
    path = Path(tmp_path / "turns.csv")
    path.write_text("\n".join(lines))
    return path
