"""Events of the emulated 7-series: a threshold on an angle triggers a message, as in its vendor's example."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from vical_mocks.mip_filter import AttitudeFilter
from vical_mocks.mip_models import FILTER
from vical_mocks.mip_settings import EVENT_ACTION, EVENT_CONTROL, EVENT_TRIGGER, SettingStore

PERIOD = 10
"""Base samples (1 ms) between two looks at the triggers."""
INSTANCES = 8
"""Triggers and actions that there are."""
_ENABLED, _THRESHOLD, _WINDOW, _MESSAGE = 1, 2, 1, 2
_EULER = 0x05


class Events:
    """Watches the triggers of one device."""

    def __init__(self, settings: SettingStore, attitude: AttitudeFilter) -> None:
        self._settings = settings
        self._attitude = attitude
        self.active: set[int] = set()

    @property
    def enabled(self) -> bool:
        """Some trigger is watched."""
        keys = self._settings.keys(EVENT_CONTROL)
        return any(self._settings.get(EVENT_CONTROL, key)[0] == _ENABLED for key in keys)

    def due(self, k: int) -> Iterator[tuple[int, int, tuple[int, ...]]]:
        """Yield (data set, trigger, field descriptors) of each message that is due at base sample `k`."""
        for key in self._settings.keys(EVENT_CONTROL):
            instance = key[0]
            if self._settings.get(EVENT_CONTROL, key)[0] != _ENABLED or not self._is_active(key, k):
                self.active.discard(instance)
                continue
            begins = instance not in self.active
            self.active.add(instance)
            yield from self._messages(instance, begins, k)

    def _is_active(self, key: bytes, k: int) -> bool:
        """Whether a value is in its window; a window with its bounds reversed is what lies outside."""
        trigger = self._settings.get(EVENT_TRIGGER, key)
        if trigger[0] != _THRESHOLD or len(trigger) != 21:
            return False
        data_set, field, parameter, kind, low, high = struct.unpack(">4B2d", trigger[1:])
        if (data_set, field, kind) != (FILTER, _EULER, _WINDOW) or not 1 <= parameter <= 3:
            return False
        value = self._attitude.euler(k)[parameter - 1]
        return bool(low <= value <= high if low <= high else value < high or value > low)

    def _messages(self, instance: int, begins: bool, k: int) -> Iterator[tuple[int, int, tuple[int, ...]]]:
        for key in self._settings.keys(EVENT_ACTION):
            action = self._settings.get(EVENT_ACTION, key)
            if action[0] != instance or action[1] != _MESSAGE or len(action) < 6:
                continue
            data_set, decimation, count = struct.unpack_from(">BHB", action, 2)
            if begins if decimation == 0 else k % (PERIOD * decimation) == 0:
                yield data_set, instance, tuple(action[6 : 6 + count])
