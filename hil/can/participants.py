"""All participants of a bus between processes: their sockets, watched together."""

from __future__ import annotations

import contextlib
import select
import socket

from hil.can import peers
from hil.can.peers import Peer

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
        if not self._door.poll(0):  # a twentieth of what it costs to be told that nobody is there
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
        if len(peer.waiting) >= peers.MOST_WAITING:
            self._flush(peer)
            if len(peer.waiting) >= peers.MOST_WAITING:
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
