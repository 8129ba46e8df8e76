"""Torn, damaged and foreign files: all that is whole is read, the rest is one clear error."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.core.typing import StructArray
from hil.recording import read_info, read_topic
from tests.support.recorded_rows import JOINTS, record_state

ROWS_PER_CHUNK = 4


@pytest.fixture(scope="module")
def rows_and_bytes(tmp_path_factory: pytest.TempPathFactory) -> tuple[StructArray, bytes]:
    path = tmp_path_factory.mktemp("whole") / "00.mcap"
    rows = record_state(path, 40, rows_per_chunk=ROWS_PER_CHUNK, joint_names=JOINTS)
    return rows, path.read_bytes()


def rows_or_refusal(path: Path) -> StructArray | None:
    """What can be saved of a file, None when it is refused; any other error is the test's."""
    for read in (read_info, read_topic):
        with contextlib.suppress(DataError):
            read(path)
    try:
        return read_topic(path, salvage=True)
    except DataError:
        return None


@pytest.mark.thorough
def test_file_cut_anywhere_gives_its_whole_chunks_or_a_clear_refusal(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    rows, content = rows_and_bytes
    path = tmp_path / "00.mcap.partial"
    lengths = []
    ends = {
        *range(0, 600, 2),
        *range(600, len(content), 13),
        *range(len(content) - 60, len(content)),
    }
    for end in sorted(ends):
        path.write_bytes(content[:end])
        with pytest.raises(DataError, match=str(path)):
            read_topic(path)
        salvaged = rows_or_refusal(path)
        if salvaged is not None:
            assert salvaged.tobytes() == rows[: len(salvaged)].tobytes()
            lengths.append(len(salvaged))
    assert lengths == sorted(lengths)
    assert set(lengths) == {*range(0, 40 + 1, ROWS_PER_CHUNK)}


def test_refusal_of_a_torn_file_counts_what_can_be_read_and_says_how(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    path = tmp_path / "00.mcap"
    path.write_bytes(rows_and_bytes[1][:-9])
    with pytest.raises(DataError, match="10 complete chunks with 40 messages") as caught:
        read_topic(path)
    assert "salvage=True" in caught.value.hint
    info = read_info(path)
    assert not info.complete
    assert "torn at byte" in info.tear


def test_cut_between_a_chunk_and_its_index_loses_nothing(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    rows, content = rows_and_bytes
    path = tmp_path / "00.mcap"
    path.write_bytes(content)
    with path.open("rb") as file:
        from hil.recording.mcap_records import scan

        third = scan(file, path).chunks[2]
    path.write_bytes(content[: third.offset + third.length])
    assert read_topic(path, salvage=True).tobytes() == rows[: 3 * ROWS_PER_CHUNK].tobytes()
    path.write_bytes(content[: third.offset + third.length - 1])
    assert read_topic(path, salvage=True).tobytes() == rows[: 2 * ROWS_PER_CHUNK].tobytes()


def test_zeros_after_a_power_loss_are_a_tear(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    rows, content = rows_and_bytes
    path = tmp_path / "00.mcap"
    half = len(content) // 2
    path.write_bytes(content[:half] + bytes(len(content) - half))
    salvaged = rows_or_refusal(path)
    assert salvaged is not None
    assert 0 < len(salvaged) < 40
    assert salvaged.tobytes() == rows[: len(salvaged)].tobytes()


def test_flipped_bits_in_a_chunk_are_found_and_the_other_chunks_saved(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    rows, content = rows_and_bytes
    path = tmp_path / "00.mcap"
    path.write_bytes(content)
    with path.open("rb") as file:
        from hil.recording.mcap_records import scan

        third = scan(file, path).chunks[2]
    damaged = bytearray(content)
    damaged[third.offset + third.length // 2] ^= 0x10
    path.write_bytes(damaged)
    with pytest.raises(DataError, match=f"damaged: chunk 2 at byte {third.offset}"):
        read_topic(path)
    expected = np.delete(rows, slice(2 * ROWS_PER_CHUNK, 3 * ROWS_PER_CHUNK))
    assert read_topic(path, salvage=True).tobytes() == expected.tobytes()


@pytest.mark.thorough
def test_any_flipped_byte_gives_true_rows_or_a_refusal(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    rows, content = rows_and_bytes
    known = {row.tobytes() for row in rows}
    path = tmp_path / "00.mcap"
    rng = np.random.default_rng(0)
    for position in rng.integers(0, len(content), 600):
        damaged = bytearray(content)
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        salvaged = rows_or_refusal(path)
        if salvaged is not None:
            assert salvaged.dtype == rows.dtype
            assert {row.tobytes() for row in salvaged} <= known


def test_damaged_summary_is_refused_and_the_rows_are_saved_from_the_chunks(
    tmp_path: Path, rows_and_bytes: tuple[StructArray, bytes]
) -> None:
    rows, content = rows_and_bytes
    path = tmp_path / "00.mcap"
    where = content.rindex(b"float64[6] qd_target")
    path.write_bytes(content[:where] + b"float64[6] xx_target" + content[where + 20 :])
    with pytest.raises(DataError, match="its summary is damaged"):
        read_topic(path)
    salvaged = read_topic(path, salvage=True)
    assert salvaged.dtype == rows.dtype
    assert salvaged.tobytes() == rows.tobytes()


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89MCAP", b"time,q1,q2\n0,1,2\n", bytes(4096), b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 9,
     b"\x89MCAP0\r\n\x06" + b"\xff" * 400, b"\x89MCAP0\r\n\x01" + b"\xff" * 7 + b"\x7f" * 90],
    ids=["empty", "short", "csv", "zeros", "magic", "magics", "huge chunk", "huge header"],
)  # fmt: skip
def test_garbage_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "00.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError):
        read_topic(path)
    with pytest.raises(DataError):
        read_topic(path, salvage=True)


def test_missing_file_and_directory_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(DataError, match="cannot read"):
            read_topic(path)
