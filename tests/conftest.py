"""The order of the whole run: `pytest -n 2` gives files to whoever is free, so the long ones go first.

A test marked `root` is skipped for everybody else.
"""

from __future__ import annotations

import os

import pytest

# Nothing that our processes do may end in a warning of numpy's; pytest's own filter does not reach children.
os.environ.setdefault("PYTHONWARNINGS", "error::RuntimeWarning")
# Before numpy is imported: its threads make small matrices ten times slower.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
LONGEST_FIRST = (
    "test_euroc.py",
    "test_calibrator.py",
    "test_calibration_statistics.py",
    "test_iidc.py",
    "test_calibrate.py",
    "test_demo_command.py",
    "test_run_processes.py",
    "test_td_icp_command.py",
    "test_gx3_on_a_terminal.py",
    "test_simulated_camera.py",
    "test_record_over_zenoh.py",
    "test_calibration_filter.py",
    "test_tracks.py",
)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first (a stable sort: within a file, and after them, the order stays random)."""
    rank = {name: k for k, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs root, before any of its fixtures."""
    if item.get_closest_marker("root") and os.geteuid() != 0:
        pytest.skip("needs root: sudo .venv/bin/python -m pytest -m root tests")
