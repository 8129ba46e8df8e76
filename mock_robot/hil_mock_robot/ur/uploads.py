"""What arrives on the ports that take URScript."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Protocol

from hil_mock_robot.ur.machine import Machine


class Inbox(Protocol):
    """Collects bytes until there is a program, and lets it play."""

    def feed(self, data: bytes) -> None:
        """Some bytes came, cut anywhere."""


class _Nothing:
    def feed(self, data: bytes) -> None:
        """Nobody understands URScript yet."""


def inbox_of(machine: Machine) -> Inbox:
    """An inbox for one connection."""
    name = "hil_mock_robot.ur.inbox"
    if find_spec(name) is None:
        return _Nothing()
    inbox: Inbox = import_module(name).ScriptInbox(machine)
    return inbox
