"""RTDE, port 30004: clients choose what they are told every tick, and what they may write."""

from __future__ import annotations

from collections import Counter

from hil_mock_robot.ur.contracts import Link
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.ownership import Ownership
from hil_mock_robot.ur.rtde_session import RtdeSession
from hil_mock_robot.ur.wire import Level


class RtdeService:
    """Listens for RTDE clients.

    Args:
        machine: Whose values they get.

    Attributes:
        owners: Who has which input.
        sessions: Clients that are connected.
        dropped: Reason → how many packages of all clients were dropped for it.
    """

    port = 30004

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.owners = Ownership()
        self.sessions: list[RtdeSession] = []
        self.dropped: Counter[str] = Counter()

    def accept(self, link: Link) -> RtdeSession:
        """See `Service`."""
        session = RtdeSession(self, self.machine.line.over(link))
        self.sessions.append(session)
        return session

    def say(self, level: Level, source: str, text: str) -> int:
        """Tell every client that has started something in words; returns how many were told."""
        return sum(session.say(level, source, text) for session in self.sessions)
