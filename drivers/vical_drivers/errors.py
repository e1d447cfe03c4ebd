"""One tree of driver errors; each message names the device and what to try.

Line noise, a lost sample or a bad checksum is *not* an error: it is counted (see `SourceStats`).
"""


class DriverError(Exception):
    """Base of everything a driver raises on purpose; the message is one line for a person."""


class DeviceNotFoundError(DriverError):
    """Nothing answers there, or the path does not exist."""


class DeviceBusyError(DriverError):
    """Another process holds the device."""


class DevicePermissionError(DriverError):
    """The device exists but this user may not open it; the message names the group."""


class DeviceLostError(DriverError):
    """The device was there and went away (unplugged, powered off)."""


class DataEndedError(DriverError):
    """A recording played as a device is at its end: nothing more will come, however long one waits."""


class DeviceReplacedError(DriverError):
    """Another device answers where a known one was; the source has closed itself: open it anew."""


class DeviceTimeoutError(DriverError, TimeoutError):
    """The device is open but stays silent."""


class DeviceRefusedError(DriverError):
    """The device answered and refused: wrong echo, NACK, or a setting that was not taken."""


class MissingLibraryError(DriverError):
    """A system library is not installed; the message names the package."""
