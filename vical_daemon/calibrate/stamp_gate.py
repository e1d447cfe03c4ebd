"""Lets the messages of one stream pass whose stamps go on from those before; a jump must prove itself.

Stamps cannot be held against the clock of this machine: a replay has those of its log, another host a clock
of its own. But one stream goes on from where it is. One message with a stamp of nonsense, taken at its word,
would make all good ones after it look hours late.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")
REACH_S = 2.0
"""Messages of one stream follow each other within this, s; the slowest cameras that are taken have 1 Hz."""
LEAST_S = 50e-6
"""And not faster than this, s: 20 kHz, above every inertial device that is taken; junk repeats its stamps."""
ENOUGH = 3
"""Messages that agree with each other: two of a random kind may do so by chance."""
PROOF_S = 0.5
"""So long, s, must messages agree before a stream that is known is believed to have jumped: in this time, a
stream that goes on where it was would have shown itself."""
_CHAINS = 64  # sequences followed at a time: among so many stamps of junk a good one is still found


@dataclass(slots=True)
class _Chain(Generic[T]):
    """Messages that go on from each other and not from the stream.

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
        refused: Messages whose stamps did not go on from those before and never proved themselves.
        jumps: How often the stream went on from somewhere else.
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
            among_others: Other streams have such stamps: the first message of this one needs no more proof.

        Returns:
            The stamps and messages that may pass: this one, none yet, or all that proved a beginning or jump.
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
        """End of the data: what there is of a stream too short to prove that it is one."""
        if self._newest_ns is not None:
            self._refuse_all()
            return []
        chains, self._chains = self._chains, []
        return [pair for chain in chains for pair in chain.held]

    def _chain_of(self, stamp_ns: int) -> _Chain[T]:
        """The sequence that a stamp goes on from, moved to the end; a new one where there is none."""
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
        self.refused += sum(len(chain.held) for chain in self._chains)
        self._chains.clear()


def _near(a_ns: int, b_ns: int) -> bool:
    return abs(a_ns - b_ns) <= REACH_S * 1e9
