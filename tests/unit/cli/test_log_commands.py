"""vical info, recover and replay."""

from __future__ import annotations

import json

import pytest

from vical_daemon.bus.messages import encode_string
from vical_daemon.cli import main
from vical_daemon.logs import open_recording
from vical_daemon.logs.channel import stamp_of
from vical_daemon.logs.mcap import LogFolder, LogReader, LogWriter


@pytest.fixture
def log(asl_folder, tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path, {"vical": {"version": "1"}}) as writer:
        for i, (key, payload) in enumerate(open_recording(asl_folder).messages()):
            if not 400 <= i < 404:
                writer.write(key, payload, stamp_of(payload) + 2_000_000)
        writer.attach("config.yaml", "text/yaml", b"rig: rig0", 1)
    return path


def test_info_of_a_log(log, capsys):
    assert main(["info", str(log), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    imu = next(t for t in found["topics"] if t["topic"] == "/vical/rig0/imu/imu0")
    assert imu["type_name"] == "sensor_msgs/msg/Imu"
    assert imu["rate_hz"] == pytest.approx(200)
    assert imu["missing"] == 4
    assert imu["gaps"] == 1
    assert imu["latency_ms"] == pytest.approx([2.0, 2.0])
    assert found["complete"]
    assert found["problem"] == ""
    assert found["metadata"] == {"vical": {"version": "1"}}
    assert found["attachments"] == {"config.yaml": 9}
    assert main(["info", str(log)]) == 0
    text = capsys.readouterr().out
    assert "/vical/rig0/imu/imu0" in text
    assert "200.00" in text


def test_messages_without_a_stamp_have_no_latency(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as writer:
        writer.write("vical/rig0/command/record", encode_string("split"), 10**18)
    main(["info", str(path), "--json"])
    (command,) = json.loads(capsys.readouterr().out)["topics"]
    assert (command["count"], command["latency_ms"]) == (1, None)  # was 0 ms, whatever the delay


def test_info_of_a_folder_and_of_a_cut_log(asl_folder, log, capsys):
    assert main(["info", str(asl_folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [t["count"] for t in found["topics"]] == [200, 2400]
    log.write_bytes(log.read_bytes()[:100_000])
    assert main(["info", str(log)]) == 0
    text = capsys.readouterr().out
    assert "UNFINISHED" in text
    assert "end is missing" in text


@pytest.mark.parametrize("command", ["info", "recover", "replay"])
def test_bad_files_are_one_line(command, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    assert main([command, str(path)]) == 1
    path.write_text("text")
    assert main([command, str(path)]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2
    assert all("a.mcap" in line for line in lines)


def test_recover_file_and_folder(log, tmp_path, capsys):
    raw = log.read_bytes()
    log.write_bytes(raw[: len(raw) // 2])
    assert main(["recover", str(log), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["recovered"]
    assert found["output"].endswith("a.recovered.mcap")
    assert found["messages"] > 100
    assert main(["recover", str(log)]) == 1  # exists already
    assert "exists already" in capsys.readouterr().err
    assert main(["recover", str(log), "-o", str(tmp_path / "b.mcap")]) == 0
    parts = tmp_path / "parts"
    parts.mkdir()
    (parts / "x.mcap.part").write_bytes(raw[:-20])
    assert main(["recover", str(parts)]) == 0
    reader = LogReader(parts / "x.mcap")
    assert len(list(reader.messages())) == 2596
    assert reader.complete
    assert main(["recover", str(parts)]) == 0
    assert "nothing to recover" in capsys.readouterr().out
    assert main(["recover", str(parts), "-o", "x"]) == 2
    folder = LogFolder(parts)
    assert folder.lock()
    assert main(["recover", str(parts)]) == 1
    folder.unlock()


def test_recovering_what_is_complete_makes_no_copy(log, tmp_path, capsys):
    before = sorted(tmp_path.iterdir())
    assert main(["recover", str(log)]) == 0
    assert "complete, nothing to recover: 2596 messages" in capsys.readouterr().out
    assert main(["recover", str(log), "-o", str(tmp_path / "b.mcap"), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["recovered"]
    assert found["was_complete"] and found["output"] == str(log)
    assert sorted(tmp_path.iterdir()) == before


def test_recovering_next_to_nothing_is_no_success(log, tmp_path, capsys):
    log.write_bytes(log.read_bytes()[:100])
    before = sorted(tmp_path.iterdir())
    assert main(["recover", str(log)]) == 1
    assert "not one whole message in its 100 bytes" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_info_of_several_logs_names_the_broken_one(log, asl_folder, tmp_path, capsys):
    broken = tmp_path / "broken.mcap"
    broken.write_text("text")
    words = [str(log), str(broken), str(asl_folder)]
    assert main(["info", *words]) == 1
    out, err = capsys.readouterr()
    assert str(log) in out and str(asl_folder) in out and str(broken) not in out
    assert err.count("\n") == 1 and str(broken) in err
    assert main(["info", *words, "--json"]) == 1
    logs = json.loads(capsys.readouterr().out)["logs"]
    assert [bool(entry.get("topics")) for entry in logs] == [True, False, True]
    assert str(broken) in logs[1]["problem"]
