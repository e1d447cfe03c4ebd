"""`vical verify` on a real recording: EuRoC's against its own calibration, as it is and changed.

python -m benchmarks verify_euroc [--every K]

The whole recording is calibrated once for each lens model. Then stretches of it, begun every 5 s, are
verified against that result, unchanged, and with one block of it changed. With `--every K` the stretches have
each K-th image alone, as of a slower camera.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import json
import math
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.euroc_halves import FOLDER
from vical_daemon.cli import main as vical

BEGINS_S = range(0, 60, 5)


def _moved(camera: dict[str, Any]) -> None:
    camera["T_imu_cam"]["p_m"][0] += 0.01


def _turned(camera: dict[str, Any]) -> None:
    pose = camera["T_imu_cam"]
    now = Rotation.from_quat(pose["q_wxyz"], scalar_first=True) * Rotation.from_rotvec(
        [math.radians(1.0), 0, 0]
    )
    pose["q_wxyz"] = now.as_quat(scalar_first=True).tolist()


def _late(camera: dict[str, Any]) -> None:
    camera["timeshift_cam_imu_s"] += 3e-3


def _focused(camera: dict[str, Any]) -> None:
    camera["intrinsics"][:2] = [1.01 * f for f in camera["intrinsics"][:2]]


CHANGES: dict[str, Callable[[dict[str, Any]], None]] = {
    "nothing": lambda _: None,
    "position 10 mm": _moved,
    "rotation 1 deg": _turned,
    "time shift 3 ms": _late,
    "lens 1 %": _focused,
}


def _asked(*arguments: str) -> dict[str, Any]:
    """What a command prints as JSON."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        vical([*arguments, "--target", str(FOLDER / "target.yaml"), "--json", "--quiet"])
    document: dict[str, Any] = json.loads(out.getvalue())
    return document


def thinned(every: int, place: Path) -> Path:
    """Copy the recording with each `every`-th image alone."""
    folder = place / "recording"
    shutil.copytree(FOLDER, folder)
    corners = folder / "mav0/cam0/corners.csv.gz"
    lines = gzip.decompress(corners.read_bytes()).decode().splitlines()
    stamps = list(dict.fromkeys(x.split(",")[0] for x in lines if not x.startswith("#")))
    kept = set(stamps[::every])
    text = "\n".join(x for x in lines if x.startswith("#") or x.split(",")[0] in kept)
    corners.unlink()
    corners.write_bytes(gzip.compress(text.encode()))
    return folder


def answers(
    initial: Path, recording: Path, place: Path, change: Callable[[dict[str, Any]], None]
) -> list[dict[str, Any]]:
    """Verify all stretches against the calibration of the whole, changed.

    Args:
        recording: Folder of the stretches.
        initial: The lens to start from.
        place: For files.
        change: Changes a camera of the result.
    """
    stored = place / f"{initial.stem}.json"
    if not stored.exists():
        stored.write_text(json.dumps(_asked("calibrate", str(FOLDER), "--initial", str(initial))))
    result = json.loads(stored.read_text())
    change(result["cameras"]["cam0"])
    against = place / "against.json"
    against.write_text(json.dumps(result))
    common = ["verify", str(recording), "--against", str(against), "--initial", str(initial)]
    return [_asked(*common, "--skip", str(s)) for s in BEGINS_S]


def main(argv: list[str]) -> int:
    """Print a row for each change."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks verify_euroc")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="keep each K-th image (default: 1)")
    every_kth = parser.parse_args(argv).every
    print(
        "| lens | changed since | stretches | holds | changed | right block alone | cannot tell | after s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        place, text = Path(name), (FOLDER / "initial.yaml").read_text()
        recording = FOLDER if every_kth == 1 else thinned(every_kth, place)
        for model, row in (("radtan", text), ("plumb_bob", _one_term_more(text))):
            initial = place / f"{model}.yaml"
            initial.write_text(row)
            for what, change in CHANGES.items():
                every = answers(initial, recording, place, change)
                words = [a["verdict"] for a in every]
                right = sum({c["what"] for c in a["changes"]} == {what.rsplit(" ", 2)[0]} for a in every)
                after = [a["seconds_used"] for a in every if a["verdict"] != "cannot tell"]
                cells = [len(words), *(words.count(w) for w in ("holds", "changed")), right]
                spread = f"{np.median(after):.0f}, {max(after):.0f}" if after else "-"
                cells = [model, what, *cells, words.count("cannot tell"), spread]
                print("| " + " | ".join(map(str, cells)) + " |", flush=True)
    return 0


def _one_term_more(text: str) -> str:
    lines = text.replace("radtan", "plumb_bob").splitlines()
    return "\n".join(x.replace("]", ", 0.0]", 1) if "distortion_coeffs" in x else x for x in lines)
