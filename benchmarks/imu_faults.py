"""What the IMU driver makes of everything that goes wrong: outcome, time taken, nothing left behind."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from vical_drivers.errors import DeviceLostError, DriverError
from vical_drivers.microstrain.device import MicrostrainImu, open_imu
from vical_mocks.faults import ByteFaults
from vical_mocks.gx3_emulator import Gx3Emulator
from vical_mocks.gx3_state import Settings


def main(argv: list[str]) -> int:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(prog="benchmarks imu_faults", description=__doc__)
    parser.add_argument("--replugs", type=int, default=100)
    args = parser.parse_args(argv)
    cases: dict[str, Callable[[], str]] = {
        f"unplug and replug, {args.replugs} times": lambda: _replug(args.replugs),
        "1000 bytes of garbage before the first reply": lambda: _found(faults=ByteFaults(at_start=1000)),
        "already streams 0xCC at power-up": lambda: _found(
            eeprom=Settings(power_up_mode=2, preset_command=0xCC)
        ),
        "left streaming at 921600 baud": lambda: _found(
            link="uart", eeprom=Settings(baud=921_600, power_up_mode=2, preset_command=0xC2)
        ),
        "samples at 1 Hz, takes a command a second": lambda: _found(eeprom=Settings(decimation=1000)),
        "MIP device, driver set to single-byte": lambda: _refused("single-byte", device="mip"),
        "nobody answers": lambda: _refused("auto", mute=True),
        "a second process on the port": _second_process,
        "permission denied (as another user)": _denied,
        "no such port": lambda: _message(lambda: open_imu("/dev/ttyNoSuch")),
        "device goes silent": _silent,
        "link stalls 0.2 s, every second": _stalls,
    }
    print("| fault | outcome | s |\n|---|---|---|")
    for name, case in cases.items():
        threads, descriptors, start_s = threading.active_count(), _descriptors(), time.monotonic()
        outcome = case()
        seconds = time.monotonic() - start_s
        assert threading.active_count() == threads, f"{name}: a thread is left"
        assert _descriptors() == descriptors, f"{name}: a descriptor is left"
        print(f"| {name} | {outcome} | {seconds:.1f} |", flush=True)
    return 0


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


def _collect(imu: MicrostrainImu, count: int, limit_s: float = 15.0) -> int:
    got, end_s = 0, time.monotonic() + limit_s
    while got < count:
        got += len(imu.read(0.2))
        if time.monotonic() > end_s:
            raise TimeoutError(f"{got} of {count} samples in {limit_s:g} s")
    return got


def _replug(times: int) -> str:
    with Gx3Emulator(link="direct") as emulator, open_imu(emulator.port_name, warm_up_s=0.05) as imu:
        longest_s = 0.0
        for _ in range(times):
            _collect(imu, 5)
            emulator.unplug()
            try:
                _collect(imu, 10**9)
            except DeviceLostError:
                pass  # noticed: now it comes back
            emulator.plug()
            start_s = time.monotonic()
            _collect(imu, 1)
            longest_s = max(longest_s, time.monotonic() - start_s)
        return f"{imu.stats().reconnects} reconnects, samples again after at most {longest_s:.2f} s"


def _found(**device: object) -> str:
    with Gx3Emulator(**device) as emulator:  # type: ignore[arg-type]
        link = str(device.get("link", "auto"))
        start_s = time.monotonic()
        with open_imu(emulator.port_name, link=link) as imu:
            opened_s = time.monotonic() - start_s
            _collect(imu, 50)
            lost = imu.stats().lost
        return f"found and streaming after {opened_s:.1f} s, {lost} lost"


def _message(work: Callable[[], object]) -> str:
    try:
        work()
    except DriverError as error:
        return f"{type(error).__name__}: {str(error).split(': ', 1)[-1]}"
    return "no error"


def _refused(protocol: str, *, mute: bool = False, device: str = "single-byte") -> str:
    with Gx3Emulator(protocol=device) as emulator:
        if mute:
            emulator.device.face.receive = lambda _data: None  # type: ignore[method-assign]
        return _message(lambda: open_imu(emulator.port_name, protocol=protocol))


def _second_process() -> str:
    with Gx3Emulator() as emulator, open_imu(emulator.port_name) as imu:
        words = ["imu", "info", emulator.port_name]
        code = f"from vical_daemon.cli import main; raise SystemExit(main({words!r}))"
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        _collect(imu, 100)
        said = other.stderr.strip().split(": ")[-2:]
        return f"the second: exit {other.returncode}, {': '.join(said)}; the first loses {imu.stats().lost}"


def _denied() -> str:
    if os.geteuid() != 0:
        return _message(lambda: open_imu("/dev/ttyS0"))
    with tempfile.TemporaryDirectory() as folder:
        node = Path(folder) / "ttyDenied"
        os.mkfifo(node, 0o600)
        child = os.fork()
        if child == 0:
            _denied_child(folder, node)
        _, status = os.waitpid(child, 0)
        return "DevicePermissionError names the group" if status == 0 else "wrong error"


def _denied_child(folder: str, node: Path) -> None:
    os.chmod(folder, 0o755)  # noqa: PTH101
    os.setuid(65534)
    os._exit(0 if "usermod -aG" in _message(lambda: open_imu(str(node))) else 1)


def _silent() -> str:
    with Gx3Emulator() as emulator, open_imu(emulator.port_name, silence_s=1.0) as imu:
        _collect(imu, 50)
        emulator.device.face.power_up()
        start_s = time.monotonic()
        said = _message(lambda: _collect(imu, 10**9))
        noticed_s = time.monotonic() - start_s
        _collect(imu, 10)
        return f"{said.split(';')[0]} (after {noticed_s:.1f} s), then back by itself"


def _stalls() -> str:
    with Gx3Emulator(stall_every_s=1.0) as emulator, open_imu(emulator.port_name) as imu:
        _collect(imu, 500)
        return f"{imu.stats().lost} samples lost"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
