"""Saves the running estimator in the runtime directory, so that a restarted process resumes it.

A restart then costs a gap in the data, not the calibration. The file is valid for the same devices, config,
code and boot only. It is used once, so that a state that crashes the process is not loaded again.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import pickle
import stat
import sys
import time
from collections.abc import Mapping
from enum import EnumType
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from vical_drivers.user_files import read_file

from vical_daemon import estimation
from vical_daemon.calibrate.arrival_stamps import LiveStamps
from vical_daemon.calibrate.estimators import Estimator
from vical_daemon.config.model import Config
from vical_daemon.config.strict_yaml import MAX_BYTES
from vical_daemon.estimation.status.recent_past import RecentPast
from vical_daemon.service.atomic_file import atomic_write
from vical_daemon.service.claims import job_name
from vical_daemon.service.wall_clock import WallClock

_log = logging.getLogger(__name__)
SAVE_EVERY_S = 2.0
PROVEN_S = 10.0  # an estimator is not saved before it has run this long without failing
OLDEST_S = 300.0  # after this long the rig may have been touched
_COST = 100  # saving may take 1/100 of the time
_SIZE_LIMIT = 2**26  # bytes; 0.25 to 0.5 MB from the first minute on
CODE = Path(estimation.__file__).parent
"""The code that a state depends on."""
_ARITHMETIC = estimation.__name__
_PLAIN = {("builtins", "slice"), ("collections", "deque"), ("numpy", "dtype"), ("numpy", "ndarray")} | {
    (module, name)
    for core in ("numpy._core", "numpy.core")
    for module, name in (
        (f"{core}.multiarray", "scalar"),
        (f"{core}.multiarray", "_reconstruct"),
        (f"{core}.numeric", "_frombuffer"),
    )
}
"""Types in a state, besides the classes of the estimation."""


def file_name(config: Config) -> str:
    """Name of the file: rigs that share a folder, and processes for other cameras, have their own."""
    return f"{job_name(config, 'estimate', config.calibration_cameras[0])}.state"


class _Head(msgspec.Struct, frozen=True):
    identity: str
    devices: dict[str, str]
    saved_ns: int  # UNIX, by the service's clock
    image_stamps_ns: dict[str, list[int]]


class Kept(NamedTuple):
    """What an earlier process saved.

    Attributes:
        estimator: Its estimator.
        age_s: Time since then, s.
        image_stamps_ns: Last stamps of the cameras that stamp on arrival, see `LiveStamps.known_ns`. The
            estimator never got these stamps, but the even ones that follow from them.
    """

    estimator: Estimator
    age_s: float
    image_stamps_ns: dict[str, list[int]]


class Checkpoint:
    """The state of one estimator, on disk.

    Args:
        folder: The runtime directory; None: nothing is saved (demo, tests).
        config: The rig.
        clock: Clock of the service. Another clock means another boot, with unrelated stamps.
    """

    def __init__(self, folder: Path | None, config: Config, clock: WallClock) -> None:
        self._path = None if folder is None else folder / file_name(config)
        self._clock = clock
        self._identity = _identity(config, clock)
        self._next_s = time.monotonic() + PROVEN_S

    def load(self, devices: Mapping[str, str]) -> Kept | None:
        """Return the state that an earlier process saved for these devices, or None.

        Args:
            devices: Serial numbers by component; empty: unknown, so no state is loaded.
        """
        if self._path is None:
            return None
        try:
            data = _read_private(self._path)
            self.forget()
            line, _, body = data.partition(b"\n")
            head = msgspec.json.decode(line, type=_Head)
            age_s = (self._clock.now_ns() - head.saved_ns) * 1e-9
            if head.identity != self._identity or not devices or head.devices != dict(devices):
                return None
            if not 0.0 <= age_s <= OLDEST_S:
                return None
            return Kept(_Unpickler(io.BytesIO(body)).load(), age_s, head.image_stamps_ns)
        except FileNotFoundError:
            return None
        except Exception as error:  # any damaged file: the estimator then starts without it
            _log.warning("%s is not used: %s", self._path, " ".join(str(error).split()))
            return None

    def save(
        self, estimator: Estimator, devices: Mapping[str, str], stamps: LiveStamps | None = None
    ) -> None:
        """Save a converged estimator, if enough time has passed since the last save. Never raises."""
        begin_s = time.monotonic()
        if self._path is None or begin_s < self._next_s or not devices:
            return
        try:
            known_ns = {} if stamps is None else stamps.known_ns()
            head = _Head(self._identity, dict(devices), self._clock.now_ns(), known_ns)
            body = io.BytesIO()
            _Pickler(body, protocol=5).dump(estimator)
            atomic_write(self._path, msgspec.json.encode(head) + b"\n" + body.getvalue(), durable=False)
        except Exception as error:
            _log.warning("the estimator's state cannot be kept: %s", " ".join(str(error).split()))
            self._next_s = float("inf")
            return
        end_s = time.monotonic()
        self._next_s = end_s + max(SAVE_EVERY_S, _COST * (end_s - begin_s))

    def forget(self) -> None:
        """Remove the file: the next estimator starts from the stored calibration."""
        self._next_s = time.monotonic() + PROVEN_S
        if self._path is None:
            return
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s: %s", self._path, error.strerror)


class _Pickler(pickle.Pickler):
    """Leaves out the recent past: 8 MB at 20 images a second, of use for changes of the last second alone."""

    def reducer_override(self, obj: object) -> Any:
        return (RecentPast, ()) if type(obj) is RecentPast else NotImplemented


class _Unpickler(pickle.Unpickler):
    """Creates objects of the estimation and plain types only, so that a file cannot run code."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("builtins", "getattr"):  # a method of one of our objects
            return _method
        if (module, name) in _PLAIN:
            return super().find_class(module, name)
        if module == _ARITHMETIC or module.startswith(_ARITHMETIC + "."):
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__.startswith(_ARITHMETIC):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is no part of an estimator")


def _method(owner: object, name: str) -> Any:
    """Return a method of an estimator's object; Python 3.11.0 to 3.11.3 pickle enum members this way, too."""
    if isinstance(owner, EnumType) and owner.__module__.startswith(_ARITHMETIC) and name in owner.__members__:
        return owner[name]
    if not type(owner).__module__.startswith(_ARITHMETIC) or name.startswith("__"):
        raise pickle.UnpicklingError(f"{name} is no method of an estimator")
    return getattr(owner, name)


def _read_private(path: Path) -> bytes:
    """Read a file that only this user can have written.

    Raises:
        OSError: There is no file, or another user could have written it.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        about = os.fstat(descriptor)
        writable = about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if not stat.S_ISREG(about.st_mode) or about.st_uid != os.getuid() or writable:
            raise PermissionError(1, "others could have written it", str(path))
        return file.read(_SIZE_LIMIT)


def _identity(config: Config, clock: WallClock) -> str:
    """Return a hash of what a state depends on: code, config, target, clock."""
    digest = hashlib.sha256(f"{sys.version} {np.__version__} {clock.boot_id} {clock.offset_ns}".encode())
    digest.update(repr(config).encode())
    files = sorted(CODE.rglob("*.py"))
    for path in (*files, *([config.target_path] if config.target_path else [])):
        if path.is_file():
            digest.update(read_file(path, MAX_BYTES))
    return digest.hexdigest()
