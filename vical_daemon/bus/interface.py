"""The interface of the bus, and the in-memory bus for tests, demo and replay.

Payloads are bytes (ROS 2 CDR, see `bus/messages`); keys and their delivery rules are in `topics`.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, Protocol

from vical_daemon.bus.topics import parse_key


class Sample(NamedTuple):
    """One message on the bus (a tuple because millions of them are made).

    Attributes:
        key: Full key, e.g. ``vical/rig0/imu/imu0``.
        payload: CDR bytes, as recorded.
        sequence: Counted by the publisher per key, from 0; gaps are losses.
    """

    key: str
    payload: bytes
    sequence: int


Handler = Callable[[Sample], None]


class Subscription(Protocol):
    """A bounded queue of received samples, or a handler that gets them."""

    @property
    def dropped(self) -> int:
        """Samples lost to a full queue, or to gaps in the sequence."""
        ...

    def recv(self, timeout_s: float | None = None) -> Sample | None:
        """Return the next sample; None after `timeout_s` (0: at once) or when closed."""
        ...

    def close(self) -> None:
        """Leave; may be called twice."""
        ...


class Bus(Protocol):
    """Publish, subscribe, query the last value. Thread-safe."""

    def publish(self, key: str, payload: bytes) -> None:
        """Send a message with the delivery rules of the `topics` table. Never raises on a slow subscriber."""
        ...

    def subscribe(
        self,
        key_expression: str,
        handler: Handler | None = None,
        *,
        depth: int = 1024,
    ) -> Subscription:
        """Receive the samples of matching keys (``*`` matches one chunk, ``**`` any number).

        Args:
            key_expression: Zenoh key expression.
            handler: Called for each sample (LocalBus: in the publisher's thread, before `publish`
                returns; zenoh: in a thread of its own). None: the caller takes them with `recv`.
            depth: Queue length when there is no handler; a full queue drops what arrives.
        """
        ...

    def latest(self, key_expression: str, timeout_s: float = 1.0) -> list[Sample]:
        """Return the kept last value of each matching key (see `topics`); [] if there is none."""
        ...

    def close(self) -> None:
        """Leave; may be called twice."""
        ...


@lru_cache(maxsize=4096)  # called for each sample, with few different keys
def key_matches(expression: str, key: str) -> bool:
    """Tell whether a key matches a zenoh key expression made of chunks, ``*`` and ``**``.

    >>> key_matches("vical/*/imu/**", "vical/rig0/imu/imu0")
    True
    >>> key_matches("vical/*", "vical/rig0/imu")
    False
    """
    return _match(expression.split("/"), key.split("/"))


def _match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_match(pattern[1:], chunks[i:]) for i in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _match(pattern[1:], chunks[1:])


class SampleQueue:
    """A bounded queue between the bus and a reader. Drops and counts what does not fit."""

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._queue: deque[Sample] = deque()
        self._ready = threading.Condition()
        self._closed = False
        self.dropped = 0

    def put(self, sample: Sample) -> None:
        """Append a sample; a full queue drops it. Never waits."""
        with self._ready:
            if len(self._queue) >= self._depth:
                self.dropped += 1
                return
            self._queue.append(sample)
            self._ready.notify()

    def recv(self, timeout_s: float | None = None) -> Sample | None:
        """Return the next sample, or None after the timeout or once closed and empty."""
        with self._ready:
            self._ready.wait_for(lambda: self._queue or self._closed, timeout_s)
            return self._queue.popleft() if self._queue else None

    def close(self) -> None:
        """Wake the waiting readers; queued samples can still be taken."""
        with self._ready:
            self._closed = True
            self._ready.notify_all()


class LocalSubscription:
    """Subscription of a `LocalBus`."""

    def __init__(self, bus: LocalBus, expression: str, handler: Handler | None, depth: int) -> None:
        self.expression = expression
        self._bus = bus
        self._handler = handler
        self._queue = SampleQueue(depth)

    @property
    def dropped(self) -> int:
        """Samples lost to a full queue."""
        return self._queue.dropped

    def deliver(self, sample: Sample) -> None:
        """Take one sample (called by the bus)."""
        if self._handler is not None:
            self._handler(sample)
        else:
            self._queue.put(sample)

    def recv(self, timeout_s: float | None = None) -> Sample | None:
        """Return the next sample, or None after the timeout or once closed."""
        return self._queue.recv(timeout_s)

    def close(self) -> None:
        """Unsubscribe and wake the waiting readers."""
        self._bus.remove(self)
        self._queue.close()


class LocalBus:
    """Everything in one process, in the order of publication: replays are bit-identical."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._subscriptions: list[LocalSubscription] = []
        self._numbers: dict[str, int] = {}
        self._last: dict[str, Sample] = {}

    def publish(self, key: str, payload: bytes) -> None:
        """Deliver to every matching subscription before returning."""
        with self._lock:
            number = self._numbers.get(key, 0)
            self._numbers[key] = number + 1
            sample = Sample(key, payload, number)
            parsed = parse_key(key)
            if parsed is not None and parsed.topic.keep_last:
                self._last[key] = sample
            targets = [s for s in self._subscriptions if key_matches(s.expression, key)]
        for subscription in targets:
            subscription.deliver(sample)

    def subscribe(
        self,
        key_expression: str,
        handler: Handler | None = None,
        *,
        depth: int = 1024,
    ) -> LocalSubscription:
        """See `Bus.subscribe`."""
        subscription = LocalSubscription(self, key_expression, handler, depth)
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def remove(self, subscription: LocalSubscription) -> None:
        """Forget a subscription (called by its `close`)."""
        with self._lock:
            if subscription in self._subscriptions:
                self._subscriptions.remove(subscription)

    def latest(self, key_expression: str, timeout_s: float = 1.0) -> list[Sample]:  # noqa: ARG002
        """See `Bus.latest`; answers at once."""
        with self._lock:
            return [s for k, s in sorted(self._last.items()) if key_matches(key_expression, k)]

    def close(self) -> None:
        """Close all subscriptions."""
        with self._lock:
            subscriptions = list(self._subscriptions)
        for subscription in subscriptions:
            subscription.close()
