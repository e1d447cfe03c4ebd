"""Passes the messages of a stream whose stamps are continuous; a jump must be confirmed first.

Stamps cannot be compared with the clock of this machine: a replay has the stamps of its log, and another host
has its own clock. But the stamps of one stream are continuous. If one wrong stamp were accepted, all good
messages after it would look hours late.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")
REACH_S = 2.0
"""Longest step between messages of a stream, s; the slowest supported cameras have 1 Hz."""
LEAST_S = 50e-6
"""Shortest step, s: 20 kHz, above every supported IMU; junk repeats its stamps."""
ENOUGH = 3
"""Consecutive messages that confirm a jump; two may agree by chance."""
PROOF_S = 0.5
"""Time over which messages must agree before a jump of a known stream is accepted, s. If the stream had not
jumped, its next message would have arrived within this time."""
_CHAINS = 64  # candidate sequences kept: a good one is found among this many junk stamps


@dataclass(slots=True)
class _Chain(Generic[T]):
    """Messages that are continuous with each other, but not with the stream.

    Attributes:
        first_ns: Stamp of the first one.
        newest_ns: Stamp of the last one.
        held: The messages.
    """

    first_ns: int
    newest_ns: int
    held: list[tuple[int, T]] = field(default_factory=list)


class StampGate(Generic[T]):
    """The gate of one stream.

    Attributes:
        refused: Messages whose stamps were not continuous and were never confirmed.
        jumps: How often the stream jumped.
    """

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._chains: list[_Chain[T]] = []
        self.refused = 0
        self.jumps = 0

    def push(self, stamp_ns: int, item: T, *, among_others: bool = False) -> list[tuple[int, T]]:
        """Take a message.

        Args:
            stamp_ns: Its stamp.
            item: The message.
            among_others: Other streams have such stamps: the first message needs no confirmation.

        Returns:
            The stamps and messages that pass: this one, none yet, or all that confirmed a start or jump.
        """
        if self._newest_ns is not None and _near(stamp_ns, self._newest_ns):
            self._newest_ns = stamp_ns
            self._refuse_all()
            return [(stamp_ns, item)]
        chain = self._chain_of(stamp_ns)
        chain.newest_ns = stamp_ns
        chain.held.append((stamp_ns, item))
        if len(chain.held) < ENOUGH and not (self._newest_ns is None and among_others):
            return []
        if self._newest_ns is not None and stamp_ns - chain.first_ns < PROOF_S * 1e9:
            return []
        self._chains.remove(chain)
        self._refuse_all()
        self.jumps += self._newest_ns is not None
        self._newest_ns = stamp_ns
        return chain.held

    def flush(self) -> list[tuple[int, T]]:
        """Return, at the end of the data, the messages of a stream too short to be confirmed."""
        if self._newest_ns is not None:
            self._refuse_all()
            return []
        chains, self._chains = self._chains, []
        return [pair for chain in chains for pair in chain.held]

    def _chain_of(self, stamp_ns: int) -> _Chain[T]:
        """Return the sequence that a stamp continues, moved to the end; a new one if there is none."""
        for k in range(len(self._chains) - 1, -1, -1):
            chain = self._chains[k]
            if LEAST_S * 1e9 <= stamp_ns - chain.newest_ns <= REACH_S * 1e9:
                self._chains.append(self._chains.pop(k))
                return chain
        if len(self._chains) >= _CHAINS:
            self._drop(self._chains[0])
        chain = _Chain(stamp_ns, stamp_ns)
        self._chains.append(chain)
        return chain

    def _drop(self, chain: _Chain[T]) -> None:
        self._chains.remove(chain)
        self.refused += len(chain.held)

    def _refuse_all(self) -> None:
        if self._chains:
            self.refused += sum(len(chain.held) for chain in self._chains)
            self._chains.clear()


def _near(a_ns: int, b_ns: int) -> bool:
    return abs(a_ns - b_ns) <= REACH_S * 1e9
