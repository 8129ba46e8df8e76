"""Hosts a CAN bus between processes: who connects gets all frames but its own, in one order.

Single-threaded: its host calls `serve` whenever `fileno` is readable or `due_s` has come. It takes
what participants send at once, so none is held up by another; who does not read is hung up on.
What a round has for a participant goes to it in one burst, still one frame a packet.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from types import TracebackType

from hil.can.frame import (
    ERROR,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    EXTENDED,
    ID_MASK,
    TX_OVERFLOW,
    Frame,
    pack_frame,
    unpack_frame,
)
from hil.can.listening import Listener
from hil.can.participants import Participants
from hil.can.paths import socket_path
from hil.can.peers import Peer
from hil.can.wire_model import Wire

_OFF = pack_frame(ERROR | ERROR_BUS_OFF, bytes(8))
_BACK = pack_frame(ERROR | ERROR_RESTARTED, bytes(8))
_OVERFLOW = pack_frame(ERROR | ERROR_CONTROLLER, bytes([0, TX_OVERFLOW, 0, 0, 0, 0, 0, 0]))


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
    """Data and remote frames that can be; nobody sends the errors of others' controllers."""
    can_id = int.from_bytes(raw[:4], "little")
    longest = ID_MASK if can_id & EXTENDED else 0x7FF
    return not can_id & ERROR and raw[4] <= 8 and can_id & ID_MASK <= longest
