"""The pictures of the documentation, taken from a demo: page, phone, terminal and report.

    python -m benchmarks pictures --out docs/_static

A browser looks at the live page of a running `vical demo`; afterwards `vical calibrate --report` makes the
report from the log of that demo, and what `vical watch` shows is drawn from the messages in it. Where the
real recording lies next to the checkout, its report is taken as well.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import queue
import re
import subprocess
import sys
import tempfile
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from vical_mocks.harness import browser, web_feed

from vical_daemon.bus.interface import LocalBus
from vical_daemon.cli import live_table
from vical_daemon.cli.errors import EXIT_NOT_CONVERGED
from vical_daemon.cli.watch import View
from vical_daemon.estimation.guidance import Guidance, Verb
from vical_daemon.logs.mcap import LogReader
from vical_daemon.vision.target import Checkerboard

ROOT = Path(__file__).resolve().parents[1]
EUROC = ROOT.parent / "shared" / "data" / "euroc_imu_april"
_VICAL = [sys.executable, "-m", "vical_daemon"]


def main(argv: list[str]) -> int:
    """Take the pictures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks pictures", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("pictures"), help="folder (default: ./pictures)")
    parser.add_argument("--seconds", type=float, default=45.0, help="length of the demo")
    args = parser.parse_args(argv)
    if browser.find() is None:
        print("skipped: no Chromium here (apt-get install chromium)", file=sys.stderr)
        return 0
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name, closing(browser.Browser(Path(name) / "profile")) as chromium:
        work = Path(name)
        guidance(chromium, work, args.out / "guidance.png")
        log = live_page(chromium, work, args.out, args.seconds)
        terminal(chromium, work, log, args.out / "terminal.png")
        board = ["--target", str(log.with_name("target.yaml"))]
        report(chromium, work, [str(log), *board], args.out / "demo_report.png")
        if EUROC.is_dir():
            known = ["--target", str(EUROC / "target.yaml"), "--initial", str(EUROC / "initial.yaml")]
            fixed = [*known, "--fix", "intrinsics"]
            report(
                chromium, work, [str(EUROC), *fixed], args.out / "report.png", args.out / "report_phone.png"
            )
    print("\n".join(str(path) for path in sorted(args.out.glob("*.png"))))
    return 0


def guidance(chromium: browser.Browser, work: Path, path: Path) -> None:
    """Look at the page on a phone while a board is wanted elsewhere, fed by the harness of the tests."""
    bus, stop, rng = LocalBus(), threading.Event(), np.random.default_rng(0)
    board = work / "board.yaml"
    board.write_text(Checkerboard(8, 6, 0.05, 0.05).to_yaml())
    served: queue.Queue[str] = queue.Queue()
    thread = web_feed.serve_page(bus, stop, served.put, board)
    address = served.get(timeout=60)
    advice = Guidance(Verb.TURN, ("x", "y"))

    async def script(page: Any) -> None:
        await page.open(address, 390, 844)
        for number in range(1, 400):
            web_feed.publish_estimate(bus, web_feed.estimate(0.02 + 0.001 * number, rng, motion=advice))
            web_feed.publish_status(bus)
            web_feed.publish_image(bus, number)
            await asyncio.sleep(0.05)
            if number > 30 and await page.evaluate("document.querySelector('#corners .wanted') !== null"):
                break
        await page.screenshot(path)

    try:
        chromium.drive(script)
    finally:
        stop.set()
        thread.join()


def live_page(chromium: browser.Browser, work: Path, out: Path, seconds: float) -> Path:
    """Run the demo, look at its page on a desk and on a phone; return the demo's log."""
    command = [*_VICAL, "demo", "--web", "0", "--seconds", str(seconds), "--out", str(work / "demo")]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert demo.stderr is not None
    address = next(m.group(1) for line in demo.stderr if (m := re.search(r"live page at (\S+)", line)))

    async def script(page: Any) -> None:
        marks = "document.querySelectorAll('#corners .detected, #corners .predicted').length === 2"
        await page.open(address, 390, 844, dark=True)  # while something is still wanted
        converged = "document.getElementById('status').classList.contains('converged')"
        wanted = "document.querySelector('#corners .wanted') !== null"
        await page.wait(f"{marks} && ({wanted} || {converged})", seconds + 15)
        await page.screenshot(out / "phone.png")
        await page.open(address, height=1180)
        await page.wait(converged, seconds + 15)
        await page.wait(f"page.latest.cam0.duration_s > {0.7 * seconds}", seconds + 15)
        await page.evaluate("document.querySelector('button[data-room=\"1\"]').click()")
        await page.wait(marks, seconds)
        await page.screenshot(out / "page.png")

    try:
        chromium.drive(script)
        demo.communicate(timeout=seconds + 60)
    finally:
        demo.kill()
    return next(iter((work / "demo").glob("*.mcap")))


def terminal(chromium: browser.Browser, work: Path, log: Path, path: Path) -> None:
    """Draw what `vical watch` showed at the end of the log."""
    from rich.console import Console

    from vical_daemon.bus.interface import Sample

    view = View("*", as_json=False)
    for message in LogReader(log).messages():
        view.take(Sample(message.channel.topic.removeprefix("/"), message.payload, 0))
    console = Console(record=True, width=104, force_terminal=True, file=io.StringIO())
    console.print(live_table.screen(view.estimates, view.health))
    chromium.draw_svg(console.export_svg(title="vical watch"), work, path)


def report(
    chromium: browser.Browser, work: Path, arguments: list[str], path: Path, phone: Path | None = None
) -> None:
    """Make the report of a calibration and look at its first page, on a desk and on a phone in the dark."""
    html = work / "report.html"
    command = [*_VICAL, "calibrate", *arguments, "--report", str(html)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if done.returncode not in (0, EXIT_NOT_CONVERGED):
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}")

    async def script(page: Any) -> None:
        await page.open(html.as_uri(), 1100, 1400)
        await page.wait("document.readyState === 'complete' && document.querySelector('figure svg') !== null")
        await asyncio.sleep(0.5)  # the 3-D view draws itself when it knows its size
        await page.screenshot(path)
        if phone is not None:
            await page.open(html.as_uri(), 390, 844, dark=True)
            await page.wait("document.readyState === 'complete' && document.querySelector('.known') !== null")
            await page.screenshot(phone)

    chromium.drive(script)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
