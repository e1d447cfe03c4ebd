"""The table of commands: name, module and one line each, so that `vical --help` imports none of them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec


@dataclass(frozen=True, slots=True)
class Command:
    """One subcommand.

    Attributes:
        name: As typed.
        group: Heading under which `vical --help` lists it.
        summary: One line.
    """

    name: str
    group: str
    summary: str

    @property
    def module(self) -> str:
        """Dotted name of the module with add_arguments and run."""
        return "vical_daemon.cli." + self.name.replace("-", "_")

    @property
    def present(self) -> bool:
        """Whether the module exists (looked up, not imported)."""
        return find_spec(self.module) is not None


START, SERVICE, DEVICES, CALIBRATION, LOGS, RESULTS = (
    "First steps",
    "The service",
    "Devices",
    "Calibration",
    "Recordings",
    "Results",
)

COMMANDS = (
    Command("demo", START, "run the whole system without hardware, and compare the estimate with the truth"),
    Command("init", START, "write a commented config from what is plugged in, and check it"),
    Command("check", START, "check a config and its devices"),
    Command("doctor", START, "check this computer for causes of inaccurate time stamps"),
    Command("target", START, "write a board to print, to scale, and its target file"),
    Command("completion", START, "print a completion script for bash or zsh"),
    Command("run", SERVICE, "run the daemon, or single roles of it"),
    Command(
        "command", SERVICE, "accept or discard the live calibration, start over, start or stop recording"
    ),
    Command("watch", SERVICE, "show the calibration live in the terminal"),
    Command("web", SERVICE, "serve a page with the live calibration, on loopback"),
    Command("install-service", SERVICE, "install or remove systemd units, udev rules and the user"),
    Command(
        "devices",
        DEVICES,
        "list IMUs and cameras, with their lines for the config",
    ),
    Command("imu", DEVICES, "use an IMU directly: info, stream, decode, gyro bias, self test"),
    Command("camera", DEVICES, "use a camera directly: list, stream, snapshot, controls"),
    Command("calibrate", CALIBRATION, "calibrate from recordings: mounting, time shift and lens"),
    Command(
        "merge", CALIBRATION, "merge recordings of one rig into one calibration, and name those that disagree"
    ),
    Command("td-icp", CALIBRATION, "find the time shift between sensors from their rotations"),
    Command("verify", CALIBRATION, "check whether a calibration still holds for a recording"),
    Command(
        "observability", CALIBRATION, "show which parameters a motion determines, and what motion is missing"
    ),
    Command("allan", CALIBRATION, "measure the noise densities of an IMU from a recording at rest"),
    Command("imu-calibrate", CALIBRATION, "measure scale, misalignment and biases of an IMU"),
    Command("info", LOGS, "show topics, rates, gaps, drops, jitter and duration of a recording"),
    Command("replay", LOGS, "play a recording on the bus in real time"),
    Command("recover", LOGS, "repair an unfinished MCAP file"),
    Command("compare", RESULTS, "compare calibrations: in joint sigmas, and in pixels over the image"),
    Command("export", RESULTS, "export a calibration to the format of other software"),
)


ELSEWHERE = {
    "list": "`vical devices` lists IMUs and cameras",
    "record": "`vical run -c FILE` records (`record` in the config); start, stop: `vical command`",
    "start": "`vical run -c FILE`, or for the service: systemctl start vical.target",
    "stop": "^C ends `vical run`; the service: systemctl stop vical.target",
    "status": "`vical watch` shows the calibration live; the service: systemctl status 'vical-*'",
    "version": "`vical --version`",
}
"""Words that other programs have as commands, and what serves here."""


def available() -> dict[str, Command]:
    """Return the commands whose module exists, by name, in the order of the table."""
    return {command.name: command for command in COMMANDS if command.present}
