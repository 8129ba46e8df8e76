"""`hil recover`: what is whole in a torn file becomes a whole file; the rest is named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError, RecordingError
from hil.core.lock_file import hold_run
from hil.core.typing import StructArray
from hil.recording import Attachment, RunDirectory, read_info, read_topic
from hil.recording.mcap_records import scan
from hil.recording.recovery import recover, recover_file
from hil.report.run_facts import torn as torn_in_words
from tests.support.recorded_rows import EPOCH, JOINTS, record_state

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
    assert f"{size - tear} bytes behind the tear" in words


def test_whole_file_is_said_to_be_whole_and_left_as_it_is(
    tmp_path: Path, whole: tuple[StructArray, bytes]
) -> None:
    path = tmp_path / "00.mcap"
    path.write_bytes(whole[1])
    recovery = recover_file(path)
    assert recovery.did == "nothing"
    assert "is whole" in recovery.to_lines()[0]
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
    with pytest.raises(DataError, match="nothing to rescue"):
        recover_file(path)
    assert [file.name for file in tmp_path.iterdir()] == ["00.mcap.partial"]


def test_messages_of_a_channel_that_is_nowhere_defined_any_more_are_counted_as_lost(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bag.mcap.partial"
    foreign(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    flip(path, chunk_at(path, 0).offset + 100)
    with pytest.raises(DataError, match="messages of which nothing says what they are"):
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
    with pytest.raises(DataError, match="holds something else"):
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
    with pytest.raises(RecordingError, match="reads back different"):
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
    assert "nothing to rescue" in str(result.error)


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
            with pytest.raises(DataError, match="is running"):
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
    assert (again.exit_code, "no torn or damaged recording" in again.output) == (0, True)


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
    assert "is not an MCAP file" in error.message
    assert "take it from a copy" in error.hint


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
    assert "its beginning is lost" in error.message
    assert error.hint.endswith("take it from a copy; usable by itself is 01.mcap beside it")
    (warning,) = torn_in_words(run)
    assert error.hint in warning
    assert "hil recover" not in warning


def test_a_file_by_itself_without_a_beginning_may_be_of_another_format(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"t,q\n")
    with pytest.raises(DataError, match="magic bytes") as caught:
        read_topic(path)
    assert "hil import" in caught.value.hint
