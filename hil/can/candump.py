"""Logs of a bus as `candump -L` writes them: one line of text a frame, read by all CAN tools.

`(1699999999.123456) can0 181#37060000C80A`: Unix time [s], channel, identifier and data in hex.
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
    """A line of a log.

    Attributes:
        frame: With its time.
        channel: On which it was seen.
    """

    frame: Frame
    channel: str


def line_of(frame: Frame, channel: str) -> str:
    """A frame as a line, without the end of it."""
    flags, can_id = frame.id & ~ID_MASK, frame.id & ID_MASK
    if flags & ERROR:
        name = f"{can_id | ERROR:08X}"
    else:
        name = f"{can_id:08X}" if flags & EXTENDED else f"{can_id:03X}"
    told = f"R{len(frame.data) or ''}" if flags & REMOTE else frame.data.hex().upper()
    return f"({frame.time_s:.6f}) {channel} {name}#{told}"


def logged_in(line: str) -> Logged:
    """The frame in a line.

    Raises:
        ValueError: It is none, or a frame that is not classic CAN.
    """
    match = _LINE.fullmatch(line.strip())
    if match is None:
        raise ValueError("a CAN FD frame" if "##" in line else f"no frame: {line.strip()[:60]!r}")
    can_id = _identifier(match["id"])
    if match["data"] is None:
        can_id, data = can_id | REMOTE, bytes(int(match["length"] or 0))
    else:
        data = bytes.fromhex(match["data"])
    return Logged(Frame(can_id, data, float(match["time"])), match["channel"])


def _identifier(told: str) -> int:
    can_id = int(told, 16)
    if len(told) == 3 or (can_id & ERROR and not can_id & (EXTENDED | REMOTE)):
        return can_id
    if can_id & ~ID_MASK:
        raise ValueError(f"no identifier: {told}")
    return can_id | EXTENDED


def read_candump(path: str | os.PathLike[str], channel: str | None = None) -> Iterator[Frame]:
    """All frames of a log, in its order.

    Args:
        path: Of the log; empty lines are passed over, and a last one that was cut short.
        channel: Only what was on it; `None` for a log of one channel.

    Raises:
        DataError: The log cannot be read, a line is damaged, or there are several channels and none
            was asked for; the message names file and line.
    """
    only = channel
    for where, logged in _logged(Path(path)):
        if channel is None:
            only = only or logged.channel
            if logged.channel != only:
                raise DataError(
                    f"{where}: channel {logged.channel}, and {only} before it",
                    hint="name the channel to read",
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
            f"log {path} cannot be read: {error.strerror}", hint="give a file of `candump -L`"
        ) from error


def _is_torn(line: str) -> bool:
    """Whether it is what a program that was killed leaves: no line's end, and no frame."""
    return not line.endswith("\n") and _LINE.fullmatch(line.strip()) is None


def _at(path: Path, number: int, line: str) -> Logged:
    try:
        return logged_in(line)
    except ValueError as error:
        raise DataError(
            f"{path}:{number}: {error}",
            hint="a line of `candump -L` reads (1699999999.123456) can0 181#0123; "
            "remove the damaged one",
        ) from error


class CandumpWriter:
    """Writes a log; used with `with`, or closed by `close`.

    Args:
        path: What is there is replaced.
        channel: How to call the bus in it.

    Raises:
        RecordingError: The file cannot be made; `write` and `close` raise it as well.
    """

    def __init__(self, path: str | os.PathLike[str], channel: str = "can0") -> None:
        if not channel or any(letter.isspace() for letter in channel):
            raise RecordingError(
                f"{channel!r} cannot be the channel of a log", hint="use a name without spaces"
            )
        self.path, self.channel = Path(path), channel
        try:
            self._file = self.path.open("w", encoding="ascii", errors="replace")
        except OSError as error:
            raise self._broken(error) from error

    def write(self, frame: Frame) -> None:
        """Append a frame; it is on the disk after `close` at the latest."""
        try:
            self._file.write(line_of(frame, self.channel) + "\n")
        except OSError as error:
            raise self._broken(error) from error

    def close(self) -> None:
        """Write what is still in memory. Idempotent."""
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
            hint="free space there, or log somewhere else",
        )
