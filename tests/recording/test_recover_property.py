"""Torn at every byte, flipped at any bit: true rows or a clear refusal, never anything else."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from hil.core.errors import DataError, HilError
from hil.core.typing import StructArray
from hil.recording import Attachment, McapWriter, read_info, read_topic
from hil.recording.mcap_records import scan
from hil.recording.recovery import recover_file
from hil.robot.state import CDR_HEADER
from tests.support.fuzzing import examples, quick_folder
from tests.support.recorded_rows import raw_topic, rows_of

TOPIC = raw_topic()
ROWS, ROWS_PER_CHUNK = 12, 3


@cache
def recorded() -> tuple[StructArray, bytes]:
    """A small recording with all a recording has: metadata, attachment, rows, chunks, events."""
    rows = rows_of(TOPIC, ROWS)
    plan = Attachment("plan.json", "application/json", b'{"steps": []}')
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "00.mcap")
        metadata = {"run": {"uid": "7"}}
        with McapWriter(path, [TOPIC], attachments=[plan], metadata=metadata) as writer:
            for begin in range(0, ROWS, ROWS_PER_CHUNK):
                writer.write(TOPIC.name, rows[begin : begin + ROWS_PER_CHUNK])
                writer.write_event({"t": 1.8e9 + begin, "kind": "checkpoint", "step": begin})
                writer.flush(durable=False)
        return rows, path.read_bytes()


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with quick_folder() as folder:
        yield folder


def by_mcaps_own_reader(path: Path) -> bytes:
    """The rows as mcap's indexed reader finds them, checksums verified."""
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(
            topics=TOPIC.name, log_time_order=False
        )
        data = [message.data for _, _, message in messages]
    assert all(one.startswith(CDR_HEADER) for one in data)
    return b"".join(one[len(CDR_HEADER) :] for one in data)


@pytest.mark.thorough
def test_cut_at_every_byte_it_is_recovered_up_to_the_tear_or_refused(
    folder: Path,
) -> None:
    rows, content = recorded()
    torn, whole = folder / "00.mcap.partial", folder / "00.mcap"
    kept = []
    for end in range(len(content)):
        torn.write_bytes(content[:end])
        try:
            recovery = recover_file(torn, whole)
        except DataError as refusal:
            kept.append(0 if str(torn) in refusal.message else -1)
            continue
        found = read_topic(whole, TOPIC.name)
        assert found.dtype == rows.dtype
        assert found.tobytes() == rows[: len(found)].tobytes()
        assert found.tobytes() == read_topic(torn, TOPIC.name, salvage=True).tobytes()
        assert found.tobytes() == by_mcaps_own_reader(whole)
        assert recovery.lost_bytes == end - int(recovery.problem.split()[3])
        assert not recovery.salvage.damaged
        kept.append(len(found))
        whole.unlink()
    assert kept == sorted(kept)
    assert set(kept) == set(range(0, ROWS + 1, ROWS_PER_CHUNK))
    assert kept == rows_whole_before(torn, content)


def rows_whole_before(path: Path, content: bytes) -> list[int]:
    """For every length the file can be cut to: how many rows stand in chunks before the cut."""
    path.write_bytes(content)
    with path.open("rb") as file:
        ends = [chunk.offset + chunk.length for chunk in scan(file, path).chunks]
    return [ROWS_PER_CHUNK * sum(end <= cut for end in ends) for cut in range(len(content))]


def or_refusal(call: Callable[[], Any]) -> Any:
    """What a call gives, None when it is refused; every other error is the test's."""
    with contextlib.suppress(HilError):
        return call()
    return None


def is_part_of(found: StructArray, rows: StructArray) -> bool:
    """Whether all rows found are true ones, in their order, none twice."""
    numbers = {row.tobytes(): number for number, row in enumerate(rows)}
    places = [numbers.get(row.tobytes(), -1) for row in found]
    return -1 not in places and all(np.diff(places) > 0)


flips = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=3
)


def flipped(content: bytes, where: list[tuple[float, int]]) -> bytes:
    damaged = bytearray(content)
    for place, bits in where:
        damaged[int(place * len(damaged))] ^= bits
    return bytes(damaged)


@examples(150)
@given(where=flips)
def test_flipped_bits_in_a_whole_file_give_every_row_or_a_refusal(
    where: list[tuple[float, int]],
    folder: Path,
) -> None:
    rows, content = recorded()
    path = folder / "flipped.mcap"
    path.write_bytes(flipped(content, where))
    or_refusal(lambda: read_info(path))
    found = or_refusal(lambda: read_topic(path, TOPIC.name))
    assert found is None or found.tobytes() == rows.tobytes()
    salvaged = or_refusal(lambda: read_topic(path, TOPIC.name, salvage=True))
    assert salvaged is None or is_part_of(salvaged, rows)


@pytest.mark.thorough
@examples(120)
@given(where=flips, cut=st.floats(0.3, 1))
def test_flipped_bits_in_a_torn_file_are_recovered_as_true_rows_or_refused(
    where: list[tuple[float, int]],
    cut: float,
    folder: Path,
) -> None:
    rows, content = recorded()
    path = folder / "flipped.mcap.partial"
    path.write_bytes(flipped(content[: int(cut * len(content))], where))
    whole = path.with_name("recovered.mcap")
    whole.unlink(missing_ok=True)
    recovery = or_refusal(lambda: recover_file(path, whole))
    if recovery is None or recovery.did == "nothing":
        assert not whole.exists()
        return
    recovery.to_lines(), recovery.to_dict()
    found = or_refusal(lambda: read_topic(whole, TOPIC.name))
    if found is not None:
        assert is_part_of(found, rows)
        salvaged = or_refusal(lambda: read_topic(path, TOPIC.name, salvage=True))
        assert salvaged is not None
        assert found.tobytes() == salvaged.tobytes()
