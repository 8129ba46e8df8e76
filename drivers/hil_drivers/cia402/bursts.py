"""All frames of a cycle to and from a port: by one call of the kernel where it is a socket."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from hil.can import MOST, Burst, Catch
from hil_drivers.cia402.ports import AGAIN_S, FramePort, SocketPort, send_within

Sending = Callable[[float], bool]


def sending(port: FramePort, frames: Sequence[bytearray | memoryview]) -> Sending:
    """What puts these frames on the bus as they then are; False when there was no room for all.

    It is told until when (`time.monotonic`) it may try again with what there was no room for.

    Args:
        port: To the bus.
        frames: Of 16 bytes each, writable; they stay where they are.
    """
    if isinstance(port, SocketPort):
        return _burst(port, frames)
    views = [memoryview(frame) for frame in frames]

    def one_by_one(until_s: float) -> bool:
        went = [send_within(port, view, until_s) for view in views]
        return all(went)

    return one_by_one


def receiving(port: FramePort) -> Callable[[], Sequence[bytes]]:
    """What gives frames that have come, at most `MOST`, without waiting."""
    if isinstance(port, SocketPort):
        return _catch(port)
    receive = port.receive

    def one_by_one() -> Sequence[bytes]:
        frames: list[bytes] = []
        while len(frames) < MOST and (raw := receive(0.0)) is not None:
            frames.append(raw)
        return frames

    return one_by_one


def _burst(port: SocketPort, frames: Sequence[bytearray | memoryview]) -> Sending:
    send, line, number = Burst(frames).send, port.line, len(frames)

    def at_once(until_s: float) -> bool:
        try:
            sent = send(line)
            while sent < number and time.monotonic() < until_s:
                time.sleep(AGAIN_S)
                sent += send(line, after=sent)
        except OSError as error:
            raise port.gone(error.strerror or str(error)) from error
        return sent == number

    return at_once


def _catch(port: SocketPort) -> Callable[[], Sequence[bytes]]:
    take, line = Catch().take, port.line

    def at_once() -> Sequence[bytes]:
        try:
            return take(line)
        except OSError as error:
            why = error.strerror or "its host has ended, or frames were not taken fast enough"
            raise port.gone(why) from error

    return at_once
