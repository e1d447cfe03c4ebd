"""Provenance of a result, to reproduce it: command, inputs with hashes, versions, settings."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from vical_drivers.user_files import open_file

PACKAGES = (
    "vical",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "rosbags",
    "mcap",
    "foxglove-sdk",
    "eclipse-zenoh",
)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a result comes from.

    Attributes:
        command: The command line.
        made_at: When the report was made, UTC.
        files: Per input: name, size in bytes, SHA-256.
        versions: Version of each package, of Python and of the system.
        settings: Options that change the result, by name.
    """

    command: str
    made_at: str
    files: list[tuple[str, int, str]]
    versions: dict[str, str]
    settings: dict[str, str] = field(default_factory=dict)


def collect(
    command: str = "", inputs: Sequence[Path] = (), settings: Mapping[str, object] | None = None
) -> Provenance:
    """Collect provenance now.

    Args:
        command: The command line as typed.
        inputs: Files (hashed) or folders (their files hashed together, names included).
        settings: Options that change the result.
    """
    return Provenance(
        command=command,
        made_at=datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        files=[(str(p), *_size_and_hash(Path(p))) for p in inputs if Path(p).exists()],
        versions=_versions(),
        settings={k: str(v) for k, v in (settings or {}).items()},
    )


def _size_and_hash(path: Path) -> tuple[int, str]:
    digest, size = hashlib.sha256(), 0
    members = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for member in members:
        if path.is_dir():
            digest.update(str(member.relative_to(path)).encode())
        with open_file(member) as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
                size += len(block)
    return size, digest.hexdigest()


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
