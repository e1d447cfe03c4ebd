"""The recorder without its thread: what it records, when it starts and stops, and its status."""

from __future__ import annotations

import json
import logging
import re
import resource
import threading
from importlib.metadata import PackageNotFoundError, version

from vical_drivers.user_files import read_file

from vical_daemon.bus.messages import (
    DiagnosticStatus,
    Level,
    MessageError,
    check_message,
    decode_calibration,
    decode_diagnostics,
    decode_string,
    merge_calibrations,
)
from vical_daemon.bus.topics import CALIBRATION, COMMAND, STATUS, Topic, parse_key
from vical_daemon.config.model import Config
from vical_daemon.config.strict_yaml import MAX_BYTES
from vical_daemon.logs.mcap import Attachment, LogError, LogFolder, LogSession, describe
from vical_daemon.record.images import ImageCompressor
from vical_daemon.record.queue import Arrival, RecordQueue
from vical_daemon.service import notify
from vical_daemon.service.device_serials import DeviceSerials
from vical_daemon.service.wall_clock import WallClock

_log = logging.getLogger(__name__)
_RETRY_NS = 5_000_000_000
_RECOVERY_S = 5.0
_SLOW_S = 5.0
"""A write that takes so long is reported, s. Some cards stall for a second now and then."""
_KEYS = 512
_OF_LIMIT = 0.75
"""Share of the largest file that this process may write (`ulimit -f`) after which the next one begins. The
rest is for what comes before the next look, 0.1 s, an open chunk of 1 MB, index and attachments."""
_REPORTS = 32  # log lines about malformed messages and unknown commands
_PASSWORD = re.compile(rb"""(\bpassword["']?[ \t]*:).*(?:\n[ \t]++(?![\w"']+[ \t]*:).*)*""")
"""The key, and its value with the lines that go on with it."""
_ROLES = ("imu", "camera", "detect", "estimate", "record", "web", "")  # "": tf_static, which has no name


class Recorder:
    """Writes arrivals into segments on the disk, and obeys commands. Never raises because of disk or data."""

    def __init__(self, config: Config, folder: LogFolder, clock: WallClock) -> None:
        self._config, self._folder, self._clock = config, folder, clock
        self._images = ImageCompressor(config)
        self._wanted, self._why_off = config.record.enabled, "off: record.enabled is false"
        self._session: LogSession | None = None
        reserve = f"{config.record.reserve_bytes / 1e6:.0f} MB"
        self._no_room = (
            f"the disk of {folder.path} has reached record.reserve_bytes ({reserve}); waiting for space"
        )
        self._problem = ""
        self._retry_ns = 0
        self._command_key = COMMAND.key(config.rig, "record")
        self._serials = DeviceSerials()
        self._calibrations: dict[str, bytes] = {}
        self._latched: dict[str, bytes] = {}
        self._recovery: threading.Thread | None = None
        self._keys: set[str] = set()
        self._names = {*config.imus, *config.cameras, *_ROLES}
        self._reported: set[str] = set()  # kinds of which a message did not decode
        self._longest_stall_s = 0.0
        self.messages = 0
        self.refused = 0
        self.malformed = 0

    @property
    def recording(self) -> bool:
        """A segment is open."""
        return self._session is not None

    def wants(self, topic: Topic) -> bool:
        """Whether messages of this kind are recorded."""
        return topic.recorded and (self._config.record.images or topic.kind not in ("image", "compressed"))

    def write(self, item: Arrival) -> None:
        """Process one arrival: use it, obey it, record it. Malformed messages are only counted."""
        if not (self._decodes(item) and self._admit(item)):
            return
        self._learn(item)
        if self._session is None:
            return
        key, payload = self._images.as_recorded(item.key, item.payload)
        try:
            self._session.write(key, payload, item.log_time_ns, latched=_latches(item.topic))
            self.messages += 1
        except LogError as error:
            self._fail(str(error))

    def _decodes(self, item: Arrival) -> bool:
        """Whether a message has the type of its key; if not, some readers would refuse the whole file."""
        try:
            check_message(item.topic.type_name, item.payload)
        except MessageError as error:
            self.malformed += 1
            if item.topic.kind not in self._reported:
                self._reported.add(item.topic.kind)
                _log.warning(
                    "%s: not recorded, not a %s: %s; further ones are only counted",
                    item.key[:100],
                    item.topic.type_name,
                    " ".join(str(error).split()),
                )
            return False
        return True

    def _admit(self, item: Arrival) -> bool:
        """Refuse new keys above a limit, so that invented names do not fill memory and log."""
        key = item.key
        if key in self._keys or self._of_the_rig(item):
            return True
        if len(self._keys) >= _KEYS:
            self.refused += 1
            return False
        self._keys.add(key)
        return True

    def _of_the_rig(self, item: Arrival) -> bool:
        """Whether a key belongs to a device or role of the config: those are always recorded."""
        parsed = parse_key(item.key)
        return parsed is not None and parsed.name in self._names

    def _learn(self, item: Arrival) -> None:
        if item.key == self._command_key:
            self._obey(item.payload)
        elif item.topic is CALIBRATION:
            self._calibrations[item.key] = item.payload
        elif item.topic is STATUS:
            self._note_serials(item.payload)
        if _latches(item.topic):
            self._latched[item.key] = item.payload

    def _obey(self, payload: bytes) -> None:
        word = decode_string(payload).strip()
        if word == "start":
            self._wanted, self._retry_ns = True, 0
            self.tick()
        elif word == "stop":
            _log.info("recording stopped by command")
            self._wanted, self._why_off = False, "stopped by command"
            self.close()
        elif word == "split" and self._session is not None:
            self._split()
        elif len(self._reported) < _REPORTS and word[:40] not in self._reported:
            self._reported.add(word[:40])
            _log.warning("command %r is not known: start, stop or split", word[:40])

    def _split(self) -> None:
        """Continue in a new file."""
        if self._session is not None:
            try:
                self._session.rotate(self._clock.now_ns())
            except LogError as error:
                self._fail(str(error))

    def _note_serials(self, payload: bytes) -> None:
        for status in decode_diagnostics(payload).statuses:
            self._serials.note(status)
        if self._serials.replaced:
            self._serials.adopt()
            self._split()  # a file names its devices

    def tick(self) -> None:
        """Do the periodic work: flush, rotate, enforce quota and reserve, restart after a failure."""
        now_ns = self._clock.now_ns()
        try:
            if self._session is not None:
                self._continue(self._session, now_ns)
            elif self._wanted and now_ns >= self._retry_ns:
                self._retry_ns = now_ns + _RETRY_NS
                self._begin(now_ns)
        except (LogError, OSError) as error:
            if self._session is not None and not self._folder.in_place():  # since it was looked for
                self._leave_folder(now_ns)
            elif isinstance(error, LogError):
                self._fail(str(error))
            else:
                self._fail(f"cannot record into {self._folder.path}: {describe(error)}")

    def _leave_folder(self, now_ns: int) -> None:
        self._retry_ns = now_ns  # nothing to wait for
        self._end(f"{self._folder.path} was moved, deleted or replaced; going on in a new file")

    def _continue(self, session: LogSession, now_ns: int) -> None:
        if not self._folder.in_place():
            self._leave_folder(now_ns)
            return
        session.tick(now_ns)
        self._folder.enforce_quota(session.path, session.segment_bytes)
        if not self._folder.has_room():
            self._end(self._no_room)

    def _begin(self, now_ns: int) -> None:
        if not self._folder.lock():
            standing_by = f"standing by: another recorder writes into {self._folder.path}"
            if self._problem != standing_by:
                _log.warning("%s; recording begins when that one ends", standing_by)
            self._problem = standing_by
            return
        self._start_recovery()
        self._folder.enforce_quota()
        if not self._folder.has_room(resuming=bool(self._problem)):
            if self._problem != self._no_room:
                _log.warning("not recording: %s", self._no_room)
            self._problem = self._no_room
            return
        record = self._config.record
        self._session = LogSession(
            self._folder, self._config.rig, now_ns,
            rotate_s=record.rotate_s, rotate_bytes=min(record.rotate_bytes, self._largest_bytes()),
            metadata=self._metadata, attachments=self._attachments,
        )  # fmt: skip
        self._problem = ""
        for key, payload in self._latched.items():
            self._session.write(key, payload, now_ns, latched=True)
        _log.info("recording into %s", self._session.path)

    def _largest_bytes(self) -> int:
        """Size of a file after which the limit of this process demands the next one; says so once."""
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        if limit == resource.RLIM_INFINITY:
            return self._config.record.rotate_bytes
        largest = int(_OF_LIMIT * limit)
        if largest < self._config.record.rotate_bytes and "limit" not in self._reported:
            self._reported.add("limit")
            text = "files may have %.0f MB (ulimit -f): a new one begins after %.0f MB"
            _log.warning(text, limit / 1e6, largest / 1e6)
        return largest

    def _start_recovery(self) -> None:
        """Recover what a crash left, in a thread: a part of 1 GB takes longer than data may wait."""
        if self._recovery is None or not self._recovery.is_alive():
            self._recovery = threading.Thread(target=self._recover, name="log recovery", daemon=True)
            self._recovery.start()

    def _recover(self) -> None:
        try:
            for recovery in self._folder.recover():
                _log.info("recovered %s: %d messages", recovery.output.name, recovery.messages)
        except FileNotFoundError as error:  # moved or deleted meanwhile: `tick` reports a folder that is gone
            _log.info("recovery in %s ended: %s", self._folder.path, error)
        except OSError as error:
            _log.warning("recovery in %s: %s", self._folder.path, error)

    def _end(self, problem: str) -> None:
        session, self._session = self._session, None
        self._problem = problem
        if problem:
            _log.warning("%s", problem)
        if session is not None:
            self._close(session)

    def _close(self, session: LogSession) -> None:
        try:
            session.close(self._clock.now_ns())
        except LogError as error:
            self._problem = str(error)
            _log.error("%s", error)

    def _fail(self, problem: str) -> None:
        """Give up the segment (its part can be recovered) and retry later; log the same problem once."""
        if problem != self._problem:
            _log.error("%s; trying again every %d s", problem, _RETRY_NS // 10**9)
        session, self._session = self._session, None
        self._problem, self._retry_ns = problem, self._clock.now_ns() + _RETRY_NS
        if session is not None:
            try:
                session.close(self._clock.now_ns())
            except LogError:
                pass  # logged already; `recover` repairs the part

    def close(self) -> None:
        """Finish the open segment and let another recorder take over; may be called twice."""
        self._end("")
        if self._recovery is not None:
            self._recovery.join(_RECOVERY_S)
        if self._recovery is None or not self._recovery.is_alive():  # or two processes would recover one part
            self._folder.unlock()

    def _metadata(self) -> dict[str, dict[str, str]]:
        try:
            program = version("vical")
        except PackageNotFoundError:
            program = "unknown"
        about = {"version": program, "rig": self._config.rig, **self._clock.status_values()}
        return {"vical": about, "devices": dict(self._serials.known)}

    def _attachments(self) -> list[Attachment]:
        items = []
        for name, path in (("config.yaml", self._config.path), ("target.yaml", self._config.target_path)):
            if path is not None and path.is_file():
                items.append(Attachment(name, "text/yaml", _without_secrets(read_file(path, MAX_BYTES))))
        estimates = [decode_calibration(payload) for payload in self._calibrations.values()]
        if estimates:
            text = json.dumps(merge_calibrations(estimates).to_json(), indent=1)
            items.append(Attachment("calibration.json", "application/json", text.encode()))
        return items

    def held_up(self, queue: RecordQueue, busy_s: float) -> DiagnosticStatus:
        """Return the status while a write does not return; looks at nothing on the disk.

        Args:
            queue: What waits.
            busy_s: How long it has taken so far, s.
        """
        waiting = f"the disk of {self._folder.path} has taken nothing for {busy_s:.0f} s"
        if busy_s >= _SLOW_S and not self._longest_stall_s:
            _log.warning("%s; data wait in memory, further stalls are in the status alone", waiting)
            notify.event("disk_stalled", waiting, level="warning")
        if busy_s >= _SLOW_S:
            self._longest_stall_s = max(self._longest_stall_s, busy_s)
        message = f"{waiting}, {len(queue)} messages wait in memory"
        values = self._counts(queue) | {"state": "recording" if self._session else "waiting"}
        level = Level.WARN if busy_s >= _SLOW_S else Level.OK
        return DiagnosticStatus(level, "record", message, values=values)

    def _counts(self, queue: RecordQueue) -> dict[str, str]:
        return {
            "messages": str(self.messages),
            "queue_depth": str(len(queue)),
            "dropped": str(sum(queue.dropped.values())),
            "longest_stall_s": f"{self._longest_stall_s:.0f}",
        }

    def status(self, queue: RecordQueue, lost: int) -> DiagnosticStatus:
        """Return the health of the recorder."""
        session = self._session
        values = {
            "state": "recording" if session else ("waiting" if self._wanted else "stopped"),
            "file": session.path.name if session else "",
            "segment_bytes": str(session.segment_bytes if session else 0),
            **self._counts(queue),
            "lost_on_bus": str(lost),
            "refused": str(self.refused),
            "malformed": str(self.malformed),
            "images_not_compressed": str(self._images.failures),
            "files_deleted": str(self._folder.deleted),
        }
        try:
            values["disk_free_bytes"] = str(self._folder.free_bytes())
        except OSError:
            pass  # the folder is missing: `problem` reports it
        if self._problem:
            return DiagnosticStatus(Level.ERROR, "record", self._problem, values=values)
        if session is None:
            message = "not recording" if self._wanted else self._why_off
            return DiagnosticStatus(Level.OK, "record", message, values=values)
        message = f"recording, {self.messages} messages"
        if queue.dropped or lost:
            message = f"{message}; {values['dropped']} dropped, {lost} lost since the start"
            return DiagnosticStatus(Level.WARN, "record", message, values=values)
        return DiagnosticStatus(Level.OK, "record", message, values=values)


def _latches(topic: Topic) -> bool:
    """Whether a segment must start with the last message of a topic, to be readable alone."""
    return topic.kind in ("camera_info", "tf_static")


def _without_secrets(text: bytes) -> bytes:
    """Return a config without its passwords, because logs are shared; whatever way YAML writes the key."""
    return _PASSWORD.sub(rb"\1 removed", text)
