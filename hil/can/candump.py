"""Reading and writing of bus logs in the text format of `candump -L`, one line per frame.

All CAN tools read the format of `candump -L`. For example, the line `(1699999999.123456) can0
181#37060000C80A` contains the Unix time [s], the channel, and the identifier and the data in
hexadecimal.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from hil.can.frames import ERROR, EXTENDED, ID_MASK, REMOTE, Frame
from hil.core import DataError, RecordingError

_LINE = re.compile(
    r"\((?P<time>\d{1,12}\.\d{1,9})\)\s+(?P<channel>\S+)\s+"
    r"(?P<id>[0-7][0-9A-Fa-f]{2}|[0-9A-Fa-f]{8})#"
    r"(?:R(?P<length>[0-8]?)|(?P<data>(?:[0-9A-Fa-f]{2}){0,8}))(?:\s+[RT])?",
    re.ASCII,
)


class Logged(NamedTuple):
    """Content of one line of a log: frame and channel.

    Attributes:
        frame: Frame with the time of its reception.
        channel: Channel on which the frame was received.
    """

    frame: Frame
    channel: str


def line_of(frame: Frame, channel: str) -> str:
    """Return a frame as a line of a log, without the end of line."""
    flags, can_id = frame.id & ~ID_MASK, frame.id & ID_MASK
    if flags & ERROR:
        name = f"{can_id | ERROR:08X}"
    else:
        name = f"{can_id:08X}" if flags & EXTENDED else f"{can_id:03X}"
    text = f"R{len(frame.data) or ''}" if flags & REMOTE else frame.data.hex().upper()
    return f"({frame.time_s:.6f}) {channel} {name}#{text}"


def logged_in(line: str) -> Logged:
    """Return the frame and the channel in a line of a log.

    Raises:
        ValueError: The line does not contain a frame, or the frame is not classic CAN.
    """
    match = _LINE.fullmatch(line.strip())
    if match is None:
        is_fd = "##" in line
        raise ValueError("a CAN FD frame" if is_fd else f"not a frame: {line.strip()[:60]!r}")
    can_id = _identifier(match["id"])
    if match["data"] is None:
        can_id, data = can_id | REMOTE, bytes(int(match["length"] or 0))
    else:
        data = bytes.fromhex(match["data"])
    return Logged(Frame(can_id, data, float(match["time"])), match["channel"])


def _identifier(text: str) -> int:
    can_id = int(text, 16)
    if len(text) == 3 or (can_id & ERROR and not can_id & (EXTENDED | REMOTE)):
        return can_id
    if can_id & ~ID_MASK:
        raise ValueError(f"not an identifier: {text}")
    return can_id | EXTENDED


def read_candump(path: str | os.PathLike[str], channel: str | None = None) -> Iterator[Frame]:
    """Yield all frames of a log in the order of its lines.

    Args:
        path: Path of the log; empty lines and an incomplete last line are skipped.
        channel: Channel to read; `None` for a log with only one channel.

    Raises:
        DataError: The log is unreadable, a line is damaged, or the log has several channels and
            `channel` is None; the message contains file and line.
    """
    only = channel
    for where, logged in _logged(Path(path)):
        if channel is None:
            only = only or logged.channel
            if logged.channel != only:
                raise DataError(
                    f"{where}: channel {logged.channel} after channel {only}",
                    hint="select the channel to read",
                )
        if logged.channel == only:
            yield logged.frame


def _logged(path: Path) -> Iterator[tuple[str, Logged]]:
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            for number, line in enumerate(file, 1):
                if line.strip() and not _is_torn(line):
                    yield f"{path}:{number}", _at(path, number, line)
    except OSError as error:
        raise DataError(
            f"log {path} cannot be read: {error.strerror}", hint="use a file of `candump -L`"
        ) from error


def _is_torn(line: str) -> bool:
    """Return whether a line is incomplete because the writing program was killed.

    An incomplete line has no end of line and contains no frame.
    """
    return not line.endswith("\n") and _LINE.fullmatch(line.strip()) is None


def _at(path: Path, number: int, line: str) -> Logged:
    try:
        return logged_in(line)
    except ValueError as error:
        raise DataError(
            f"{path}:{number}: {error}",
            hint="a line of `candump -L` has the form (1699999999.123456) can0 181#0123; "
            "remove the damaged line",
        ) from error


class CandumpWriter:
    """Writer of a log, closed by `close` or at the end of a `with` block.

    Args:
        path: Path of the log; an existing file is overwritten.
        channel: Name of the bus in the log.

    Raises:
        RecordingError: The log file cannot be created; `write` and `close` raise this error if they
            cannot write.
    """

    def __init__(self, path: str | os.PathLike[str], channel: str = "can0") -> None:
        if not channel or any(letter.isspace() for letter in channel):
            raise RecordingError(
                f"{channel!r} is not a valid channel of a log", hint="use a name without spaces"
            )
        self.path, self.channel = Path(path), channel
        try:
            self._file = self.path.open("w", encoding="ascii", errors="replace")
        except OSError as error:
            raise self._broken(error) from error

    def write(self, frame: Frame) -> None:
        """Append a frame to the log; the frame is written to the file at the latest by `close`."""
        try:
            self._file.write(line_of(frame, self.channel) + "\n")
        except OSError as error:
            raise self._broken(error) from error

    def close(self) -> None:
        """Write buffered frames and close the file. Idempotent."""
        try:
            self._file.close()
        except OSError as error:
            raise self._broken(error) from error

    def __enter__(self) -> CandumpWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _broken(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"log {self.path} cannot be written: {error.strerror}",
            hint="free disk space, or log to a different folder",
        )
