"""Torn and damaged recordings: what is whole is read and recovered, the rest is named."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError, HilError, RecordingError
from hil.core.lock_file import hold_run
from hil.core.typing import StructArray
from hil.recording import Attachment, McapWriter, Recorder, RunDirectory, read_info, read_topic
from hil.recording.mcap_records import ChunkSpan, scan
from hil.recording.recovery import recover, recover_file
from hil.report.run_facts import torn as torn_in_words
from hil.robot.state import CDR_HEADER, STATE_TOPIC
from tests.support.fuzzing import examples, quick_folder
from tests.support.paths import FILES, ROOT
from tests.support.recorded_rows import (
    EPOCH,
    JOINTS,
    raw_topic,
    record_state,
    rows_of,
    six_axis_topic,
)

# `hil recover`: what is whole in a torn file becomes a whole file; the rest is named


ROWS = 40
ROWS_PER_CHUNK = 4
SPEC = Attachment("spec.yaml", "application/yaml", b"hil: 1\n")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[StructArray, bytes]:
    path = tmp_path_factory.mktemp("whole") / "00.mcap"
    rows = record_state(
        path,
        ROWS,
        rows_per_chunk=ROWS_PER_CHUNK,
        joint_names=JOINTS,
        attachments=[SPEC],
        metadata={"run": {"uid": "7"}},
    )
    return rows, path.read_bytes()


@pytest.fixture
def torn(tmp_path: Path, whole: tuple[StructArray, bytes]) -> Path:
    """Half a recording; `rows_before(torn)` of its rows are whole."""
    path = tmp_path / "00.mcap.partial"
    path.write_bytes(whole[1][: len(whole[1]) // 2])
    return path


def chunk_at(path: Path, number: int) -> Any:
    with path.open("rb") as file:
        return scan(file, path).chunks[number]


def flip(path: Path, position: int, bits: int = 0x10) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= bits
    path.write_bytes(content)


def messages_of(path: Path) -> Iterator[tuple[str, int, int, int, bytes]]:
    with path.open("rb") as file:
        for _, channel, m in make_reader(file, validate_crcs=True).iter_messages(
            log_time_order=False
        ):
            yield channel.topic, m.sequence, m.log_time, m.publish_time, m.data


def test_recovered_file_is_whole_and_has_the_rows_that_salvage_reads(torn: Path) -> None:
    salvaged = read_topic(torn, salvage=True)
    recovery = recover_file(torn)
    assert recovery.did == "rebuilt"
    assert 0 < len(salvaged) < ROWS
    assert read_topic(recovery.out).tobytes() == salvaged.tobytes()
    assert read_info(recovery.out).complete


def test_torn_original_is_kept_bit_for_bit_and_read_by_nothing_any_more(torn: Path) -> None:
    content = torn.read_bytes()
    recovery = recover_file(torn)
    assert recovery.torn == torn.with_name("00.mcap.torn")
    assert sorted(path.name for path in torn.parent.iterdir()) == ["00.mcap", "00.mcap.torn"]
    assert (torn.parent / "00.mcap.torn").read_bytes() == content


def test_discard_deletes_the_torn_original(torn: Path) -> None:
    assert recover_file(torn, discard=True).torn is None
    assert [path.name for path in torn.parent.iterdir()] == ["00.mcap"]


def test_metadata_attachments_and_topics_without_messages_are_kept(torn: Path) -> None:
    info = read_info(recover_file(torn).out)
    assert info.metadata["run"] == {"uid": "7"}
    assert info.attachments["spec.yaml"] == SPEC
    assert info.topics["/events"].messages == 0


def test_recovered_file_says_what_it_was_made_from(torn: Path) -> None:
    size = torn.stat().st_size
    told = read_info(recover_file(torn).out).metadata["recovered"]
    assert told["from"] == "00.mcap.partial"
    assert told["from_bytes"] == str(size)
    assert "torn at byte" in told["problem"]


def test_report_counts_what_is_kept_per_topic_and_what_is_lost(torn: Path) -> None:
    size, salvaged = torn.stat().st_size, read_topic(torn, salvage=True)
    recovery = recover_file(torn)
    document = recovery.to_dict()
    kept = {entry["topic"]: entry for entry in document["kept"]}
    assert kept["/robot/state"]["messages"] == len(salvaged)
    assert kept["/robot/state"]["from"] == pytest.approx(EPOCH, abs=1e-6)
    assert kept["/robot/state"]["to"] == pytest.approx(salvaged["host_time"][-1], abs=1e-6)
    tear = int(recovery.problem.split()[3])
    assert recovery.problem.startswith(f"torn at byte {tear} of {size}")
    assert document["lost_bytes"] == size - tear
    words = "\n".join(recovery.to_lines())
    assert f"{len(salvaged)} messages of /robot/state" in words
    assert f"{size - tear} bytes after the tear" in words


def test_whole_file_is_said_to_be_whole_and_left_as_it_is(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    path = tmp_path / "00.mcap"
    path.write_bytes(whole[1])
    recovery = recover_file(path)
    assert recovery.did == "nothing"
    assert "is undamaged" in recovery.to_lines()[0]
    assert [file.name for file in tmp_path.iterdir()] == ["00.mcap"]
    assert path.read_bytes() == whole[1]


def test_whole_file_that_only_lacks_its_name_is_renamed(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    path = tmp_path / "00.mcap.partial"
    path.write_bytes(whole[1])
    assert recover_file(path).did == "renamed"
    assert [file.name for file in tmp_path.iterdir()] == ["00.mcap"]
    assert (tmp_path / "00.mcap").read_bytes() == whole[1]


def test_whole_file_is_made_durable_before_it_gets_its_name(
    tmp_path: Path, whole: tuple[StructArray, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "00.mcap.partial"
    path.write_bytes(whole[1])
    file, synced, fsync = path.stat().st_ino, [], os.fsync

    def noted(descriptor: int) -> None:
        if os.fstat(descriptor).st_ino == file:
            synced.append([entry.name for entry in tmp_path.iterdir()])
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    assert recover_file(path).did == "renamed"
    assert synced == [["00.mcap.partial"]]


def test_damaged_chunk_is_left_out_and_named_with_its_times(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    rows, content = whole
    path = tmp_path / "00.mcap"
    path.write_bytes(content)
    third = chunk_at(path, 2)
    flip(path, third.offset + third.length // 2)
    recovery = recover_file(path)
    (damage,) = recovery.salvage.damages
    assert damage.offset == third.offset
    assert "checksum" in damage.what or "decompress" in damage.what
    first, last = (damage.first_ns * 1e-9 - EPOCH, damage.last_ns * 1e-9 - EPOCH)
    assert (first, last) == pytest.approx((8 / 125, 11 / 125), abs=1e-6)
    expected = np.delete(rows, slice(2 * ROWS_PER_CHUNK, 3 * ROWS_PER_CHUNK))
    assert read_topic(path).tobytes() == expected.tobytes()


def test_wrong_message_index_is_made_anew_without_losing_a_row(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    rows, content = whole
    path = tmp_path / "00.mcap"
    path.write_bytes(content)
    offset, _ = next(iter(chunk_at(path, 2).indexes.values()))
    flip(path, offset - 6, 1 ^ 2)  # from one channel to another
    with pytest.raises(DataError, match="damaged: its summary counts"):
        read_topic(path)
    assert read_topic(path, salvage=True).tobytes() == rows.tobytes()
    recovery = recover_file(path)
    assert (recovery.did, recovery.salvage.misindexed) == ("rebuilt", 1)
    assert read_topic(path).tobytes() == rows.tobytes()


def test_wrong_time_in_a_message_index_is_made_anew(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    """Readers that seek by time go by it, and no checksum covers it."""
    path = tmp_path / "00.mcap"
    path.write_bytes(whole[1])
    offset, _ = next(iter(chunk_at(path, 2).indexes.values()))
    flip(path, offset + 2)
    recovery = recover_file(path)
    assert (recovery.did, recovery.salvage.misindexed) == ("rebuilt", 1)
    assert recover_file(path).did == "nothing"


def test_index_that_its_writer_has_sorted_by_time_is_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = MessageIndex.write

    def sorted_first(index: MessageIndex, out: Any) -> None:
        index.records.sort()
        write(index, out)

    monkeypatch.setattr(MessageIndex, "write", sorted_first)
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "somebody else's")
        channel = writer.register_channel("/late", "bytes", 0)
        for number, time in enumerate([3, 1, 2, 5, 4, 1]):
            writer.add_message(channel, time, b"x", time, number)
        writer.finish()
    content = path.read_bytes()
    recovery = recover_file(path)
    assert (recovery.did, recovery.salvage.misindexed) == ("nothing", 0)
    assert path.read_bytes() == content


def test_spoilt_attachment_is_refused_by_readers_and_left_out(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    rows, content = whole
    path = tmp_path / "00.mcap"
    path.write_bytes(content.replace(b"hil: 1\n", b"hil: 2\n"))
    with pytest.raises(DataError, match=r"spec.yaml.*checksum is wrong"):
        read_topic(path)
    recovery = recover_file(path)
    assert "spec.yaml" in recovery.salvage.damages[0].what
    assert "spec.yaml" not in read_info(path).attachments
    assert read_topic(path).tobytes() == rows.tobytes()


def test_file_without_one_whole_message_has_nothing_to_rescue(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    path = tmp_path / "00.mcap.partial"
    path.write_bytes(whole[1][:700])
    with pytest.raises(DataError, match="contains no message that can be recovered"):
        recover_file(path)
    assert [file.name for file in tmp_path.iterdir()] == ["00.mcap.partial"]


def test_messages_of_a_channel_that_is_nowhere_defined_any_more_are_counted_as_lost(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bag.mcap.partial"
    foreign(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    flip(path, chunk_at(path, 0).offset + 100)
    with pytest.raises(DataError, match="messages without a channel definition"):
        recover_file(path)


def test_first_chunk_damaged_loses_only_its_own_rows(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    rows, content = whole
    path = tmp_path / "00.mcap.partial"
    path.write_bytes(content)
    first = chunk_at(path, 0)
    flip(path, first.offset + first.length // 2)
    path.write_bytes(path.read_bytes()[:-300])
    recover_file(path)
    assert read_topic(tmp_path / "00.mcap").tobytes() == rows[ROWS_PER_CHUNK:].tobytes()


def test_named_output_leaves_the_torn_file_alone(tmp_path: Path, torn: Path) -> None:
    content, out = torn.read_bytes(), tmp_path / "elsewhere.mcap"
    recovery = recover_file(torn, out)
    assert recovery.out == out
    assert len(read_topic(out)) > 0
    assert torn.read_bytes() == content
    with pytest.raises(DataError, match="exists already"):
        recover_file(torn, out)


def test_recovering_again_changes_nothing(torn: Path) -> None:
    out = recover_file(torn).out
    before = {path.name: path.read_bytes() for path in torn.parent.iterdir()}
    assert recover_file(out).did == "nothing"
    assert recover_file(out.with_name("00.mcap.torn")).did == "nothing"
    assert {path.name: path.read_bytes() for path in torn.parent.iterdir()} == before


def test_other_file_of_the_final_name_is_never_replaced(torn: Path) -> None:
    final = torn.with_name("00.mcap")
    record_state(torn.with_name("other.mcap"), 8)
    torn.with_name("other.mcap").rename(final)
    torn_bytes, final_bytes = torn.read_bytes(), final.read_bytes()
    with pytest.raises(DataError, match="with different content"):
        recover_file(torn)
    assert (torn.read_bytes(), final.read_bytes()) == (torn_bytes, final_bytes)


def test_older_torn_file_is_never_replaced(torn: Path) -> None:
    torn.with_name("00.mcap.torn").write_bytes(b"precious")
    with pytest.raises(DataError, match="never replaced"):
        recover_file(torn)
    assert torn.with_name("00.mcap.torn").read_bytes() == b"precious"


PEAK = """
import sys
from pathlib import Path
from hil.recording.recovery import recover_file
recover_file(Path(sys.argv[1]))
# Not ru_maxrss: that of a child counts what its parent had before the exec.
lines = Path("/proc/self/status").read_text().splitlines()
print(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
"""


def peak_of_recovering(folder: Path, rows: int) -> int:
    """Most memory that recovering a file of so many rows needs, in a process of its own."""
    record_state(folder / f"{rows}.mcap", rows, rows_per_chunk=50)
    path = folder / f"{rows}.mcap"
    path.write_bytes(path.read_bytes()[:-1000])
    done = subprocess.run([sys.executable, "-c", PEAK, str(path)], capture_output=True, check=True)
    return int(done.stdout) * 1024


@pytest.mark.thorough
def test_memory_is_bounded_by_a_chunk_and_not_by_the_file(tmp_path: Path) -> None:
    small, large = (peak_of_recovering(tmp_path, rows) for rows in (5_000, 50_000))
    size = (tmp_path / "50000.mcap").stat().st_size
    assert size > 15e6
    assert large - small < size / 3


def test_disk_that_refuses_leaves_the_torn_file(
    torn: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = torn.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(RecordingError, match="No space left"):
        recover_file(torn)
    assert [path.name for path in torn.parent.iterdir()] == ["00.mcap.partial"]
    assert torn.read_bytes() == content


def test_file_that_reads_back_different_is_not_kept(
    torn: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = Writer.add_message

    def forgetful(self: Any, channel: int, log: int, data: bytes, *rest: int) -> None:
        add(self, channel, log, data[:-1] + b"!", *rest)

    monkeypatch.setattr(Writer, "add_message", forgetful)
    with pytest.raises(RecordingError, match="differs from the written data"):
        recover_file(torn)
    assert [path.name for path in torn.parent.iterdir()] == ["00.mcap.partial"]


def foreign(path: Path, **options: Any) -> list[tuple[str, int, int, int, bytes]]:
    """200 JSON messages of three topics, one without a schema, and their contents."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=500, **options)
        writer.start("", "somebody else's")
        schema = writer.register_schema("thing", "jsonschema", b'{"type": "object"}')
        channels = [writer.register_channel(f"/thing/{i}", "json", schema) for i in range(2)]
        channels.append(writer.register_channel("/raw", "bytes", 0, {"a": "b"}))
        out = []
        for i in range(200):
            data = json.dumps({"i": i, "text": "x" * (i % 7)}).encode()
            writer.add_message(channels[i % 3], 10**18 + i, data, 10**18 - i, i)
            out.append((["/thing/0", "/thing/1", "/raw"][i % 3], i, 10**18 + i, 10**18 - i, data))
        writer.finish()  # type: ignore[no-untyped-call]
    return out


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"index_types": IndexType.NONE},
        {"use_chunking": False},
        {"enable_crcs": False},
        {"repeat_channels": False, "repeat_schemas": False},
    ],
    ids=str,
)
def test_torn_files_of_other_writers_keep_every_message_up_to_the_tear(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = tmp_path / "bag.mcap"
    messages = foreign(path, **options)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    recover_file(path)
    kept = list(messages_of(path))
    assert 60 < len(kept) < 200
    assert kept == messages[: len(kept)]


def a_run(root: Path, files: dict[str, bytes]) -> Path:
    run = RunDirectory.create(root, "ur5", "test")
    run.write_start({"uid": "u"})
    for name, content in files.items():
        (run.path / "recording" / name).write_bytes(content)
    return run.path


def test_every_torn_recording_of_a_run_is_recovered_and_logged(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    content = whole[1]
    parts = {
        "00.mcap": content,
        "00.001.mcap.partial": content[:-9],
        "01.mcap.partial": content[: len(content) // 2],
    }
    run = a_run(tmp_path, parts)
    result = recover(run)
    assert [(file.path.name, file.did) for file in result.files] == [
        ("00.001.mcap.partial", "rebuilt"),
        ("01.mcap.partial", "rebuilt"),
    ]
    assert [path.name for path in RunDirectory(run).recordings] == [
        "00.mcap",
        "00.001.mcap",
        "01.mcap",
    ]
    events = [event for event in RunDirectory(run).events() if event["kind"] == "recovered"]
    assert [event["file"] for event in events] == ["00.001.mcap.partial", "01.mcap.partial"]
    assert recover(run).files == ()


def test_one_hopeless_recording_does_not_keep_the_others_from_being_recovered(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    content = whole[1]
    run = a_run(tmp_path, {"00.mcap.partial": content[:700], "01.mcap.partial": content[:-9]})
    result = recover(run)
    assert [file.path.name for file in result.files] == ["01.mcap.partial"]
    assert [path.name for path, _ in result.problems] == ["00.mcap.partial"]
    assert "contains no message that can be recovered" in str(result.error)


@pytest.mark.parametrize("discard", [False, True])
@pytest.mark.parametrize("cut", [0, 9])
def test_recovered_run_still_agrees_with_its_checksums(
    tmp_path: Path, whole: tuple[StructArray, bytes], discard: bool, cut: int
) -> None:
    run = RunDirectory(a_run(tmp_path, {"00.mcap.partial": whole[1][: len(whole[1]) - cut]}))
    run.write_stop("failed", "the disk was full")
    recover(run.path, discard=discard)
    assert run.verify() == []
    (run.path / "recording" / "00.mcap").unlink()
    assert len(run.verify()) == (1 if discard or not cut else 0)


def test_live_run_is_refused(tmp_path: Path, whole: tuple[StructArray, bytes]) -> None:
    run = a_run(tmp_path, {"00.mcap.partial": whole[1][:-9]})
    with hold_run(run):
        for source in (run, run / "recording" / "00.mcap.partial"):
            with pytest.raises(DataError, match="is active"):
                recover(source)
    assert (run / "recording" / "00.mcap.partial").exists()


def test_discard_also_deletes_what_an_earlier_recovery_set_aside(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    run = a_run(tmp_path, {"00.mcap.partial": whole[1][:-9]})
    recover(run)
    assert [file.did for file in recover(run, discard=True).files] == ["discarded"]
    assert [path.name for path in (run / "recording").iterdir()] == ["00.mcap"]


def test_command_tells_in_words_and_in_json(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    run = a_run(tmp_path, {"00.mcap.partial": whole[1][:-9]})
    told = CliRunner().invoke(app, ["recover", str(run), "-o", str(tmp_path / "out")])
    assert told.exit_code == 0
    assert f"kept  {ROWS} messages of /robot/state" in told.output
    document = json.loads(CliRunner().invoke(app, ["recover", str(run), "--json"]).output)
    assert document["problems"] == []
    assert document["files"][0]["did"] == "rebuilt"
    again = CliRunner().invoke(app, ["recover", str(run)])
    assert (again.exit_code, "no truncated or damaged recording" in again.output) == (0, True)


def test_refusal_to_read_a_torn_file_names_the_command(torn: Path) -> None:
    with pytest.raises(DataError) as caught:
        read_topic(torn)
    assert f"hil recover {torn}" in caught.value.hint


def cut_run(folder: Path, content: bytes) -> RunDirectory:
    """A run whose only recording was finished once and cut off later."""
    run = RunDirectory.create(folder, "ur5", "cut")
    run.write_start({"uid": "u"})
    run.part_path(0).write_bytes(content)
    return run


@pytest.mark.parametrize("missing", [1, 8, 9, 300, 2000])
def test_a_finished_file_that_was_cut_off_later_is_recovered_too(
    tmp_path: Path, whole: tuple[StructArray, bytes], missing: int
) -> None:
    run = cut_run(tmp_path, whole[1][:-missing])
    (recovery,) = recover(run.path).files
    assert recovery.did == "rebuilt"
    assert recovery.torn == run.path / "recording" / "00.mcap.torn"
    assert read_info(run.part_path(0)).complete
    assert recover(run.path).files == ()


def test_a_finished_file_that_is_whole_is_left_alone(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    run = cut_run(tmp_path, whole[1])
    result = recover(run.path)
    assert (result.files, result.problems) == ((), ())
    assert [path.name for path in (run.path / "recording").iterdir()] == ["00.mcap"]


def test_a_finished_file_of_which_nothing_is_left_is_a_problem(tmp_path: Path) -> None:
    run = cut_run(tmp_path, b"")
    ((path, error),) = recover(run.path).problems
    assert path == run.part_path(0)
    assert "is no longer an MCAP file" in error.message
    assert "restore it from a backup" in error.hint


def test_a_finished_file_that_is_damaged_in_its_middle_is_recovered_too(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    run = cut_run(tmp_path, whole[1])
    flip(run.part_path(0), chunk_at(run.part_path(0), 1).offset + 100)
    (recovery,) = recover(run.path).files
    assert (recovery.did, recovery.salvage.damaged) == ("rebuilt", 1)
    assert recovery.torn == run.path / "recording" / "00.mcap.torn"
    assert len(read_topic(run.part_path(0))) < ROWS
    assert recover(run.path).files == ()


def test_what_a_damaged_finished_file_left_is_deleted_on_demand(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    run = cut_run(tmp_path, whole[1])
    flip(run.part_path(0), chunk_at(run.part_path(0), 1).offset + 100)
    recover(run.path)
    result = recover(run.path, discard=True)
    assert ([file.did for file in result.files], result.problems) == (["discarded"], ())
    assert [path.name for path in (run.path / "recording").iterdir()] == ["00.mcap"]


def test_a_run_whose_recording_lost_its_beginning_is_told_the_same_by_all(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    run = cut_run(tmp_path, bytes(8) + whole[1][8:])
    run.part_path(1).write_bytes(whole[1])
    ((_, error),) = recover(run.path).problems
    with pytest.raises(DataError) as caught:
        read_topic(run.part_path(0))
    assert (caught.value.message, caught.value.hint) == (error.message, error.hint)
    assert "its first bytes are lost" in error.message
    assert error.hint.endswith("; these recordings of the run are usable: 01.mcap")
    (warning,) = torn_in_words(run)
    assert error.hint in warning
    assert "hil recover" not in warning


def test_a_file_by_itself_without_a_beginning_may_be_of_another_format(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"t,q\n")
    with pytest.raises(DataError, match="magic bytes") as caught:
        read_topic(path)
    assert "hil import" in caught.value.hint


# `hil recover` of parts that no sample had reached: of every run killed early, or at a seam


TOPIC = six_axis_topic()
ROWS_OF_A_PART = 300


def open_part(path: Path) -> McapWriter:
    run = {"run": {"uid": "u"}}
    return McapWriter(path, [TOPIC], metadata=run, attachments=[SPEC], joint_names=JOINTS)


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    run = RunDirectory.create(tmp_path, "ur5", "test")
    run.write_start({"uid": "u"})
    return run


@pytest.fixture
def empty(run: RunDirectory) -> Path:
    """The first part as it is until the first flush."""
    writer = open_part(run.part_path(0))
    writer.abandon()
    return writer.partial_path


def finished(path: Path, rows: int = ROWS_OF_A_PART) -> tuple[bytes, list[ChunkSpan], int]:
    """A part with one chunk per 100 rows: its bytes, its chunks, and where its data end."""
    with open_part(path) as writer:
        for begin in range(0, rows, 100):
            writer.write(STATE_TOPIC, rows_of(TOPIC, 100, first=begin))
            writer.flush(durable=False)
        end = writer.size
    with path.open("rb") as file:
        return path.read_bytes(), scan(file, path).chunks, end


def test_run_killed_before_its_first_flush_recovers_to_an_empty_recording(
    run: RunDirectory, empty: Path
) -> None:
    told = CliRunner().invoke(app, ["recover", str(run.path)])
    assert told.exit_code == 0, told.output
    assert "the process was killed before it wrote samples" in told.output
    (whole,) = run.recordings
    info = read_info(whole)
    assert (whole.name, info.complete) == ("00.mcap", True)
    assert (info.attachments["spec.yaml"], info.metadata["run"]) == (SPEC, {"uid": "u"})
    assert read_topic(whole).dtype == TOPIC.dtype
    assert len(read_topic(whole)) == 0
    with whole.open("rb") as file:
        assert list(make_reader(file, validate_crcs=True).iter_messages()) == []


def test_again_there_is_nothing_left_to_do(run: RunDirectory, empty: Path) -> None:
    assert [file.did for file in recover(run.path).files] == ["empty"]
    assert recover(run.path).files == ()


def test_part_that_lay_ready_when_the_kill_came_does_not_keep_the_run_from_being_recovered(
    run: RunDirectory,
) -> None:
    content, *_ = finished(run.part_path(0))
    run.part_path(0).unlink()
    run.part_path(0).with_suffix(".mcap.partial").write_bytes(content[:-9])
    open_part(run.part_path(0, 1)).abandon()
    result = recover(run.path, discard=True)
    assert (result.error, {file.path.name: file.did for file in result.files}) == (
        None,
        {"00.mcap.partial": "rebuilt", "00.001.mcap.partial": "empty"},
    )
    assert [path.name for path in run.recordings] == ["00.mcap", "00.001.mcap"]
    assert [len(read_topic(path)) for path in run.recordings] == [ROWS_OF_A_PART, 0]
    assert sorted(event["did"] for event in run.events()) == ["empty", "rebuilt"]


def test_part_given_by_its_name_is_as_empty_as_in_its_run(run: RunDirectory, empty: Path) -> None:
    assert [file.did for file in recover(empty).files] == ["empty"]


def test_copies_go_to_another_folder_and_leave_the_part(
    run: RunDirectory, empty: Path, tmp_path: Path
) -> None:
    assert recover(run.path, tmp_path / "out").error is None
    assert len(read_topic(tmp_path / "out" / "00.mcap")) == 0
    assert [path.name for path in run.recordings] == ["00.mcap.partial"]


def test_file_by_itself_without_a_message_has_nothing_to_rescue(
    empty: Path, tmp_path: Path
) -> None:
    alone = empty.rename(tmp_path / "00.mcap.partial")
    with pytest.raises(DataError, match="contains no message that can be recovered"):
        recover(alone)


@pytest.mark.thorough
def test_kill_at_any_byte_of_the_first_write_leaves_an_empty_part(
    run: RunDirectory, empty: Path, tmp_path: Path
) -> None:
    content, chunks, _ = finished(tmp_path / "whole.mcap")
    before = empty.stat().st_size
    written = chunks[0].offset + chunks[0].length
    # Densely where the chunk's head is, then here and there in its content.
    for end in (*range(before, before + 60), *range(before + 60, written, 997), written - 1):
        empty.write_bytes(content[:end])
        result = recover(run.path, tmp_path / f"{end}")
        assert [file.did for file in result.files] == ["empty"], (end, result.error)


@pytest.mark.thorough
def test_kill_at_any_byte_of_the_ending_of_an_empty_part_leaves_an_empty_part(
    run: RunDirectory, empty: Path, tmp_path: Path
) -> None:
    before = empty.stat().st_size
    content, *_ = finished(tmp_path / "whole.mcap", rows=0)
    for end in range(before, len(content), 7):
        empty.write_bytes(content[:end])
        result = recover(run.path, tmp_path / f"{end}")
        assert [file.did for file in result.files] == ["empty"], (end, result.error)


def test_zeros_that_a_power_loss_leaves_are_no_samples(run: RunDirectory, empty: Path) -> None:
    empty.write_bytes(empty.read_bytes() + bytes(5000))
    assert [file.did for file in recover(run.path).files] == ["empty"]


def spoilt_length(content: bytearray, chunk: ChunkSpan) -> None:
    content[chunk.offset - 4] = 1  # the chunk claims to be longer than the file


def spoilt_data(content: bytearray, chunk: ChunkSpan) -> None:
    content[chunk.offset + chunk.length // 2] ^= 1


def spoilt_kind(content: bytearray, chunk: ChunkSpan) -> None:
    content[chunk.offset - 9] = 0x7F


def zeros_first(content: bytearray, chunk: ChunkSpan) -> None:
    content[chunk.offset - 9 : chunk.offset + 100] = bytes(109)


@pytest.mark.parametrize("spoil", [spoilt_length, spoilt_data, spoilt_kind, zeros_first])
def test_part_whose_samples_are_there_but_spoilt_is_not_called_empty(
    run: RunDirectory, empty: Path, tmp_path: Path, spoil: object
) -> None:
    whole, chunks, _ = finished(tmp_path / "whole.mcap", rows=100)
    content = bytearray(whole[:-9])
    spoil(content, chunks[0])  # type: ignore[operator]
    empty.write_bytes(content)
    result = recover(run.path, discard=True)
    assert "contains no message that can be recovered" in str(result.error)
    assert empty.read_bytes() == content


# A recording that is being written is nobody's torn file, whether a run holds it or not


WRITTEN = rows_of(TOPIC, 200)
RECORDING = """
import subprocess, sys
from pathlib import Path
from tests.support.recorded_rows import rows_of, six_axis_topic
from hil.recording import McapWriter
from hil.robot import STATE_TOPIC
writer = McapWriter(Path(sys.argv[1]), [six_axis_topic()])
writer.write(STATE_TOPIC, rows_of(six_axis_topic(), 200))
writer.flush(durable=False)
child = [sys.executable, "-c", "import sys; sys.stdin.read()"]  # lives on until the pipe closes
subprocess.Popen(child, close_fds=False, stdout=subprocess.DEVNULL)
print("recording", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("discard", [False, True])
def test_recording_that_goes_on_is_refused_and_loses_nothing(tmp_path: Path, discard: bool) -> None:
    with Recorder(McapWriter(tmp_path / "x.mcap", [TOPIC]), flush_interval_s=0.005) as recorder:
        recorder.put(STATE_TOPIC, WRITTEN[:100])
        while recorder.backlog:
            time.sleep(0.002)
        with pytest.raises(
            DataError, match=r"x.mcap.partial is being written or recovered by another process"
        ):
            recover(tmp_path / "x.mcap.partial", discard=discard)
        recorder.put(STATE_TOPIC, WRITTEN[100:])
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]
    assert read_topic(tmp_path / "x.mcap").tobytes() == WRITTEN.tobytes()


def test_recording_that_was_given_up_can_be_recovered_at_once(tmp_path: Path) -> None:
    writer = McapWriter(tmp_path / "x.mcap", [TOPIC])
    writer.write(STATE_TOPIC, WRITTEN)
    writer.flush(durable=False)
    writer.abandon()
    assert recover(writer.partial_path).files[0].did == "rebuilt"


@pytest.mark.wire
def test_recording_of_another_process_is_refused_until_that_is_dead(tmp_path: Path) -> None:
    """Whatever programs it has started live on."""
    path = tmp_path / "x.mcap"
    command = [sys.executable, "-c", RECORDING, str(path)]
    tests = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "env": tests}
    with subprocess.Popen(command, **pipes) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"recording\n"
        with pytest.raises(DataError, match="being written"):
            recover(path.with_name("x.mcap.partial"))
        child.kill()
        child.wait()
        assert recover(path.with_name("x.mcap.partial")).files[0].did == "rebuilt"
    assert read_topic(path).tobytes() == WRITTEN.tobytes()


def test_file_systems_without_locks_are_recorded_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with McapWriter(tmp_path / "x.mcap", [TOPIC]) as writer:
        writer.write(STATE_TOPIC, WRITTEN)
    assert read_info(tmp_path / "x.mcap").complete


def test_recording_finished_in_the_instant_it_was_looked_at_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = McapWriter(tmp_path / "x.mcap", [TOPIC])
    writer.write(STATE_TOPIC, WRITTEN)
    lock = fcntl.flock

    def finished_just_before(*arguments: Any) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        writer.finish()
        lock(*arguments)

    monkeypatch.setattr(fcntl, "flock", finished_just_before)
    with pytest.raises(DataError):
        recover_file(writer.partial_path, discard=True)
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]


def test_checksums_leave_out_what_a_hanging_disk_has_not_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "test")
    run.write_start({"uid": "u"})
    fsync, go_on = os.fsync, threading.Event()

    def hanging(descriptor: int) -> None:
        if threading.current_thread().name == "hil-disk":
            go_on.wait(20)
        fsync(descriptor)

    recorder = Recorder(McapWriter(run.part_path(0), [TOPIC]), fsync_interval_s=0.01)
    monkeypatch.setattr(os, "fsync", hanging)
    recorder.put(STATE_TOPIC, WRITTEN)
    with pytest.raises(RecordingError, match="could not be finished"):
        recorder.close(timeout_s=0.3)
    run.write_stop("failed", "the disk hangs")
    go_on.set()
    recorder.close(timeout_s=10)
    assert [path.name for path in run.recordings] == ["00.mcap"]
    assert list((run.stop or {})["sha256"]) == ["start.json"]
    assert run.verify() == []


def test_checksums_have_what_was_given_up(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "test")
    run.write_start({"uid": "u"})
    McapWriter(run.part_path(0), [TOPIC]).abandon()
    run.write_stop("failed", "the disk was full")
    assert list((run.stop or {})["sha256"]) == ["recording/00.mcap.partial", "start.json"]


# Torn anywhere, flipped at any bit: true rows or a clear refusal, never anything else


RAW_TOPIC = raw_topic()
TORN_ROWS, ROWS_OF_A_CHUNK = 12, 3


@cache
def recorded() -> tuple[StructArray, bytes]:
    """A small recording with all a recording has: metadata, attachment, rows, chunks, events."""
    rows = rows_of(RAW_TOPIC, TORN_ROWS)
    plan = Attachment("plan.json", "application/json", b'{"steps": []}')
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "00.mcap")
        metadata = {"run": {"uid": "7"}}
        with McapWriter(path, [RAW_TOPIC], attachments=[plan], metadata=metadata) as writer:
            for begin in range(0, TORN_ROWS, ROWS_OF_A_CHUNK):
                writer.write(RAW_TOPIC.name, rows[begin : begin + ROWS_OF_A_CHUNK])
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
            topics=RAW_TOPIC.name, log_time_order=False
        )
        data = [message.data for _, _, message in messages]
    assert all(one.startswith(CDR_HEADER) for one in data)
    return b"".join(one[len(CDR_HEADER) :] for one in data)


@pytest.mark.parametrize(
    "apart", [pytest.param(7, marks=pytest.mark.thorough), pytest.param(1, marks=pytest.mark.proof)]
)
def test_cut_anywhere_it_is_recovered_up_to_the_tear_or_refused(folder: Path, apart: int) -> None:
    """At every seventh byte or each, and at all beside the beginning, a chunk's end and the end."""
    rows, content = recorded()
    torn, whole = folder / "00.mcap.partial", folder / "00.mcap"
    rows_before, kept = rows_whole_before(torn, content), []
    steps = [0, *(1 + np.flatnonzero(np.diff(rows_before))), len(content)]
    near = {cut for step in steps for cut in range(int(step) - 20, int(step) + 20)}
    cuts = sorted(near & {*range(len(content))} | {*range(0, len(content), apart)})
    for end in cuts:
        torn.write_bytes(content[:end])
        try:
            recovery = recover_file(torn, whole)
        except DataError as refusal:
            kept.append(0 if str(torn) in refusal.message else -1)
            continue
        found = read_topic(whole, RAW_TOPIC.name)
        assert found.dtype == rows.dtype
        assert found.tobytes() == rows[: len(found)].tobytes()
        assert found.tobytes() == read_topic(torn, RAW_TOPIC.name, salvage=True).tobytes()
        assert found.tobytes() == by_mcaps_own_reader(whole)
        assert recovery.lost_bytes == end - int(recovery.problem.split()[3])
        assert not recovery.salvage.damaged
        kept.append(len(found))
        whole.unlink()
    assert kept == sorted(kept)
    assert set(kept) == set(range(0, TORN_ROWS + 1, ROWS_OF_A_CHUNK))
    assert kept == [rows_before[end] for end in cuts]


def rows_whole_before(path: Path, content: bytes) -> list[int]:
    """For every length the file can be cut to: how many rows stand in chunks before the cut."""
    path.write_bytes(content)
    with path.open("rb") as file:
        ends = [chunk.offset + chunk.length for chunk in scan(file, path).chunks]
    return [ROWS_OF_A_CHUNK * sum(end <= cut for end in ends) for cut in range(len(content))]


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
    found = or_refusal(lambda: read_topic(path, RAW_TOPIC.name))
    assert found is None or found.tobytes() == rows.tobytes()
    salvaged = or_refusal(lambda: read_topic(path, RAW_TOPIC.name, salvage=True))
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
    found = or_refusal(lambda: read_topic(whole, RAW_TOPIC.name))
    if found is not None:
        assert is_part_of(found, rows)
        salvaged = or_refusal(lambda: read_topic(path, RAW_TOPIC.name, salvage=True))
        assert salvaged is not None
        assert found.tobytes() == salvaged.tobytes()


# A kill -9 anywhere in a recovery leaves the old state or the new one; again ends in the new


SCRIPT = FILES / "kill_recover.py"


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["00.mcap.partial", "00.mcap"])
@pytest.mark.parametrize("discard", [False, True])
def test_a_kill_at_any_step_leaves_the_old_or_the_new_state(
    tmp_path: Path, name: str, discard: bool
) -> None:
    torn = tmp_path / name
    record_state(tmp_path / "whole.mcap", 100)
    torn.write_bytes((tmp_path / "whole.mcap").read_bytes()[:-3000])
    rows = read_topic(torn, salvage=True).tobytes()
    whole = f"{len(rows) // 416} rows {hashlib.sha256(rows).hexdigest()}"
    original = hashlib.sha256(torn.read_bytes()).hexdigest()

    command = [sys.executable, str(SCRIPT), str(torn), str(tmp_path / "work")]
    command += ["--discard"] if discard else []
    done = subprocess.run(command, capture_output=True, text=True, check=True)

    new, aside = {"00.mcap": whole}, {"00.mcap.torn": original}
    kept = new if discard else new | aside
    # A torn file of another name stands beside the new one for a moment; one that has the final
    # name already has its second name before it loses the first.
    between = {name: original} | (aside if name == "00.mcap" else new)
    allowed = [{name: original}, between, new | aside, kept]
    steps = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(steps) > 12
    for step in steps:
        assert step["dead"] in allowed, step
        assert step["after"] == kept, step
        assert step["drafts"] == [], step


# Torn, damaged and foreign files: all that is whole is read, the rest is one clear error


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
        *range(0, 600, 7),
        *range(600, len(content), 37),
        *range(len(content) - 40, len(content)),
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
    for position in rng.integers(0, len(content), 200):
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
    with pytest.raises(DataError, match="the summary is damaged"):
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
