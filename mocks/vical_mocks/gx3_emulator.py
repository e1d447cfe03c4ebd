"""A 3DM-GX3-25 behind a pseudo terminal: byte-exact, in real time, in a thread of its own.

By hand: ``python -m vical_mocks.gx3_emulator`` prints the terminal's name and runs until Ctrl-C.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import fcntl
import math
import os
import select
import signal
import sys
import tempfile
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Self

import numpy as np

from vical_mocks.clock import LINKS, SkewedClock, make_link
from vical_mocks.faults import ByteFaults, FaultyLink
from vical_mocks.gx3_device import Gx3Device
from vical_mocks.gx3_state import Identity, Settings
from vical_mocks.imu import GX3_25_ERRORS, FloatArray, ImuErrors, Motion, at_rest
from vical_mocks.mip_models import MODELS
from vical_mocks.openers import Openers

_IDLE_S = 0.05
_BAUD_OF = {getattr(termios, f"B{b}"): b for b in (9600, 19200, 115200, 230400, 460800, 921600)}


class Gx3Emulator:
    """The device, the link and the terminal; a context manager.

    Args:
        motion: True motion: host seconds (CLOCK_MONOTONIC), shape (n,) -> angular rate rad/s (n, 3) and
            specific force m/s^2 (n, 3). None: level and at rest.
        protocol: "single-byte" or "mip".
        model: For MIP: "gx3", "gx5" or "cv7".
        link: One of "direct", "usb", "uart", "ftdi": how bytes are delayed and bunched.
        clock_skew_ppm: Rate error of the device's crystal.
        clock_wander_ppm: Amplitude of its slow change.
        errors: Sensor errors; None for none.
        seed: Seed of noise and jitter.
        serial_number: As answered to the host.
        eeprom: Settings at power-up; default as from the factory.
        baud_matters: Compare the terminal's baud with the device's and garble what does not match, as a real
            UART does; None: for every link but "usb" and "direct".
        faults: Damage to the bytes towards the host.
        stall_every_s: Mean time between stalls of the link; 0 for none.
        boot_s: Time after a replug in which it hears and says nothing.
    """

    def __init__(
        self,
        motion: Motion | None = None,
        *,
        protocol: str = "single-byte",
        model: str = "gx3",
        link: str = "usb",
        clock_skew_ppm: float = 0.0,
        clock_wander_ppm: float = 0.0,
        errors: ImuErrors | None = None,
        seed: int = 0,
        serial_number: str = "6223-12345",
        eeprom: Settings | None = None,
        first_ticks: int = 0,
        baud_matters: bool | None = None,
        faults: ByteFaults | None = None,
        stall_every_s: float = 0.0,
        boot_s: float = 0.0,
    ) -> None:
        self._motion = motion
        self._clock = SkewedClock(time.monotonic(), clock_skew_ppm, clock_wander_ppm)
        self._faults = faults
        self._stall_every_s = stall_every_s
        self._rng = np.random.default_rng([seed, 7])
        self._link_kind = link
        self._baud_matters = link in ("uart", "ftdi") if baud_matters is None else baud_matters
        identity = Identity(serial_number=serial_number)
        self.device = Gx3Device(
            motion, clock=self._clock, protocol=protocol, model=model, errors=errors, seed=seed,
            identity=identity, eeprom=eeprom, first_ticks=first_ticks,
        )  # fmt: skip
        self._folder = tempfile.TemporaryDirectory(prefix="vical-gx3-")
        self.port_name = str(Path(self._folder.name) / "ttyGX3")
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._master = self._slave = -1
        self._plugged_before = False
        self._boot_s, self._dark_until_s = boot_s, -math.inf
        self._wake_r, self._wake_w = os.pipe()
        self.plug()

    def plug(self) -> None:
        """Connect to the host: a new terminal under the same name. The device powers up."""
        with self._lock:
            if self._master >= 0:
                return
            replugged, self._plugged_before = self._plugged_before, True
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            name = Path(self.port_name)
            name.unlink(missing_ok=True)
            name.symlink_to(os.ttyname(self._slave))
            self._openers = Openers(self._slave)
            if replugged:
                self.device.power_up(time.monotonic())
                self._dark_until_s = time.monotonic() + self._boot_s
            self._link = self._new_link()
        self._wake()

    def _new_link(self) -> FaultyLink:
        link = make_link(self._link_kind, self._rng, self.device.baud)
        return FaultyLink(link, self._faults, stall_every_s=self._stall_every_s)

    def unplug(self) -> None:
        """Pull the cable: the terminal disappears under whoever has it open."""
        with self._lock:
            if self._master < 0:
                return
            Path(self.port_name).unlink(missing_ok=True)
            self._openers.close()
            os.close(self._slave)
            os.close(self._master)
            self._master = self._slave = -1

    def power_off(self) -> None:
        """Take the supply away; the port stays, as that of a converter on USB does."""
        with self._lock:
            self._dark_until_s = math.inf

    def power_on(self, boot_s: float = 0.0) -> None:
        """Give the supply back; the device powers up and hears nothing for `boot_s`."""
        with self._lock:
            self._dark_until_s = time.monotonic() + boot_s
            self.device.power_up(self._dark_until_s)
            self._link = self._new_link()
        self._wake()

    def toggle_cable(self) -> None:
        """Unplug where it is plugged in, plug in where it is not."""
        # A thread of its own: a signal may come while the lock is held.
        act = self.unplug if self._master >= 0 else self.plug
        threading.Thread(target=act, name="gx3-cable", daemon=True).start()

    def damage(self, faults: ByteFaults | None) -> None:
        """Begin (None: end) to damage the bytes towards the host."""
        with self._lock:
            self._faults = faults
            if self._master >= 0:
                self._link = self._new_link()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Nothing is sent or taken meanwhile; afterwards all that was due comes at once."""
        with self._lock:
            yield

    def start(self) -> Self:
        """Begin to run."""
        self._thread = threading.Thread(target=self._run, name="gx3-emulator", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End; may be called twice."""
        self._stop.set()
        self._wake()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.unplug()
        if self._wake_w >= 0:
            os.close(self._wake_r)
            os.close(self._wake_w)
            self._wake_r = self._wake_w = -1
        self._folder.cleanup()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # closing: nobody is asleep
            os.write(self._wake_w, b"x")

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                wait_s, master = self._step(), self._master
            watched = [self._wake_r]
            if master >= 0:
                watched += [fd for fd in (master, self._openers.fileno()) if fd >= 0]
            with contextlib.suppress(OSError, ValueError):  # unplugged meanwhile: the next step sees it
                ready, _, _ = select.select(watched, [], [], wait_s)
                if self._wake_r in ready:
                    os.read(self._wake_r, 64)

    def _step(self) -> float:
        """Do what is due; return how long there is nothing more to do, s."""
        if self._master < 0:
            return _IDLE_S
        now_s = time.monotonic()
        if self._openers.closed_by_all():
            self._forget_host()
        if now_s < self._dark_until_s:
            with contextlib.suppress(OSError):  # whatever the host says is lost
                os.read(self._master, 4096)
            return min(self._dark_until_s - now_s, _IDLE_S)
        self._take_input(now_s)
        for t_s, data in self.device.advance(now_s):
            self._link.push(data, t_s)
        for _, data in self._link.poll(now_s):
            self._give(data)
        if self._link.next_s() is None:
            self.device.wire_is_idle()
            self._link.set_baud(self.device.baud)
        due = [t for t in (self.device.next_s(), self._link.next_s()) if t is not None]
        return max(0.0, min([*due, now_s + _IDLE_S]) - time.monotonic())

    def _forget_host(self) -> None:
        """Do what a serial port does at its last close, and this terminal not, as the emulator has it open.

        It drops what was not read and is exclusive no more: the vendor's programs lock their port (TIOCEXCL).
        """
        fcntl.ioctl(self._slave, termios.TIOCNXCL)
        termios.tcflush(self._slave, termios.TCIOFLUSH)

    def _take_input(self, now_s: float) -> None:
        try:
            data = os.read(self._master, 4096)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise
            return
        if not self._openers.count:  # opened since the step began, and perhaps closed again
            if self._openers.closed_by_all():
                self._forget_host()
            else:
                self._openers.count = max(1, self._openers.count)  # whoever writes has it open
        self.device.receive(self._garbled(data), now_s)

    def _give(self, data: bytes) -> None:
        if not self._openers.count:
            return  # nobody has the port open: a computer drops what comes in
        try:
            os.write(self._master, self._garbled(data))
        except OSError as error:
            # Nobody reads and the terminal is full: the bytes are lost, as on USB.
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise

    def _garbled(self, data: bytes) -> bytes:
        """What the other side sees when the two bauds differ."""
        if not self._baud_matters or not data:
            return data
        host_baud = _BAUD_OF.get(termios.tcgetattr(self._slave)[4], 0)
        if host_baud == self.device.baud:
            return data
        count = max(1, round(len(data) * host_baud / self.device.baud))
        return bytes(int(b) & 0x7F for b in self._rng.integers(0, 256, count))

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def sway(t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A level unit turning to and fro about its vertical axis: 1 rad/s, every two seconds."""
    gyro, force = at_rest(t_s)
    gyro[:, 2] = np.sin(np.pi * t_s)
    return gyro, force


MOTIONS: dict[str, Motion] = {"rest": at_rest, "sway": sway}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m vical_mocks.gx3_emulator",
        description="Emulate a MicroStrain 3DM-GX3-25 on a pseudo terminal; prints the terminal's name. "
        "SIGUSR1 pulls the cable, or plugs it in again.",
    )
    parser.add_argument("--protocol", choices=("single-byte", "mip"), default="single-byte")
    parser.add_argument("--model", choices=tuple(MODELS), default="gx3", help="what a MIP unit knows")
    parser.add_argument("--motion", choices=tuple(MOTIONS), default="rest", help="how the unit moves")
    parser.add_argument("--link", choices=LINKS, default="usb", help="how bytes are delayed and bunched")
    parser.add_argument("--skew-ppm", type=float, default=35.0, help="rate error of the device clock")
    parser.add_argument("--wander-ppm", type=float, default=0.0, help="slow change of the rate error")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=None, help="end by itself after this time")
    parser.add_argument("--serial-number", default="6223-12345")
    parser.add_argument("--lose", type=float, default=0.0, metavar="P", help="lost bytes, probability each")
    parser.add_argument("--flip", type=float, default=0.0, metavar="P", help="flipped bits, probability each")
    parser.add_argument("--garbage", type=int, default=0, metavar="N", help="random bytes before the first")
    parser.add_argument("--stall", type=float, default=0.0, metavar="S", help="mean time between stalls")
    parser.add_argument("--streaming", action="store_true", help="already streams 0xC2 at power-up")
    parser.add_argument("--baud", type=int, default=115_200, help="left at this baud by someone")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the emulator until Ctrl-C, SIGTERM or --seconds."""
    args = _parser().parse_args(argv)
    done = threading.Event()

    def end(_signal: int, _frame: FrameType | None) -> None:
        done.set()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    eeprom = Settings(baud=args.baud)
    if args.streaming:
        eeprom.power_up_mode, eeprom.preset_command = 2, 0xC2
    with Gx3Emulator(
        MOTIONS[args.motion],
        protocol=args.protocol,
        model=args.model,
        link=args.link,
        clock_skew_ppm=args.skew_ppm,
        clock_wander_ppm=args.wander_ppm,
        errors=GX3_25_ERRORS,
        seed=args.seed,
        serial_number=args.serial_number,
        eeprom=eeprom,
        faults=ByteFaults(lose=args.lose, flip=args.flip, at_start=args.garbage, seed=args.seed),
        stall_every_s=args.stall,
    ) as emulator:
        signal.signal(signal.SIGUSR1, lambda _signal, _frame: emulator.toggle_cable())
        sys.stdout.write(emulator.port_name + "\n")
        sys.stdout.flush()
        done.wait(args.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
