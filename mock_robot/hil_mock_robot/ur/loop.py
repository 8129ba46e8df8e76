"""One thread for everything: sockets are served between ticks, so nothing needs a lock."""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Iterable
from typing import Protocol

from hil_mock_robot.ur.contracts import Service
from hil_mock_robot.ur.conversations import Conversations
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.side import SideService
from hil_mock_robot.ur.sockets import listen
from hil_mock_robot.ur.troubles import Troubles
from hil_mock_robot.ur.witness import Witness

DEAF_S = 10.0
"""Wall time a client that is sent everything may leave it unread; it is hung up on then."""

LONGEST_WAIT_S = 0.5


class Pacer(Protocol):
    """Says when the next tick is due."""

    @property
    def patient(self) -> bool:
        """Whether time waits for clients that must not lose anything; the wall clock does not."""

    def wait_s(self) -> float | None:
        """Wall time until the next tick: 0 when it is due, None as long as nothing permits it."""

    def ticked(self) -> None:
        """A tick was made."""


class Loop:
    """Serves a machine's ports and lets its time pass.

    Args:
        machine: The controller.
        services: What listens.
        pacer: When ticks are due.
        address: Loopback address to listen on.
        troubles: What is wrong, for those who want that.
        witness: Writes down what happens.
        side: Not part of the controller: it is served whatever is wrong.

    Raises:
        PluginError: A port is taken.
    """

    def __init__(
        self,
        machine: Machine,
        services: Iterable[Service],
        pacer: Pacer,
        address: str,
        *,
        troubles: Troubles | None = None,
        witness: Witness | None = None,
        side: SideService | None = None,
    ) -> None:
        self._machine, self._pacer, self._address = machine, pacer, address
        self._services, self._side = list(services), side
        self._troubles, self._witness = troubles or Troubles(machine), witness
        self._listening: dict[socket.socket, Service] = {}
        self._talks = Conversations(machine.mishaps, witness)
        self.sessions = self._talks.sessions
        self._ending = self._dark = False
        self._suffered: tuple[bool, frozenset[int], bool] = (False, frozenset(), False)
        self._woken, self._waker = socket.socketpair()
        self._open([*([side] if side is not None else []), *self._services])

    def run(self) -> None:
        """Until `end`."""
        try:
            while not self._ending:
                self.turn()
        finally:
            self.close()

    def end(self) -> None:
        """Let `run` return; may be called by a signal handler."""
        self._ending = True
        with contextlib.suppress(OSError):
            self._waker.send(b"x")

    def close(self) -> None:
        """Hang up on everybody."""
        for each in [*self._listening, *self.sessions, self._woken, self._waker]:
            each.close()
        if self._witness is not None:
            self._witness.close()

    def turn(self) -> None:
        """Serve what has come, and tick when that is due."""
        self._suffer()
        held = self._held()
        wait = None if held else self._pacer.wait_s()
        self._serve(LONGEST_WAIT_S if wait is None else min(wait, LONGEST_WAIT_S))
        wait = self._pacer.wait_s()
        if not held and wait is not None and wait <= 0:
            self._tick()

    def _tick(self) -> None:
        self._troubles.tick()
        self._suffer()
        if not self._dark:
            self._machine.tick()
        self._pacer.ticked()
        self._talks.ticked()
        if self._witness is not None:
            self._witness.ticked()
        if self._side is not None:
            self._side.ticked()

    def _suffer(self) -> None:
        """Do to the ports what the troubles do to them."""
        troubles = self._troubles
        now = (troubles.unplugged, troubles.mute, troubles.dark)
        if now == self._suffered:
            return
        self._suffered = now
        for link, _ in self.sessions.values():
            link.blocked = self._unheard(link.port)
        if troubles.dark and not self._dark:
            self._shut()
        elif self._dark and not troubles.dark:
            self._open(self._services)
        self._dark = troubles.dark

    def _unheard(self, port: int) -> bool:
        if self._side is not None and port == self._side.port:
            return False
        return self._troubles.unplugged or port in self._troubles.mute

    def _open(self, services: Iterable[Service]) -> None:
        # RTDE last of the controller's: whoever finds it open finds the others open, too.
        for service in reversed(list(services)):
            self._listening[listen(self._address, service.port)] = service

    def _shut(self) -> None:
        """Close every port of the controller, and all connections to it."""
        for each in [s for s, service in self._listening.items() if service is not self._side]:
            del self._listening[each]
            each.close()
        for link, _ in self.sessions.values():
            if self._side is None or link.port != self._side.port:
                link.close()
        self._talks.forget_closed()

    def _held(self) -> bool:
        """Whether time waits for a client; one that does not read at all is hung up on."""
        held = False
        for link, session in self.sessions.values():
            if not session.lossless or not link.pending:
                continue
            if link.deaf_s > DEAF_S:
                link.close()
            held = held or not link.blocked
        return held and self._pacer.patient

    def _serve(self, wait_s: float) -> None:
        self._talks.forget_closed()
        heard = [s for s, (link, _) in self.sessions.items() if not link.blocked]
        ports = [s for s, service in self._listening.items() if not self._unheard(service.port)]
        waiting = [s for s in heard if self.sessions[s][0].pending]
        everybody = [*ports, *heard, self._woken]
        readable, writable, _ = select.select(everybody, waiting, [], max(0.0, wait_s))
        for each in writable:
            self.sessions[each][0].flush()
        for each in readable:
            if each in self._listening:
                self._talks.accept(each, self._listening[each])
            elif each in self.sessions:
                self._talks.receive(each)
        self._talks.forget_closed()
