"""Many frames with one call of the kernel: what a cycle sends, what it gets.

A frame a call costs more than everything else in a cycle. Linux takes and gives any number at once
(sendmmsg, recvmmsg), on SocketCAN and on a bus between processes; elsewhere it is one by one.
"""

from __future__ import annotations

import ctypes
import socket
import sys
from collections.abc import Callable, Sequence

from hil.canbus.frame import FRAME
from hil_drivers.cia402.ports import FramePort, SocketPort

MOST = 64
"""Frames taken at once."""

_NOW = socket.MSG_DONTWAIT
_SIZE = FRAME.size


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


def sending(port: FramePort, frames: Sequence[bytearray | memoryview]) -> Callable[[], bool]:
    """What puts these frames on the bus as they then are; False when there was no room for all.

    Args:
        port: To the bus.
        frames: Of 16 bytes each, writable; they stay where they are.
    """
    if isinstance(port, SocketPort) and _send_many is not None:
        return _Burst(port, frames, _send_many).send
    send, views = port.send, [memoryview(frame) for frame in frames]

    def one_by_one() -> bool:
        went = [send(view) for view in views]
        return all(went)

    return one_by_one


def receiving(port: FramePort) -> Callable[[], Sequence[bytes]]:
    """What gives frames that have come, at most `MOST`, without waiting."""
    if isinstance(port, SocketPort) and _receive_many is not None:
        return _Catch(port, _receive_many).take
    receive = port.receive

    def one_by_one() -> Sequence[bytes]:
        frames: list[bytes] = []
        while len(frames) < MOST and (raw := receive(0.0)) is not None:
            frames.append(raw)
        return frames

    return one_by_one


class _Burst:
    def __init__(
        self,
        port: SocketPort,
        frames: Sequence[bytearray | memoryview],
        call: Callable[..., int],
    ) -> None:
        self._port, self._call, self._number = port, call, len(frames)
        self._memory = [(ctypes.c_char * _SIZE).from_buffer(frame) for frame in frames]
        self._messages, self._vectors = _messages([ctypes.addressof(m) for m in self._memory])
        self._at = ctypes.c_void_p(ctypes.addressof(self._messages))

    def send(self) -> bool:
        sent = self._call(self._port.line.fileno(), self._at, self._number, _NOW)
        if sent < 0:
            return self._port.send(bytes(self._memory[0])) and False  # says why not
        return sent == self._number


class _Catch:
    def __init__(self, port: SocketPort, call: Callable[..., int]) -> None:
        self._port, self._call = port, call
        self._memory = bytearray(_SIZE * MOST)
        self._held = (ctypes.c_char * len(self._memory)).from_buffer(self._memory)
        first = ctypes.addressof(self._held)
        self._messages, self._vectors = _messages([first + _SIZE * at for at in range(MOST)])
        self._at = ctypes.c_void_p(ctypes.addressof(self._messages))
        self._view = memoryview(self._memory)
        self._lengths = memoryview(self._messages).cast("B").cast("I")[_LENGTH_AT::_STRIDE]

    def take(self) -> Sequence[bytes]:
        number = self._call(self._port.line.fileno(), self._at, MOST, _NOW, None)
        if number < 0:  # there is none, or whoever receives one says what is wrong
            raw = self._port.receive(0.0)
            return () if raw is None else (raw,)
        if not self._lengths[number - 1]:
            number = self._before_the_end(number)
        memory = bytes(self._view[: _SIZE * number])
        return [memory[at : at + _SIZE] for at in range(0, len(memory), _SIZE)]

    def _before_the_end(self, number: int) -> int:
        """A packet without bytes is the end of the bus: what came before it still counts."""
        lengths = self._lengths[:number].tolist()
        if not lengths[0]:
            raise self._port.gone("its host has ended, or frames were not taken fast enough")
        return lengths.index(0)


def _messages(addresses: Sequence[int]) -> tuple[ctypes.Array[_Message], ctypes.Array[_Vector]]:
    """One message per address; the second array must live as long as the first."""
    vectors = (_Vector * len(addresses))(*[_Vector(address, _SIZE) for address in addresses])
    messages = (_Message * len(addresses))()
    for at, message in enumerate(messages):
        message.header.vectors = ctypes.pointer(vectors[at])
        message.header.vector_count = 1
    return messages, vectors
