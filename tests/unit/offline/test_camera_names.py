"""A file of Kalibr's numbers its cameras; the recording has names of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from vical_daemon.cli import main
from vical_daemon.config.priors import read_initial
from vical_daemon.config.strict_yaml import ConfigError
from vical_daemon.offline.calibration_job import make_job
from vical_daemon.offline.camera_names import by_recording, priors_meant
from vical_daemon.offline.errors import InputError, OptionError
from vical_daemon.offline.td_icp.request import prior_of
from vical_daemon.results.export.kalibr import read_camchain, write_camchain
from vical_daemon.results.export.sources import rig_from_json

CAMERA = "  intrinsics: [{f}, {f}, 320, 240]\n  resolution: [640, 480]\n"


def chain(path, *cameras):
    """Cameras as (section, focal length, topic)."""
    path.write_text(
        "".join(
            f"{name}:\n{CAMERA.format(f=f)}" + (f"  rostopic: {topic}\n" if topic else "")
            for name, f, topic in cameras
        )
    )
    return read_initial(path)


def focal(priors):
    return {name: prior.intrinsics[0] for name, prior in priors.items()}


def test_the_topic_tells_which_camera_it_is(tmp_path):
    initial = chain(
        tmp_path / "a.yaml", ("cam0", 500.0, "/right/image_raw"), ("cam1", 600.0, "/left/image_raw")
    )
    assert focal(priors_meant(initial, ["left", "right"])) == {"right": 500.0, "left": 600.0}
    assert focal(priors_meant(initial, ["left"]))["left"] == 600.0
    assert prior_of(initial, "right").intrinsics[0] == 500.0
    with pytest.raises(OptionError, match="--initial has cam0, cam1, the recording has a: rename the camera"):
        priors_meant(initial, ["a"])


def test_kalibr_was_given_the_cameras_in_another_order(tmp_path):
    initial = chain(
        tmp_path / "a.yaml", ("cam0", 500.0, "/cam1/image_raw"), ("cam1", 600.0, "/cam0/image_raw")
    )
    assert focal(priors_meant(initial, ["cam0", "cam1"])) == {"cam0": 600.0, "cam1": 500.0}


def test_topics_of_another_robot_do_not_matter(tmp_path):
    initial = chain(tmp_path / "a.yaml", ("cam0", 500.0, "/old/image"), ("cam1", 600.0, ""))
    assert focal(priors_meant(initial, ["cam0", "cam1"])) == {"cam0": 500.0, "cam1": 600.0}


def test_a_topic_has_precedence_over_a_name():
    said = by_recording({"cam1": 1, "cam0": 2}, {"cam0": "/cam1/image_raw"}, ["cam0", "cam1"])
    assert said == {"cam1": 2}
    copied = dict.fromkeys(["cam0", "cam1"], "/cam0/image_raw")
    assert by_recording({"cam0": 1, "cam1": 2}, copied, ["cam0", "cam1"]) == {"cam0": 1, "cam1": 2}


def test_sections_may_have_the_names_of_the_recording(tmp_path):
    assert focal(chain(tmp_path / "a.yaml", ("left", 500.0, "")).cameras) == {"left": 500.0}
    (tmp_path / "a.yaml").write_text("left: {resolution: [640, 480]}\nlidar0: {rate: 5}\n")
    with pytest.raises(ConfigError, match=r"lidar0: unknown section; expected cameras \(cam0"):
        read_initial(tmp_path / "a.yaml")


def test_an_export_names_the_topic_and_comes_back(tmp_path, rig, capsys):
    """From a result with topics to Kalibr's file and back: verify and compare find the cameras."""
    left = replace(rig.cameras["left"], topic="/left/image_raw")
    other = replace(rig.cameras["cam0"], name="right", topic="/right/image_raw")
    written = replace(rig, cameras={"left": left, "right": other}, status="converged")
    (tmp_path / "camchain.yaml").write_text(write_camchain(written))
    back = read_camchain(tmp_path / "camchain.yaml")
    assert {name: camera.topic for name, camera in back.cameras.items()} == {
        "cam0": "/left/image_raw",
        "cam1": "/right/image_raw",
    }
    entries = {
        camera.name: {
            "T_imu_cam": {"p_m": camera.p_imu_cam.tolist(), "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            "timeshift_cam_imu_s": 0.0,
            "intrinsics": camera.intrinsics,
            "distortion_model": camera.distortion_model,
            "distortion": camera.distortion,
            "resolution": camera.resolution,
            "topic": camera.topic,
        }
        for camera in (left, other)
    }
    assert rig_from_json({"cameras": entries}).cameras["left"].topic == "/left/image_raw"
    (tmp_path / "result.json").write_text(json.dumps({"cameras": entries}))
    main(["compare", str(tmp_path / "result.json"), str(tmp_path / "camchain.yaml"), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert sorted(document["cameras"]) == ["left", "right"]
    assert not any("only in" in note for note in document["notes"])


def test_several_imus_are_named_with_their_topics():
    streams = {
        name: SimpleNamespace(name=name, source=topic, kind="imu")
        for name, topic in (("zed", "/zed/imu/data"), ("zed_2", "/zed/imu/data_raw"))
    }
    recording = SimpleNamespace(duration_s=10.0, imus=streams, cameras={}, path=Path("a.bag"), warnings=[])
    says = r"2 imus \(zed: /zed/imu/data, zed_2: /zed/imu/data_raw\); say which with --imu"
    with pytest.raises(OptionError, match=says):
        make_job(recording, read_initial_empty(), target=None)
    with pytest.raises(InputError, match="holds no camera"):
        make_job(recording, read_initial_empty(), target=None, imu="/zed/imu/data_raw")


def read_initial_empty():
    from vical_daemon.config.priors import Initial

    return Initial()
