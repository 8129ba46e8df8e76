"""Transfer of many CAN frames with one system call, over a socket with one frame per packet.

If every frame needed a system call, these calls would take longer than the rest of a cycle. Linux
sends or receives any number of frames in one system call (sendmmsg, recvmmsg), on SocketCAN and on
a bus between processes. On other systems the frames are transferred one by one.
"""

from __future__ import annotations

import ctypes
import errno
import socket
import sys
from collections.abc import Callable, Iterable, Sequence

from hil.can.frames import FRAME

MOST = 64
"""Maximum number of frames received in one call."""

FULL = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})
"""Values of `errno` for a full transmit queue, on AF_UNIX and on SocketCAN."""

_NOW = socket.MSG_DONTWAIT
_SIZE = FRAME.size
_ROOM = _SIZE + 1
"""Buffer size for a packet [bytes]: one byte more than a frame, to detect longer packets."""


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """C structure `msghdr` of the system call `sendmsg`."""

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
    """C structure `mmsghdr` of the system call `sendmmsg`."""

    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


_LENGTH_AT = _Message.length.offset // 4
_STRIDE = ctypes.sizeof(_Message) // 4
"""Distance between the length fields of two messages in an array, in units of four bytes."""


def _kernel_call(name: str) -> Callable[..., int] | None:
    """Return a non-blocking C function that is called without releasing the interpreter lock.

    The argument types are not declared: if the last call was milliseconds ago and the caches are
    cold, the check of the types takes longer than the rest of the call.
    """
    if sys.platform != "linux":
        return None
    return getattr(ctypes.PyDLL(None), name, None)


_send_many, _receive_many = _kernel_call("sendmmsg"), _kernel_call("recvmmsg")


class Burst:
    """Sender of frames in fixed memory, with the contents that they have at the time of sending.

    Args:
        frames: Writable buffers of 16 bytes, one per frame, that must keep their place in memory.
    """

    def __init__(self, frames: Sequence[bytearray | memoryview]) -> None:
        self._call, self._number = _send_many, len(frames)
        self._memory = [(ctypes.c_char * _SIZE).from_buffer(frame) for frame in frames]
        self._messages, self._vectors = _messages(map(ctypes.addressof, self._memory), _SIZE)
        self._at = ctypes.c_void_p(ctypes.addressof(self._messages))

    def send(self, line: socket.socket, number: int | None = None, *, after: int = 0) -> int:
        """Send the first `number` frames; return how many the transmit queue accepted.

        Args:
            line: Socket of the bus.
            number: Number of frames to send; None for all frames.
            after: Number of frames at the beginning that were sent before and are skipped.

        Raises:
            OSError: The socket is closed; no frame was sent.
        """
        wanted = self._number if number is None else number
        if self._call is not None:
            at = self._at
            if after:
                at = ctypes.c_void_p(ctypes.addressof(self._messages[after]))
            sent = self._call(line.fileno(), at, wanted - after, _NOW)
            if sent >= 0:
                return sent
        return self._one_by_one(line, self._memory[after:wanted])  # raises the reason

    def _one_by_one(
        self, line: socket.socket, frames: Sequence[ctypes.Array[ctypes.c_char]]
    ) -> int:
        for at, frame in enumerate(frames):
            try:
                line.send(frame, _NOW)
            except OSError as error:
                if at or error.errno in FULL:  # the next call raises the error
                    return at
                raise
        return len(frames)


class Catch:
    """Receiver of all frames that wait in a socket.

    Args:
        most: Maximum number of frames received in one call.
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
        """Return at most `most` received frames without blocking.

        Raises:
            OSError: The socket is closed, or a packet is not a frame; frames before that packet
                were returned by earlier calls.
        """
        if self._wrong is not None:
            raise self._wrong
        number = -1
        if self._call is not None:
            number = self._call(line.fileno(), self._at, self._most, _NOW, None)
        if number < 0:  # no frame, or an error that the next call raises
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
        """Return the number of frames before an invalid packet; raise if no frame precedes it."""
        at = next(at for at, length in enumerate(lengths) if length != _SIZE)
        self._wrong = ConnectionError(
            f"a packet of at least {lengths[at]} bytes is not a frame"
            if lengths[at]
            else "the other end closed the connection"
        )
        if not at:
            raise self._wrong
        return at


def _received(line: socket.socket) -> bytes:
    try:
        return line.recv(_ROOM, _NOW)
    except ConnectionResetError:  # reported once, before the frames that were sent earlier
        return line.recv(_ROOM, _NOW)


def _messages(
    addresses: Iterable[int], length: int
) -> tuple[ctypes.Array[_Message], ctypes.Array[_Vector]]:
    """Return an array with one message per address, and an array that must live as long."""
    each = [_Vector(address, length) for address in addresses]
    vectors = (_Vector * len(each))(*each)
    messages = (_Message * len(each))()
    for at, message in enumerate(messages):
        message.header.vectors = ctypes.pointer(vectors[at])
        message.header.vector_count = 1
    return messages, vectors
