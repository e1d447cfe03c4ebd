"""MCAP logs: writing (foxglove-sdk's writer), reading what may be damaged, recovery."""

from vical_daemon.logs.mcap.files import PART_SUFFIX, LogError, describe, is_being_written
from vical_daemon.logs.mcap.folder import LogFolder
from vical_daemon.logs.mcap.reader import LogChannel, LogMessage, LogReader, segments_in, size_now
from vical_daemon.logs.mcap.recover import Recovery, recover, recover_folder, recovered_name
from vical_daemon.logs.mcap.session import Attachment, LogSession
from vical_daemon.logs.mcap.writer import LogWriter

__all__ = [
    "PART_SUFFIX",
    "Attachment",
    "LogChannel",
    "LogError",
    "LogFolder",
    "LogMessage",
    "LogReader",
    "LogSession",
    "LogWriter",
    "Recovery",
    "describe",
    "is_being_written",
    "recover",
    "recover_folder",
    "recovered_name",
    "segments_in",
    "size_now",
]
