"""Asking the person at the robot."""

from __future__ import annotations

import select
import sys
from collections.abc import Callable

WAIT_S = 0.05


def ask_operator(text: str, meanwhile: Callable[[], object]) -> str:
    """Ask on the console; the engine's `Prompt`.

    Args:
        text: What is to be done and confirmed.
        meanwhile: Called while waiting; keeps the robot's state flowing, raises on a stop.

    Returns:
        `operator` for a yes, nothing for anything else or when there is no console to ask on.
    """
    if not (sys.stdin and sys.stdin.isatty()):
        return ""
    sys.stderr.write(f"\n{text}\nType yes when done: ")
    sys.stderr.flush()
    while not select.select([sys.stdin], [], [], WAIT_S)[0]:
        meanwhile()
    answer = sys.stdin.readline().strip().lower()
    return "operator" if answer in ("y", "yes") else ""


def mock_mounts(text: str, meanwhile: Callable[[], object]) -> str:
    """A robot on a virtual clock is a mock: it mounts the declared load when it is told to."""
    return "mock"
