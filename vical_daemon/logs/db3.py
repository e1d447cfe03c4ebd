"""Reads the sqlite files of ROS 2 bags as they are: also without `metadata.yaml`, unfinished, or cut off."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

from vical_drivers.user_files import open_file

from vical_daemon.logs.mcap.chunks import CHUNK_LIMIT, Budget

Item = tuple[str, str, int, bytes]
"""Topic, type, time at which it was recorded (ns), and the message."""
_TOPICS = "SELECT id, name, type FROM topics"
_MESSAGES = "SELECT topic_id, timestamp, data FROM messages ORDER BY id"


def read_db3(paths: list[Path], budget: Budget, warn: Callable[[str], None]) -> Iterator[Item]:
    """Yield the messages of the files of one bag in the order in which they were recorded.

    Args:
        paths: The files.
        budget: Limits what comes out of them: a column may be computed.
        warn: Takes what is damaged, one line each.

    Raises:
        ValueError: None of them can be read; the message completes a sentence.
        SpentError: They hold more than files of their size can.
        OSError: One is no regular file.
    """
    begun, refused = [], []
    for path in paths:
        try:
            begun.append((next((row[2] for row in _rows(path)), 0), path.name, path))
        except sqlite3.Error as error:
            refused.append(f"{path.name} cannot be read: {error}")
    if not begun:
        raise ValueError("; ".join(refused) + "; is it complete? Copy it again")
    for text in refused:
        warn(text)
    for _, _, path in sorted(begun):
        count = 0
        try:
            for row in _rows(path):
                budget.spend(len(row[3]))
                yield row
                count += 1
        except sqlite3.Error as error:
            warn(f"{path.name}: cut off or damaged behind {count} messages ({error}); those are used")


def _rows(path: Path) -> Iterator[Item]:
    with closing(_opened(path)) as database:
        topics = {number: (name, kind) for number, name, kind in database.execute(_TOPICS)}
        for topic, time_ns, data in database.execute(_MESSAGES):
            if topic in topics and isinstance(time_ns, int) and isinstance(data, bytes):
                yield *topics[topic], time_ns, data


def _opened(path: Path) -> sqlite3.Connection:
    """Open a file that nothing will change; its tables must be tables (a view could compute forever).

    Raises:
        sqlite3.Error: It cannot be read, or is none of a bag.
        OSError: It is no regular file.
    """
    open_file(path).close()
    address = path.absolute().as_uri()
    # As it is, without locks and a log of changes, unless there is a log: that holds what a crash left.
    waiting = path.with_name(f"{path.name}-wal")
    unfinished = waiting.is_file() and waiting.stat().st_size > 0
    how = "mode=ro" if unfinished else "immutable=1"
    database = sqlite3.connect(f"{address}?{how}", uri=True, check_same_thread=False)  # played by a thread
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, CHUNK_LIMIT)
        database.execute("PRAGMA trusted_schema=OFF")
        database.execute("PRAGMA writable_schema=ON")  # or a file that is cut off is refused as a whole
        kinds = dict(database.execute("SELECT name, type FROM sqlite_master").fetchall())
        if (kinds.get("topics"), kinds.get("messages")) != ("table", "table"):
            raise sqlite3.DatabaseError("it has no tables of a ROS 2 bag")
    except BaseException:
        database.close()
        raise
    return database
