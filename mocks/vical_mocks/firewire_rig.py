"""The test's side of the fake FireWire bus: builds the preloaded library and shares a page with it.

The bus itself is `fake_firewire.c` next to the camera tests; the structure here and there are the same.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

ENVIRONMENT = "VICAL_FAKE_FIREWIRE"
GUID = 0x00B09D0100A1B2C3
TRUTHS = 4096


class Truth(ctypes.Structure):
    """One exposure: shutter opened and closed (CLOCK_MONOTONIC, ns), frame counter, raw shutter."""

    _fields_ = (
        ("t_open_ns", ctypes.c_int64),
        ("t_close_ns", ctypes.c_int64),
        ("counter", ctypes.c_uint32),
        ("raw_shutter", ctypes.c_uint32),
    )


class Rig(ctypes.Structure):
    """What is shared: commands to the bus first, then what it did.

    `lose_frames`: so many whole frames are lost. `lose_packets`: so many packets are lost from number
    `lose_at` of a frame on; the kernel then moves the rest of the frame up, and takes the beginning of the
    next frame for its end.
    """

    _fields_ = (
        ("magic", ctypes.c_uint32),
        ("unplugged", ctypes.c_uint32),
        ("lose_frames", ctypes.c_uint32),
        ("lose_packets", ctypes.c_uint32),
        ("lose_at", ctypes.c_uint32),
        ("bus_resets", ctypes.c_uint32),
        ("no_embedding", ctypes.c_uint32),
        ("no_bandwidth", ctypes.c_uint32),
        ("stopped", ctypes.c_uint32),
        ("ppm", ctypes.c_double),
        ("cycle_offset_ns", ctypes.c_int64),
        ("frames", ctypes.c_uint32),
        ("opens", ctypes.c_uint32),
        ("closes", ctypes.c_uint32),
        ("sent", ctypes.c_uint32),
        ("truth", Truth * TRUTHS),
    )


@dataclass(frozen=True)
class Exposure:
    """Truth of one frame, ns of CLOCK_MONOTONIC."""

    t_mid_ns: int
    exposure_ns: int


class FireWireRig:
    """Commands and truth of the bus that this process runs on.

    Args:
        path: The shared file, as named in the environment.
    """

    def __init__(self, path: str) -> None:
        with Path(path).open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), ctypes.sizeof(Rig))
        self.shared = Rig.from_buffer(self._map)

    def exposures_of(self, counter: int) -> Exposure:
        """Return the truth of one of the latest frames; KeyError where it is too old."""
        for back in range(1, min(self.shared.frames, 256) + 1):
            t = self.shared.truth[(self.shared.frames - back) % TRUTHS]
            if t.counter == counter:
                return Exposure((t.t_open_ns + t.t_close_ns) // 2, t.t_close_ns - t.t_open_ns)
        raise KeyError(counter)

    def exposures(self) -> dict[int, Exposure]:
        """Return the truth of the latest frames by frame counter."""
        found = {}
        for k in range(max(0, self.shared.frames - TRUTHS), self.shared.frames):
            t = self.shared.truth[k % TRUTHS]
            found[t.counter] = Exposure((t.t_open_ns + t.t_close_ns) // 2, t.t_close_ns - t.t_open_ns)
        return found


def missing_tools() -> str:
    """Return what the fake bus needs and is not here, in words; "" when all is there."""
    if shutil.which("gcc") is None:
        return "no C compiler: apt install gcc"
    for soname in ("libdc1394.so.25", "libdc1394.so.22"):
        try:
            ctypes.CDLL(soname)
        except OSError:
            continue
        return ""
    return "no libdc1394: apt install libdc1394-25"


def build(source: Path, folder: Path) -> dict[str, str]:
    """Compile the bus into `folder`; returns the environment under which a process has it.

    Raises:
        subprocess.CalledProcessError: It does not compile.
    """
    library, shared = folder / "fake_firewire.so", folder / "rig"
    command = ["gcc", "-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-o", str(library)]
    subprocess.run([*command, str(source), "-ldl", "-lpthread", "-lm"], check=True)
    shared.write_bytes(bytes(ctypes.sizeof(Rig)))
    return {**os.environ, "LD_PRELOAD": str(library), ENVIRONMENT: str(shared)}
