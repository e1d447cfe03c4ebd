"""Exposure, gain and the automatic controls of a V4L2 camera."""

from __future__ import annotations

import contextlib
import logging

from vical_drivers.camera.settings import CameraSettings
from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.controls import Control, Controls
from vical_drivers.errors import DeviceRefusedError

_log = logging.getLogger(__name__)
_FIXED_EXPOSURE = (abi.EXPOSURE_MANUAL, abi.EXPOSURE_SHUTTER_PRIORITY)
_MOVES_IMAGE = (abi.CID_FOCUS_AUTO, abi.CID_IMAGE_STABILIZATION)
"""Controls that change where a camera sees a point while nothing moves. Most webcams focus by themselves."""


def apply_settings(controls: Controls, settings: CameraSettings) -> None:
    """Write exposure, gain and the named controls; automatic ones are switched off first.

    Raises:
        DeviceRefusedError: The camera has no such control or does not take the value.
    """
    if settings.exposure_s is not None:
        set_exposure(controls, settings.exposure_s)
    if settings.gain is not None:
        _set_gain(controls, settings.gain)
    _hold_lens(controls, settings)
    # a manual value is refused while its automatic control is on, so those go first
    for name, value in sorted(settings.controls.items(), key=lambda item: "auto" not in item[0]):
        controls.set(name, round(value))


def _hold_lens(controls: Controls, settings: CameraSettings) -> None:
    """Switch autofocus and image stabilisation off, unless the settings name them."""
    named = {control.control_id for control in map(controls.find, settings.controls) if control is not None}
    for control_id in _MOVES_IMAGE:
        control = controls.find(control_id)
        if control is None or control_id in named:
            continue
        with contextlib.suppress(DeviceRefusedError):  # announced, and not known: some cameras are like that
            if controls.get(control_id):
                controls.set(control_id, 0)
                _log.warning(
                    "control=%s was=on now=off reason=it changes the lens; name it in controls to keep it on",
                    control.name,
                )


def set_exposure(controls: Controls, exposure_s: float) -> int:
    """Set a fixed exposure time and return the one obtained, ns.

    Raises:
        DeviceRefusedError: The camera cannot, or the time is out of its range.
    """
    exposure = controls.find(abi.CID_EXPOSURE_ABSOLUTE)
    if exposure is None:
        raise DeviceRefusedError(
            "camera: it has no exposure control; leave exposure_s out and state it as assume_exposure_s"
        )
    automatic = controls.find(abi.CID_EXPOSURE_AUTO)
    if automatic is not None:
        mode = next((m for m in _FIXED_EXPOSURE if _offers(automatic, m)), None)
        if mode is not None:
            controls.set(abi.CID_EXPOSURE_AUTO, mode)
    if controls.find(abi.CID_EXPOSURE_AUTO_PRIORITY) is not None:
        # else the camera halves its frame rate in the dark; some refuse it in manual mode, where it is moot
        with contextlib.suppress(DeviceRefusedError):
            controls.set(abi.CID_EXPOSURE_AUTO_PRIORITY, 0)
    value = max(1, round(exposure_s * 1e9 / abi.EXPOSURE_UNIT_NS))
    obtained = controls.set(abi.CID_EXPOSURE_ABSOLUTE, value)
    return obtained * abi.EXPOSURE_UNIT_NS


def _offers(menu: Control, value: int) -> bool:
    return value in menu.menu if menu.menu else menu.minimum <= value <= menu.maximum


def _set_gain(controls: Controls, gain: float) -> None:
    if controls.find(abi.CID_AUTOGAIN) is not None:
        controls.set(abi.CID_AUTOGAIN, 0)
    which = abi.CID_GAIN if controls.find(abi.CID_GAIN) is not None else abi.CID_ANALOGUE_GAIN
    if controls.find(which) is None:
        raise DeviceRefusedError("camera: it has no gain control; leave gain out")
    controls.set(which, round(gain))


def is_automatic(controls: Controls) -> bool:
    """Return whether the camera chooses its exposure itself, and could be told one."""
    if controls.find(abi.CID_EXPOSURE_ABSOLUTE) is None or controls.find(abi.CID_EXPOSURE_AUTO) is None:
        return False
    try:
        return controls.get(abi.CID_EXPOSURE_AUTO) not in _FIXED_EXPOSURE
    except DeviceRefusedError:
        return False


def read_exposure_ns(controls: Controls) -> int | None:
    """Return the exposure time in force, ns; None where unknown or chosen by the camera itself."""
    if controls.find(abi.CID_EXPOSURE_ABSOLUTE) is None:
        return None
    try:
        if controls.find(abi.CID_EXPOSURE_AUTO) is not None:
            mode = controls.get(abi.CID_EXPOSURE_AUTO)
            if mode not in _FIXED_EXPOSURE:
                return None
        return controls.get(abi.CID_EXPOSURE_ABSOLUTE) * abi.EXPOSURE_UNIT_NS
    except DeviceRefusedError as error:  # announced, and not known: some cameras are like that
        _log.warning("exposure=unknown reason=%s", error)
        return None
