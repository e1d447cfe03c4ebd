"""The examples run, and the documentation's reference pages can be made."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from vical_daemon.results.export import export

ROOT = Path(__file__).parents[3]


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_estimator_in_python_says_that_a_second_is_too_short(capsys):
    assert load(ROOT / "examples" / "calibrate_in_python.py").main(1.0) == float("inf")
    assert capsys.readouterr().out.split(":")[0] in ("waiting", "initialising")


def test_export_of_a_result(rig, tmp_path, capsys):
    path = tmp_path / "result.json"
    path.write_text(export(rig, "json")[0].text)
    load(ROOT / "examples" / "export_result.py").main(str(path))
    assert "cam0 sits at" in capsys.readouterr().out
    assert (tmp_path / "camchain-imucam.yaml").exists()


def test_reading_a_recording(tmp_path, capsys):
    lines = ["#timestamp [ns],wx,wy,wz,ax,ay,az"]
    lines += [f"{10**18 + k * 5_000_000},0.01,0.02,{0.001 * k},0.1,0.2,9.8" for k in range(800)]
    (tmp_path / "mav0" / "imu0").mkdir(parents=True)
    (tmp_path / "mav0" / "imu0" / "data.csv").write_text("\n".join(lines))
    (tmp_path / "mav0" / "cam0").mkdir()
    corners = [
        f"{10**18 + k * 50_000_000},{p},{100 + 10 * p},{200 + p}" for k in range(70) for p in range(12)
    ]
    (tmp_path / "mav0" / "cam0" / "corners.csv").write_text(
        "#timestamp [ns],point_id,u [px],v [px]\n" + "\n".join(corners)
    )
    load(ROOT / "examples" / "read_recording.py").main(str(tmp_path))
    out = capsys.readouterr().out
    assert "imu0: imu, 800 messages" in out
    assert "12.0 points per image" in out


@pytest.mark.parametrize(
    ("name", "words", "says"),
    [
        ("plain_zenoh.py", ["tcp/127.0.0.1:1"], "no bus at tcp/127.0.0.1:1"),
        ("watch_calibration.py", ["tcp/127.0.0.1:1"], "no bus at tcp/127.0.0.1:1"),
        ("watch_async.py", ["tcp/127.0.0.1:1"], "no bus at tcp/127.0.0.1:1"),
        ("site_router.py", ["ca.pem", "site.pem", "site.key", "users.txt"], "cannot be read"),
        ("site_router.py", [], "usage: "),
        ("read_recording.py", ["nowhere.mcap"], "nowhere.mcap does not exist"),
        ("read_recording.py", [], "usage: "),
        ("export_result.py", ["nowhere.json"], "nowhere.json: "),
        ("export_result.py", [], "usage: "),
    ],
)
def test_without_bus_or_file_it_ends_in_one_line(name, words, says, tmp_path):
    command = [sys.executable, str(ROOT / "examples" / name), *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 1
    assert says in done.stderr and done.stderr.count("\n") == 1, done.stderr


def test_foxglove_layout_is_json_and_names_our_topics():
    layout = json.loads((ROOT / "examples" / "foxglove_layout.json").read_text())
    text = json.dumps(layout)
    for needed in ("/vical/rig0/camera/cam0/image", "/vical/rig0/imu/imu0", "/vical/rig0/calibration/cam0"):
        assert needed in text


@pytest.fixture(scope="module")
def reference():
    return load(ROOT / "docs" / "_ext" / "reference_text.py")


def test_reference_pages_cover_the_code(reference):
    from vical_daemon.bus import topics
    from vical_daemon.cli import table
    from vical_daemon.estimation.events import Cause

    keys = reference.topics_table()
    assert all(topic.pattern in keys for topic in topics.TOPICS)
    settings = reference.config_text()
    for key in ("rate_hz", "imus.NAME", "calibration.convergence", "position_sigma_m", "**required**"):
        assert key in settings
    commands = reference.commands_text()
    assert all(f"## vical {name}" in commands for name in table.available())
    assert all(f"| `{cause}` |" in reference.causes_table() for cause in Cause if cause)
    modules = reference.modules_text()
    assert "`vical_drivers.clock`" in modules
    assert "`vical_daemon.results.report.writer`" in modules


@pytest.mark.parametrize(
    ("latex", "mathml"),
    [
        (r"\tfrac12 b", "<mn>1</mn><mn>2</mn></mfrac><mi>b</mi>"),
        (r"\tfrac1{15} x", "<mn>1</mn><mn>15</mn></mfrac><mi>x</mi>"),
        (r"\hat\nu_i^2", "</mover><msubsup><mrow></mrow><mi>i</mi><mn>2</mn></msubsup>"),
    ],
)
def test_formulas_mean_on_the_pages_what_tex_makes_of_them(latex, mathml):
    pytest.importorskip("sphinx", reason="the docs' packages are not installed")
    from docutils import nodes

    page = load(ROOT / "docs" / "_ext" / "mathml.py")._mathml(nodes.math(latex, latex), block=False)
    assert mathml in "".join(page.split())
