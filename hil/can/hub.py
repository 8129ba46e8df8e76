"""Hosts a CAN bus between processes: who connects gets all frames but its own, in one order.

A hub is single-threaded: its host calls `serve` whenever `fileno` is readable or `due_s` has come.
It takes what participants send at once, so none is held up by another, and hangs up on who does not
read. What a round has for a participant goes to it in one burst, still one frame a packet. With a
bit rate, frames pass when a wire would have passed them (`wire_model`).

`LocalEnd` is the host's own end, `Participants` are the sockets of all others, watched together,
and `Peer` is one of them. A `Listener` holds the channel: a lock beside its socket says who hosts
it, and the socket that a dead hub has left is replaced. `hub_thread` serves a hub in a thread, for
tests and tools that host a bus beside their work.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

from hil.can.bursts import MOST, Burst, Catch
from hil.can.channels import private_folder, socket_path
from hil.can.frames import (
    ERROR,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    EXTENDED,
    FRAME,
    ID_MASK,
    TX_OVERFLOW,
    Frame,
    pack_frame,
    unpack_frame,
)
from hil.can.wire_model import Wire
from hil.core import LockFile, PluginError, hold

_OFF = pack_frame(ERROR | ERROR_BUS_OFF, bytes(8))
_BACK = pack_frame(ERROR | ERROR_RESTARTED, bytes(8))
_OVERFLOW = pack_frame(ERROR | ERROR_CONTROLLER, bytes([0, TX_OVERFLOW, 0, 0, 0, 0, 0, 0]))


class Hub:
    """A bus.

    Args:
        channel: A name such as `can0`, or the absolute path of its socket.
        bitrate: Model the wire: what it takes to send a frame, and who may send first [bit/s].
            A frame that finds the transmit queue of its sender full is dropped, and the sender gets
            an error frame. `None`: frames pass at once.
        speed: Seconds of the bus in one second of the clock.
        clock: [s].

    Attributes:
        path: Of the socket.
        local: The host's own end.
        wire: The model of the wire, `None` without one.

    Raises:
        PluginError: The channel is taken, or cannot be made.
    """

    def __init__(
        self,
        channel: str | os.PathLike[str],
        *,
        bitrate: float | None = None,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.local = LocalEnd(self._put)
        self._serving = False
        self._clock = clock
        self.wire = None if bitrate is None else Wire(bitrate, speed=speed)
        if self.wire:
            self.wire.join(self.local, sorts=True)
        self._listener = Listener(socket_path(channel))
        self.path = self._listener.path
        self._all = Participants(self._listener.socket)

    @property
    def peers(self) -> tuple[Peer, ...]:
        """All participants but the host, in the order in which they came."""
        return self._all.ring

    @property
    def due_s(self) -> float | None:
        """When to serve at the latest, by the clock; `None` when nothing is due."""
        return self.wire.due_s if self.wire else None

    def fileno(self) -> int:
        """Readable when there is something to serve."""
        return self._all.fileno()

    def serve(self, timeout_s: float = 0.0) -> None:
        """One round: newcomers, frames, those who are gone.

        Args:
            timeout_s: Wait so long for something to do.

        Raises:
            Exception: What `heard` of the host's end raises; frames of that round may be lost.
        """
        due_s = self.due_s
        if due_s is not None:
            timeout_s = min(timeout_s, due_s - self._clock())
        ready = self._all.ready(timeout_s)
        self._accept()
        self._serving = True
        try:
            for peer in ready:
                self._attend(peer)
            if self.wire:
                for end, raw, _ in self.wire.passed(self._clock()):
                    self._pass_on(end, raw)
        finally:
            self._serving = False
            self._all.flush()

    def flush(self) -> None:
        """Let participants have what this round has brought so far: the rest of it takes long."""
        self._all.flush()

    def bus_off(self, peer: Peer | None = None) -> None:
        """Put a participant off the bus, as if its controller had seen too many errors.

        Args:
            peer: Which one, `None` for all there are; new connections are on the bus.
        """
        for each in self.peers if peer is None else (peer,):
            if not each.off:
                self._all.give(each, _OFF)
                each.off = True
                if self.wire and each in self.peers:
                    self.wire.forget(each)
        self._settle()

    def recover(self, peer: Peer | None = None) -> None:
        """Let it back on the bus, `None` for all."""
        for each in self.peers if peer is None else (peer,):
            if each.off:
                each.off = False
                self._all.give(each, _BACK)
        self._settle()

    def close(self) -> None:
        """Hang up on everybody and let go of the channel. Idempotent."""
        self._all.close()
        self._listener.close()

    def __enter__(self) -> Hub:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _accept(self) -> None:
        while (peer := self._all.accept()) is not None:
            if self.wire:
                self.wire.join(peer)

    def _attend(self, peer: Peer) -> None:
        frames, gone = peer.batch()
        self._accept()  # who was connected when these were sent is to get them
        if gone:
            self._all.drop(peer)
        for raw in frames:
            if not peer.off and _is_sendable(raw):
                self._take(peer, raw)
        if gone and self.wire:
            self.wire.leave(peer)

    def _put(self, end: LocalEnd, raw: bytes) -> None:
        self._take(end, raw)
        self._settle()

    def _settle(self) -> None:
        """Outside of a round nothing is waited for."""
        if not self._serving:
            self._all.flush()

    def _take(self, end: Peer | LocalEnd, raw: bytes) -> None:
        if self.wire is None:
            self._pass_on(end, raw)
        elif not self.wire.offer(end, raw, self._clock()):
            end.dropped += 1
            if isinstance(end, Peer):
                self._all.give(end, _OVERFLOW)

    def _pass_on(self, sender: object, raw: bytes) -> None:
        for peer in self._all.ring:
            if peer is not sender:
                self._all.give(peer, raw)
        if sender is not self.local and self.local.heard is not None:
            self.local.heard(unpack_frame(raw, time.time()))


def _is_sendable(raw: bytes) -> bool:
    """Data and remote frames that can be; no end sends the errors of others' controllers."""
    can_id = int.from_bytes(raw[:4], "little")
    longest = ID_MASK if can_id & EXTENDED else 0x7FF
    return not can_id & ERROR and raw[4] <= 8 and can_id & ID_MASK <= longest


class LocalEnd:
    """The host's own end of the bus, behind which as many nodes may be as it likes.

    Attributes:
        heard: Called with every frame that others send, while the hub serves.
        dropped: Frames for which the transmit queue had no room; those of the highest identifiers.
    """

    def __init__(self, take: Callable[[LocalEnd, bytes], None]) -> None:
        self._take = take
        self.heard: Callable[[Frame], None] | None = None
        self.dropped = 0

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus; who serves the hub may call it.

        From within `heard` it goes with all else of that round, or with `Hub.flush`.
        """
        self._take(self, pack_frame(can_id, data))


_IN, _OUT = select.EPOLLIN, select.EPOLLOUT


class Participants:
    """Those who are connected.

    Args:
        listener: Where newcomers connect; non-blocking.

    Attributes:
        ring: They, in the order in which they came; replaced, never changed.
    """

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._peers: dict[int, Peer] = {}
        self._given: dict[Peer, None] = {}
        self.ring: tuple[Peer, ...] = ()
        self._door = select.poll()
        self._door.register(listener.fileno(), select.POLLIN)
        self._epoll = select.epoll()
        self._epoll.register(listener.fileno(), _IN)

    def fileno(self) -> int:
        """Readable when one of them, or a newcomer, wants something."""
        return self._epoll.fileno()

    def ready(self, timeout_s: float) -> list[Peer]:
        """Who has something to be read, or has gone; what waited for others is sent on the way.

        Args:
            timeout_s: Wait so long for it.
        """
        if timeout_s > 0:  # `epoll` itself counts in milliseconds
            select.select([self._epoll], [], [], timeout_s)
        events = [(self._peers.get(fd), event) for fd, event in self._epoll.poll(0)]
        for peer, event in events:
            if peer is not None and event & _OUT:
                self._flush(peer)
        return [peer for peer, event in events if peer is not None and event & ~_OUT]

    def accept(self) -> Peer | None:
        """The next newcomer, `None` when there is none."""
        if not self._door.poll(0):  # a twentieth of what a failing accept() costs
            return None
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return None
        peer = Peer(connection)
        self._peers[peer.fd] = peer
        self.ring = (*self.ring, peer)
        self._epoll.register(peer.fd, _IN)
        return peer

    def give(self, peer: Peer, raw: bytes) -> None:
        """Let one of them have a frame, with the next `flush`."""
        if peer.off or peer.deaf:
            return
        if len(peer.waiting) >= MOST_WAITING:
            self._flush(peer)
            if len(peer.waiting) >= MOST_WAITING:
                self._give_up(peer)
                return
        peer.waiting.append(raw)
        self._given[peer] = None

    def flush(self) -> None:
        """Send all that was given, as far as sockets take it; the rest when they do."""
        for peer in self._given:
            if not peer.full and not peer.deaf:
                self._flush(peer)
        self._given.clear()

    def drop(self, peer: Peer) -> None:
        """Hang up on one of them. Idempotent."""
        if self._peers.get(peer.fd) is not peer:
            return
        del self._peers[peer.fd]
        self.ring = tuple(other for other in self.ring if other is not peer)
        self._epoll.unregister(peer.fd)
        peer.deaf = True
        peer.socket.close()

    def close(self) -> None:
        """Hang up on all. Idempotent."""
        for peer in self.ring:
            self.drop(peer)
        self._epoll.close()

    def _flush(self, peer: Peer) -> None:
        was_full = peer.full
        try:
            peer.flush()
        except OSError:
            self._give_up(peer)
        if peer.full != was_full:
            self._epoll.modify(peer.fd, _IN | _OUT if peer.full else _IN)

    def _give_up(self, peer: Peer) -> None:
        """It gets no more; what it has sent is read up to its end, which is seen there."""
        peer.deaf, peer.full = True, False
        peer.waiting.clear()
        self._epoll.modify(peer.fd, _IN)
        with contextlib.suppress(OSError):
            peer.socket.shutdown(socket.SHUT_RDWR)


BATCH = 32
"""Frames taken from one participant before the others have their turn."""

MOST_WAITING = 65_536
"""Frames that wait for one who does not read; it is hung up on beyond that."""

_UCRED = struct.Struct("3i")


class Peer:
    """A participant.

    Args:
        connection: To it.

    Attributes:
        socket, fd: To it.
        pid: Of its process.
        off: It is off the bus: nothing passes to or from it.
        deaf: It has gone, or was given up; what it has sent before still counts.
        waiting: Frames for it that are not in its socket yet.
        full: Its socket had no room for all of them.
        dropped: Frames it wanted to send and its transmit queue had no room for.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.socket, self.fd = connection, connection.fileno()
        self.pid = _pid_of(connection)
        self.off = self.deaf = self.full = False
        self.waiting: deque[bytes] = deque()
        self.dropped = 0
        self._catch = Catch(BATCH)
        self._memory = bytearray(MOST * FRAME.size)
        view = memoryview(self._memory)
        self._burst = Burst([view[at : at + FRAME.size] for at in range(0, len(view), FRAME.size)])

    def batch(self) -> tuple[list[bytes], bool]:
        """The next frames it has sent, at most `BATCH`; or that it has gone, and sent no more."""
        try:
            return self._catch.take(self.socket), False
        except OSError:
            return [], True

    def flush(self) -> None:
        """Send what waits, as far as its socket has room; `full` says whether some is left.

        Raises:
            OSError: It has hung up.
        """
        waiting, burst, memory = self.waiting, self._burst, self._memory
        self.full = False
        while waiting and not self.full:
            frames = b"".join(islice(waiting, MOST))
            memory[: len(frames)] = frames
            wanted = len(frames) // FRAME.size
            sent = burst.send(self.socket, wanted)
            self.full = sent < wanted
            for _ in range(sent):
                waiting.popleft()


def _pid_of(connection: socket.socket) -> int:
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size)
    pid: int = _UCRED.unpack(raw)[0]
    return pid


_BACKLOG = 16


class Listener:
    """Holds a channel and listens at it.

    Args:
        path: Of the socket; see `hil.can.channels.socket_path`.

    Attributes:
        path: The same.
        socket: Non-blocking.

    Raises:
        PluginError: Another process hosts the channel, or the socket cannot be made.
    """

    def __init__(self, path: Path) -> None:
        private_folder(path)
        self.path = path
        self._held = _held_by_us(path)
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            _clear(path)
            self.socket.bind(str(path))
            path.chmod(0o600)  # before it listens: no other user gets in between
            self.socket.listen(_BACKLOG)
        except OSError as error:
            self.close()
            raise _unusable(path, error) from error
        except BaseException:
            self.close()
            raise
        self.socket.setblocking(False)

    def close(self) -> None:
        """Let go of the channel. Idempotent."""
        if self.socket.fileno() >= 0:
            self.socket.close()
            with contextlib.suppress(OSError):
                if self.path.is_socket():
                    self.path.unlink()
        self._held.release()


def _held_by_us(path: Path) -> LockFile:
    lock = path.with_name(path.name + ".lock")
    try:
        held = hold(lock, {"channel": str(path)})
    except OSError as error:
        raise _unusable(path, error) from error
    if isinstance(held, LockFile):
        return held
    raise PluginError(
        f"channel {path} is taken: {held} hosts it",
        hint="connect to that bus, end its host, or choose another channel",
    )


def _clear(path: Path) -> None:
    """Remove the socket of a hub that died, as the holder of the lock knows."""
    if path.is_socket():
        path.unlink()
    elif os.path.lexists(path):
        raise PluginError(
            f"channel {path}: there is something that is no socket",
            hint="choose another channel, or move that away",
        )


def _unusable(path: Path, error: OSError) -> PluginError:
    return PluginError(
        f"channel {path} cannot be hosted: {error.strerror or error}",
        hint="choose a folder that you may write to",
    )


_ROUND_S = 0.02
_PATIENCE_S = 10.0


@contextmanager
def hub_thread(
    channel: str | os.PathLike[str], *, bitrate: float | None = None, speed: float = 1.0
) -> Iterator[HostedHub]:
    """Host a bus while the block runs; arguments and errors of `Hub`."""
    hosted = HostedHub(Hub(channel, bitrate=bitrate, speed=speed))
    try:
        yield hosted
    finally:
        hosted.close()


class HostedHub:
    """A hub that a thread serves.

    Args:
        hub: Which; nothing else may touch it.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._asked: queue.SimpleQueue[tuple[Callable[[Hub], Any], Future[Any]]]
        self._asked = queue.SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="hil-can-hub", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """Of its socket: the channel for those who connect."""
        return self._hub.path

    def ask(self, action: Callable[[Hub], Any]) -> Any:
        """Do something with the hub between two rounds; waits, and returns or raises what it does.

        Raises:
            TimeoutError: The thread does not serve any more.
        """
        done: Future[Any] = Future()
        self._asked.put((action, done))
        return done.result(_PATIENCE_S)

    def close(self) -> None:
        """End the thread and the bus. Idempotent."""
        self._ended.set()
        self._thread.join()
        self._hub.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            while not self._asked.empty():
                self._answer(*self._asked.get())
            self._hub.serve(_ROUND_S)

    def _answer(self, action: Callable[[Hub], Any], done: Future[Any]) -> None:
        try:
            done.set_result(action(self._hub))
        except Exception as error:
            done.set_exception(error)
