"""Many frames with one call of the kernel, over a socket with one frame a packet.

A frame a call costs more than everything else in a cycle. Linux takes and gives any number at once
(sendmmsg, recvmmsg), on SocketCAN and on a bus between processes; elsewhere it is one by one.
"""

from __future__ import annotations

import ctypes
import errno
import socket
import sys
from collections.abc import Callable, Iterable, Sequence

from hil.can.frames import FRAME

MOST = 64
"""Frames taken at once."""

FULL = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})
"""No room in the transmit queue: what AF_UNIX and SocketCAN say."""

_NOW = socket.MSG_DONTWAIT
_SIZE = FRAME.size
_ROOM = _SIZE + 1
"""Bytes for a packet: one that is longer than a frame shows."""


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """What `sendmsg(2)` calls msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_Vector)),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """What `sendmmsg(2)` calls mmsghdr."""

    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


_LENGTH_AT = _Message.length.offset // 4
_STRIDE = ctypes.sizeof(_Message) // 4
"""Of the lengths among all the numbers of messages, each of four bytes."""


def _kernel_call(name: str) -> Callable[..., int] | None:
    """A call that never waits, so it does not let go of the interpreter either.

    Types of arguments are not declared: checking them costs more than the rest of the call, when
    milliseconds have passed since the last one and nothing is cached any more.
    """
    if sys.platform != "linux":
        return None
    return getattr(ctypes.PyDLL(None), name, None)


_send_many, _receive_many = _kernel_call("sendmmsg"), _kernel_call("recvmmsg")


class Burst:
    """Frames that are sent as they then lie in memory.

    Args:
        frames: Of 16 bytes each, writable; they stay where they are.
    """

    def __init__(self, frames: Sequence[bytearray | memoryview]) -> None:
        self._call, self._number = _send_many, len(frames)
        self._memory = [(ctypes.c_char * _SIZE).from_buffer(frame) for frame in frames]
        self._messages, self._vectors = _messages(map(ctypes.addressof, self._memory), _SIZE)
        self._at = ctypes.c_void_p(ctypes.addressof(self._messages))

    def send(self, line: socket.socket, number: int | None = None, *, after: int = 0) -> int:
        """Put the first `number` of them (all when None) on the line; how many it had room for.

        Args:
            line: To the bus.
            number: See above.
            after: So many of them went before, and do not again.

        Raises:
            OSError: The line is gone; nothing was sent.
        """
        wanted = self._number if number is None else number
        if self._call is not None:
            at = self._at
            if after:
                at = ctypes.c_void_p(ctypes.addressof(self._messages[after]))
            sent = self._call(line.fileno(), at, wanted - after, _NOW)
            if sent >= 0:
                return sent
        return self._one_by_one(line, self._memory[after:wanted])  # says why none was

    def _one_by_one(
        self, line: socket.socket, frames: Sequence[ctypes.Array[ctypes.c_char]]
    ) -> int:
        for at, frame in enumerate(frames):
            try:
                line.send(frame, _NOW)
            except OSError as error:
                if at or error.errno in FULL:  # what is wrong is said with the next
                    return at
                raise
        return len(frames)


class Catch:
    """Takes what has come.

    Args:
        most: Frames taken at once.
    """

    def __init__(self, most: int = MOST) -> None:
        self._call, self._most = _receive_many, most
        self._memory = bytearray(_ROOM * most)
        self._held = (ctypes.c_char * len(self._memory)).from_buffer(self._memory)
        first = ctypes.addressof(self._held)
        self._messages, self._vectors = _messages(range(first, first + _ROOM * most, _ROOM), _ROOM)
        self._at = ctypes.c_void_p(ctypes.addressof(self._messages))
        self._view = memoryview(self._memory)
        self._lengths = memoryview(self._messages).cast("B").cast("I")[_LENGTH_AT::_STRIDE]
        self._wrong: ConnectionError | None = None

    def take(self, line: socket.socket) -> list[bytes]:
        """Frames that are there, without waiting, at most as many as this was made for.

        Raises:
            OSError: The line is gone, or carries no frames; those before were given before.
        """
        if self._wrong is not None:
            raise self._wrong
        number = -1
        if self._call is not None:
            number = self._call(line.fileno(), self._at, self._most, _NOW, None)
        if number < 0:  # there is none, or receiving one says what is wrong
            return self._one_by_one(line)
        lengths = self._lengths[:number].tolist()
        if lengths.count(_SIZE) != number:
            number = self._before_wrong(lengths)
        memory = bytes(self._view[: _ROOM * number])
        return [memory[at : at + _SIZE] for at in range(0, len(memory), _ROOM)]

    def _one_by_one(self, line: socket.socket) -> list[bytes]:
        frames: list[bytes] = []
        while len(frames) < self._most:
            try:
                raw = _received(line)
            except BlockingIOError:
                break
            frames.append(raw)
            if len(raw) != _SIZE:
                return frames[: self._before_wrong([len(each) for each in frames])]
        return frames

    def _before_wrong(self, lengths: list[int]) -> int:
        """How many frames came before a packet that is none; raises if there were none."""
        at = next(at for at, length in enumerate(lengths) if length != _SIZE)
        self._wrong = ConnectionError(
            f"sent {lengths[at]} bytes or more, no frame" if lengths[at] else "hung up"
        )
        if not at:
            raise self._wrong
        return at


def _received(line: socket.socket) -> bytes:
    try:
        return line.recv(_ROOM, _NOW)
    except ConnectionResetError:  # said once, and before the frames that were sent
        return line.recv(_ROOM, _NOW)


def _messages(
    addresses: Iterable[int], length: int
) -> tuple[ctypes.Array[_Message], ctypes.Array[_Vector]]:
    """One message per address; the second array must live as long as the first."""
    each = [_Vector(address, length) for address in addresses]
    vectors = (_Vector * len(each))(*each)
    messages = (_Message * len(each))()
    for at, message in enumerate(messages):
        message.header.vectors = ctypes.pointer(vectors[at])
        message.header.vector_count = 1
    return messages, vectors
