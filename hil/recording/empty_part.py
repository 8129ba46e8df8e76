"""Is a part without one message just what a kill leaves before the first flush, or a wreck?

Every part lies open for 0.1 s before its first samples reach it, and the next one lies ready while
the last is being filled. Such a part has lost nothing, and is no reason to refuse a run.
"""

from __future__ import annotations

import struct
from typing import IO

from mcap.opcode import Opcode

from hil.recording.mcap_records import RECORD_HEADER, Layout
from hil.recording.salvage import Salvage

_CHUNK_HEAD = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_LONGEST_NAME_BYTES = 16
_MOST_ZEROS = 1 << 22


def never_got_a_message(file: IO[bytes], layout: Layout, salvage: Salvage) -> bool:
    """Whether a torn file held no whole message when its writing ended.

    Its topics must be announced and nothing before the tear be damaged. Behind it there may be
    what one interrupted write leaves: the beginning of the first chunk or of the ending, or
    zeros. Bytes that are none of these may have been samples, however they came to be unreadable.

    Args:
        file: The open file.
        layout: What `scan` found in it.
        salvage: What is whole in it.
    """
    if salvage.tally.messages or salvage.damaged or salvage.orphans or layout.spoilt:
        return False
    if not layout.channels or layout.complete or layout.chunks:
        return False
    return salvage.ended or _is_beginning_of_record(file, layout)


def _is_beginning_of_record(file: IO[bytes], layout: Layout) -> bool:
    rest = layout.size - layout.good_bytes
    file.seek(layout.good_bytes)
    head = file.read(RECORD_HEADER.size)
    if not any(head):
        return rest <= _MOST_ZEROS and not any(file.read(rest))
    if len(head) < RECORD_HEADER.size:
        return head[0] in (Opcode.CHUNK, Opcode.DATA_END)
    opcode, length = RECORD_HEADER.unpack(head)
    if opcode == Opcode.DATA_END:
        return rest <= RECORD_HEADER.size + 4
    return opcode == Opcode.CHUNK and _is_cut_chunk(file, length)


def _is_cut_chunk(file: IO[bytes], length: int) -> bool:
    """Whether a chunk's own head agrees with its length: a wrong one may swallow a whole file."""
    head = file.read(_CHUNK_HEAD.size)
    if len(head) < _CHUNK_HEAD.size:
        return True
    name_bytes = _CHUNK_HEAD.unpack(head)[-1]
    if name_bytes > _LONGEST_NAME_BYTES:
        return False
    rest = file.read(name_bytes + _LENGTH.size)
    if len(rest) < name_bytes + _LENGTH.size:
        return True
    (data_bytes,) = _LENGTH.unpack_from(rest, name_bytes)
    return bool(length == _CHUNK_HEAD.size + name_bytes + _LENGTH.size + data_bytes)
