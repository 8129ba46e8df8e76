"""MCAP bytes of any kind: rows, a description, a recovery or a clear error; bounded in memory."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from lz4.frame import compress as lz4_compress
from mcap.opcode import Opcode

from hil.core.errors import HilError
from hil.core.typing import StructArray
from hil.recording import read_info, read_topic
from hil.recording.recovery import recover_file
from tests.support.fuzzing import examples, quick_folder
from tests.support.recorded_rows import JOINTS, record_state

MAGIC = b"\x89MCAP0\r\n"
HEADER = b"\x04\0\0\0ros2\0\0\0\0"


@cache
def whole() -> tuple[StructArray, bytes]:
    with quick_folder() as folder:
        rows = record_state(folder / "00.mcap", 24, rows_per_chunk=6, joint_names=JOINTS)
        return rows, (folder / "00.mcap").read_bytes()


def outcome(call: Callable[[], Any]) -> Any:
    """What a call gives, None when it is refused in words; every other error is the test's."""
    with contextlib.suppress(HilError):
        return call()
    return None


def look_at(content: bytes) -> StructArray | None:
    """Everything that reads a recording; the rows where there are any."""
    with quick_folder() as folder:
        path = folder / "00.mcap"
        path.write_bytes(content)
        outcome(lambda: read_info(path))
        salvaged = outcome(lambda: read_topic(path, salvage=True))
        recovered = outcome(lambda: recover_file(path, folder / "new.mcap"))
        if recovered is not None and recovered.did == "rebuilt":
            recovered.to_lines(), recovered.to_dict()
            outcome(lambda: read_topic(folder / "new.mcap"))
        assert path.read_bytes() == content
        found: StructArray | None = outcome(lambda: read_topic(path))
        return salvaged if found is None else found


@examples(60)
@given(st.binary(max_size=400))
def test_any_bytes(content: bytes) -> None:
    look_at(content)
    look_at(MAGIC + content)


opcodes = st.sampled_from([*Opcode, 0, 0x10, 0x80, 0xFF])


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    size = len(content) if length is None else length
    return struct.pack("<BQ", opcode, size % 2**64) + content


lengths = st.none() | st.sampled_from([0, 1, 9, 2**31, 2**32, 2**63, 2**64 - 1])


@pytest.mark.thorough
@examples(120)
@given(st.lists(st.tuples(opcodes, st.binary(max_size=80), lengths), max_size=8))
def test_any_records(records: list[tuple[int, bytes, int | None]]) -> None:
    body = b"".join(record(*one) for one in records)
    look_at(MAGIC + record(Opcode.HEADER, HEADER) + body + MAGIC)


@pytest.mark.thorough
@examples(60)
@given(data=st.data())
def test_records_of_a_recording_deleted_doubled_and_swapped(data: st.DataObject) -> None:
    rows, content = whole()
    parts = split(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(parts) - 1))
        how = data.draw(st.sampled_from(["delete", "double", "swap", "retype", "cut"]))
        if how == "delete" and len(parts) > 1:
            del parts[at]
        elif how == "double":
            parts.insert(at, parts[at])
        elif how == "swap":
            parts.append(parts.pop(at))
        elif how == "retype":
            parts[at] = bytes([data.draw(opcodes)]) + parts[at][1:]
        else:
            kept = data.draw(st.integers(9, len(parts[at])))
            parts[at] = record(parts[at][0], parts[at][9:kept])
    found = look_at(MAGIC + b"".join(parts) + MAGIC)
    if found is not None and found.dtype == rows.dtype:
        assert {row.tobytes() for row in found} <= {row.tobytes() for row in rows}


def split(content: bytes) -> list[bytes]:
    """The records of a whole file."""
    at, out = len(MAGIC), []
    while at < len(content) - len(MAGIC):
        length = struct.unpack_from("<Q", content, at + 1)[0]
        out.append(content[at : at + 9 + length])
        at += 9 + length
    return out


def chunk(compression: bytes, claimed: int, data: bytes) -> bytes:
    """A chunk without a checksum that claims to hold so many bytes."""
    head = struct.pack("<QQQI", 1, 2, claimed, 0)
    named = struct.pack("<I", len(compression)) + compression
    return record(Opcode.CHUNK, head + named + struct.pack("<Q", len(data)) + data)


ZEROS = bytes(1 << 24)
BOMBS = {
    "zstd": (b"zstd", zstandard.compress(ZEROS)),
    "zstd without its size": (
        b"zstd",
        zstandard.ZstdCompressor(write_content_size=False).compress(ZEROS),
    ),
    "lz4": (b"lz4", lz4_compress(ZEROS)),
    "unknown": (b"brotli", b"x" * 100),
}


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("claimed", [0, 100, len(ZEROS), 1 << 30, 1 << 40, (1 << 64) - 1])
def test_compressed_bombs(name: str, claimed: int) -> None:
    compression, data = BOMBS[name]
    bomb = chunk(compression, claimed, data)
    assert look_at(MAGIC + record(Opcode.HEADER, HEADER) + bomb) is None


def test_file_that_defines_the_same_channel_anew_in_every_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.recording.salvage._MOST_CHANNELS", 1000)
    schema = struct.pack("<H", 1) + b"\x01\0\0\0a\x01\0\0\0b\0\0\0\0"
    records = [record(Opcode.SCHEMA, schema)]
    for number in range(1_001):
        topic = str(number).encode()
        channel = struct.pack("<HHI", 1, 1, len(topic)) + topic + b"\0\0\0\0" + b"\0\0\0\0"
        message = struct.pack("<HIQQ", 1, 0, number, number) + b"x"
        records += [record(Opcode.CHANNEL, channel), record(Opcode.MESSAGE, message)]
    body = b"".join(records)
    inside = chunk(b"", len(body), body)
    path = tmp_path / "many.mcap"
    path.write_bytes(MAGIC + record(Opcode.HEADER, HEADER) + inside)
    assert outcome(lambda: recover_file(path)) is None
    assert [file.name for file in tmp_path.iterdir()] == ["many.mcap"]
