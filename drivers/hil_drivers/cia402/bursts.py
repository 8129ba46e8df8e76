"""All frames of a cycle to and from a port: by one call of the kernel where it is a socket."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hil.canbus.bursts import MOST, Burst, Catch
from hil_drivers.cia402.ports import FramePort, SocketPort


def sending(port: FramePort, frames: Sequence[bytearray | memoryview]) -> Callable[[], bool]:
    """What puts these frames on the bus as they then are; False when there was no room for all.

    Args:
        port: To the bus.
        frames: Of 16 bytes each, writable; they stay where they are.
    """
    if isinstance(port, SocketPort):
        return _burst(port, frames)
    send, views = port.send, [memoryview(frame) for frame in frames]

    def one_by_one() -> bool:
        went = [send(view) for view in views]
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


def _burst(port: SocketPort, frames: Sequence[bytearray | memoryview]) -> Callable[[], bool]:
    send, line, number = Burst(frames).send, port.line, len(frames)

    def at_once() -> bool:
        try:
            return send(line) == number
        except OSError as error:
            raise port.gone(error.strerror or str(error)) from error

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
