"""The report and the terminal as a person sees them: in a browser, on paper, as pictures to look at.

VICAL_SHOTS=folder keeps the pictures (report.png, terminal.png), as in test_web_page.
"""

import base64
import io
import os
from pathlib import Path

import numpy as np
import pytest
from vical_mocks.points import simulate
from vical_mocks.rig import reference_rig

from vical_daemon.bus import messages as m
from vical_daemon.bus import topics
from vical_daemon.bus.interface import LocalBus
from vical_daemon.cli import live_table, main
from vical_daemon.cli.watch import View
from vical_daemon.logs.mcap import LogWriter
from vical_daemon.vision.target import Checkerboard

pytestmark = pytest.mark.system


@pytest.fixture
def keep(tmp_path):
    return Path(os.environ.get("VICAL_SHOTS", tmp_path))


@pytest.fixture
def report(tmp_path):
    """The report of a short simulated recording, by the command that people type."""
    run = simulate(11, 14.0, rig=reference_rig(11, timeshift_cam_imu_s=0.01), camera_rate_hz=10.0)
    log, board, html = (tmp_path / name for name in ("log.mcap", "board.yaml", "report.html"))
    board.write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    with LogWriter(log) as writer:
        for t, gyro, force in zip(run.t_imu_ns, run.gyro_rps, run.specific_force_mps2, strict=True):
            payload = m.encode_imu(int(t), "imu0", tuple(gyro), tuple(force))
            writer.write(topics.IMU.key("rig0", "imu0"), payload, int(t))
        for frame in run.frames:
            points = m.encode_points(frame.t_cam_ns, "cam0", frame.ids, frame.uv_px, None, (640, 480))
            writer.write(topics.POINTS.key("rig0", "cam0"), points, frame.t_cam_ns)
    words = ["calibrate", str(log), "--target", str(board), "--report", str(html), "--quiet"]
    assert main([*words, "--accept", "converging"]) == 0
    return html


def test_report_in_a_browser_and_on_paper(report, browser, keep, tmp_path):
    async def script(page):
        await page.open(report.as_uri(), 1100, 1400)
        await page.wait(
            "document.readyState === 'complete' && document.querySelectorAll('figure svg').length > 12"
        )
        broken = await page.evaluate(
            "[...document.querySelectorAll('figure svg')].filter((i) => i.clientWidth < 100).length"
        )
        outside = await page.evaluate(
            "performance.getEntriesByType('resource').filter((e) => !e.name.startsWith('data:')).length"
        )
        wide = await page.evaluate("document.documentElement.scrollWidth")
        await page.screenshot(keep / "report.png")
        pdf = await page.call("Page.printToPDF", printBackground=True)
        return broken, outside, wide, page.errors, base64.b64decode(pdf["data"])

    broken, outside, wide, errors, pdf = browser.drive(script)
    assert (broken, outside, errors) == (0, 0, [])
    assert wide <= 1100
    assert pdf.startswith(b"%PDF")
    assert len(pdf) > 50_000
    assert (keep / "report.png").stat().st_size > 20_000


def test_terminal(web_feed, browser, keep, tmp_path):
    from rich.console import Console

    view, bus = View("*", as_json=False), LocalBus()
    bus.subscribe("vical/**", view.take)
    guidance = "rotate about the optical axis"
    web_feed.publish_estimate(bus, web_feed.estimate(12.0, np.random.default_rng(1), guidance=guidance))
    web_feed.publish_status(bus)
    console = Console(record=True, width=104, force_terminal=True, file=io.StringIO())
    console.print(live_table.screen(view.estimates, view.health))
    browser.draw_svg(console.export_svg(title="vical watch", clear=False), tmp_path, keep / "terminal.png")
    assert (keep / "terminal.png").stat().st_size > 10_000
    text = console.export_text()
    for needed in ("rig rig0", "converging", guidance, "time shift", "ms", "imu/imu0", "500.0 Hz, 0 lost"):
        assert needed in text
