"""One end of a stream of frames between `hil` and a driver's process."""

from __future__ import annotations

import socket
import time

from hil.core import RobotConnectionError, RobotTimeout
from hil.robot.frames import MAGIC, MOST_BODY, MOST_HEADER, PREFIX, Message, garbage, unpack

_CHUNK = 1 << 18


class EndOfLine(RobotConnectionError):
    """The other side is gone."""


class Line:
    """One end of a stream of frames. Not for several threads at once.

    Args:
        end: Connected stream socket; the line owns it.

    Attributes:
        torn: Half a frame was left behind, or no frame came: the line is of no use any more.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._buffer = bytearray()
        self.torn = False

    def send(self, frame: bytes, timeout_s: float | None = None) -> None:
        """Send a packed frame.

        Raises:
            EndOfLine: Nobody is there.
            RobotTimeout: The other side does not take it; the line is of no use after that.
        """
        self._require_whole()
        # Torn until it is sent: whatever interrupts this leaves half a frame behind.
        self.torn = True
        try:
            self._end.settimeout(timeout_s)
            self._end.sendall(frame)
        except TimeoutError as error:
            raise RobotTimeout(
                f"the driver's process has not taken a message within {timeout_s:g} s",
                hint="it is overloaded or hangs: stop the robot, then begin anew",
            ) from error
        except OSError as error:
            self.torn = False  # nobody is there to be out of step with
            raise EndOfLine(f"the line is cut: {error}") from error
        self.torn = False

    def receive(self, timeout_s: float | None = None) -> Message:
        """The next frame; a time-out loses nothing.

        Raises:
            EndOfLine: Nobody is there.
            RobotTimeout: It has not come in time.
            RobotConnectionError: What came is no frame; the line is of no use after that.
        """
        self._require_whole()
        until = None if timeout_s is None else time.monotonic() + timeout_s
        self._fill(PREFIX.size, until)
        magic, head, body = PREFIX.unpack_from(self._buffer)
        if magic != MAGIC or head > MOST_HEADER or body > MOST_BODY:
            self.torn = True
            raise garbage(repr(bytes(self._buffer[:40])))
        begin, end = PREFIX.size + head, PREFIX.size + head + body
        self._fill(end, until)
        text, raw = bytes(self._buffer[PREFIX.size : begin]), self._buffer[begin:end]
        del self._buffer[:end]
        return unpack(text, raw)

    def close(self) -> None:
        """The other side sees the end; so does a thread that receives on this one."""
        self._end.close()

    def cut(self) -> None:
        """Let whoever receives on this end see the end of the line; from any thread."""
        try:
            self._end.shutdown(socket.SHUT_RDWR)
        except OSError:  # cut already, from either side
            return

    def _fill(self, size: int, until: float | None) -> None:
        while len(self._buffer) < size:
            left = None if until is None else until - time.monotonic()
            try:
                self._end.settimeout(left if left is None else max(left, 1e-6))
                piece = self._end.recv(_CHUNK)
            except TimeoutError as error:
                raise RobotTimeout(
                    "the driver's process does not answer",
                    hint="the driver hangs: see that the robot is at rest, then begin anew",
                ) from error
            except OSError as error:
                raise EndOfLine(f"the line is cut: {error}") from error
            if not piece:
                raise EndOfLine("the line has ended")
            self._buffer += piece

    def _require_whole(self) -> None:
        if self.torn:
            raise RobotConnectionError(
                "the line to the driver's process is out of step", hint="close the robot"
            )
