"""`vical demo`: the whole system without hardware, truth beside the estimate at the end."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vical_daemon.cli.errors import CliError
from vical_daemon.cli.options import add_json

if TYPE_CHECKING:
    from vical_mocks.live_rig import LiveRig

    from vical_daemon.bus import LocalBus
    from vical_daemon.cli.process_sets import RoleThreads
    from vical_daemon.config import Config
    from vical_daemon.estimation.result import CalibrationEstimate

HELP = "the whole system without hardware, truth beside the estimate at the end"
CAMERA, IMU = "cam0", "imu0"
SECONDS = 50.0
BOARD = {"kind": "checkerboard", "cols": 9, "rows": 6, "row_spacing_m": 0.045, "col_spacing_m": 0.045}
_CONFIG = """\
# What `vical demo` runs. On a robot only `port` and `uri` differ.
rig: demo
imus:
  {imu}:
    port: {port}
    rate_hz: 200
    noise: {{gyro_density: 3.8e-4, accel_density: 1.2e-3}}
cameras:
  {camera}:
    uri: folder:simulated      # the demo puts its rendered camera here
    size: [640, 480]
    rate_hz: {rate}
    lens:                      # a data sheet's focal length, and nothing about mounting or delay
      intrinsics: [510, 510, 320, 240]
target: target.yaml
calibration: {{mode: target}}
record: {{directory: {log}, images: true}}
store: {{directory: {store}}}
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, metavar="S", help="of data (default %(default)g)"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="another motion, another noise")
    parser.add_argument(
        "--out", metavar="DIR", help="config, target, recording and result (default: a new folder)"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate, acquire, detect, estimate, record; 1 if the outcome is not what it should be."""
    if not 5 <= args.seconds <= 3600:
        raise CliError("--seconds: 5 to 3600 are of use", 2)
    out = _folder(args.out)
    from vical_mocks.live_rig import LiveRig, LiveRigSettings

    from vical_daemon.cli import demo_truth

    _say(f"simulating a 3DM-GX3-25 on a pseudo terminal and a camera before a checkerboard; files in {out}")
    settings = LiveRigSettings(board=BOARD, seed=args.seed)
    with LiveRig(settings) as rig:
        config = _write_config(out, rig.port, settings.camera_rate_hz)
        estimate, trace = _run_roles(config, rig, args)
    result = estimate.to_json() | {"status": str(estimate.status), "trace": trace}
    result |= {"cpu_s": time.process_time(), "truth": rig.rig.truth(args.seconds, CAMERA)}
    result["recordings"] = sorted(str(path) for path in out.rglob("*.mcap"))
    problem = "no solution"
    if CAMERA in estimate.cameras:
        table = demo_truth.compare(result, result["truth"], CAMERA)
        result["error"] = demo_truth.as_json(table)
        problem = demo_truth.verdict(result, table)
        if not args.json:
            _print_text(result, demo_truth.as_text(table))
    text = json.dumps(result)
    (out / "result.json").write_text(text + "\n", encoding="utf-8")
    if args.json:
        print(text)
    if problem:
        raise CliError(f"the demo failed: {problem}")
    return 0


def _run_roles(
    config: Config, rig: LiveRig, args: argparse.Namespace
) -> tuple[CalibrationEstimate, list[dict[str, Any]]]:
    """Run every role as a thread over one LocalBus for the given time of data."""
    from vical_daemon.bus import LocalBus
    from vical_daemon.cli.process_sets import RoleThreads
    from vical_daemon.wall_clock import private_clock

    bus, clock = LocalBus(), private_clock()
    roles = RoleThreads(config, bus)
    watch = _Watch(bus, config)
    started: list[str] = []
    try:
        for role in ("estimate", "detect", "camera", "imu"):
            options: dict[str, Any] = {"clock": clock}
            if role == "camera":
                options["open_source"] = lambda _camera: rig.camera()
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


def _follow(watch: _Watch, roles: RoleThreads, args: argparse.Namespace) -> None:
    """Show progress until the data are as long as asked for, or the time is up."""
    give_up_s = time.monotonic() + args.seconds + 30.0
    with _Screen(quiet=args.quiet) as screen:
        while watch.duration_s < args.seconds and time.monotonic() < give_up_s:
            if roles.failed.wait(0.25):
                return
            screen.show(watch)


class _Watch:
    """Keeps the last estimate, a trace of one entry a second, and the last status of each role."""

    def __init__(self, bus: LocalBus, config: Config) -> None:
        from vical_daemon import topics

        self._estimate: CalibrationEstimate | None = None
        self.trace: list[dict[str, Any]] = []
        self.health: dict[str, str] = {}
        bus.subscribe(topics.calibration_key(config.rig, CAMERA), self._on_estimate)
        bus.subscribe(topics.status_key(config.rig, "x").removesuffix("x") + "*", self._on_status)

    @property
    def duration_s(self) -> float:
        return self._estimate.duration_s if self._estimate is not None else 0.0

    def latest(self) -> CalibrationEstimate:
        if self._estimate is None:
            raise CliError("the demo failed: nothing was estimated; see the messages above")
        return self._estimate

    def _on_estimate(self, sample: Any) -> None:
        from vical_daemon.messages import decode_calibration

        estimate = self._estimate = decode_calibration(sample.payload).estimate
        camera = estimate.cameras.get(CAMERA)
        if camera is not None and (not self.trace or estimate.duration_s >= self.trace[-1]["t_s"] + 1.0):
            sigma = [max(camera.T_imu_cam.covariance[i][i], 0.0) ** 0.5 for i in range(6)]
            pose = camera.T_imu_cam
            self.trace.append(
                {
                    "t_s": estimate.duration_s,
                    "p_m": pose.p_m,
                    "p_sigma_m": sigma[:3],
                    "q_wxyz": pose.q_wxyz,
                    "r_sigma_rad": sigma[3:],
                    "timeshift_s": camera.timeshift_cam_imu_s,
                    "timeshift_sigma_s": camera.timeshift_sigma_s,
                    "nis_per_dof": estimate.nis_per_dof,
                    "status": str(estimate.status),
                }
            )

    def _on_status(self, sample: Any) -> None:
        from vical_daemon.messages import decode_diagnostics

        for status in decode_diagnostics(sample.payload).statuses:
            if status.name != "clock":
                self.health[status.name] = status.message


class _Screen:
    """Progress on stderr: a live table on a terminal, a line every five seconds elsewhere."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._next_s = 0.0
        self._live: Any = None

    def __enter__(self) -> _Screen:
        if sys.stderr.isatty() and not self._quiet:
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
            self._live.__enter__()
        return self

    def __exit__(self, *args: object) -> None:
        if self._live is not None:
            self._live.__exit__(*args)

    def show(self, watch: _Watch) -> None:
        from vical_daemon.cli import live_table

        estimate = watch._estimate
        if estimate is None or self._quiet:
            return
        if self._live is not None:
            health = [f"{name}: {text}" for name, text in sorted(watch.health.items())]
            self._live.update(live_table.picture(CAMERA, estimate, health), refresh=True)
        elif time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + 5.0
            print(live_table.one_line(CAMERA, estimate), file=sys.stderr)


def _write_config(out: Path, port: str, rate_hz: float) -> Config:
    from vical_daemon.config import load
    from vical_daemon.vision.target import Checkerboard

    board = {key: value for key, value in BOARD.items() if key != "kind"}
    (out / "target.yaml").write_text(Checkerboard(**board).to_yaml(), encoding="utf-8")  # type: ignore[arg-type]
    text = _CONFIG.format(
        imu=IMU,
        camera=CAMERA,
        port=port,
        rate=rate_hz,
        log=json.dumps(str(out)),
        store=json.dumps(str(out / "store")),
    )
    (out / "vical.yaml").write_text(text, encoding="utf-8")
    return load(out / "vical.yaml")


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
    print(f"\n{CAMERA} in the imu frame, beside the truth\n{table}")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
