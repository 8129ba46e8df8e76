"""Logs of a bus: what we write others read, what others write we read."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from hil.can.candump import CandumpWriter, line_of, logged_in, read_candump
from hil.can.frames import ERROR, EXTENDED, REMOTE, Frame
from hil.core.errors import DataError, RecordingError

FRAMES = [
    Frame(0x80, b"", 1699999999.0),
    Frame(0x181, bytes.fromhex("37060000c80a"), 1699999999.123456),
    Frame(0x7FF, bytes(8), 1699999999.2),
    Frame(0x1234567 | EXTENDED, b"\x01", 1699999999.3),
    Frame(0x123 | EXTENDED, b"\xff", 1699999999.3),
    Frame(0x701 | REMOTE, b"", 1699999999.4),
    Frame(0x701 | REMOTE, bytes(3), 1699999999.5),
]
OVERFLOW = Frame(ERROR | 0x04, bytes([0, 2, 0, 0, 0, 0, 0, 0]), 1699999999.6)


def write(path: Path, frames: list[Frame]) -> None:
    with CandumpWriter(path, "can0") as log:
        for frame in frames:
            log.write(frame)


def test_a_line_is_that_of_candump() -> None:
    assert line_of(FRAMES[1], "can0") == "(1699999999.123456) can0 181#37060000C80A"


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write(tmp_path / "bus.log", [*FRAMES, OVERFLOW])
    assert list(read_candump(tmp_path / "bus.log")) == [*FRAMES, OVERFLOW]


def test_python_can_reads_what_we_write(tmp_path: Path) -> None:
    write(tmp_path / "bus.log", FRAMES)
    with can.CanutilsLogReader(tmp_path / "bus.log") as log:
        messages = list(log)
    for frame, message in zip(FRAMES, messages, strict=True):
        assert message.arbitration_id == frame.id & 0x1FFF_FFFF
        assert message.is_extended_id == bool(frame.id & EXTENDED)
        assert message.is_remote_frame == bool(frame.id & REMOTE)
        assert message.dlc == len(frame.data)
        assert message.timestamp == pytest.approx(frame.time_s, abs=1e-6)
        assert message.is_remote_frame or bytes(message.data) == frame.data


def test_we_read_what_python_can_writes(tmp_path: Path) -> None:
    with can.CanutilsLogWriter(tmp_path / "bus.log", channel="can0") as log:
        for frame in FRAMES:
            log.on_message_received(
                can.Message(
                    timestamp=frame.time_s,
                    arbitration_id=frame.id & 0x1FFF_FFFF,
                    is_extended_id=bool(frame.id & EXTENDED),
                    is_remote_frame=bool(frame.id & REMOTE),
                    data=None if frame.id & REMOTE else frame.data,
                )
            )
    read = list(read_candump(tmp_path / "bus.log"))
    assert [frame.id for frame in read] == [frame.id for frame in FRAMES]
    data = [frame for frame in FRAMES if not frame.id & REMOTE]
    assert [frame for frame in read if not frame.id & REMOTE] == data


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("(1.0) can0 181#0", "not a frame"),
        ("(1.0) can0 181#" + 9 * "00", "not a frame"),
        ("(1.0) can0 18#00", "not a frame"),
        ("(1.0) can0 FFF#00", "not a frame"),
        ("(1.0) can0 C0000001#", "not an identifier"),
        ("(nan) can0 181#00", "not a frame"),
        ("1.0 can0 181#00", "not a frame"),
        ("(1.0) can0 181##100", "CAN FD"),
        ("(1.0) can0 181#R9", "not a frame"),
        ("(1.000", "not a frame"),
        ("\udcff\x00", "not a frame"),
    ],
)
def test_a_damaged_line_is_named_with_its_file(tmp_path: Path, line: str, told: str) -> None:
    log = tmp_path / "bus.log"
    whole = line_of(FRAMES[1], "can0")
    log.write_text(f"{whole}\n\n{line}\n{whole}\n", errors="surrogateescape")
    frames = read_candump(log)
    assert next(frames) == FRAMES[1]
    with pytest.raises(DataError, match=told) as raised:
        next(frames)
    assert f"{log}:3: " in str(raised.value)


def test_a_log_of_two_buses_is_read_one_at_a_time(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    lines = [line_of(frame, f"can{number % 2}") for number, frame in enumerate(FRAMES)]
    log.write_text("\n".join(lines))
    assert list(read_candump(log, "can1")) == FRAMES[1::2]
    with pytest.raises(DataError, match=r"bus\.log:2: channel can1 after channel can0"):
        list(read_candump(log))


def test_direction_marks_of_newer_tools_are_accepted() -> None:
    assert logged_in("(1.5) vcan0 080# T\n") == (Frame(0x80, b"", 1.5), "vcan0")


def test_a_log_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.log cannot be read"):
        list(read_candump(tmp_path / "none.log"))


def test_a_log_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"bus\.log cannot be written"):
        CandumpWriter(tmp_path / "missing" / "bus.log")
    with pytest.raises(RecordingError, match="without spaces"):
        CandumpWriter(tmp_path / "bus.log", "can 0")


def test_the_line_that_a_kill_cut_short_is_left_out(tmp_path: Path) -> None:
    log = tmp_path / "torn.log"
    log.write_text("(1.000000) can0 181#0102\n(1.004000) can0 18")
    assert [frame.data for frame in read_candump(log)] == [b"\x01\x02"]
    log.write_text("(1.000000) can0 18\n(1.004000) can0 181#0102\n")
    with pytest.raises(DataError, match=r"torn\.log:1"):
        list(read_candump(log))
