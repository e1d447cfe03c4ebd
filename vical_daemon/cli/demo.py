"""`vical demo`: the whole system without hardware, with a comparison to the truth at the end."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json, check_port
from vical_daemon.service.atomic_file import write_output

if TYPE_CHECKING:
    from vical_daemon.cli.demo_screen import Watch
    from vical_daemon.cli.demo_truth import StampWitness
    from vical_daemon.cli.emulated import EmulatedRig
    from vical_daemon.cli.process_sets import RoleThreads
    from vical_daemon.config.model import Config
    from vical_daemon.estimation.result import CalibrationEstimate
    from vical_daemon.vision.target import Checkerboard

CAMERA, IMU = "cam0", "imu0"
RATE_HZ = 12.5
FILTER_SAMPLES = 10
MOST, AFTER_CONVERGENCE = 80.0, 10.0  # seconds of data
ENOUGH_SHARE = 0.6  # of the images used in time; with fewer the machine is said to be busy
SETTLED = 1.0  # s of converged data: images that are still on their way must not undo it
LONGEST = 4.0  # times its seconds: so long a demo goes on that has not converged by then
BOARD = {"cols": 9, "rows": 6, "row_spacing_m": 0.045, "col_spacing_m": 0.045}
_CONFIG = """\
# What `vical demo` runs, and `vical run -c vical.yaml` as a service. On a robot only `port` and `uri` differ.
rig: demo
imus:
  {imu}:
    port: emulated
    rate_hz: 100
    filter_samples: {taps}         # as long as a sample lasts, the default
    noise: {{gyro_density: 3.8e-4, accel_density: 1.2e-3}}
cameras:
  {camera}:
    uri: emulated
    size: [640, 480]
    rate_hz: {rate}
    lens:                      # a data sheet's focal length, and nothing about mounting or delay
      intrinsics: [510, 510, 320, 240]
target: target.yaml
calibration: {{mode: target}}
record: {{directory: {log}, images: true}}
store: {{directory: {store}}}
"""


_EPILOG = """\
afterwards:
  vical info DIR/*.mcap
  vical calibrate DIR/*.mcap --target DIR/target.yaml

exit code: 0 converged, and the truth is within 4 sigma; 1 otherwise
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help=f"seconds of data (default: until converged, at most {MOST:g}); "
        f"if it has not converged by then, up to {LONGEST:g} times as many",
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="seed of motion and noise (default 1)"
    )
    parser.add_argument(
        "--out", metavar="DIR", help="folder for config, target, recording and result (default: a new folder)"
    )
    parser.add_argument(
        "--web",
        type=int,
        metavar="PORT",
        help="also serve the live page (http://127.0.0.1:PORT/; 0: any free port)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate, acquire, detect, estimate, record; 1 if the outcome is not what it should be."""
    if args.seconds is not None and not 5 <= args.seconds <= 3600:
        raise CliError("--seconds: 5 to 3600 s", 2)
    check_port("--web", args.web)
    out = _folder(args.out)
    before = set(out.rglob("*.mcap"))
    for stored in (out / "store").glob("*.json"):  # of an earlier demo: this one is to start from nothing
        stored.unlink()
    from vical_daemon.cli import demo_truth
    from vical_daemon.cli.emulated import make_rig
    from vical_daemon.vision.target import Checkerboard

    board = Checkerboard(**BOARD)  # type: ignore[arg-type]

    _say(f"simulating a 3DM-GX3-25 on a pseudo terminal and a camera before a checkerboard; files in {out}")
    with make_rig(board, RATE_HZ, seed=args.seed) as rig:
        config = _write_config(out, board, rig.port)
        if args.web is not None:
            config = replace(config, web=replace(config.web, enabled=True, port=args.web))
        stamps = demo_truth.StampWitness(rig.imu_instant_ns, FILTER_SAMPLES)
        estimate, trace = _run_roles(config, rig, stamps, args)
    truth = demo_truth.truth_of_stamps(rig.rig.truth(0.0, CAMERA), stamps.error_s, stamps.wander_s, CAMERA)
    result = estimate.to_json() | {"status": str(estimate.status), "trace": trace}
    result |= {"cpu_s": time.process_time(), "truth": truth}
    result["recordings"] = sorted(str(path) for path in set(out.rglob("*.mcap")) - before)
    problem, table = f"no solution: {estimate.reason or estimate.guidance}", None
    if CAMERA in estimate.cameras:
        result["cameras"][CAMERA]["resolution"] = list(config.cameras[CAMERA].size)
        table = demo_truth.compare(result, result["truth"], CAMERA)
        result["error"] = demo_truth.as_json(table)
        problem = demo_truth.verdict(result, table)
    text = json.dumps(result)
    write_output(out / "result.json", text + "\n")  # first: stdout may be closed, as after `| head`
    if args.json:
        print(text)
    elif table:
        _print_text(result, demo_truth.as_text(table))
    busy = _busy(result)
    if problem:
        raise CliError(f"the demo failed: {problem}" + (f" ({busy})" if busy else ""))
    if busy and not args.quiet:
        _say(f"\n{busy}")
    return 0


def _run_roles(
    config: Config, rig: EmulatedRig, stamps: StampWitness, args: argparse.Namespace
) -> tuple[CalibrationEstimate, list[dict[str, Any]]]:
    """Run every role as a thread over one LocalBus for the given time of data."""
    from vical_daemon.bus.interface import LocalBus
    from vical_daemon.cli.demo_screen import Watch
    from vical_daemon.cli.process_sets import ROLE_MODULES, RoleThreads
    from vical_daemon.service.wall_clock import private_clock

    bus, clock = LocalBus(), private_clock()
    roles = RoleThreads(config, bus)
    watch = Watch(bus, config.rig, CAMERA)
    started: list[str] = []
    try:
        page = ("web",) if config.web.enabled else ()
        for role in (*page, "record", "estimate", "detect", "camera", "imu"):
            import_module(ROLE_MODULES[role])  # before its source starts: it hears the first sample
            options: dict[str, Any] = {"clock": clock}
            if role == "web":
                options["ready"] = lambda address: _say(f"live page at {address}")
            if role == "camera":
                options["open_source"] = lambda _camera: rig.camera()
            if role == "imu":
                options["open_source"] = stamps.open
            roles.start(role, options)
            started.append(role)
        _follow(watch, roles, args)
    finally:
        for role in reversed(started):
            if role == "detect":
                time.sleep(0.3)  # the last images
            roles.stop(role)
    roles.raise_failure()
    return watch.latest(), watch.trace


def _busy(result: dict[str, Any]) -> str:
    """Name the usual cause of a late or failed end: a machine that cannot do it in real time; or ""."""
    expected = result["duration_s"] * RATE_HZ
    if result["frames"] > ENOUGH_SHARE * expected:
        return ""
    return (
        f"only {result['frames']} of {expected:.0f} frames were used in time: this machine is busy; "
        "end other programs or try again"
    )


def _follow(watch: Watch, roles: RoleThreads, args: argparse.Namespace) -> None:
    """Show progress until there are as many seconds of data as asked for; then, if need be, until converged.

    A machine that stands still now and then, or is busy, needs longer: its stamps are worse, its images late.
    """
    from vical_daemon.cli.demo_screen import Screen

    most_s = args.seconds or MOST
    begin_s, extended = time.monotonic(), False
    with Screen(CAMERA, quiet=args.quiet) as screen:
        while time.monotonic() < begin_s + most_s * (LONGEST if extended else 1.0) + 15.0:
            if args.seconds is None and watch.converged_for_s > AFTER_CONVERGENCE:
                return
            if watch.duration_s >= most_s:
                if watch.converged_for_s > SETTLED:
                    return
                if not extended:
                    extended = True
                    _say(f"not converged yet: going on until it is, for {LONGEST * most_s:.0f} s at most")
            if roles.failed.wait(0.25):
                return
            screen.show(watch)


def _write_config(out: Path, board: Checkerboard, port: str) -> Config:
    """Write target and settings; returns the settings with the port of the rig that runs now."""
    from vical_daemon.config.model import load

    (out / "target.yaml").write_text(board.to_yaml(), encoding="utf-8")
    text = _CONFIG.format(
        imu=IMU,
        camera=CAMERA,
        rate=RATE_HZ,
        taps=FILTER_SAMPLES,
        log=json.dumps(str(out)),
        store=json.dumps(str(out / "store")),
    )
    (out / "vical.yaml").write_text(text, encoding="utf-8")
    config = load(out / "vical.yaml")
    return replace(config, imus={IMU: replace(config.imus[IMU], port=port)})


def _folder(given: str | None) -> Path:
    if given is None:
        return Path(tempfile.mkdtemp(prefix="vical-demo-"))
    try:
        Path(given).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CliError(f"--out {given}: {error.strerror}") from None
    return Path(given).absolute()


def _print_text(result: dict[str, Any], table: str) -> None:
    from vical_daemon.cli.calibration_text import describe

    print(describe(result))
    for path in result["recordings"]:
        print(f"\nrecorded: {path}")
    truth = result["truth"]
    late_ms, wander_ms = 1e3 * truth["imu_stamp_error_s"], 1e3 * truth["imu_stamp_wander_s"]
    print(
        "\nOn this machine the stamps of the emulated IMU were off by "
        f"{late_ms:+.2f} ± {wander_ms:.2f} ms.\n"
        "The true time shift below contains this offset, and error/sigma allows for the ±."
    )
    print(f"\n{CAMERA} in the imu frame, compared with the truth\n{table}")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
