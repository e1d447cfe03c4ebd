"""The state as Prometheus metrics (text exposition format 0.0.4)."""

from __future__ import annotations

import math
import re

from vical_daemon.estimation.result import Status
from vical_daemon.web.state import WebState, is_stale

_NAME = re.compile(r"[^a-zA-Z0-9_]")


def metrics(state: WebState) -> str:
    """Return all metrics: calibration per camera, level and every numeric counter per component.

    A camera whose estimates have stopped has no status; its age shows it.
    """
    families: dict[str, tuple[str, list[str]]] = {}

    def add(name: str, help_text: str, labels: dict[str, str], value: float) -> None:
        if math.isfinite(value):
            inner = ",".join(f'{k}="{_escape(v)}"' for k, v in labels.items())
            families.setdefault(name, (help_text, []))[1].append(f"{name}{{{inner}}} {value!r}")

    for camera, (message, age_s) in sorted(state.calibrations.items()):
        labels = {"rig": state.rig, "camera": camera}
        estimate, known = message.estimate, message.camera_estimate
        for status in Status:
            add(
                "vical_calibration_status", "1 for the status it is in.",
                labels | {"status": str(status)}, float(status is estimate.status and not is_stale(age_s)),
            )  # fmt: skip
        add("vical_calibration_age_seconds", "Since the last estimate.", labels, round(age_s, 3))
        add("vical_calibration_progress", "0 to 1.", labels, estimate.progress)
        add("vical_calibration_nis_per_dof", "1 when consistent.", labels, estimate.nis_per_dof)
        add("vical_calibration_rejected_fraction", "Refused share.", labels, estimate.rejected_fraction)
        if known is None:
            continue
        add("vical_timeshift_seconds", "t_imu = t_cam + shift.", labels, known.timeshift_cam_imu_s)
        add("vical_timeshift_sigma_seconds", "Its standard deviation.", labels, known.timeshift_sigma_s)
        for i, axis in enumerate("xyz"):
            own = labels | {"axis": axis}
            variance = known.T_imu_cam.covariance
            add("vical_lever_arm_meters", "Camera in the imu frame.", own, known.T_imu_cam.p_m[i])
            add("vical_lever_arm_sigma_meters", "Its sigma.", own, math.sqrt(max(variance[i][i], 0)))
            sigma = math.sqrt(max(variance[i + 3][i + 3], 0))
            add("vical_rotation_sigma_radians", "Sigma of R_imu_cam about cam axes.", own, sigma)
    for role, statuses in sorted(state.statuses.items()):
        for component in statuses:
            labels = {"rig": state.rig, "role": role, "component": component.name}
            level_help = "0 ok, 1 warning, 2 error, 3 stale."
            add("vical_component_level", level_help, labels, float(component.level))
            for key, text in component.values.items():
                value = _number(text)
                if value is not None:
                    name = f"vical_component_{_NAME.sub('_', key)}"
                    add(name, "As in the status of the component.", labels, value)
    return "".join(
        f"# HELP {name} {help_text}\n# TYPE {name} gauge\n" + "\n".join(lines) + "\n"
        for name, (help_text, lines) in families.items()
    )


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
