"""What the controller listens on."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from hil_mock_robot.ur.contracts import Service
from hil_mock_robot.ur.machine import Machine

_SERVICES: tuple[tuple[str, str, tuple[Any, ...]], ...] = (
    ("rtde", "RtdeService", ()),
    ("dashboard", "DashboardService", ()),
    ("primary", "PrimaryService", (30001,)),
    ("primary", "PrimaryService", (30002,)),
    ("realtime", "RealtimeService", ()),
)


def services_of(machine: Machine) -> list[Service]:
    """Every port of a UR controller."""
    found = []
    for module, kind, more in _SERVICES:
        name = f"hil_mock_robot.ur.{module}"
        if find_spec(name) is not None:
            found.append(getattr(import_module(name), kind)(machine, *more))
    return found
