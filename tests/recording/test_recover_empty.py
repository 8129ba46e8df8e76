"""`hil recover` of parts that no sample had reached: of every run killed early, or at a seam."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError
from hil.recording import Attachment, McapWriter, RunDirectory, read_info, read_topic
from hil.recording.mcap_records import ChunkSpan, scan
from hil.recording.recovery import recover
from hil.robot.state import STATE_TOPIC
from tests.support.recorded_rows import JOINTS, rows_of, six_axis_topic

TOPIC = six_axis_topic()
SPEC = Attachment("spec.yaml", "application/yaml", b"hil: 1\n")
ROWS = 300


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


def finished(path: Path, rows: int = ROWS) -> tuple[bytes, list[ChunkSpan], int]:
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
    assert "the kill came before its first samples reached it" in told.output
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
    assert [len(read_topic(path)) for path in run.recordings] == [ROWS, 0]
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
    with pytest.raises(DataError, match="nothing to rescue"):
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
    assert "nothing to rescue" in str(result.error)
    assert empty.read_bytes() == content
