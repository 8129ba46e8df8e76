"""Do the message indexes behind a chunk lead to its messages? No checksum covers them."""

from __future__ import annotations

from collections import defaultdict
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from hil.recording.mcap_records import INDEX_ENTRY_BYTES, INDEX_HEADER


class IndexCheck:
    """Told of every message of a chunk, then of every index behind it; counts wrong chunks.

    A chunk without any index is right: writers may leave them out.
    """

    def __init__(self) -> None:
        self.wrong = 0
        self._expected: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._seen = self._failed = self._ignored = False

    def expect(self, channel: int, log_ns: int, offset: int) -> None:
        """A message of the chunk."""
        self._expected[channel].append((log_ns, offset))

    def see(self, file: IO[bytes], offset: int, length: int) -> None:
        """A message index: where its content is in the file."""
        self._seen = True
        if length < INDEX_HEADER.size:
            self._failed = True
            return
        file.seek(offset)
        channel, _ = INDEX_HEADER.unpack(file.read(INDEX_HEADER.size))
        expected = self._expected.pop(channel, [])
        # Only an index of the right length is read: a wrong one may claim the whole file.
        if length != INDEX_HEADER.size + INDEX_ENTRY_BYTES * len(expected):
            self._failed = True
            return
        entries = np.frombuffer(file.read(INDEX_ENTRY_BYTES * len(expected)), "<u8")
        # Some writers sort the entries by time, others leave them as the messages came.
        found, wanted = (_sorted(pairs) for pairs in (entries, expected))
        self._failed |= not np.array_equal(found, wanted)

    def ignore_chunk(self) -> None:
        """The chunk is damaged, so nothing is known of its messages."""
        self._ignored = True

    def end_chunk(self) -> None:
        """The indexes of this chunk are over."""
        failed = self._failed or bool(self._expected)
        self.wrong += self._seen and failed and not self._ignored
        self._expected.clear()
        self._seen = self._failed = self._ignored = False


def _sorted(pairs: Any) -> NDArray[np.uint64]:
    """(N, 2) log times [ns] and offsets, by time and then by offset."""
    table = np.asarray(pairs, np.uint64).reshape(-1, 2)
    return table[np.lexsort((table[:, 1], table[:, 0]))]
