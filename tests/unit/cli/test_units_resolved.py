"""What systemd resolves from units and drop-ins, compared with the files and with the docs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from vical_daemon.cli import main, process_sets
from vical_daemon.cli.process_sets import PROCESSES

SERVICES = tuple(f"vical-{name}.service" for name in PROCESSES)
REPOSITORY = Path(__file__).resolve().parents[3]
MANAGER = Path("/lib/systemd/systemd")
NOBODY = 65534  # systemd refuses `--test` to root
needs_systemd = pytest.mark.skipif(not MANAGER.is_file(), reason="systemd is not installed (Debian: systemd)")
OTHERWISE = {"RestrictNamespaces": "n/a", "IPAddressDeny": "0.0.0.0/0", "IPAddressAllow": "127.0.0.0/8"}
"""What systemd prints for `yes` (the kinds that are left), `any` and `localhost`."""
Settings = dict[str, list[str]]


@pytest.fixture(scope="module")
def units() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder).resolve()
        assert main(["install-service", "--root", str(root), "--program", sys.executable]) == 0
        for path in (root, *root.rglob("*")):  # nobody has to read it
            path.chmod(0o755 if path.is_dir() else 0o644)
        yield root / "etc/systemd/system"


def written(path: Path, section: str = "Service") -> Settings:
    """Return the settings of one section of a unit file."""
    found: Settings = {}
    current = ""
    for line in path.read_text().splitlines():
        if line.startswith("["):
            current = line.strip("[]")
        elif current == section and "=" in line and not line.startswith("#"):
            key, value = line.split("=", 1)
            found.setdefault(key, []).append(value)
    return found


def resolved(units: Path, name: str) -> Settings:
    """Return what systemd would run a unit with: `systemd --test` loads everything and prints it."""
    done = subprocess.run(
        [MANAGER, "--test", "--system", f"--unit={name}"],
        env={"SYSTEMD_UNIT_PATH": f"{units}:", "PATH": os.environ["PATH"]},
        **({"user": NOBODY, "group": NOBODY, "extra_groups": []} if os.getuid() == 0 else {}),
        capture_output=True,
        text=True,
        check=True,
    )
    pattern = rf"^\s*-> Unit {re.escape(name)}:\n(.*?)(?=^\s*-> Unit |\Z)"
    section = re.search(pattern, done.stdout, re.M | re.S)
    assert section is not None, done.stdout[:500] + done.stderr
    found: Settings = {}
    for line in section.group(1).splitlines():
        key, _, value = line.strip().partition(": ")
        found.setdefault(key, []).append(value)
    return found


def plain(value: str) -> str:
    """Return a value in one spelling: times in s, sizes in bytes, switches as yes and no."""
    units_s = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
    parts = re.findall(r"([0-9.]+)(ms|s|min|h)(?![a-z])", value)
    if parts and "".join(a + b for a, b in parts) == value.replace(" ", ""):
        return f"{sum(float(number) * units_s[unit] for number, unit in parts):g} s"
    if re.fullmatch(r"[0-9]+[MG]", value):
        return str(int(value[:-1]) << {"M": 20, "G": 30}[value[-1]])
    return {"true": "yes", "false": "no"}.get(value, value)


def test_no_setting_stands_in_a_unit_and_in_the_common_drop_in(units: Path) -> None:
    """Drop-ins are read after the unit, so that the common value would win."""
    common = written(units / "vical-.service.d/10-common.conf")
    lists = {"SupplementaryGroups", "Environment", "DeviceAllow"}  # add to what is there
    for name in SERVICES:
        assert not (set(written(units / name)) & set(common)) - lists, name


@needs_systemd
@pytest.mark.parametrize("name", SERVICES)
def test_systemd_takes_every_setting_as_it_is_written(units: Path, name: str) -> None:
    resolved_as = resolved(units, name)
    settings = written(units / "vical-.service.d/10-common.conf") | written(units / name)
    compared = 0
    for key, values in settings.items():
        if key in resolved_as and len(values) == 1 and " " not in values[0]:
            expected = OTHERWISE.get(key, values[0])
            assert plain(expected) in [plain(value) for value in resolved_as[key]], key
            compared += 1
    assert compared >= 35, "systemd prints the settings under other names now"
    for key in written(units / name):
        assert key in resolved_as or key == "ExecStart", f"{key} cannot be compared"


@needs_systemd
@pytest.mark.parametrize("name", PROCESSES)
def test_the_table_in_the_docs_is_what_systemd_resolves(units: Path, name: str) -> None:
    text = (REPOSITORY / "docs" / "service.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"]
    (header,) = [row for row in rows if row[0] == "setting"]
    table = rows[rows.index(header) + 2 :]
    resolved_as = resolved(units, f"vical-{name}.service")
    assert [row[0] for row in table[:3]] == ["`TimeoutStartSec`", "`WatchdogSec`", "`TimeoutStopSec`"]
    column, compared = header.index(name), 0
    for row in table:
        if len(row) != len(header):
            break
        key, default = row[0].strip("`"), {"Nice": "0", "CPUSchedulingPolicy": "other"}
        value = resolved_as.get(key, [default.get(key, "missing")])[-1]
        assert plain(value) == plain(row[column]), key
        compared += 1
    assert compared >= 7


@needs_systemd
@pytest.mark.parametrize(("name", "roles"), PROCESSES.items())
def test_systemd_waits_longer_for_the_end_than_the_roles_may_take(
    units: Path, name: str, roles: tuple[str, ...]
) -> None:
    may_take_s = sum(process_sets.PATIENCE_S.get(role, process_sets.STOP_S) for role in roles)
    stop_s = float(plain(resolved(units, f"vical-{name}.service")["TimeoutStopSec"][-1]).split()[0])
    assert stop_s > may_take_s
