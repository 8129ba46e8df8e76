"""Many frames with one call of the kernel: what a cycle sends, what it gets.

A frame a call costs more than everything else in a cycle. Linux takes and gives any number at once
(sendmmsg, recvmmsg), on SocketCAN and on a bus between processes; elsewhere it is one by one.
"""

from __future__ import annotations

import ctypes
import os
import socket
import sys
from collections.abc import Callable, Sequence

from hil.canbus.frame import FRAME
from hil_drivers.cia402.ports import FULL, FramePort, SocketPort

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


def _kernel_call(name: str) -> Callable[..., int] | None:
    """A call that never waits, so it does not let go of the interpreter either."""
    if sys.platform != "linux":
        return None
    call = getattr(ctypes.PyDLL(None, use_errno=True), name, None)
    if call is None:
        return None
    messages = ctypes.POINTER(_Message)
    call.argtypes = [ctypes.c_int, messages, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
    if name == "sendmmsg":
        call.argtypes = call.argtypes[:-1]
    call.restype = ctypes.c_int
    return call  # type: ignore[no-any-return]


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

    def one() -> Sequence[bytes]:
        raw = receive(0.0)
        return () if raw is None else (raw,)

    return one


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

    def send(self) -> bool:
        sent = self._call(self._port.line.fileno(), self._messages, self._number, _NOW)
        if sent < 0 and (code := ctypes.get_errno()) not in FULL:
            raise self._port.gone(os.strerror(code))
        return sent == self._number


class _Catch:
    def __init__(self, port: SocketPort, call: Callable[..., int]) -> None:
        self._port, self._call = port, call
        self._memory = bytearray(_SIZE * MOST)
        self._held = (ctypes.c_char * len(self._memory)).from_buffer(self._memory)
        first = ctypes.addressof(self._held)
        self._messages, self._vectors = _messages([first + _SIZE * at for at in range(MOST)])

    def take(self) -> Sequence[bytes]:
        number = self._call(self._port.line.fileno(), self._messages, MOST, _NOW, None)
        if number <= 0:
            if number < 0 and (code := ctypes.get_errno()) not in FULL:
                raise self._port.gone(os.strerror(code))
            return ()
        if not self._messages[number - 1].length:
            number = self._before_the_end(number)
        memory = bytes(self._memory[: _SIZE * number])
        return [memory[at : at + _SIZE] for at in range(0, len(memory), _SIZE)]

    def _before_the_end(self, number: int) -> int:
        """A packet without bytes is the end of the bus: what came before it still counts."""
        lengths = [self._messages[at].length for at in range(number)]
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
