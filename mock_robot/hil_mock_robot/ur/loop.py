"""The loop of the mock controller: one thread, sockets are served between ticks, no locks.

`Loop` has the ports, `Conversations` the connections (`TcpLink`) and their sessions. `RealTime`,
`FreeRun` and `LockStep` say when the next tick is due: with the wall clock, as fast as it goes, or
when a client permits it.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from hil.core import PluginError
from hil_mock_robot.server import loop
from hil_mock_robot.server.loop import Mishaps
from hil_mock_robot.ur.contracts import Service, Session
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.machine import Machine

if TYPE_CHECKING:
    from hil_mock_robot.ur.journal import Witness
    from hil_mock_robot.ur.side import SideService

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


class Loop(loop.Loop):
    """Serves a machine's ports and lets its time pass.

    Args:
        machine: The controller.
        services: What listens.
        pacer: When ticks are due.
        address: Loopback address to listen on.
        faults: What goes wrong, for those who want that.
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
        faults: UrFaults | None = None,
        witness: Witness | None = None,
        side: SideService | None = None,
    ) -> None:
        super().__init__()
        self._machine, self._pacer, self._address = machine, pacer, address
        self._services, self._side = list(services), side
        self._faults, self._witness = faults or UrFaults(machine), witness
        self._listening: dict[socket.socket, Service] = {}
        self._talks = Conversations(machine.mishaps, witness)
        self.sessions = self._talks.sessions
        self._dark = False
        self._suffered: tuple[bool, frozenset[int], bool] = (False, frozenset(), False)
        self._open([*([side] if side is not None else []), *self._services])

    def leave(self) -> None:
        """Hang up on everybody."""
        for each in [*self._listening, *self.sessions]:
            each.close()
        if self._witness is not None:
            self._witness.close(set_points=self._witness.sent)

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
        self._faults.tick()
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
        """Do to the ports what the faults do to them."""
        struck = self._faults.mock
        now = (struck.unplugged, struck.mute, struck.dark)
        if now == self._suffered:
            return
        self._suffered = now
        for link, _ in self.sessions.values():
            link.blocked = self._unheard(link.port)
        if struck.dark and not self._dark:
            self._shut()
        elif self._dark and not struck.dark:
            self._open(self._services)
        self._dark = struck.dark

    def _unheard(self, port: int) -> bool:
        if self._side is not None and port == self._side.port:
            return False
        return self._faults.mock.unplugged or port in self._faults.mock.mute

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
        everybody = [*ports, *heard, self.woken]
        readable, writable, _ = select.select(everybody, waiting, [], max(0.0, wait_s))
        for each in writable:
            self.sessions[each][0].flush()
        for each in readable:
            if each in self._listening:
                self._talks.accept(each, self._listening[each])
            elif each in self.sessions:
                self._talks.receive(each)
        self._talks.forget_closed()


READ_BYTES = 65_536
MOST_SESSIONS = 200


class Conversations:
    """Connections and their sessions; one that we cannot cope with is hung up on.

    Args:
        mishaps: Who hears of that.
        witness: Writes down who comes, goes and says what.

    Attributes:
        sessions: Socket → its link and session.
    """

    def __init__(self, mishaps: Mishaps, witness: Witness | None) -> None:
        self._mishaps, self._witness = mishaps, witness
        self.sessions: dict[socket.socket, tuple[TcpLink, Session]] = {}

    def accept(self, listening: socket.socket, service: Service) -> None:
        """Somebody has connected."""
        with contextlib.suppress(OSError):
            connection, (peer, *_) = listening.accept()
            if len(self.sessions) >= MOST_SESSIONS:
                connection.close()
                return
            self._welcome(service, TcpLink(connection, peer, service.port))

    def receive(self, connection: socket.socket) -> None:
        """Something has come, or the client has hung up."""
        link, session = self.sessions[connection]
        try:
            data = connection.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            link.close()
            return
        try:
            if self._witness is not None:
                self._witness.received(link, data)
            session.received(data)
        except Exception as error:
            self._give_up(link, error)

    def ticked(self) -> None:
        """The controller has made a tick."""
        for link, session in list(self.sessions.values()):
            try:
                session.ticked()
            except Exception as error:
                self._give_up(link, error)

    def forget_closed(self) -> None:
        """Part with those who are not connected any more."""
        for connection in [s for s, (link, _) in self.sessions.items() if link.closed]:
            link, session = self.sessions.pop(connection)
            try:
                session.hung_up()
            except Exception as error:
                self._give_up(link, error)
            if self._witness is not None:
                self._witness.disconnected(link)

    def _welcome(self, service: Service, link: TcpLink) -> None:
        if self._witness is not None:
            self._witness.connected(link)
        try:
            self.sessions[link.socket] = (link, service.accept(link))
        except Exception as error:
            self._give_up(link, error)
            if self._witness is not None:
                self._witness.disconnected(link)

    def _give_up(self, link: TcpLink, error: Exception) -> None:
        """A mistake of ours: this client has to do without us, the others do not."""
        link.close()
        self._mishaps.met(error, f"a connection to port {link.port}")


MOST_PENDING = 4_000_000
"""Bytes that wait for a client that does not read; the connection is closed beyond that."""

RTDE_PORT = 30004
"""Every mock has it, whatever else it listens on."""


class TcpLink:
    """A non-blocking socket with a buffer; implements `Link`.

    Args:
        connection: The socket.
        peer: Address of the client.
        port: On which it came in.

    Attributes:
        blocked: Whether nothing gets through; it is kept meanwhile.
    """

    def __init__(self, connection: socket.socket, peer: str, port: int = 0) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket, self.peer, self.port = connection, peer, port
        self.blocked = False
        self.closed = False
        self._waiting = bytearray()
        self._read_at = time.monotonic()

    @property
    def pending(self) -> int:
        """Bytes that wait for the client to read."""
        return len(self._waiting)

    @property
    def deaf_s(self) -> float:
        """Wall time for which the client has taken nothing of what waits."""
        return time.monotonic() - self._read_at if self._waiting else 0.0

    def send(self, data: bytes) -> None:
        """Send, or keep what the client does not take yet."""
        if self.closed:
            return
        if not self._waiting:
            self._read_at = time.monotonic()
        self._waiting += data
        self.flush()
        if len(self._waiting) > MOST_PENDING:
            self.close()

    def flush(self) -> None:
        """Hand over what waits, as far as the client takes it."""
        if not self._waiting or self.closed or self.blocked:
            return
        try:
            sent = self.socket.send(self._waiting)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        del self._waiting[:sent]
        self._read_at = time.monotonic()

    def close(self) -> None:
        """Hang up."""
        if not self.closed:
            self.closed = True
            self.socket.close()


def listen(address: str, port: int) -> socket.socket:
    """An open port.

    Raises:
        PluginError: It is taken.
    """
    try:
        listening = _bound(address, port)
    except OSError as error:
        raise PluginError(
            f"cannot listen on {address}:{port}: {error.strerror}", hint=_elsewhere(port)
        ) from error
    listening.listen()
    listening.setblocking(False)
    return listening


def _bound(address: str, port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((address, port))
    except OSError:
        bound.close()
        raise
    return bound


def _elsewhere(port: int) -> str:
    for last in range(2, 255):
        try:
            for each in {port, RTDE_PORT}:
                _bound(f"127.0.0.{last}", each).close()
        except OSError:
            continue
        return (
            "another mock or simulator runs there: end it, or use an address that is free, "
            f"--address 127.0.0.{last}, also in the station"
        )
    return "another mock or simulator runs there: end it"


SLIP_S = 0.05
"""Wall time the schedule may be late before it is given up; what was missed is not caught up.

Catching up lets device time race: half a second late at ten times the speed were five seconds that
pass at once, in which no client can kick a watchdog or lead an arm.
"""

CLOSEST = 0.5
"""Share of the time between ticks that passes at least after each. A tick that is late is caught up
at twice the pace, not at once: some clients, such as UR's own without `--buffered`, drop all but
the newest of the packages that they find waiting."""

OVER_S = 10.0
"""Wall time over which the pace is averaged [s]."""

ALARMING = 0.95
"""Below this share of the requested pace clients may run into time-outs: the operator is warned."""

WARN_EVERY_S = 60.0
"""Wall time between two such warnings [s]."""


@dataclass(frozen=True, slots=True)
class Slip:
    """Wall time that the schedule has just given up, because the computer was too slow for it.

    Attributes:
        behind_s: How much, this time [s].
        total_s: How much since the start [s].
        pace: Device time passed over device time requested, over the last `OVER_S`.
    """

    behind_s: float
    total_s: float
    pace: float


class RealTime:
    """Ticks on an absolute schedule, so that lateness does not add up.

    Args:
        tick_s: Device time of a tick.
        factor: Device seconds per second of wall time.

    Attributes:
        patient: Accelerated time waits for clients; real time does not.
        behind_s: Wall time given up since the start [s].
        listeners: Called at each slip.
    """

    def __init__(self, tick_s: float, factor: float = 1.0) -> None:
        self._tick_s = tick_s
        self._due = self._not_before = time.monotonic()
        self._slips: deque[tuple[float, float]] = deque()
        self.behind_s = 0.0
        self.listeners: list[Callable[[Slip], object]] = []
        self.change(factor)

    @property
    def pace(self) -> float:
        """Device time passed over device time requested, over the last `OVER_S`; 1 keeps up."""
        now = time.monotonic()
        while self._slips and self._slips[0][0] < now - OVER_S:
            self._slips.popleft()
        lost_s = sum(behind for _, behind in self._slips)
        return max(0.0, 1.0 - lost_s / OVER_S)

    def change(self, factor: float) -> None:
        """Go on at another speed."""
        self._spacing_s = self._tick_s / factor
        self.patient = factor > 1.0

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return max(0.0, max(self._due, self._not_before) - time.monotonic())

    def ticked(self) -> None:
        """See `Pacer`."""
        self._due += self._spacing_s
        now = time.monotonic()
        self._not_before = now + CLOSEST * self._spacing_s
        if now - self._due > SLIP_S:
            self._slip(now)

    def _slip(self, now: float) -> None:
        behind, self._due = now - self._due, now
        self.behind_s += behind
        self._slips.append((now, behind))
        slip = Slip(behind, self.behind_s, self.pace)
        for listener in self.listeners:
            listener(slip)


class SlipWarning:
    """Warns the operator of a computer that is too slow, at most once a minute.

    Args:
        say: Prints one line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._next = time.monotonic()

    def slipped(self, slip: Slip) -> None:
        """Print a line if the pace is alarming and the last line is long enough ago."""
        now = time.monotonic()
        if slip.pace >= ALARMING or now < self._next:
            return
        self._next = now + WARN_EVERY_S
        self._say(
            f"behind the wall clock: device time passes at {slip.pace:.0%} of its pace, "
            f"{slip.total_s:.1f} s were given up since the start. This computer is too busy: "
            "time-outs of clients are then not protocol errors; close other programs, or use "
            "--speed 0.5"
        )


class FreeRun:
    """As fast as it goes; clients that must not lose anything hold it up."""

    patient = True

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return 0.0

    def ticked(self) -> None:
        """See `Pacer`."""


class LockStep:
    """No tick without a permit: results do not depend on how busy the computer is.

    Attributes:
        permitted: Ticks that may still be made.
    """

    patient = True

    def __init__(self) -> None:
        self.permitted = 0

    def allow(self, ticks: int) -> None:
        """Let so many more ticks pass."""
        self.permitted += ticks

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return 0.0 if self.permitted > 0 else None

    def ticked(self) -> None:
        """See `Pacer`."""
        self.permitted -= 1
