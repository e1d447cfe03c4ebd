"""How two calibrations differ: results, logs, stores or files of other software."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vical_daemon.estimation.measurements import FloatArray
from vical_daemon.estimation.result import Status
from vical_daemon.offline.camera_names import by_recording
from vical_daemon.offline.errors import InputError
from vical_daemon.offline.sources import read_known
from vical_daemon.results.compare import FALSE_ALARM, Verdict, directions, judge
from vical_daemon.results.difference import Difference, NotComparableError, difference
from vical_daemon.results.export import Rig
from vical_daemon.results.known import LENS, KnownCamera, keys
from vical_daemon.results.pixel_map import PixelMap, lens_displacement_px, lens_error_px, pixel_map

SAME, CHANGED, NOT_COMPARABLE = "same", "changed", "not comparable"
DISTANCES_M = (1.0, 10.0)


@dataclass(frozen=True, slots=True)
class CameraComparison:
    """Two calibrations of one camera.

    Attributes:
        names: What it is called in A and in B.
        why: Why it cannot be compared; "": it can.
        difference: B minus A.
        verdict: Of all of it.
        held: Which of them held its lens at given values while the other estimated it, "a" or "b"; "": none.
        held_off_px: How far off the images of that one put this lens, RMS over the image; None: not known.
        lens_px: How far apart the lenses project, RMS over the image, and its sigma; None: no lens in both.
        maps: Over the image, by distance; empty without lens or image size.
    """

    names: tuple[str, str]
    why: str = ""
    difference: Difference | None = None
    verdict: Verdict | None = None
    held: str = ""
    held_off_px: float | None = None
    lens_px: tuple[float, float] | None = None
    maps: tuple[PixelMap, ...] = ()

    @property
    def word(self) -> str:
        """The verdict in a word."""
        if self.verdict is None:
            return NOT_COMPARABLE
        return CHANGED if self.verdict.changed else SAME


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two calibrations.

    Attributes:
        sources: As named by the user.
        cameras: Those that are in both.
        imu: Bias differences, their joint sigmas and z, 6 each; None: not in both. Not part of the verdict.
        notes: What was assumed, and what is only in one of them.
    """

    sources: tuple[str, str]
    cameras: list[CameraComparison]
    imu: tuple[FloatArray, FloatArray] | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """Changed if any camera is, same if all are."""
        words = {camera.word for camera in self.cameras}
        if CHANGED in words:
            return CHANGED
        return SAME if words == {SAME} else NOT_COMPARABLE

    @property
    def max_px(self) -> float | None:
        """Largest difference over the images; None: there is no map."""
        return _largest([m.apart_px for camera in self.cameras for m in camera.maps])

    @property
    def least_px(self) -> float | None:
        """The same, beyond what both sigmas allow."""
        return _largest([m.least_px for camera in self.cameras for m in camera.maps])

    def document(self) -> dict[str, Any]:
        """Return the comparison as `vical compare --json` prints it."""
        differences, sigmas, z = {}, {}, {}
        for camera in self.cameras:
            apart = camera.difference
            if apart is not None:
                names = keys(apart.model, lens=apart.has_lens)
                differences[camera.names[0]] = dict(zip(names, apart.d.tolist(), strict=True))
                sigmas[camera.names[0]] = dict(zip(names, apart.sigma.tolist(), strict=True))
                z[camera.names[0]] = dict(zip(names, (apart.d / apart.sigma).tolist(), strict=True))
        return {
            "verdict": self.verdict,
            "false_alarm": FALSE_ALARM,
            "max_px": self.max_px,
            "max_px_beyond_sigmas": self.least_px,
            "z": z,
            "differences": differences,
            "joint_sigma": sigmas,
            "cameras": {camera.names[0]: _camera_document(camera) for camera in self.cameras},
            "imu": None if self.imu is None else _imu_document(*self.imu),
            "notes": self.notes,
        }


def compare(
    a: str, b: str, *, camera: str | None = None, distances_m: tuple[float, ...] = DISTANCES_M
) -> Comparison:
    """Compare two sources.

    Args:
        a: Result, store, log or foreign file.
        b: Likewise.
        camera: Only this one.
        distances_m: Of the maps.

    Raises:
        InputError: One of them cannot be read, or holds no such camera.
    """
    known, rigs = zip(*(read_known(source) for source in (a, b)), strict=True)
    wrong = [
        s
        for s, rig in zip((a, b), rigs, strict=True)
        if rig is not None and rig.status == Status.INCONSISTENT
    ]
    pairs, notes = _pairs(known[0], known[1], camera)
    if camera and not pairs:
        raise InputError(f"no camera {camera!r} in both {a} and {b}")
    if wrong:
        why = f"{wrong[0]} is inconsistent: its data contradict each other"
        cameras = [CameraComparison((x.name, y.name), why) for x, y in pairs]
    else:
        cameras = [_compare(x, y, distances_m) for x, y in pairs]
    for x, y in pairs:
        notes += [note for note in (*x.notes, *y.notes) if note not in notes]
    return Comparison((a, b), cameras, _imu(*rigs), notes)


def _pairs(
    a: dict[str, KnownCamera], b: dict[str, KnownCamera], camera: str | None
) -> tuple[list[tuple[KnownCamera, KnownCamera]], list[str]]:
    """Cameras of the same name, or of one topic; of one camera each, whatever their names."""
    a = by_recording(a, {name: known.topic for name, known in a.items()}, b)
    b = by_recording(b, {name: known.topic for name, known in b.items()}, a)
    names = [name for name in a if name in b and camera in (None, name)]
    if not names and camera is None and len(a) == len(b) == 1:
        (x,), (y,) = a.values(), b.values()
        return [(x, y)], [f"{x.name} of the first is compared with {y.name} of the second"]
    only = [
        f"{name} is only in {known[name].source}"
        for known, other in ((a, b), (b, a))
        for name in known
        if name not in other
    ]
    return [(a[name], b[name]) for name in names], only if camera is None else []


def _compare(a: KnownCamera, b: KnownCamera, distances_m: tuple[float, ...]) -> CameraComparison:
    names = (a.name, b.name)
    try:
        apart = difference(a, b)
    except NotComparableError as error:
        return CameraComparison(names, str(error))
    verdict = judge(apart)
    maps = tuple(m for distance_m in distances_m if (m := pixel_map(apart, distance_m)) is not None)
    held = "" if a.lens_held == b.lens_held or not apart.has_lens else "a" if a.lens_held else "b"
    of_held = a if held == "a" else b
    off_px = lens_error_px(of_held) if held and of_held.lens_contradicted else None
    lens_px = None
    if apart.has_lens:
        base = a if apart.model == a.model else b
        lens_px = lens_displacement_px(base, apart.d[LENS], apart.covariance[LENS, LENS])
    return CameraComparison(names, "", apart, verdict, held, off_px, lens_px, maps)


def _imu(a: Rig | None, b: Rig | None) -> tuple[FloatArray, FloatArray] | None:
    """Differences of the biases and their joint sigmas; biases walk: over the time between by walk^2 dt."""
    if a is None or b is None or a.bias_sigmas is None or b.bias_sigmas is None:
        return None
    gyro, accel = (getattr(b, k) - getattr(a, k) for k in ("gyro_bias_rps", "accel_bias_mps2"))
    between_s = abs(b.t_ns - a.t_ns) * 1e-9 if a.t_ns and b.t_ns else 0.0
    walk = np.array([a.noise.gyro_walk] * 3 + [a.noise.accel_walk] * 3)
    return np.concatenate([gyro, accel]), np.sqrt(a.bias_sigmas**2 + b.bias_sigmas**2 + walk**2 * between_s)


def _largest(maps: list[FloatArray]) -> float | None:
    values = [float(np.nanmax(m)) for m in maps if np.isfinite(m).any()]
    return max(values, default=None)


def _camera_document(camera: CameraComparison) -> dict[str, Any]:
    out: dict[str, Any] = {"verdict": camera.word, "reason": camera.why, "name_in_b": camera.names[1]}
    if camera.difference is None or camera.verdict is None:
        return out
    v = camera.verdict
    out |= {"chi_square": v.chi_square, "dof": v.dof, "probability": v.probability, "changed": list(v.blocks)}
    out |= {"common_s": camera.difference.common_s, "lens_models_unlike_px": camera.difference.unlike_px}
    out |= {"lens_held_by": camera.held, "lens_held_off_px": camera.held_off_px}
    out["directions"] = [
        {
            "name": one.name,
            "unit": one.unit,
            "axis": None if one.axis is None else one.axis.tolist(),
            "value": one.value,
            "sigma": one.sigma,
            "z": one.z,
        }
        for one in directions(camera.difference)
    ]
    if camera.lens_px is not None:
        out |= dict(zip(("lens_px", "lens_px_sigma"), camera.lens_px, strict=True))
    out["maps"] = [
        {
            "distance_m": m.distance_m,
            "uv_px": m.uv_px.tolist(),
            "apart_px": m.apart_px.tolist(),
            "least_px": m.least_px.tolist(),
        }
        for m in camera.maps
    ]
    return out


def _imu_document(d: FloatArray, sigma: FloatArray) -> dict[str, Any]:
    names = [f"{k}_{axis}_{u}" for k, u in (("gyro_bias", "rps"), ("accel_bias", "mps2")) for axis in "xyz"]
    return {
        "differences": dict(zip(names, d.tolist(), strict=True)),
        "joint_sigma": dict(zip(names, sigma.tolist(), strict=True)),
        "z": dict(zip(names, (d / sigma).tolist(), strict=True)),
    }
