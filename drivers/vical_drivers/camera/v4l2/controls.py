"""Controls of a V4L2 node by name: list, read, write, with ranges in the error messages."""

from __future__ import annotations

import ctypes
import errno
import logging
import os
import re
from dataclasses import dataclass, field

from vical_drivers.camera.v4l2 import abi
from vical_drivers.camera.v4l2.kernel import Kernel
from vical_drivers.camera.v4l2.node import VideoNode, translate
from vical_drivers.errors import DeviceRefusedError

_log = logging.getLogger(__name__)
ALIASES: dict[str, int] = {
    "exposure_absolute": abi.CID_EXPOSURE_ABSOLUTE,
    "exposure_time_absolute": abi.CID_EXPOSURE_ABSOLUTE,
    "auto_exposure": abi.CID_EXPOSURE_AUTO,
    "exposure_auto": abi.CID_EXPOSURE_AUTO,
    "exposure_auto_priority": abi.CID_EXPOSURE_AUTO_PRIORITY,
    "exposure_dynamic_framerate": abi.CID_EXPOSURE_AUTO_PRIORITY,
    "focus_auto": abi.CID_FOCUS_AUTO,
    "focus_automatic_continuous": abi.CID_FOCUS_AUTO,
    "white_balance_temperature_auto": abi.CID_AUTO_WHITE_BALANCE,
    "white_balance_automatic": abi.CID_AUTO_WHITE_BALANCE,
}
"""Names that changed between kernel versions; both are understood."""

_SIMPLE_TYPES = frozenset(
    {
        abi.CTRL_TYPE_INTEGER,
        abi.CTRL_TYPE_BOOLEAN,
        abi.CTRL_TYPE_MENU,
        abi.CTRL_TYPE_INTEGER64,
        abi.CTRL_TYPE_INTEGER_MENU,
        abi.CTRL_TYPE_BUTTON,
    }
)
_ESSENTIAL = (
    abi.CID_EXPOSURE_AUTO,
    abi.CID_EXPOSURE_ABSOLUTE,
    abi.CID_EXPOSURE_AUTO_PRIORITY,
    abi.CID_AUTOGAIN,
    abi.CID_GAIN,
    abi.CID_ANALOGUE_GAIN,
    abi.CID_FOCUS_AUTO,
    abi.CID_IMAGE_STABILIZATION,
    abi.CID_AUTO_WHITE_BALANCE,
)
"""Asked for by number where the list breaks off."""
_STALLED = frozenset(
    {errno.EIO, errno.EPIPE, errno.EILSEQ, errno.ERANGE, errno.ETIMEDOUT, errno.EREMOTEIO, errno.EPROTO}
)
"""What uvcvideo returns where a camera does not know its own controls. A camera that is gone is ENODEV."""
_KINDS = {abi.CTRL_TYPE_BOOLEAN: "boolean", abi.CTRL_TYPE_BUTTON: "button"}


@dataclass(frozen=True, slots=True)
class Control:
    """One control on offer.

    Attributes:
        name: Lower case with underscores, as `v4l2-ctl` prints it.
        control_id: The kernel's number.
        kind: integer, boolean, menu or button (writing any value presses it; it cannot be read).
        minimum, maximum, step, default: Range, in the control's own unit.
        flags: The kernel's CTRL_FLAG_* bits.
        menu: Value -> text, for menus.
    """

    name: str
    control_id: int
    kind: str
    minimum: int
    maximum: int
    step: int
    default: int
    flags: int
    menu: dict[int, str] = field(default_factory=dict)

    @property
    def readable(self) -> bool:
        """Whether it holds a value."""
        return self.kind != "button" and not self.flags & abi.CTRL_FLAG_WRITE_ONLY

    @property
    def range_text(self) -> str:
        """The range in words."""
        if self.menu:
            return ", ".join(f"{value} ({text})" for value, text in sorted(self.menu.items()))
        step = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.minimum} to {self.maximum}{step}"


class Controls:
    """The controls of an open node.

    Args:
        kernel: The system-call boundary.
        node: The open node.
    """

    def __init__(self, kernel: Kernel, node: VideoNode) -> None:
        self._kernel = kernel
        self._node = node
        self._by_id: dict[int, Control] = {}
        for control in self._enumerate():
            self._by_id[control.control_id] = control

    def _enumerate(self) -> list[Control]:
        found: list[Control] = []
        control_id = 0
        while True:
            query = abi.QueryExtCtrl(id=control_id | abi.CTRL_FLAG_NEXT_CTRL)
            try:
                self._kernel.ioctl(self._node.fd, abi.VIDIOC_QUERY_EXT_CTRL, query)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    return found
                if error.errno in _STALLED:
                    # Many kernels end the list at a control that the camera announces and does not know.
                    _log.warning("controls path=%s listed=in part reason=%s", self._node.path, error.strerror)
                    return found + self._asked_by_number({c.control_id for c in found})
                raise translate(error, self._node.path, "list its controls") from error
            control_id = query.id
            if _usable(query):
                found.append(self._describe(query))

    def _asked_by_number(self, known: set[int]) -> list[Control]:
        found = []
        for control_id in _ESSENTIAL:
            query = abi.QueryExtCtrl(id=control_id)
            try:
                self._kernel.ioctl(self._node.fd, abi.VIDIOC_QUERY_EXT_CTRL, query)
            except OSError as error:
                if error.errno in _STALLED or error.errno == errno.EINVAL:
                    continue
                raise translate(error, self._node.path, "list its controls") from error
            if control_id not in known and _usable(query):
                found.append(self._describe(query))
        return found

    def _describe(self, query: abi.QueryExtCtrl) -> Control:
        is_menu = query.type in (abi.CTRL_TYPE_MENU, abi.CTRL_TYPE_INTEGER_MENU)
        kind = "menu" if is_menu else _KINDS.get(query.type, "integer")
        return Control(
            name=control_name(query.name.decode("utf-8", "replace")),
            control_id=query.id,
            kind=kind,
            minimum=query.minimum,
            maximum=query.maximum,
            step=query.step,
            default=query.default_value,
            flags=query.flags,
            menu=self._menu(query) if is_menu else {},
        )

    def _menu(self, query: abi.QueryExtCtrl) -> dict[int, str]:
        menu = {}
        for index in range(query.minimum, query.maximum + 1):
            item = abi.QueryMenu(id=query.id, index=index)
            try:
                self._kernel.ioctl(self._node.fd, abi.VIDIOC_QUERYMENU, item)
            except OSError as error:
                if error.errno == errno.EINVAL:  # menus may have holes
                    continue
                raise translate(error, self._node.path, "list a menu") from error
            if query.type == abi.CTRL_TYPE_INTEGER_MENU:
                menu[index] = str(int.from_bytes(bytes(item)[8:16], "little", signed=True))
            else:
                menu[index] = item.name.decode("utf-8", "replace")
        return menu

    def all(self) -> list[Control]:
        """Return every control on offer."""
        return list(self._by_id.values())

    def find(self, name: str | int) -> Control | None:
        """Return a control by its name, an alias of it, or its number; None where there is none."""
        if isinstance(name, int):
            return self._by_id.get(name)
        wanted = control_name(name)
        for control in self._by_id.values():
            if control.name == wanted:
                return control
        return self._by_id.get(ALIASES.get(wanted, -1))

    def get(self, name: str | int) -> int:
        """Read a control's value, in its own unit."""
        control = self._need(name)
        return self._transfer(abi.VIDIOC_G_EXT_CTRLS, control, 0, f"report its {control.name}")

    def set(self, name: str | int, value: int) -> int:
        """Write a control and return the value that the device took.

        Raises:
            DeviceRefusedError: No such control, out of range, read-only, or inactive because an
                automatic control is on.
        """
        control = self._need(name)
        in_range = control.minimum <= value <= control.maximum and (not control.menu or value in control.menu)
        if not in_range and control.kind != "button":
            raise DeviceRefusedError(
                f"{self._node.path}: {control.name} = {value} is out of range: {control.range_text}"
            )
        if control.flags & abi.CTRL_FLAG_READ_ONLY:
            raise DeviceRefusedError(f"{self._node.path}: {control.name} is read-only")
        return self._transfer(
            abi.VIDIOC_S_EXT_CTRLS,
            control,
            value,
            f"set {control.name} to {value} (range {control.range_text})",
        )

    def _need(self, name: str | int) -> Control:
        control = self.find(name)
        if control is None:
            offered = ", ".join(sorted(c.name for c in self._by_id.values())) or "none"
            raise DeviceRefusedError(f"{self._node.path}: no control {name!r}; it offers: {offered}")
        return control

    def _transfer(self, request: int, control: Control, value: int, doing: str) -> int:
        item = abi.ExtControl(id=control.control_id, value64=value)
        batch = abi.ExtControls(which=abi.CTRL_WHICH_CUR_VAL, count=1, controls=ctypes.pointer(item))
        try:
            self._kernel.ioctl(self._node.fd, request, batch)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EBUSY):
                raise DeviceRefusedError(
                    f"{self._node.path}: cannot {doing}: the control is inactive or grabbed now; "
                    "switch the automatic control of it off first"
                ) from error
            if error.errno in _STALLED:
                raise DeviceRefusedError(
                    f"{self._node.path}: cannot {doing}: the camera answers with an error "
                    f"({os.strerror(error.errno or 0)})"
                ) from error
            raise translate(error, self._node.path, doing) from error
        wide = control.kind == "integer" and (control.minimum < -(1 << 31) or control.maximum >= 1 << 32)
        return int(item.value64) if wide else ctypes.c_int32(item.value64 & 0xFFFFFFFF).value


def _usable(query: abi.QueryExtCtrl) -> bool:
    return query.type in _SIMPLE_TYPES and not query.flags & abi.CTRL_FLAG_DISABLED


def control_name(text: str) -> str:
    """Return a control's name as `v4l2-ctl` writes it.

    >>> control_name("Exposure Time, Absolute")
    'exposure_time_absolute'
    """
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
