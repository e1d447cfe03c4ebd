"""Turns a result of `vical calibrate -o result.json` into Kalibr's file and prints the lever arm."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from vical_daemon.results.export import ExportError, export, rig_from_json


def main(path: str) -> None:
    """Write camchain-imucam.yaml and imu.yaml beside the result."""
    result = Path(path)
    rig = rig_from_json(json.loads(result.read_text(encoding="utf-8")))
    for camera in rig.cameras.values():
        print(
            f"{camera.name} sits at {1e3 * camera.p_imu_cam} mm, "
            f"shift {1e3 * camera.timeshift_cam_imu_s:.3f} ms"
        )
    for file in export(rig, "kalibr"):
        (result.parent / file.name).write_text(file.text, encoding="utf-8")
        print(f"wrote {result.parent / file.name}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: export_result.py result.json")
    try:
        main(sys.argv[1])
    except (OSError, ValueError, ExportError) as error:
        sys.exit(f"{sys.argv[1]}: {error}")
