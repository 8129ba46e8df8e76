"""Faults on request: when they begin, what they do to the PLC, when they are over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hil_mock_robot.plant.records import EMERGENCY_STOP, FAULTS
from hil_mock_robot.server.faults import Schedule
from hil_mock_robot.twincat.ads import CONFIG, RUN, Links, PlcHandler
from hil_mock_robot.twincat.faults import COUNTED, Fault
from hil_mock_robot.twincat.program import PlcProgram

DRIVE_FAULT = 0x8611
"""CiA 402's following error, as good as any."""

LASTING = ("drive_fault", "emergency_stop")
"""Faults that nobody can reset while they last."""


class Troubles:
    """Does to the PLC what is asked for.

    Args:
        program, handler, links: What suffers.
        faults: What is to happen, and when.
        cycle_s: Of the PLC's task [s].

    Attributes:
        frozen: Whether the PLC's task stands still, while ADS answers.
    """

    def __init__(
        self,
        program: PlcProgram,
        handler: PlcHandler,
        links: Links,
        faults: Sequence[Fault],
        cycle_s: float,
    ) -> None:
        self._program, self._handler, self._links = program, handler, links
        self._schedule: Schedule[Fault] = Schedule(faults, cycle_s, COUNTED)
        self.frozen = False

    def add(self, fault: Fault) -> None:
        """One more, now or when it says."""
        if self._schedule.add(fault):
            self._strike(fault)
        self._suffer()

    def clear(self) -> None:
        """What lasts is over."""
        self._schedule.clear()
        self._suffer()

    def happened(self, event: str, details: Mapping[str, Any]) -> None:
        """The program tells something."""
        if event == "start" and details["by"] == "start":
            self._schedule.began("motion")

    def turn(self, cycles: int) -> None:
        """Let cycles pass, and what begins or is over with them."""
        if self._schedule.idle:
            self._schedule.ticks += cycles
            return
        begun, _ = self._schedule.turn(cycles)
        for fault in begun:
            self._strike(fault)
        self._suffer()

    def _strike(self, fault: Fault) -> None:
        program = self._program
        if fault.kind == "drive_fault":
            code = fault.code or DRIVE_FAULT
            program.fail(code, f"drive fault {code:#06x}")
        elif fault.kind == "emergency_stop":
            program.fail(EMERGENCY_STOP, FAULTS[EMERGENCY_STOP])
        elif fault.kind == "restart":
            program.restart()
        elif fault.kind == "refuse":
            program.commands.refuse = fault.code or 1
        elif fault.kind == "online_change":
            self._handler.memory.online_change()
        elif fault.kind == "cut":
            self._links.cut()

    def _suffer(self) -> None:
        lasting = {fault.kind for fault in self._schedule.lasting}
        self.frozen = "freeze" in lasting or "config" in lasting
        self._handler.spoils = "spoil" in lasting
        self._handler.loses_stops = "lose_stops" in lasting
        self._links.silent = "silence" in lasting
        self._handler.state = CONFIG if "config" in lasting else RUN
        self._program.commands.cause_lasts = not lasting.isdisjoint(LASTING)
        if "cut" not in lasting:
            self._links.listen()
