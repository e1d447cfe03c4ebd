"""The order of the whole run: `pytest -n auto` gives files to whoever is free, so the long ones go first.

A test marked `root` is skipped for everybody else.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# Nothing that our processes do may end in a warning of numpy's; pytest's own filter does not reach children.
os.environ.setdefault("PYTHONWARNINGS", "error::RuntimeWarning")
# Before numpy is imported: its threads make small matrices ten times slower.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
LONGEST_FIRST = (  # in turn those that mostly wait and those that compute: `pytest --durations=0 tests`
    "test_web_page.py",
    "test_calibrator.py",
    "test_shared_memory.py",
    "test_target_free.py",
    "test_gaps.py",
    "test_gx3_faults.py",
    "test_partial_start.py",
    "test_slow_motion.py",
    "test_fast_motion.py",
    "test_mounting_changes.py",
    "test_verify_service.py",
    "test_run_processes.py",
    "test_euroc.py",
    "test_changes.py",
    "test_web_hostile.py",
    "test_any_numbers.py",
    "test_wrong_units.py",
    "test_calibrate.py",
    "test_bus_access.py",
    "test_target_size.py",
    "test_several_recordings.py",
    "test_bus_security.py",
    "test_target_check.py",
    "test_late_camera.py",
    "test_target_modes.py",
    "test_demo_command.py",
    "test_bounded_input.py",
    "test_target_free_options.py",
    "test_verify_live.py",
    "test_structure.py",
    "test_web_phone.py",
    "test_mounting_search.py",
    "test_frame_source_contract.py",
    "test_held_back.py",
    "test_model_selection.py",
    "test_gravity.py",
    "test_rolling_shutter_correction.py",
    "test_calibrate_traffic.py",
    "test_start.py",
    "test_clock_wander.py",
    "test_merge.py",
    "test_target_free_parts.py",
    "test_free_partial.py",
    "test_iidc.py",
    "test_compare_and_verify.py",
    "test_held_lens.py",
    "test_arrival_stamps.py",
    "test_gx3_on_a_terminal.py",
    "test_recording_as_people_have_it.py",
    "test_target_free_statistics.py",
    "test_mounting_watch.py",
    "test_clock_changes.py",
    "test_shared_errors.py",
    "test_aravis.py",
    "test_calibration_with_junk.py",
    "test_consistency.py",
    "test_clock_drift.py",
    "test_wrong_lens.py",
    "test_init.py",
    "test_recording.py",
    "test_window_start.py",
    "test_bus_wait.py",
    "test_calibration_statistics.py",
    "test_luck.py",
)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Workers of `pytest -n auto`: two more than processors, as some files mostly wait; a dozen are long."""
    return min(len(os.sched_getaffinity(0)) + 2, 12)


def pytest_configure(config: pytest.Config) -> None:
    """Let each worker of xdist begin to collect at another file.

    Every worker collects all files. Where there is no bytecode yet, pytest compiles each and rewrites its
    assertions. So the workers share that work: what one comes to later, another has compiled.
    """
    worker = getattr(config, "workerinput", None)
    folders = [Path(arg) for arg in config.args]
    if worker is None or not all(folder.is_dir() for folder in folders):
        return
    files = sorted({str(file) for folder in folders for file in folder.rglob("test_*.py")})
    first = len(files) * int(worker["workerid"].removeprefix("gw")) // worker["workercount"]
    config.args = files[first:] + files[:first]


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Iterator[None]:
    """Put the longest files first (a stable sort: within a file, and after them, the order stays random)."""
    if hasattr(config, "workerinput"):  # each began at another file, and xdist wants one order
        items.sort(key=lambda item: item.path)
    yield
    rank = {name: k for k, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs root, before any of its fixtures."""
    if item.get_closest_marker("root") and os.geteuid() != 0:
        pytest.skip("needs root: sudo .venv/bin/python -m pytest -m root tests")


def pytest_collection_finish() -> None:
    """Keep Python's garbage collector from looking again and again through thousands of collected tests."""
    gc.collect()
    gc.freeze()
