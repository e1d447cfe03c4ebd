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
    "Devices by hand",
    "Calibration",
    "Recordings",
    "Results",
)

COMMANDS = (
    Command("demo", START, "the whole system without hardware, truth beside the estimate at the end"),
    Command("init", START, "write a commented config from what is plugged in, and check it"),
    Command("check", START, "read config and devices, say what is wrong"),
    Command("doctor", START, "what on this computer stands in the way of good stamps, and what to do"),
    Command("target", START, "a board to print, to scale, and its target YAML"),
    Command("completion", START, "completion for bash or zsh, as a script to source"),
    Command("run", SERVICE, "the daemon, or single roles of it"),
    Command("watch", SERVICE, "subscribe to calibration updates and show them live"),
    Command("web", SERVICE, "a page with the live calibration, on loopback"),
    Command("install-service", SERVICE, "install systemd units, udev rules and the user, or remove them"),
    Command(
        "devices",
        DEVICES,
        "IMUs on serial ports, cameras, and how to name them in the config",
    ),
    Command("imu", DEVICES, "talk to the IMU: info, stream, decode, gyro bias, self test"),
    Command("camera", DEVICES, "talk to a camera: list, stream, snapshot"),
    Command("calibrate", CALIBRATION, "the online filter over a recording: extrinsics and time shift"),
    Command("td-icp", CALIBRATION, "temporal calibration alone"),
    Command("observability", CALIBRATION, "which parameters the motion revealed, and what motion is missing"),
    Command("allan", CALIBRATION, "noise densities of an IMU from a recording at rest"),
    Command("imu-calibrate", CALIBRATION, "scale, misalignment and biases of the IMU itself"),
    Command("info", LOGS, "topics, rates, gaps, drops, jitter and duration of a recording"),
    Command("replay", LOGS, "put a recording back on the bus in real time"),
    Command("recover", LOGS, "make an unfinished MCAP file whole"),
    Command("export", RESULTS, "the result in the form that other software reads"),
)


def available() -> dict[str, Command]:
    """Return the commands whose module exists, by name, in the order of the table."""
    return {command.name: command for command in COMMANDS if command.present}
