"""Host of a CAN bus between processes; each participant receives all frames of the others.

A hub has no thread: the process that hosts the bus calls `serve` whenever `fileno` is readable or
the time `due_s` is reached. All participants receive the frames in the same order. The hub reads
the frames of the participants immediately, so that no participant waits for another. The hub closes
the connection of a participant that does not read. All frames of a round for one participant are
sent in one burst, with one frame per packet. With a bit rate, the hub delays frames like a real bus
(`wire_model`).

`LocalEnd` is the host's connection to the bus, `Participants` contains the sockets of all other
participants, and `Peer` is the socket of one participant. A `Listener` owns the channel: a lock
file beside the socket names the host process. The socket of a dead hub is replaced. `hub_thread`
serves a hub in a thread, for tests and tools that do other work at the same time.
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
    """CAN bus between processes, hosted by this process.

    Args:
        channel: Name of the channel such as `can0`, or absolute path of its socket.
        bitrate: Bit rate of a model of the wire [bit/s], which includes transmission times and
            arbitration. In the model, if the transmit queue of a sender is full, the frame is
            dropped and the sender receives an error frame. With `None`, frames are passed on
            immediately.
        speed: Ratio of bus time to the time of the clock.
        clock: Function that returns the present time [s].

    Attributes:
        path: Path of the socket.
        local: Host's connection to the bus.
        wire: Model of the wire; `None` without a bit rate.

    Raises:
        PluginError: The channel is used by another host, or cannot be created.
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
        """Participants except the host, in the order in which they connected."""
        return self._all.ring

    @property
    def due_s(self) -> float | None:
        """Latest time of the next `serve` call, on the clock; `None` if no frame is pending."""
        return self.wire.due_s if self.wire else None

    def fileno(self) -> int:
        """Return a file descriptor that is readable when the hub needs a call of `serve`."""
        return self._all.fileno()

    def serve(self, timeout_s: float = 0.0) -> None:
        """Serve one round: accept connections, pass frames on, remove closed connections.

        Args:
            timeout_s: Longest wait for a frame or a connection [s].

        Raises:
            Exception: Any exception that the callback `heard` of the host's connection raises;
                frames of the round can be lost.
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
        """Send the frames queued so far in this round, before work that takes long."""
        self._all.flush()

    def bus_off(self, peer: Peer | None = None) -> None:
        """Put a participant off the bus, as if its controller had detected too many errors.

        Args:
            peer: Participant to put off the bus; `None` for all present participants. Participants
                that connect later are on the bus.
        """
        for each in self.peers if peer is None else (peer,):
            if not each.off:
                self._all.give(each, _OFF)
                each.off = True
                if self.wire and each in self.peers:
                    self.wire.forget(each)
        self._settle()

    def recover(self, peer: Peer | None = None) -> None:
        """Put a participant back on the bus; `None` for all participants."""
        for each in self.peers if peer is None else (peer,):
            if each.off:
                each.off = False
                self._all.give(each, _BACK)
        self._settle()

    def close(self) -> None:
        """Close all connections and release the channel. Idempotent."""
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
        self._accept()  # participants connected before these frames must receive them
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
        """Send queued frames at once, unless `serve` is running and sends them at its end."""
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
    """Return whether a frame is a data or remote frame, which participants are allowed to send."""
    can_id = int.from_bytes(raw[:4], "little")
    longest = ID_MASK if can_id & EXTENDED else 0x7FF
    return not can_id & ERROR and raw[4] <= 8 and can_id & ID_MASK <= longest


class LocalEnd:
    """Host's connection to the bus, which any number of nodes can use.

    Attributes:
        heard: Callback for every frame of the other participants, called while the hub serves.
        dropped: Number of frames dropped because the transmit queue was full; the frames with the
            highest identifiers are dropped.
    """

    def __init__(self, take: Callable[[LocalEnd, bytes], None]) -> None:
        self._take = take
        self.heard: Callable[[Frame], None] | None = None
        self.dropped = 0

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus; only the thread that serves the hub may call this.

        A frame passed to `send` within `heard` is sent with the other frames of the round, or by
        `Hub.flush`.
        """
        self._take(self, pack_frame(can_id, data))


_IN, _OUT = select.EPOLLIN, select.EPOLLOUT


class Participants:
    """Connected participants of a bus.

    Args:
        listener: Non-blocking socket that accepts connections.

    Attributes:
        ring: Participants in the order in which they connected. The tuple is replaced at each
            change.
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
        """Return a file descriptor that is readable when a socket of the bus needs service."""
        return self._epoll.fileno()

    def ready(self, timeout_s: float) -> list[Peer]:
        """Return participants with received data or a closed connection; also send waiting frames.

        Args:
            timeout_s: Longest wait [s].
        """
        if timeout_s > 0:  # `epoll` itself has a resolution of milliseconds
            select.select([self._epoll], [], [], timeout_s)
        events = [(self._peers.get(fd), event) for fd, event in self._epoll.poll(0)]
        for peer, event in events:
            if peer is not None and event & _OUT:
                self._flush(peer)
        return [peer for peer, event in events if peer is not None and event & ~_OUT]

    def accept(self) -> Peer | None:
        """Accept and return the next participant; `None` if no participant is waiting."""
        if not self._door.poll(0):  # takes a twentieth of the time of a failing accept()
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
        """Queue a frame for a participant, which the next `flush` sends."""
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
        """Send all queued frames that the sockets accept; the remaining frames are sent later."""
        for peer in self._given:
            if not peer.full and not peer.deaf:
                self._flush(peer)
        self._given.clear()

    def drop(self, peer: Peer) -> None:
        """Close the connection of a participant. Idempotent."""
        if self._peers.get(peer.fd) is not peer:
            return
        del self._peers[peer.fd]
        self.ring = tuple(other for other in self.ring if other is not peer)
        self._epoll.unregister(peer.fd)
        peer.deaf = True
        peer.socket.close()

    def close(self) -> None:
        """Close all connections. Idempotent."""
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
        """Stop sending to a participant, but read its frames until the end of the connection."""
        peer.deaf, peer.full = True, False
        peer.waiting.clear()
        self._epoll.modify(peer.fd, _IN)
        with contextlib.suppress(OSError):
            peer.socket.shutdown(socket.SHUT_RDWR)


BATCH = 32
"""Maximum number of frames received from a participant before the next participant."""

MOST_WAITING = 65_536
"""Maximum number of frames that wait for a participant before its connection is closed."""

_UCRED = struct.Struct("3i")


class Peer:
    """Participant of a bus.

    Args:
        connection: Socket of the participant.

    Attributes:
        socket: Socket of the participant.
        fd: File descriptor of the socket.
        pid: Process id of the participant.
        off: Whether the participant is off the bus, so that no frame passes to or from the
            participant.
        deaf: Whether the connection is closed, or the hub no longer sends to the participant;
            frames received before remain valid.
        waiting: Frames for the participant that its socket has not yet accepted.
        full: Whether the socket did not accept all frames for the participant.
        dropped: Number of the participant's frames that did not fit into its transmit queue.
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
        """Return at most `BATCH` received frames, and whether the participant has disconnected."""
        try:
            return self._catch.take(self.socket), False
        except OSError:
            return [], True

    def flush(self) -> None:
        """Send the waiting frames that the socket accepts; set `full` if frames remain.

        Raises:
            OSError: The participant has disconnected.
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
    """Owner of a channel, which locks the channel and accepts connections.

    Args:
        path: Path of the channel's socket, from `hil.can.channels.socket_path`.

    Attributes:
        path: Path of the socket.
        socket: Non-blocking listening socket.

    Raises:
        PluginError: Another process hosts the channel, or the socket cannot be created.
    """

    def __init__(self, path: Path) -> None:
        private_folder(path)
        self.path = path
        self._held = _held_by_us(path)
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            _clear(path)
            self.socket.bind(str(path))
            path.chmod(0o600)  # before listen(), so that no other user can connect
            self.socket.listen(_BACKLOG)
        except OSError as error:
            self.close()
            raise _unusable(path, error) from error
        except BaseException:
            self.close()
            raise
        self.socket.setblocking(False)

    def close(self) -> None:
        """Close the socket and release the channel. Idempotent."""
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
        f"channel {path} is in use: {held} hosts it",
        hint="connect to that bus, end its host, or choose another channel",
    )


def _clear(path: Path) -> None:
    """Remove the socket of a dead hub; only the owner of the channel's lock may call this."""
    if path.is_socket():
        path.unlink()
    elif os.path.lexists(path):
        raise PluginError(
            f"channel {path}: the path exists and is not a socket",
            hint="choose another channel, or move the file away",
        )


def _unusable(path: Path, error: OSError) -> PluginError:
    return PluginError(
        f"channel {path} cannot be hosted: {error.strerror or error}",
        hint="choose a folder with write permission",
    )


_ROUND_S = 0.02
_PATIENCE_S = 10.0


@contextmanager
def hub_thread(
    channel: str | os.PathLike[str], *, bitrate: float | None = None, speed: float = 1.0
) -> Iterator[HostedHub]:
    """Host a bus while the `with` block runs; arguments and exceptions are those of `Hub`."""
    hosted = HostedHub(Hub(channel, bitrate=bitrate, speed=speed))
    try:
        yield hosted
    finally:
        hosted.close()


class HostedHub:
    """Hub that is served by a separate thread.

    Args:
        hub: Hub that the thread serves and that no other code must use.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._calls: queue.SimpleQueue[tuple[Callable[[Hub], Any], Future[Any]]]
        self._calls = queue.SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="hil-can-hub", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """Path of the socket, which participants pass as the channel."""
        return self._hub.path

    def ask(self, action: Callable[[Hub], Any]) -> Any:
        """Execute an action with the hub between two rounds; return or raise the action's result.

        Raises:
            TimeoutError: The thread does not serve the hub any more.
        """
        done: Future[Any] = Future()
        self._calls.put((action, done))
        return done.result(_PATIENCE_S)

    def close(self) -> None:
        """End the thread and close the bus. Idempotent."""
        self._ended.set()
        self._thread.join()
        self._hub.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            while not self._calls.empty():
                self._answer(*self._calls.get())
            self._hub.serve(_ROUND_S)

    def _answer(self, action: Callable[[Hub], Any], done: Future[Any]) -> None:
        try:
            done.set_result(action(self._hub))
        except Exception as error:
            done.set_exception(error)
