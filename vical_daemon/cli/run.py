"""`vical run [ROLE ...] -c FILE`: the daemon, or single processes and roles of it."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from vical_daemon.cli.children import STOP_S, Children
from vical_daemon.cli.errors import EXIT_USAGE, NOTHING_TO_RUN, CliError, report_thread
from vical_daemon.cli.leaving import leave
from vical_daemon.cli.options import add_config, add_json
from vical_daemon.cli.stop_signals import die_with, leave_at_once, stop_signals

if TYPE_CHECKING:
    from vical_daemon.bus.interface import Bus
    from vical_daemon.cli.bus_access import HostedSocket
    from vical_daemon.cli.process_sets import RoleThreads
    from vical_daemon.config.model import Config
    from vical_daemon.service.claims import Claims

_log = logging.getLogger(__name__)
_TICK_S = 1.0
_POLL_S = 0.2
_CLAIM_S = 12.0  # a process that was told to stop is usually gone; a child that fails later is tried again


_EPILOG = """\
examples:
  vical run -c vical.yaml                 everything; then, in another terminal: vical watch
  vical run imu record -c vical.yaml      record the IMU only

As a service: vical install-service
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of COMMANDS."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "roles",
        metavar="ROLE",
        nargs="*",
        help="acquire, record, calibrate, web (processes) or imu, camera, record, detect, estimate, web "
        "(roles); default: all processes that the config asks for, as children",
    )
    parser.add_argument("--parent", type=int, default=0, help=argparse.SUPPRESS)  # of the children of `run`
    add_config(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Run until SIGTERM, SIGINT or SIGHUP; 1 if a role or a child failed."""
    if args.parent and not die_with(args.parent):
        raise CliError("the `vical run` that started this process has ended")
    from vical_daemon.cli import process_sets
    from vical_daemon.config.model import load

    config = load(args.config)
    if not config.imus and not config.cameras:
        raise CliError(f"{args.config}: {NOTHING_TO_RUN}", EXIT_USAGE)
    if not args.roles:
        return _run_children(args, config, process_sets.needed_processes(config))
    roles = process_sets.role_names(args.roles)
    threading.excepthook = report_thread
    with stop_signals(leave_at_once, STOP_S if args.parent else 0) as stop:
        code = _run_roles(config, roles, stop)
    return leave(code)


def _claims(config: Config, roles: list[str], stop: threading.Event) -> Claims:
    """Claim what only one process may publish; `record` and `web` settle that by their folder and port.

    Raises:
        CliError: Another process does it.
    """
    from vical_daemon.config.paths import make_private, runtime_directory
    from vical_daemon.service.claims import ClaimedError, Claims, job_name

    cameras = list(config.cameras)
    devices = {"imu": list(config.imus), "camera": cameras, "detect": cameras, "estimate": cameras}
    names = {
        job_name(config, role, device): (role, device) for role in roles for device in devices.get(role, [])
    }
    try:
        return Claims(make_private(runtime_directory()), names, _CLAIM_S, stop)
    except ClaimedError as error:
        role, device = names[str(error)]
        raise CliError(
            f"another process already runs the role {role} for {device} of {config.rig}; stop it first "
            "(systemctl status 'vical-*')"
        ) from None


def _run_roles(config: Config, roles: list[str], stop: threading.Event) -> int:
    """Run roles as threads of this process; consumers are started first and stopped last."""
    from vical_daemon.cli.bus_access import HostedSocket, open_for_roles
    from vical_daemon.cli.emulated import emulated_devices
    from vical_daemon.cli.process_sets import RoleThreads
    from vical_daemon.service import notify

    bus = open_for_roles(config, roles, stop)
    if bus is None:  # stopped while waiting for the router
        return 0
    hosted = HostedSocket.of(bus, config)
    try:
        with _claims(config, roles, stop), emulated_devices(config, roles) as options:
            notify.ready(f"starting: {', '.join(roles)}")  # not later: the roles load large libraries
            threads = RoleThreads(config, bus)
            try:
                for role in reversed(roles):
                    threads.start(role, options.get(role))
                _attend(config, bus, roles, threads, stop, hosted)
            finally:
                clean = threads.stop_all()
    finally:
        bus.close()
    threads.raise_failure()
    return 0 if clean else 1


def _attend(
    config: Config, bus: Bus, roles: list[str], threads: RoleThreads, stop: threading.Event,
    hosted: HostedSocket | None,
) -> None:  # fmt: skip
    """Tell systemd how it goes, once a second, until the end.

    Raises:
        CliError: The socket of the bus is gone; a new process makes it again.
    """
    from vical_daemon.bus import topics
    from vical_daemon.service import notify
    from vical_daemon.service.liveness import Liveness

    liveness = Liveness(roles, time.monotonic())
    key = topics.STATUS.pattern.format(rig=config.rig, name="*")
    bus.subscribe(key, lambda sample: liveness.take(sample, time.monotonic()))
    ready, said = False, False
    while not stop.is_set() and not threads.failed.is_set():
        turn_s = time.monotonic()
        stop.wait(_TICK_S)
        if time.monotonic() - turn_s > 2.0 * _TICK_S:  # all were held up: let the roles report first
            stop.wait(_TICK_S)
        if not ready and liveness.ready():
            ready = True
            gc.collect()
            gc.freeze()  # what was loaded stays: the collector need not walk through it during a read
            _log.info("ready: %s", ", ".join(roles))
        problem = liveness.problem(time.monotonic())
        if not problem:
            notify.watchdog()
        if ready and bool(problem) != said:  # said once, not each second
            said = bool(problem)
            _log.log(
                logging.ERROR if said else logging.INFO,
                "%s",
                f"not alive: {problem}" if said else "alive again",
            )
        notify.status(problem or liveness.summary())
        if hosted is not None and (gone := hosted.lost()):
            raise CliError(f"{gone}; starting again")
    notify.stopping()


def _run_children(args: argparse.Namespace, config: Config, names: list[str]) -> int:
    """Start each process as a child and tend them until a signal comes."""
    from vical_daemon.bus.socket_paths import Reach, reach
    from vical_daemon.cli.bus_access import socket_path

    # Asked before anything starts: record and calibrate would join the bus of the other one.
    if "acquire" in names and reach(socket_path(config.bus)) is Reach.OPEN:
        raise CliError(
            f"vical is already running: another process hosts the bus at {socket_path(config.bus)}; "
            "stop it first (systemctl status vical-acquire), or set bus.socket"
        )
    more = [flag for flag in ("--verbose", "--quiet") if getattr(args, flag[2:])]
    file, me = Path(args.config).absolute(), str(os.getpid())
    as_started = _contents(file)

    def command(name: str) -> list[str]:
        if _contents(file) != as_started:
            _log.warning(
                "%s was edited: process %s starts with the new settings, others keep the old ones until "
                "`vical run` is started again",
                file,
                name,
            )
        program = [sys.executable, "-m", "vical_daemon", "run", name]
        return [*program, "-c", str(file), "--parent", me, *more]

    hurry = threading.Event()
    children = Children(command)
    with stop_signals(lambda _number: hurry.set()) as stop:
        try:
            started = [f"{name} ({children.start(name)})" for name in names]
            _log.info("started %s", ", ".join(started))
            while not stop.wait(_POLL_S):
                children.tend(stop)
        finally:
            children.stop(hurry)
    return 0


def _contents(file: Path) -> bytes | None:
    """What is in a file; None: it cannot be read."""
    try:
        return file.read_bytes()
    except OSError:
        return None
