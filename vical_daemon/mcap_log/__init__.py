"""MCAP logs: writing (foxglove-sdk's writer), reading what may be damaged, recovery."""

from vical_daemon.mcap_log.files import PART_SUFFIX, LogError, is_being_written
from vical_daemon.mcap_log.folder import LogFolder
from vical_daemon.mcap_log.reader import LogChannel, LogMessage, LogReader
from vical_daemon.mcap_log.recover import Recovery, recover, recover_folder, recovered_name
from vical_daemon.mcap_log.session import Attachment, LogSession
from vical_daemon.mcap_log.writer import LogWriter

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
    "is_being_written",
    "recover",
    "recover_folder",
    "recovered_name",
]
